"""One fault at one moment of a rehearsed run, and what became of it, judged by what only the emulator knows."""

from __future__ import annotations

import itertools
import math
import re
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from envs.scenario import Scenario
from experiments.control.loop import Step
from experiments.reliability.faults import INF, SICK, Fault
from experiments.reliability.rehearsal import Killed, Rehearsal
from hardware.chibio.overflow_pump import OverflowPumpConfig
from hardware.emulator.device import DeviceOptions
from hardware.emulator.vial import BenchConfig, Dose, Sample
from hardware.errors import ReactorError
from hardware.safety.config import Response, SafetyConfig
from hardware.storage.journal import read_journal

__all__ = ["MOMENTS", "Case", "Outcome", "audit_doses", "audit_rows"]

MOMENTS = ("recovery", "steady", "step", "dose")
HEALTHY_MU, FULL_DILUTION = 0.025, 0.06  # 1/min: the emulator's healthy culture, and the largest feed rate over volume
DEVICE_PERIOD_S = (60.0, 68.0)  # a pump left on repeats its dose so often
OVERGROWN = 4.0  # OD; the plant would grow on, a real culture and its sensor do not
SEEN_S = 75.0  # a row's time is that of the arrival of its sample, at most so long after it was stored


@dataclass
class Outcome:
    """What happened. Times s after the fault, volumes mL; nan where there is nothing to tell.

    guarded: whether the rig has an overflow guard.
    detected_s, reason: first declared word on the fault. response: of the interlock to it. kinds: all reasons after
      it; notes: of the driver.
    peak_ml, overflowed: of the worst vial.
    peak_error: largest distance of the true OD from what the schedule asks and the pump can do, sick reactor, after the
      fault; 4 stands for anything above.
    rows_missed: samples nobody could read; rows_lost: samples that could have been read and are in no row;
      rows_doubled.
    doses_doubled: runs of the feed motor beyond one per decision; repeats: those that are the device's own (every
      63 s), while nobody could stop it.
    exits: how often the device's software ended itself although the fault was over, or was not of that kind: a command
      to an absent reactor does that. neighbours_lost: healthy neighbours whose schedule did not end.
    pumps_off: every motor at rest at the end, as the program claims.
    early_alarms, neighbour_alarms: reasons given before the fault, and for healthy neighbours.
    outcome: how the run ended. wrong: what is not as declared.
    """

    fault: str
    moment: str
    guarded: bool = True
    at_min: float = math.nan
    detected_s: float = math.nan
    reason: str = ""
    response: str = ""
    kinds: dict[str, int] = field(default_factory=dict)
    notes: dict[str, int] = field(default_factory=dict)
    peak_ml: float = math.nan
    overflowed: bool = False
    peak_error: float = 0.0
    rows_missed: int = 0
    rows_lost: int = 0
    rows_doubled: int = 0
    doses_doubled: int = 0
    repeats: int = 0
    exits: int = 0
    neighbours_lost: int = 0
    pumps_off: bool = False
    early_alarms: int = 0
    neighbour_alarms: int = 0
    outcome: str = ""
    wrong: list[str] = field(default_factory=list)

    @property
    def ok(self) -> bool:
        """Nothing is wrong."""
        return not self.wrong

    @property
    def label(self) -> str:
        """The fault's name, and the rig if it is the standard one."""
        return self.fault if self.guarded else f"{self.fault}, no guard"

    def as_dict(self) -> dict[str, Any]:
        """For summary.json."""
        return {**asdict(self), "ok": self.ok}


