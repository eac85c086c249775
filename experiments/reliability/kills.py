"""One recording that survives kills: the client processes, and their record against what the emulated device did."""

import csv
import json
import os
import signal
import subprocess
import sys
import threading
import time
import urllib.request
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from conf.schema import check, require, setting
from experiments.controllers.registry import STANDALONE
from experiments.reliability.audit import SEEN_S, audit_doses
from hardware.emulator.process import EmulatorProcess
from hardware.emulator.vial import Dose
from hardware.storage.journal import read_journal

__all__ = ["Findings", "KillConfig", "Stopped", "killed_run"]

BLIND_S = 0.25  # real seconds before a kill in which a sample may not have been asked for yet
PATIENCE_S = 60.0  # real seconds for a client to start


@dataclass(frozen=True)
class KillConfig:
    """How often and when to kill. Raises: ValueError naming key, value and allowed range."""

    kills: int = setting(200, "in all", within=(1, 100_000))
    runs: int = setting(4, "recordings they are spread over; kills at most", at_least=1)
    workers: int = setting(2, "runs at a time", within=(1, 64))
    speed: float = setting(60.0, "device seconds per real second", within=(1, 120), note="a client must keep up")
    longest_s: float = setting(
        3.0, "real time from a client's first written row to its kill, at most; drawn evenly", "s", within=(0.1, 3600)
    )
    early: float = setting(0.2, "share of kills that may fall into the start itself", within=(0, 1))
    reactors: tuple[str, ...] = setting(("M0", "M1", "M2"), "of the runs")
    controller_kind: str = setting("adaptive_inverse", "what decides the pump rate", choices=STANDALONE)
    seed: int = setting(0, "of kill moments and emulators", at_least=0)

    def __post_init__(self) -> None:
        check(self)
        require(self.runs <= self.kills, "runs", self.runs, "1 to kills")


@dataclass
class Findings:
    """What a run came to.

    kills; lives: programs that were started.
    samples: of the device while a client watched. rows: of the recordings. rows_lost: samples that are in no row.
    rows_doubled: rows that follow another one by less than 30 s.
    doses: runs of the feed motors. doses_doubled: those without an intent of their own. doses_repeated: those that the
      device repeated by itself, every 63 s, while no client lived.
    doses_not_given: intents without a dose. doses_lost: intents without a dose although the client was not killed
      between the two, and no note says why none was given.
    open_doses: kills in the middle of a dose.
    fed_ml, booked_ml: what the device delivered, and what the journals say.
    schedule_error_s: largest difference between the run time that a sample is dated with and the device's own clock.
    pumps_off, overflowed: at the end. killed_s: run time of the kills. trouble: what went wrong, one line each.
    """

    kills: int = 0
    lives: int = 0
    samples: int = 0
    rows: int = 0
    rows_lost: int = 0
    rows_doubled: int = 0
    doses: int = 0
    doses_lost: int = 0
    doses_not_given: int = 0
    doses_doubled: int = 0
    doses_repeated: int = 0
    open_doses: int = 0
    fed_ml: float = 0.0
    booked_ml: float = 0.0
    schedule_error_s: float = 0.0
    pumps_off: bool = False
    overflowed: bool = False
    killed_s: list[float] = field(default_factory=list)
    trouble: list[str] = field(default_factory=list)

    @property
    def ok(self) -> bool:
        """Nothing lost, nothing doubled."""
        bad = self.rows_lost + self.rows_doubled + self.doses_lost + self.doses_doubled + self.overflowed
        return bad == 0 and self.pumps_off and not self.trouble and self.schedule_error_s < 5.0


class Stopped(Exception):
    """The campaign was stopped before this run was at its end; its processes are gone."""


