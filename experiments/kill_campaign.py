"""`kill -9` of a real run at random moments, resumed each time: `python -m experiments.kill_campaign`.

A real client process (`experiments.deploy`) controls a real emulator process. After every kill the client is resumed
with `resume=RUN`; at the end, what the emulator knows it did is compared with what the run recorded.
"""

from __future__ import annotations

import csv
import json
import logging
import os
import signal
import subprocess
import sys
import time
import urllib.request
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from conf.schema import check, require, setting
from experiments.cli import files, frame
from experiments.reliability.case import audit_doses
from hardware.emulator.process import EmulatorProcess
from hardware.emulator.vial import Dose
from hardware.storage.journal import read_journal

__all__ = ["Campaign", "KillConfig", "kill_campaign"]

log = logging.getLogger(__name__)

SEEN_S = 75.0  # device seconds after it was stored by which a row has its sample, at the latest
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
    controller_kind: str = setting("inverse", "inverse | pi | pi_tuned | mpc | threshold | hold")
    seed: int = setting(0, "of kill moments and emulators", at_least=0)

    def __post_init__(self) -> None:
        check(self)
        require(self.runs <= self.kills, "runs", self.runs, "1 to kills")


@dataclass
class Findings:
    """What a run came to. Rows: samples of the device while the client lived, those that are in no row, rows twice.

    doses: runs of the feed motors. doses_not_given: intents without one; doses_lost: those of them that neither a kill
    between intent and pump nor a note explains. doses_doubled: runs without an intent of their own; doses_repeated: by
    the device itself, every 63 s, while no client lived. open_doses: kills in the middle of a dose. fed_ml, booked_ml:
    what the device delivered, and what the journals say. schedule_error_s: largest difference between the run time that
    a sample is dated with and the device's own clock. killed_s: run time of the kills.
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


class Campaign:
    """One recording and the kills it survives.

    Args:
      config: as given. kills: of this run. folder: where it records. seed: of kill moments and emulator.
    """

    def __init__(self, config: KillConfig, kills: int, folder: Path, seed: int) -> None:
        self.config, self.kills, self.folder = config, kills, folder
        self._rng, self._seed = np.random.default_rng([config.seed, seed]), seed
        self._killed: list[float] = []  # wall time, s
        self.findings = Findings(kills=kills)

    def run(self) -> Findings:
        """Start, kill, resume; at last end it properly and compare. Raises: LinkError if there is no emulator."""
        c = self.config
        arguments = [
            "--reactors",
            ",".join(c.reactors),
            "--speed",
            str(c.speed),
            "--seed",
            str(self._seed),
            "--od",
            "0.5",
        ]
        with EmulatorProcess(arguments) as device:
            self.device = device
            for k in range(self.kills):
                self._life(k)
            self._last_life()
            self._compare()
        return self.findings

    # ------------------------------------------------------------------------------------------------- processes

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
            time.sleep(0.01)
        return client.poll() is None and self._size() > before

    def _life(self, k: int) -> None:
        """Start or resume, and kill at a random moment: after its first row, or already while it starts."""
        has_state = (self.folder / "state.json").exists()
        client = self._client(first=not has_state)
        early = has_state and self._rng.random() < self.config.early
        if early:
            time.sleep(float(self._rng.uniform(0.5, 3.0)))
        elif self._until_it_writes(client, self._size()):
            time.sleep(float(self._rng.uniform(0.0, self.config.longest_s)))
            while not (self.folder / "state.json").exists() and client.poll() is None:
                time.sleep(0.05)
        if client.poll() is not None:
            self.findings.trouble.append(f"life {k} ended by itself with status {client.returncode}")
        self._killed.append(time.time())
        client.kill()
        client.wait()

    def _last_life(self) -> None:
        """Resume once more, run a few minutes, end as an operator would."""
        client = self._client(first=False)
        if self._until_it_writes(client, self._size()):
            time.sleep(300.0 / self.config.speed)
        self._ended = time.time()
        client.send_signal(signal.SIGINT)
        try:
            client.wait(30.0)
        except subprocess.TimeoutExpired:
            client.kill()
            client.wait()
            self.findings.trouble.append("the last life did not end on SIGINT")

    # ----------------------------------------------------------------------------------------------- comparison

    def _ask(self, what: str) -> Any:
        with urllib.request.urlopen(f"{self.device.control}/_emulator/{what}", timeout=10.0) as answer:
            return json.load(answer)

    def _compare(self) -> None:
        """The emulator's truth against journal and recordings."""
        f, c = self.findings, self.config
        before = time.time()
        truth = self._ask("truth")
        self._wall_zero = (before + time.time()) / 2.0 - truth[c.reactors[0]]["device_s"] / c.speed
        f.pumps_off = not any(any(truth[m]["motors"].values()) for m in c.reactors)
        f.overflowed = any(truth[m]["overflowed"] for m in c.reactors)
        journal, _ = read_journal(self.folder / "journal.jsonl")
        self._zero = self._device_s(journal[0]["wall"])
        f.killed_s = [round(self._device_s(t) - self._zero, 1) for t in self._killed]
        self._watching = np.array([self._device_s(r["wall"]) for r in journal if r["kind"] == "start"])
        times = [(r["wall"], r["time_s"]) for r in journal if r["kind"] == "sample"]
        f.schedule_error_s = max(abs(self._device_s(wall) - self._zero - time_s) for wall, time_s in times)
        for name in c.reactors:
            self._compare_doses([r for r in journal if r.get("reactor") == name], name)
            self._compare_rows(name)
            f.fed_ml += truth[name]["feed_ml"]

    def _device_s(self, wall: float) -> float:
        return float((wall - self._wall_zero) * self.config.speed)

    def _compare_doses(self, journal: Sequence[dict[str, Any]], name: str) -> None:
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

    def _compare_rows(self, name: str) -> None:
        """Samples made while a client watched against the rows of its CSV."""
        f = self.findings
        with open(self.folder / "recordings" / f"{name}.csv", newline="", encoding="utf-8") as file:
            rows = np.array([float(row["time_min"]) * 60.0 + self._zero for row in csv.DictReader(file)])
        f.rows += rows.size
        f.rows_doubled += int((np.diff(rows) < 30.0).sum())
        ends = np.array([self._device_s(t) for t in [*self._killed, self._ended]])
        for sample in self._ask(f"samples/{name}"):
            at = sample["stored_s"]
            k = int(np.searchsorted(ends, at))  # the life it was made in, or in the pause before
            begun = self._watching[(self._watching > (ends[k - 1] if k else -np.inf)) & (self._watching <= at)]
            if begun.size == 0 or k == ends.size or at > ends[k] - BLIND_S * self.config.speed:
                continue
            f.samples += 1
            if not ((rows >= at - 3.0) & (rows < at + SEEN_S)).any():
                f.rows_lost += 1
                span = f"a client watched from {begun.max():.0f} to {ends[k]:.0f}"
                f.trouble.append(f"{name}: the sample of device second {at:.0f} is in no row; {span}")