def audit_rows(
    r: Rehearsal, dark: tuple[float, float] | None = None, samples: Mapping[str, Sequence[Sample]] | None = None
) -> tuple[int, int, int]:
    """Samples of the device against rows of the recordings: (missed, lost, doubled).

    Args:
      dark: clock times between which samples could not be read; those are missed, not lost.
      samples: of each reactor; None takes those that the device still remembers.
    """
    missed = lost = doubled = 0
    zero = r.spans[0][0]
    times = r.record.series("time_min") * 60.0 + zero
    for n, name in enumerate(r.names):
        rows = times[n, : r.record.lengths[n]]
        doubled += int((np.diff(rows) <= 0.0).sum())
        over = bool(r.loop.done[n] or r.loop.stopped[n])
        end = rows[-1] if over and rows.size else INF
        for sample in r.device.benches[name].samples if samples is None else samples[name]:
            at = sample.stored_s
            alive = any(start + 30.0 <= at <= stop - 5.0 for start, stop in r.spans)
            if not alive or at > end:
                continue
            k = int(np.searchsorted(rows, at))
            if k == rows.size or rows[k] >= at + SEEN_S:
                if dark is not None and dark[0] - SEEN_S <= at <= dark[1]:
                    missed += 1
                else:
                    lost += 1
    return missed, lost, doubled


def audit_doses(journal: Sequence[Mapping[str, Any]], doses: Sequence[Dose], name: str, zero: float) -> tuple[int, int]:
    """Runs of a feed motor against the intents of a journal: (doubled, repeated by the device).

    A run belongs to the newest intent before it. A second one for the same intent is the device's own repetition if it
    begins a pump period after the one before, else it is a doubled dose; so are two intents for one sample.

    Args:
      journal: rows; doses: of this reactor's pumps; name: of the reactor; zero: device time of run time 0, s.
    """
    experiment, samples, intents = "", [], []
    for row in journal:
        if row.get("reactor") == name and row["kind"] == "device":
            experiment = row["start_time"]  # a device that lost its memory counts samples from 0 again
        elif row.get("reactor") == name and row["kind"] == "intent":
            intents.append(row)
            samples.append((experiment, *row["sample"]))
    doubled = sum(a == b for a, b in itertools.pairwise(samples))
    starts = np.array([float(row["on_s"]) + zero for row in intents if row["feed_ml"] > 0.0])
    repeats = 0
    before: dict[int, float] = {}
    for dose in doses:
        if dose.pump != "Pump1":
            continue
        k = int(np.searchsorted(starts, dose.start_s)) - 1
        if k < 0 or k in before:
            low, high = DEVICE_PERIOD_S
            own = k >= 0 and low <= dose.start_s - before[k] <= high
            repeats, doubled = repeats + own, doubled + (not own)
        before[k] = dose.start_s
    return doubled, repeats


class _Watch:
    """Follows a rehearsal from the moment of the fault on: who says what, and where the culture goes."""

    def __init__(self, fault: Fault | None, rehearsal: Rehearsal, result: Outcome) -> None:
        self.fault, self.r, self.result = fault, rehearsal, result
        self.struck_s = math.inf
        self._reference = math.nan
        self._at = 0.0
        rehearsal.clock.at(0.0, self._look)

    def _look(self) -> None:
        """Every 15 s: true OD of the sick reactor against what is asked of it.

        The asked OD falls at most as fast as full dilution can make it: x' = (mu - D_max) x.
        """
        r, now = self.r, self.r.clock.now()
        r.device.run_until(now)
        minutes, self._at = (now - self._at) / 60.0, now
        if hasattr(r, "loop") and math.isfinite(r.loop.began[0]) and not r.loop.done[0]:
            schedule = r.loop.schedules[0]
            elapsed = np.array([(now - r.spans[0][0]) / 60.0 - r.loop.began[0]])
            asked = schedule.setpoints[int(max(Scenario.phase(schedule, elapsed)[0], 0))]
            od = float(r.device.benches[SICK].plant.od[0])
            falling = self._reference * math.exp((HEALTHY_MU - FULL_DILUTION) * minutes)
            self._reference = max(asked, od if math.isnan(self._reference) else falling)
            if now >= self.struck_s and elapsed[0] < schedule.total_min:
                self.result.peak_error = max(self.result.peak_error, min(abs(od - self._reference), OVERGROWN))
        r.clock.at(now + 15.0, self._look)

    def step(self, step: Step) -> None:
        """What interlock and driver said in this pass."""
        struck = step.now_s + self.r.spans[0][0] >= self.struck_s
        for n, name in enumerate(self.r.names):
            mine = name == SICK or (self.fault is not None and self.fault.wide)
            for reason in (step.reasons[n] or "").split(" | "):
                kind = reason.split(":")[0]
                if not kind:
                    continue
                if not struck:
                    self.result.early_alarms += 1
                elif mine:
                    self.result.kinds[kind] = self.result.kinds.get(kind, 0) + 1
                    response = Response(int(step.response[n]))
                    self.told(kind, "report" if response == Response.PASS else response.name.lower())
                else:
                    self.result.neighbour_alarms += 1
        for note in step.notes if struck else ():
            words = re.sub(r"[\d.]+", "#", note)
            self.result.notes[words] = self.result.notes.get(words, 0) + 1
            self.told(f"note:{note}", "note")

    def told(self, word: str, response: str) -> None:
        """Keep the first word that is declared for this fault."""
        if self.fault is None or self.result.reason or not math.isfinite(self.struck_s):
            return
        for by in self.fault.by:
            kind, _, text = by.partition(":")
            if word == by or (text and word.startswith(f"{kind}:") and text in word):
                self.result.detected_s = round(self.r.clock.now() - self.struck_s, 1)
                self.result.reason, self.result.response = by, response
                return