def killed_run(
    config: KillConfig, kills: int, folder: Path, seed: int, stop: threading.Event | None = None
) -> Findings:
    """Start, kill, resume; at last end it properly and compare.

    Args: kills: of this run. folder: where it records. seed: of kill moments and emulator. stop: ends it early.
    Raises: LinkError if there is no emulator; Stopped.
    """
    findings = Findings(kills=kills)
    arguments = {"reactors": ",".join(config.reactors), "speed": config.speed, "seed": seed, "od": 0.5}
    with EmulatorProcess([word for k, v in arguments.items() for word in (f"--{k}", str(v))]) as device:
        rng = np.random.default_rng([config.seed, seed])
        clients = _Clients(config, device, folder, rng, findings, stop or threading.Event())
        killed = [clients.start_and_kill(k) for k in range(kills)]
        _Comparison(config, device, folder, killed, clients.end(), findings).run()
    return findings


class _Clients:
    """The client processes of one run, one after another. What goes wrong with them is added to `findings`."""

    def __init__(
        self,
        config: KillConfig,
        device: EmulatorProcess,
        folder: Path,
        rng: np.random.Generator,
        findings: Findings,
        stop: threading.Event,
    ) -> None:
        self.config, self.device, self.folder, self.findings = config, device, folder, findings
        self._rng, self._stop = rng, stop

    def _client(self, first: bool) -> subprocess.Popen[bytes]:
        c = self.config
        command = [sys.executable, "-m", "experiments.deploy"]
        if first:
            scenario = ["scenario=hold", "scenario.setpoints=[0.5]", "scenario.minutes=[100000]"]
            backend = ["backend=chibio", f"backend.url={self.device.url}", f"backend.speed={c.speed}"]
            names = [f"backend.reactors=[{','.join(c.reactors)}]", f"hydra.run.dir={self.folder}"]
            names += [f"backend.calibration={self.folder.parent / 'calibration'}"]
            command += [*backend, *names, *scenario, f"controller={c.controller_kind}", "safety.silent=100000"]
        else:
            command.append(f"resume={self.folder}")
        self.findings.lives += 1
        environment = {**os.environ, "OMP_NUM_THREADS": "1"}
        with open(self.folder.parent / f"{self.folder.name}.log", "ab") as out:
            return subprocess.Popen(command, stdout=out, stderr=out, env=environment, start_new_session=True)

    def _size(self) -> int:
        path = self.folder / "journal.jsonl"
        return path.stat().st_size if path.exists() else 0

    def _until_it_writes(self, client: subprocess.Popen[bytes], before: int) -> bool:
        deadline = time.monotonic() + PATIENCE_S
        while self._size() <= before and client.poll() is None and time.monotonic() < deadline:
            if self._stop.wait(0.01):
                break
        return client.poll() is None and self._size() > before

    def start_and_kill(self, k: int) -> float:
        """Start or resume, and kill at a random moment: after the first row, or already during the start.

        Args: k: number of the kill. Returns: its wall time, s. Raises: Stopped.
        """
        has_state = (self.folder / "state.json").exists()
        client = self._client(first=not has_state)
        early = has_state and self._rng.random() < self.config.early
        if early:
            self._stop.wait(float(self._rng.uniform(0.5, 3.0)))
        elif self._until_it_writes(client, self._size()):
            self._stop.wait(float(self._rng.uniform(0.0, self.config.longest_s)))
            while not ((self.folder / "state.json").exists() or self._stop.wait(0.05)) and client.poll() is None:
                pass
        if client.poll() is not None:
            self.findings.trouble.append(f"client {k} ended by itself with status {client.returncode}")
        killed = time.time()
        client.kill()
        client.wait()
        if self._stop.is_set():
            raise Stopped
        return killed

    def end(self) -> float:
        """Resume once more, run a few minutes, end as an operator would; returns the wall time of that, s."""
        client = self._client(first=False)
        if self._until_it_writes(client, self._size()):
            self._stop.wait(300.0 / self.config.speed)
        ended = time.time()
        client.send_signal(signal.SIGINT)
        try:
            client.wait(30.0)
        except subprocess.TimeoutExpired:
            client.kill()
            client.wait()
            self.findings.trouble.append("the last client did not end on SIGINT")
        return ended


