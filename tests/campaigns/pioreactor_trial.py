"""A deployment at the rig that something happens to: real client processes, the vendor's own software, our vials."""

from __future__ import annotations

import csv
import json
import math
import os
import subprocess
import time
import urllib.request
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from hardware.pioreactor.config import RigConfig
from hardware.pioreactor.versions import facts
from hardware.rig.processes import Rig
from hardware.rig.vials import Pulse
from hardware.storage.journal import read_journal
from tests.campaigns.client import Client

__all__ = ["FAULTED", "MEDIA_PIN", "SETPOINT", "WASTE_PIN", "WELL", "Seen", "Trial", "log_rows"]

FAULTED, WELL = "pio01", "pio02"
MEDIA_PIN, WASTE_PIN = 13, 12
SETPOINT = 0.5  # OD
WELL_ML = 14.0
NEAR_OD = 0.03
START_S, END_S = 90.0, 60.0  # real seconds for a client to dose, and to end


@dataclass(frozen=True)
class Seen:
    """What is left of a trial.

    journal: its rows. rows: of each recording, as (minute, OD). pulses: runs of pumps. vials: of each unit, what was
    in it once a second. told: the clients' output. status: of the last client. speed: device seconds per real second.
    """

    journal: Sequence[Mapping[str, Any]]
    rows: Mapping[str, Sequence[tuple[float, float]]]
    pulses: Sequence[Pulse]
    vials: Mapping[str, Sequence[Mapping[str, Any]]]
    told: str
    status: int | None
    speed: float


