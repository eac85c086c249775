"""`kill -9` of a real run at random moments, resumed each time: `python -m tests.campaigns.kills`.

A real client process (`experiments.deploy`) controls a real emulator process. After every kill the client is resumed
with `resume=RUN`; at the end, what the emulator knows it did is compared with what the run recorded.
"""

import csv
import json
import logging
import math
import signal
import threading
import time
import urllib.request
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from conf.presets import groups
from conf.schema import check, require, setting
from experiments.cli import files, frame
from experiments.laws.registry import on_device
from hardware.chibio.calibrations import save_calibration
from hardware.emulator.process import EmulatorProcess
from hardware.emulator.vial import Dose, StoredSample
from hardware.storage.journal import read_journal
from tests.campaigns.audit import Served, audit_doses, fed_by, rows_per_sample
from tests.campaigns.client import Client
from tests.campaigns.rehearsal import SOUND
from tests.campaigns.tracking import reachable
from tests.entry import command
from tests.studies.results import leave

CLOCKS_S = 0.05  # real seconds by which the clocks of client and emulator, compared over HTTP, are apart at least
PATIENCE_S = 60.0  # real seconds for a client to start
SETPOINT = 0.5  # OD
LAST_S = 600.0  # device seconds that the last client has
SETTLING_S = 240.0  # of which the first do not count: the first dose comes up to two minutes after the start
HELD_OD = 0.05  # mean true error after that; noise and dose spread leave 0.003, the delay of the first dose 0.03
FAR_OD = 0.1  # three minutes of growth beyond that where full dilution is needed
LONGEST_OUT_MIN = 3.0  # of clients' time


Life = tuple[float, float]  # of a client: begin and end, device s


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
    answer_s: float = setting(
        0.5, "real time a client needs to ask for a sample and to date its answer, at most", "s", within=(0.1, 10)
    )
    reactors: tuple[str, ...] = setting(("M0", "M1", "M2"), "of the runs")
    controller_kind: str = setting("dqn", "a controller that can run a device; dqn is the policy that ships")
    plant: str = setting("healthy", "preset of the emulated cultures and pumps", choices=tuple(groups()["plant"]))
    overrides: tuple[str, ...] = setting((), "further words of the deploy command, e.g. safety.cooldown=10")
    seed: int = setting(0, "of kill moments and emulators", at_least=0)

    def __post_init__(self) -> None:
        check(self)
        on_device(self.controller_kind)
        require(self.runs <= self.kills, "runs", self.runs, "1 to kills")