def _is_time(moment: str, r: Rehearsal) -> bool:
    """Whether a rehearsal is at one of `MOMENTS`."""
    minutes = r.clock.now() / 60.0
    elapsed = (r.clock.now() - r.spans[0][0]) / 60.0 - float(r.loop.began[0])
    first = r.loop.schedules[0].minutes[0]
    if moment == "recovery":
        return minutes >= 10.0
    if moment == "step":
        return elapsed >= first + 1.5
    if not elapsed >= 0.6 * first + 0.5 or moment == "steady":
        return elapsed >= 0.6 * first + 0.5
    r.device.run_until(r.clock.now())
    return r.device.benches[SICK].motor("Pump1") != 0


class Case:
    """A fault at a moment: `run` gives its `Outcome`.

    Args:
      fault: None for a healthy control run. moment: of `MOMENTS`. names: of the reactors, `SICK` first.
      schedule, safety, controller: as of deploy. seed: of all noise.
      overflow_pump: of the rig; an overflow may be declared only where there is none.
      outlier_rate: share of readings that jump for no reason; 0 keeps them from being taken for the fault.
    """

    def __init__(
        self,
        fault: Fault | None,
        moment: str,
        names: Sequence[str],
        schedule: Scenario,
        safety: SafetyConfig,
        controller: str,
        seed: int,
        overflow_pump: OverflowPumpConfig | None = None,
        outlier_rate: float = 0.0,
    ) -> None:
        self.fault, self.moment, self.names = fault, moment, tuple(names)
        self.schedule, self.safety, self.controller, self.seed = schedule, safety, controller, seed
        self.overflow_pump = overflow_pump or OverflowPumpConfig()
        self.options = DeviceOptions(bench=BenchConfig(outlier_rate=outlier_rate))
        self.result = Outcome(fault.name if fault else "none", moment, bool(self.overflow_pump.pump))
        self._exits = 0  # of the device's software up to the fault, or its end

    def run(self) -> Outcome:
        """Rehearse, judge. Raises: nothing of what the fault brings about."""
        with tempfile.TemporaryDirectory() as folder:
            schedules = [self.schedule] * len(self.names)
            self.r = Rehearsal(
                Path(folder), self.names, schedules, self.safety, self.controller, self.options, seed=self.seed,
                overflow_pump=self.overflow_pump,
            )  # fmt: skip
            self.watch = _Watch(self.fault, self.r, self.result)
            self.r.clock.at(1.0, self._wait_for_it)
            self._live()
            self._audit()
        self._judge()
        return self.result

    def _wait_for_it(self) -> None:
        """Every quarter of a second: is it time for the fault?"""
        r = self.r
        if not hasattr(r, "loop") or not _is_time(self.moment, r):
            r.clock.at(r.clock.now() + 0.25, self._wait_for_it)
            return
        self.watch.struck_s = r.clock.now()
        self.result.at_min = round(r.clock.now() / 60.0, 1)
        if self.fault is None:
            return
        r.device.run_until(r.clock.now())
        self._exits = r.device.exits
        if self.fault.end is not None and not self.fault.program and self.fault.minutes < INF:
            r.clock.at(r.clock.now() + 60.0 * self.fault.minutes, self._mend)
        self.fault.begin(r)

    def _mend(self) -> None:
        assert self.fault is not None
        assert self.fault.end is not None
        self.r.device.run_until(self.r.clock.now())
        self.fault.end(self.r)
        self._exits = self.r.device.exits

    def _live(self) -> None:
        """Lives of the program, one after another, until the schedule is over."""
        r = self.r
        limit = 60.0 * (self.schedule.total_min + 60.0)
        for _ in range(3):
            ended = ""
            try:
                r.begin()
                for repair in r.record.repairs:
                    self.watch.told(f"repair:{repair}", "resume")
                for step in r.run(limit):
                    self.watch.step(step)
            except Killed:
                ended = "killed"
            except (ReactorError, RuntimeError) as error:
                ended = f"failed: {error}"
            self.result.pumps_off = ended != "killed" and self._stop()
            r.bury()
            self.watch.told(f"end:{ended}", "stop")
            if self.fault is None or not self.fault.program or not ended:
                break
            r.wait(60.0 * self.fault.minutes)
            if self.fault.end is not None:
                self.fault.end(r)
        given_up = [name for name, s in zip(r.names, r.loop.stopped, strict=True) if s]
        whole = "completed" if r.loop.done.all() else "gave up " + ", ".join(given_up) if given_up else "not finished"
        self.result.outcome = ended or whole

    def _stop(self) -> bool:
        """What deploy does at its end: pumps off, verified. True if every motor is at rest and it claims what it can.

        That is verified off for all, but for a reactor that is gone: of that one it must say that it is not.
        """
        unverified = ""
        try:
            self.r.reactors.stop()
        except ReactorError as error:
            unverified = str(error)
        gone = [SICK] if self.fault is not None and self.fault.gone else []
        if [name for name in self.names if f"{name}: " in unverified] != gone:
            return False
        handed_over = self.r.reactors.handed_over
        return all(
            regulated or not any(self.r.truth(name)["motors"].values())
            for name, regulated in zip(self.names, handed_over, strict=True)
        )

    def _audit(self) -> None:
        r, out, fault = self.r, self.result, self.fault
        for name in r.names:
            truth = r.truth(name)
            out.peak_ml = max(out.peak_ml, truth["peak_ml"]) if out.peak_ml == out.peak_ml else truth["peak_ml"]
            out.overflowed |= truth["overflowed"]
        dark = None
        if fault is not None and fault.blind:
            lasts = fault.minutes if fault.minutes < INF else 1e6
            dark = (self.watch.struck_s, self.watch.struck_s + 60.0 * (lasts + 6.0))
        out.rows_missed, out.rows_lost, out.rows_doubled = audit_rows(r, dark)
        out.exits = r.device.exits - self._exits
        out.neighbours_lost = int((~r.loop.done[1:]).sum())
        journal, _ = read_journal(r.folder / "journal.jsonl")
        for name in r.names:
            if fault is None or not fault.rogue or (name != SICK and not fault.wide):
                doubled, repeats = audit_doses(journal, r.device.benches[name].doses, name, r.spans[0][0])
                out.doses_doubled, out.repeats = out.doses_doubled + doubled, out.repeats + repeats

    def _judge(self) -> None:
        """Compare with what is declared."""
        out, fault = self.result, self.fault
        checks = {
            "overflow": out.overflowed and (out.guarded or not (fault and fault.overflow)),
            "rows lost": out.rows_lost > 0,
            "rows doubled": out.rows_doubled > 0,
            "doses doubled": out.doses_doubled > 0,
            "device ended": out.exits > 0,
            "neighbour lost": out.neighbours_lost > 0,
            "pumps not off": not out.pumps_off and not (fault and fault.stuck),
            "not detected": fault is not None and bool(fault.by) and not out.reason,
            "false alarm": out.early_alarms + out.neighbour_alarms > 0 or (fault is None and bool(out.kinds)),
        }
        out.wrong = [name for name, is_wrong in checks.items() if is_wrong]