class Trial:
    """A rig of a sick and a well unit, and the client that runs both; use as a context manager.

    Args: folder: of the trial, must exist. speed: growth faster than real time. seed: of the vials. package: of the
      vendor's software. stopping: whether nothing is to be waited for any more.
    Attributes: known, of the software's version.
    Raises: DeviceStateError if the rig does not start.
    """

    def __init__(self, folder: Path, speed: float, seed: int, package: str, stopping: Callable[[], bool]) -> None:
        self.stopping = stopping
        self.folder, self.run, self.speed = folder, folder / "run", speed
        vials = RigConfig(package=package, od=SETPOINT, seed=seed)
        self.rig = Rig({FAULTED: 20.0, WELL: WELL_ML}, vials, speed, folder)
        self.known = facts(self.rig.version)
        self.client: Client | None = None
        self.lives = 0
        self.words: list[str] = []  # further ones of the command line

    # -- the program -----------------------------------------------------------------------------------------------

    def start(self) -> None:
        """The client, the first or, by `resume=`, the next."""
        words = [f"resume={self.run}"] if self.lives else self._command(self.run)
        self.client = Client(words, self.folder / "client.log")
        self.lives += 1

    def second(self) -> str:
        """Another client for the same units beside the first; what it said when it ended."""
        Client(self._command(self.folder / "second"), self.folder / "second.log").wait(END_S)
        return (self.folder / "second.log").read_text(encoding="utf-8")

    def _command(self, run: Path) -> list[str]:
        units = [f"backend.units.{unit}.address={url}" for unit, url in self.rig.web.items()]
        units += [f"bench.volumes_ml.{WELL}={WELL_ML}", f"backend.leader={self.rig.web[FAULTED]}"]
        return [
            "backend=pioreactor", f"backend.reactors=[{FAULTED},{WELL}]", "backend.broker=127.0.0.1",
            f"backend.broker_port={self.rig.broker}", f"backend.speed={self.speed}", "backend.reading_s=1",
            *units, "scenario=hold", f"scenario.setpoints=[{SETPOINT}]", "scenario.minutes=[100000]",
            "safety.silent=100000", f"hydra.run.dir={run}", *self.words,
        ]  # fmt: skip

    def kill(self) -> None:
        """kill -9 of the client."""
        if self.client is not None:
            self.client.kill()

    def end(self) -> int | None:
        """SIGTERM, and the status with which the client ended; None if it did not."""
        assert self.client is not None
        return self.client.end(END_S)

    # -- waiting ---------------------------------------------------------------------------------------------------

    def until(self, there: Callable[[], bool], real_s: float = START_S) -> bool:
        """Wait for something, at most so long; whether it came. A client that ended is waited for no longer."""
        deadline = time.monotonic() + real_s
        while not there():
            gone = self.client is not None and self.client.status is not None
            if time.monotonic() > deadline or gone or self.stopping():
                return there()
            time.sleep(0.02)
        return True

    def pumping(self, pin: int = MEDIA_PIN) -> bool:
        """Whether a pump of the sick unit runs."""
        return self.rig.vials.vials[FAULTED].duty[pin] > 0.0

    def near(self) -> bool:
        """Whether the sick culture is at its setpoint, in truth."""
        return abs(float(self.rig.vials.vials[FAULTED].plant.apparent_od[0]) - SETPOINT) < NEAR_OD

    def journal(self) -> list[dict[str, Any]]:
        """The journal up to now."""
        path = self.run / "journal.jsonl"
        return read_journal(path)[0] if path.exists() else []

    def ended(self) -> int:
        """How many of the sick unit's doses have an end."""
        return sum(r["kind"] == "dose_end" and bool(r.get("id")) and r["reactor"] == FAULTED for r in self.journal())

    def doses(self, more: int, real_s: float = START_S) -> bool:
        """Wait for so many more doses of the sick unit to end."""
        wanted = self.ended() + more
        return self.until(lambda: self.ended() >= wanted, real_s)

    # -- what can be done to the sick unit -------------------------------------------------------------------------

    def post(self, path: str, body: Mapping[str, Any] | None = None, method: str = "POST") -> None:
        """What somebody's browser asks of the unit."""
        data = json.dumps(body or {}).encode()
        request = urllib.request.Request(f"{self.rig.web[FAULTED]}/unit_api{path}", data, method=method)
        request.add_header("Content-Type", "application/json")
        urllib.request.urlopen(request, timeout=10.0).close()

    def run_job(self, job: str, **options: Any) -> None:
        """A job that somebody's browser asks for."""
        env = {"EXPERIMENT": "turbidostat", "JOB_SOURCE": "user"}
        options = {key.replace("_", "-"): value for key, value in options.items()}
        self.post(f"/jobs/run/job_name/{job}", {"options": options, "args": [], "env": env, "config_overrides": []})

    def stop_job(self, job: str) -> None:
        """A job that somebody's browser stops; a version that looks in the body looks nowhere else."""
        self.post(f"/jobs/stop?job_name={job}", {"job_name": job})

    def signal_job(self, job: str, number: int) -> int:
        """A signal to every process of one of the unit's jobs; how many there were."""
        found = self.rig.jobs(FAULTED, job)
        for pid in found:
            os.kill(pid, number)
        return len(found)

    def pio(self, *words: str) -> None:
        """A command that the operator types at the unit."""
        subprocess.run([str(self.rig.folder / FAULTED / "pio"), *words], check=True, capture_output=True, timeout=60.0)

    # -- what is left ----------------------------------------------------------------------------------------------

    def seen(self, status: int | None) -> Seen:
        """Everything that it left behind."""
        vials: dict[str, list[Mapping[str, Any]]] = {FAULTED: [], WELL: []}
        for row in log_rows(self.folder / "truth.jsonl"):
            if "od" in row:
                vials[row["unit"]].append(row)
        rows = {unit: _recorded(self.run / "recordings" / f"{unit}.csv") for unit in (FAULTED, WELL)}
        pulses = [pulse for vial in self.rig.vials.vials.values() for pulse in vial.pulses]
        told = (self.folder / "client.log").read_text(encoding="utf-8")
        return Seen(self.journal(), rows, pulses, vials, told, status, self.speed)

    def __enter__(self) -> Trial:
        return self

    def __exit__(self, *raised: object) -> None:
        self.kill()
        self.rig.__exit__(*raised)


def log_rows(path: Path) -> list[dict[str, Any]]:
    """Whole rows of a file of one JSON object a line."""
    return [json.loads(line) for line in path.read_text(encoding="utf-8").splitlines() if line.endswith("}")]


def _recorded(path: Path) -> list[tuple[float, float]]:
    if not path.exists():
        return []
    with path.open(newline="", encoding="utf-8") as file:
        return [(float(row["time_min"]), float(row["od"] or math.nan)) for row in csv.DictReader(file)]