class _Comparison:
    """What the emulator knows against journal and recordings.

    Args: killed: wall time of every kill. ended: when the last client was asked to end. findings: are filled in.
    """

    def __init__(
        self,
        config: KillConfig,
        device: EmulatorProcess,
        folder: Path,
        killed: Sequence[float],
        ended: float,
        findings: Findings,
    ) -> None:
        self.config, self.device, self.folder, self.findings = config, device, folder, findings
        self._killed, self._ended = killed, ended
        before = time.time()
        self._truth = self._ask("truth")
        self._wall_zero = (before + time.time()) / 2.0 - self._truth[config.reactors[0]]["device_s"] / config.speed
        self._journal, _ = read_journal(folder / "journal.jsonl")
        self._zero = self._device_s(self._journal[0]["wall"])

    def _ask(self, what: str) -> Any:
        with urllib.request.urlopen(f"{self.device.control}/_emulator/{what}", timeout=10.0) as answer:
            return json.load(answer)

    def _device_s(self, wall: float) -> float:
        return float((wall - self._wall_zero) * self.config.speed)

    def run(self) -> None:
        """All of it."""
        f, c, truth, journal = self.findings, self.config, self._truth, self._journal
        f.pumps_off = not any(any(truth[m]["motors"].values()) for m in c.reactors)
        f.overflowed = any(truth[m]["overflowed"] for m in c.reactors)
        f.killed_s = [round(self._device_s(t) - self._zero, 1) for t in self._killed]
        times = [(r["wall"], r["time_s"]) for r in journal if r["kind"] == "sample"]
        f.schedule_error_s = max(abs(self._device_s(wall) - self._zero - time_s) for wall, time_s in times)
        for name in c.reactors:
            self._doses([r for r in journal if r.get("reactor") == name], name)
            self._rows(name)
            f.fed_ml += truth[name]["feed_ml"]

    def _doses(self, journal: Sequence[dict[str, Any]], name: str) -> None:
        """Every run of the feed motor has its intent, every intent its run unless a kill or a note says why not."""
        f = self.findings
        doses = [Dose(**d) for d in self._ask(f"doses/{name}")]
        doubled, repeats = audit_doses(journal, doses, name, self._zero)
        starts = np.array([d.start_s for d in doses if d.pump == "Pump1"])
        f.doses += starts.size
        f.doses_doubled += doubled
        f.doses_repeated += repeats
        for row, following in zip(journal, [*journal[1:], {}], strict=True):
            f.booked_ml += float(row.get("repeated_ml") or 0.0)
            if row["kind"] != "intent" or row["feed_ml"] == 0.0:
                continue
            f.booked_ml += float(row["feed_ml"])
            at = row["on_s"] + self._zero
            given = ((starts > at - 3.0) & (starts < at + 45.0)).any()
            killed = any(row["wall"] - 0.1 <= t <= row["wall"] + 1.0 for t in self._killed)
            f.doses_not_given += int(not given)
            if not given and not killed and "no dose" not in str(following.get("note")):
                f.doses_lost += 1
        f.open_doses += sum("left open" in str(row.get("note")) for row in journal)

    def _rows(self, name: str) -> None:
        """Samples made while a client watched against the rows of its CSV."""
        f = self.findings
        with open(self.folder / "recordings" / f"{name}.csv", newline="", encoding="utf-8") as file:
            rows = np.array([float(row["time_min"]) * 60.0 + self._zero for row in csv.DictReader(file)])
        f.rows += rows.size
        f.rows_doubled += int((np.diff(rows) < 30.0).sum())
        watching = np.array([self._device_s(r["wall"]) for r in self._journal if r["kind"] == "start"])
        ends = np.array([self._device_s(t) for t in [*self._killed, self._ended]])
        for sample in self._ask(f"samples/{name}"):
            at = sample["stored_s"]
            k = int(np.searchsorted(ends, at))  # the client that watched then, or the one after the pause
            begun = watching[(watching > (ends[k - 1] if k else -np.inf)) & (watching <= at)]
            if begun.size == 0 or k == ends.size or at > ends[k] - BLIND_S * self.config.speed:
                continue
            f.samples += 1
            if not ((rows >= at - 3.0) & (rows < at + SEEN_S)).any():
                f.rows_lost += 1
                span = f"a client watched from {begun.max():.0f} to {ends[k]:.0f}"
                f.trouble.append(f"{name}: the sample of device second {at:.0f} is in no row; {span}")