@dataclass
class Findings:
    """What a run came to.

    kills; lives: programs that were started.
    samples: of the device while a client watched. rows: of the recordings. rows_lost: samples that are in no row.
    rows_doubled: rows beyond one for each sample: of a sample that has its row, or of none.
    doses: runs of the feed motors. doses_doubled: those without an intent of their own. doses_repeated: those that the
      device repeated by itself, every 63 s, while no client lived.
    doses_not_given: intents without a dose. doses_lost: intents without a dose although the client was neither
      killed nor asked to end between the two, and no note says why none was given.
    open_doses: kills in the middle of a dose.
    mean_error: mean distance of the true OD, of the worst reactor in the last client's life, its first minutes left
      out, from what growth and full dilution allowed since its first sample. out_min: longest time in the lives of
      clients, min, that a true OD was farther than `FAR_OD` from that.
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
    mean_error: float = math.nan
    out_min: float = 0.0
    fed_ml: float = 0.0
    booked_ml: float = 0.0
    schedule_error_s: float = 0.0
    pumps_off: bool = False
    overflowed: bool = False
    killed_s: list[float] = field(default_factory=list)
    trouble: list[str] = field(default_factory=list)

    @property
    def ok(self) -> bool:
        """Nothing lost, nothing doubled, the cultures held."""
        bad = self.rows_lost + self.rows_doubled + self.doses_lost + self.doses_doubled + self.overflowed
        sound = bad == 0 and self.pumps_off and not self.trouble and self.schedule_error_s < 5.0
        return sound and self.held

    @property
    def held(self) -> bool:
        """Whether the cultures were brought back to the setpoint in what time the clients had, and kept there."""
        return self.mean_error <= HELD_OD and self.out_min <= LONGEST_OUT_MIN


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
    arguments = {"reactors": ",".join(config.reactors), "speed": config.speed, "seed": seed, "od": SETPOINT}
    arguments |= {"plant": config.plant, "pump3-flow": 1.0}  # a second fluid, for overrides that ask for it
    with EmulatorProcess([word for k, v in arguments.items() for word in (f"--{k}", str(v))]) as device:
        rng = np.random.default_rng([config.seed, seed])
        clients = Clients(config, device, folder, rng, findings, stop or threading.Event())
        killed = [clients.start_and_kill(k) for k in range(kills)]
        Comparison(config, device, folder, killed, clients.end(), findings).run()
    return findings


@dataclass
class Clients:
    """The client processes of one run, one after another. What goes wrong with them is added to `findings`."""

    config: KillConfig
    device: EmulatorProcess
    folder: Path
    rng: np.random.Generator
    findings: Findings
    stop: threading.Event

    def start(self) -> Client:
        """A client: the first, or one that resumes the run."""
        c, command = self.config, []
        if not (self.folder / "state.json").exists():
            scenario = ["scenario=hold", f"scenario.setpoints=[{SETPOINT}]", "scenario.minutes=[100000]"]
            backend = ["backend=chibio", f"backend.url={self.device.url}", f"backend.speed={c.speed}"]
            names = [f"backend.reactors=[{','.join(c.reactors)}]", f"hydra.run.dir={self.folder}"]
            names += [f"backend.calibration={self.folder.parent / 'calibration'}"]
            command += [*backend, *names, *scenario, f"controller={c.controller_kind}", "safety.silent=100000"]
            command += c.overrides
        else:
            command.append(f"resume={self.folder}")
        self.findings.lives += 1
        return Client(command, self.folder.parent / f"{self.folder.name}.log")

    def _size(self) -> int:
        path = self.folder / "journal.jsonl"
        return path.stat().st_size if path.exists() else 0

    def _until_it_writes(self, client: Client, before: int) -> bool:
        deadline = time.monotonic() + PATIENCE_S
        while self._size() <= before and client.status is None and time.monotonic() < deadline:
            if self.stop.wait(0.01):
                break
        return client.status is None and self._size() > before

    def start_and_kill(self, k: int) -> float:
        """Start or resume, and kill at a random moment: after the first row, or already during the start.

        Args: k: number of the kill. Returns: its wall time, s. Raises: Stopped.
        """
        has_state = (self.folder / "state.json").exists()
        client = self.start()
        early = has_state and self.rng.random() < self.config.early
        if early:
            self.stop.wait(float(self.rng.uniform(0.5, 3.0)))
        elif self._until_it_writes(client, self._size()):
            self.stop.wait(float(self.rng.uniform(0.0, self.config.longest_s)))
            while not ((self.folder / "state.json").exists() or self.stop.wait(0.05)) and client.status is None:
                pass
        if client.status is not None:
            self.findings.trouble.append(f"client {k} ended by itself with status {client.status}")
        killed = time.time()
        client.kill()
        if self.stop.is_set():
            raise Stopped
        return killed

    def end(self) -> float:
        """Resume once more, run ten minutes, end as an operator would; returns the wall time of that, s."""
        client = self.start()
        if self._until_it_writes(client, self._size()):
            self.stop.wait(LAST_S / self.config.speed)
        ended = time.time()
        if client.end(30.0, signal.SIGINT) is None:
            self.findings.trouble.append("the last client did not end on SIGINT")
        return ended


@dataclass
class Comparison:
    """What the emulator knows against journal and recordings.

    killed: wall time of every kill. ended: when the last client was asked to end. findings: are filled in.
    """

    config: KillConfig
    device: EmulatorProcess
    folder: Path
    killed: Sequence[float]
    ended: float
    findings: Findings

    def __post_init__(self) -> None:
        before = time.time()
        self._truth = self._ask("truth")
        after = time.time()
        self._clocks_s = max(CLOCKS_S, (after - before) / 2.0)
        self._wall_zero = (before + after) / 2.0 - self._truth[self.config.reactors[0]]["device_s"] / self.config.speed
        self._journal, _ = read_journal(self.folder / "journal.jsonl")
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
        f.killed_s = [round(self._device_s(t) - self._zero, 1) for t in self.killed]
        times = [(r["wall"], r["time_s"]) for r in journal if r["kind"] == "sample"]
        f.schedule_error_s = max(abs(self._device_s(wall) - self._zero - time_s) for wall, time_s in times)
        for name in c.reactors:
            self._doses([r for r in journal if r.get("reactor") == name], name)
            self._rows(name)
            f.fed_ml += truth[name]["feed_ml"]
        if not f.held:
            far = f"{f.out_min:.0f} min of clients' time farther than {FAR_OD:g} OD (allowed {LONGEST_OUT_MIN:g})"
            f.trouble.append(f"not held: mean error {f.mean_error:.3f} OD at last (allowed {HELD_OD:g}), {far}")

    def _doses(self, journal: Sequence[dict[str, Any]], name: str) -> None:
        """Every run of the feed motor has its intent, every intent its run unless a kill or a note says why not."""
        f = self.findings
        doses = [Dose(**d) for d in self._ask(f"doses/{name}")]
        doubled, repeats = audit_doses(journal, doses, name, self._zero)
        starts = np.array([d.start_s for d in doses if d.pump in fed_by(journal)])
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
            ends = (*self.killed, self.ended)  # asked to end, a client cuts its dose as short as a kill does
            killed = any(row["wall"] - 0.1 <= t <= row["wall"] + 2.0 * self.config.answer_s for t in ends)
            f.doses_not_given += int(not given)
            if not given and not killed and "no dose" not in str(following.get("note")):
                f.doses_lost += 1
        f.open_doses += sum("left open" in str(row.get("note")) for row in journal)

    def _rows(self, name: str) -> None:
        """Samples made while a client watched against the rows of its CSV."""
        f = self.findings
        with open(self.folder / "recordings" / f"{name}.csv", newline="", encoding="utf-8") as file:
            rows = [(float(row["time_min"]) * 60.0 + self._zero, float(row["od"])) for row in csv.DictReader(file)]
        samples = [StoredSample(**sample) for sample in self._ask(f"samples/{name}")]
        served = Served().add(samples, self._ask(f"reads/{name}"))
        early, late = (real * self.config.speed for real in (self._clocks_s, self.config.answer_s))
        count, strangers = rows_per_sample([at for at, _ in rows], [od for _, od in rows], served, early, late)
        f.rows += len(rows)
        f.rows_doubled += strangers + int((count[count > 1] - 1).sum())
        lives = [self._life(at, name) for at in served.stored_s]
        for at, in_rows, life in zip(served.stored_s, count, lives, strict=True):
            if life is not None and at <= life[1] - self.config.answer_s * self.config.speed:
                f.samples += 1
                if in_rows == 0:
                    f.rows_lost += 1
                    span = f"a client watched from {life[0]:.0f} to {life[1]:.0f}"
                    f.trouble.append(f"{name}: the sample of device second {at:.0f} is in no row; {span}")
        self._control(served, lives)

    def _control(self, served: Served, lives: Sequence[Life | None]) -> None:
        """True ODs while clients lived."""
        watched = zip(served.stored_s, served.culture_od, lives, strict=True)
        seen = [(at, od, life) for at, od, life in watched if life is not None]
        errors = errors_in_lives(seen)
        last = [e for e, (at, _, life) in zip(errors, seen, strict=True) if self._settled(at, life)]
        f = self.findings
        f.out_min = max(f.out_min, longest_out_min(errors))
        f.mean_error = float(np.fmax(f.mean_error, np.mean(last))) if last else math.inf

    def _life(self, at: float, name: str) -> Life | None:
        """Begin and end, device s, of the life of the client that watched a reactor at `at`; None if none did.

        It watches from its start, or from where it took over a reactor that did not answer then.
        """
        ends = np.array([self._device_s(t) for t in [*self.killed, self.ended]])
        k = int(np.searchsorted(ends, at))  # the client that watched then, or the one after the pause
        if k == ends.size:
            return None
        begun = [ends[k - 1] if k else -np.inf]
        for kind, reactors in (("start", (None,)), ("device", (name,))):
            rows = [r for r in self._journal if r["kind"] == kind and r.get("reactor") in reactors]
            begun.append(min((t for r in rows if (t := self._device_s(r["wall"])) > begun[0]), default=np.inf))
        return None if max(begun) > at else (float(max(begun)), float(ends[k]))

    def _settled(self, at: float, life: Life) -> bool:
        return life[1] == self._device_s(self.ended) and at >= life[0] + SETTLING_S


def errors_in_lives(seen: Sequence[tuple[float, float, Life]]) -> list[float]:
    """Distance of each true OD from where the client that lived then could have brought it from its first sample on.

    Above the setpoint it is a share of the OD, times the setpoint: what a dose that comes a minute late leaves is one.

    Args: seen: device time of a sample, s, true OD, and the life of its client.
    """
    errors, before, reference = [], (-math.inf, (-math.inf, -math.inf)), np.zeros(1)
    for at, od, life in seen:
        if life != before[1]:
            reference = np.array([od])
        else:
            reference = reachable(reference, np.array([SETPOINT]), (at - before[0]) / 60.0)
        errors.append(abs(od - float(reference[0])) * min(1.0, SETPOINT / float(reference[0])))
        before = at, life
    return errors


def longest_out_min(errors: Sequence[float]) -> float:
    """Longest stretch of errors, OD, one a minute, that are all larger than `FAR_OD`, min."""
    longest = now = 0
    for error in errors:
        now = now + 1 if error > FAR_OD else 0
        longest = max(longest, now)
    return float(longest)


log = logging.getLogger(__name__)


def one_run(config: KillConfig, folder: Path, run: int, stop: threading.Event) -> Findings:
    """One recording with its share of the kills. Raises: Stopped."""
    kills = config.kills // config.runs + (run < config.kills % config.runs)
    began = time.monotonic()
    findings = killed_run(config, kills, folder / f"run{run}", run, stop)
    log.info("run %d: %d kills in %.0f s, %s", run, kills, time.monotonic() - began, "ok" if findings.ok else "NOT ok")
    return findings


def kill_campaign(config: KillConfig, folder: Path) -> None:
    """All runs; summary.json. Raises: UserError if anything was lost or doubled, or a culture was not held."""
    began = time.monotonic()
    for name in config.reactors:
        for part, pump in (("feed", SOUND.feed), ("waste", SOUND.waste)):
            save_calibration(folder / "calibration", name, part, asdict(pump))
    found, stop = [], threading.Event()
    with ThreadPoolExecutor(config.workers) as executor:
        futures = [executor.submit(one_run, config, folder, run, stop) for run in range(config.runs)]
        try:
            found = [future.result() for future in futures]
        except BaseException:  # clients and emulators have sessions of their own: nobody else ends them
            stop.set()
            executor.shutdown(cancel_futures=True)
            raise
    keys = [k for k, v in asdict(found[0]).items() if isinstance(v, (int, float)) and not isinstance(v, bool)]
    total: dict[str, Any] = {k: sum(getattr(f, k) for f in found) for k in keys}
    total |= {key: max(getattr(f, key) for f in found) for key in ("schedule_error_s", "mean_error", "out_min")}
    total |= {"pumps_off": all(f.pumps_off for f in found), "overflowed": any(f.overflowed for f in found)}
    total["wall_s"] = round(time.monotonic() - began, 1)
    files.write_json(folder / "summary.json", {**total, "runs": [asdict(f) for f in found]})
    rows = [(k.replace("_", " "), f"{v:.4g}" if isinstance(v, float) else v) for k, v in total.items()]
    leave(folder, __file__, ("of all runs", ""), rows)
    for f in found:
        for line in f.trouble:
            log.warning("%s", line)
    log.info("%s", ", ".join(f"{k.replace('_', ' ')} {round(v, 2)}" for k, v in total.items()))
    if not all(f.ok for f in found):
        first = next((line for f in found for line in f.trouble), "see the counts in summary.json")
        raise frame.UserError(
            f"something was lost or doubled, or not held: {first}; summary.json and the logs have all"
        )


main = command(__file__, KillConfig(), kill_campaign)


if __name__ == "__main__":
    main()