def one_run(config: KillConfig, folder: Path, run: int) -> Findings:
    """One recording with its share of the kills."""
    from experiments.control.rig_files import save
    from experiments.reliability.rehearsal import SOUND

    for name in config.reactors:
        for part, pump in (("feed", SOUND.feed), ("waste", SOUND.waste)):
            save(folder / "calibration", name, part, pump.as_dict())
    kills = config.kills // config.runs + (run < config.kills % config.runs)
    began = time.monotonic()
    findings = Campaign(config, kills, folder / f"run{run}", run).run()
    log.info("run %d: %d kills in %.0f s, %s", run, kills, time.monotonic() - began, "ok" if findings.ok else "NOT ok")
    return findings


def kill_campaign(config: KillConfig, folder: Path) -> None:
    """All runs; summary.json. Raises: UserError if anything was lost or doubled."""
    began = time.monotonic()
    with ThreadPoolExecutor(config.workers) as executor:
        found = list(executor.map(lambda run: one_run(config, folder, run), range(config.runs)))
    keys = [k for k, v in asdict(found[0]).items() if isinstance(v, (int, float)) and not isinstance(v, bool)]
    total: dict[str, Any] = {k: sum(getattr(f, k) for f in found) for k in keys}
    total["schedule_error_s"] = max(f.schedule_error_s for f in found)
    total |= {"pumps_off": all(f.pumps_off for f in found), "overflowed": any(f.overflowed for f in found)}
    total["wall_s"] = round(time.monotonic() - began, 1)
    files.write_json(folder / "summary.json", {**total, "runs": [asdict(f) for f in found]})
    for f in found:
        for line in f.trouble:
            log.warning("%s", line)
    log.info("%s", ", ".join(f"{k.replace('_', ' ')} {round(v, 2)}" for k, v in total.items()))
    if not all(f.ok for f in found):
        raise frame.UserError("something was lost or doubled; see summary.json and the logs beside the runs")


main = frame.Command("kill_campaign", KillConfig(), kill_campaign)


if __name__ == "__main__":
    main()
