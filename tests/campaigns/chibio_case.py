"""One fault at one moment of a rehearsed run: watched from then on, judged by what only the emulator knows."""

import re
import tempfile
from pathlib import Path

import numpy as np

from experiments.control.config import DeployConfig
from experiments.laws.base import Array
from experiments.loop.loop import Step
from experiments.loop.messages import FilterAlarm
from hardware.emulator.device import DeviceOptions
from hardware.emulator.vial import VialConfig
from hardware.errors import ReactorError
from hardware.safety.config import Response
from hardware.storage.journal import read_journal
from tests.campaigns.audit import audit_doses, audit_rows
from tests.campaigns.chibio_faults import FAULTY, INF
from tests.campaigns.fault import Fault
from tests.campaigns.outcome import Outcome, allowed, judged
from tests.campaigns.rehearsal import Killed, Rehearsal
from tests.campaigns.tracking import BAND_OD, Tracking

__all__ = ["ChiBioCase"]

QUIET = DeviceOptions(vial=VialConfig(outlier_rate=0.0))
"""No reading jumps for no reason, which could be taken for the fault."""
STOPPED_S = 120.0  # after its detection, within which dosing has to end where no dose is right


class _Watch:
    """Follows a rehearsal: who says what from the moment of the fault on, and where the cultures go.

    Args: fault: None for a healthy run. result: what is seen goes into it.
    Attributes: struck_s, clock time of the fault, inf before it; tracking, of the true ODs.
    """

    def __init__(self, fault: Fault | None, rehearsal: Rehearsal, result: Outcome) -> None:
        self.fault, self.r, self.result = fault, rehearsal, result
        self.struck_s = INF
        self.tracking = Tracking(_bands(fault, len(rehearsal.names)))
        self.tracking.counting = fault is None
        self._fed_ml = INF  # by the faulty reactor's pump when it should have stopped
        rehearsal.clock.at(0.0, self._look)

    def _look(self) -> None:
        """Every 15 s: true ODs against what is asked of them; what is asked does not depend on what is measured."""
        r, now = self.r, self.r.clock.now()
        r.device.run_until(now)
        if hasattr(r, "loop"):
            elapsed = (now - r.spans[0][0]) / 60.0 - r.loop.began
            _, asked, _ = r.loop.progress.asked(elapsed)
            over = r.loop.done | (elapsed >= r.loop.progress.totals)
            self.tracking.look(now / 60.0, asked, self._od(), ~over)
        if now >= self.struck_s + self.result.detected_s + STOPPED_S:
            fed_ml = float(r.device.vials[FAULTY].plant.feed.delivered_ml[0])
            self._fed_ml = min(self._fed_ml, fed_ml)
            self.result.fed_after_ml = fed_ml - self._fed_ml
        r.clock.at(now + 15.0, self._look)

    def _od(self) -> Array:
        return np.array([vial.plant.culture.od[0] for vial in self.r.device.vials.values()], dtype=np.float64)

    def strike(self) -> None:
        """The fault begins now; a lasting one leaves the cultures where they are."""
        self.struck_s, self.tracking.counting = self.r.clock.now(), True
        self.result.at_min = round(self.struck_s / 60.0, 1)
        self.over()

    def over(self) -> None:
        """The fault is over: from here on the cultures have to come back."""
        self.tracking.restart(self.r.clock.now() / 60.0)

    def close(self) -> None:
        """What became of the cultures goes into the result."""
        out, t = self.result, self.tracking
        out.peak_error, out.neighbour_error = float(t.peak[0]), float(t.peak[1:].max(initial=0.0))
        out.recovery_min, out.watched_min = float(t.recovery_min[0]), float(t.watched_min[0])
        out.neighbour_recovery_min = float(t.recovery_min[1:].max(initial=0.0))

    def step(self, step: Step) -> None:
        """What interlock and driver said in this pass."""
        struck = step.now_s + self.r.spans[0][0] >= self.struck_s
        for n, name in enumerate(self.r.names):
            mine = name == FAULTY or (self.fault is not None and self.fault.wide)
            for reason in (step.reasons[n] or "").split(" | "):
                kind = reason.split(":")[0]
                if kind in ("", FilterAlarm.kind):  # ordinary noise raises that one several times a day; nobody is told
                    continue
                if not struck:
                    self.result.early_alarms += 1
                elif mine:
                    self.result.kinds[kind] = self.result.kinds.get(kind, 0) + 1
                    response = Response(int(step.response[n]))
                    self.detect(kind, "report" if response == Response.PASS else response.name.lower())
                else:
                    self.result.neighbour_alarms += 1
        for note in step.notes if struck else ():
            words = re.sub(r"[\d.]+", "#", note)
            self.result.notes[words] = self.result.notes.get(words, 0) + 1
            self.detect(f"note:{note}", "note")

    def detect(self, word: str, response: str) -> None:
        """Take a word of the program as the detection, if it is the first that is declared for this fault."""
        if self.fault is None or self.result.reason or self.struck_s == INF:
            return
        for by in self.fault.by:
            kind, _, text = by.partition(":")
            if word == by or (text and word.startswith(f"{kind}:") and text in word):
                self.result.detected_s = round(self.r.clock.now() - self.struck_s, 1)
                self.result.reason, self.result.response = by, response
                return


def _bands(fault: Fault | None, n: int) -> Array:
    """How near each of `n` cultures is to be held, OD: the faulty one first, neighbours as usual unless it is wide."""
    bands = np.full(n, BAND_OD)
    if fault is not None:
        bands[: None if fault.wide else 1] = fault.band
    return bands


def _is_time(moment: str, r: Rehearsal) -> bool:
    """Whether a rehearsal is at one of `fault.VIRTUAL`."""
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
    return r.device.vials[FAULTY].motor("Pump1") != 0


class ChiBioCase:
    """A fault at a moment: `run` gives its `Outcome`.

    Args:
      fault: None for a healthy control run. moment: of `fault.VIRTUAL`.
      config: of the run, as `rehearsed` gives it, with `FAULTY` the first reactor; its overflow pump is the rig's,
        and an overflow may be declared only where there is none.
      seed: of all noise.
    """

    def __init__(self, fault: Fault | None, moment: str, config: DeployConfig, seed: int) -> None:
        self.fault, self.moment, self.config, self.seed = fault, moment, config, seed
        self.result = Outcome(fault.name if fault else "none", moment, bool(config.backend.overflow_pump.pump))
        self.result.allowed_error, self.result.allowed_recovery_min = allowed(fault)
        self._exits = 0  # of the device's software up to the fault, or its end

    def run(self) -> Outcome:
        """Rehearse, judge. Raises: nothing of what the fault brings about."""
        with tempfile.TemporaryDirectory() as folder:
            self.r = Rehearsal(Path(folder), self.config, QUIET, seed=self.seed)
            self.watch = _Watch(self.fault, self.r, self.result)
            self.r.clock.at(1.0, self._wait_for_it)
            self._run_and_resume()
            self._audit()
        return judged(self.result, self.fault)

    def _wait_for_it(self) -> None:
        """Every quarter of a second: is it time for the fault?"""
        r = self.r
        if not hasattr(r, "loop") or not _is_time(self.moment, r):
            r.clock.at(r.clock.now() + 0.25, self._wait_for_it)
            return
        r.device.run_until(r.clock.now())
        self.watch.strike()
        if self.fault is None:
            return
        self._exits = r.device.supervisor.exits
        if not self.fault.program and self.fault.minutes < INF:
            r.clock.at(r.clock.now() + 60.0 * self.fault.minutes, self._mend)
        self.fault.begin(r)

    def _mend(self) -> None:
        """The fault's end, by itself if nobody ends it."""
        assert self.fault is not None
        self.r.device.run_until(self.r.clock.now())
        if self.fault.end is not None:
            self.fault.end(self.r)
            self._exits = self.r.device.supervisor.exits
        self.watch.over()

    def _run_and_resume(self) -> None:
        """The program until the schedule is over; after a fault that ends it, resumed."""
        r = self.r
        limit = 60.0 * (self.config.scenario.total_min + 60.0)
        for _ in range(3):
            ended = ""
            try:
                r.begin()
                for repair in r.record.repairs:
                    self.watch.detect(f"repair:{type(repair).__name__}", "resume")
                for step in r.run(limit):
                    self.watch.step(step)
            except Killed:
                ended = "killed"
            except (ReactorError, RuntimeError) as error:
                ended = f"failed: {error}"
            self.result.pumps_off = ended != "killed" and self._stop()
            r.close()
            self.watch.detect(f"end:{ended}", "stop")
            if self.fault is None or not self.fault.program or not ended:
                break
            r.wait(60.0 * self.fault.minutes)
            if self.fault.end is not None:
                self.fault.end(r)
            self.watch.over()
        given_up = [name for name, s in zip(r.names, r.loop.stopped, strict=True) if s]
        whole = "completed" if r.loop.done.all() else "gave up " + ", ".join(given_up) if given_up else "not finished"
        self.result.outcome = ended or whole

    def _stop(self) -> bool:
        """What deploy does at its end: pumps off, verified. True if every motor is at rest and the claim is right.

        Right is "verified off" for every reactor that is there, and "not verified" for one that is gone.
        """
        unverified = ""
        try:
            self.r.reactors.stop()
        except ReactorError as error:
            unverified = str(error)
        gone = [FAULTY] if self.fault is not None and self.fault.gone else []
        if [name for name in self.r.names if f"{name}: " in unverified] != gone:
            return False
        handed_over = self.r.reactors.handed_over
        return all(
            regulated or not any(self.r.truth(name)["motors"].values())
            for name, regulated in zip(self.r.names, handed_over, strict=True)
        )

    def _audit(self) -> None:
        """What only the emulator knows, against what was recorded."""
        r, out, fault = self.r, self.result, self.fault
        self.watch.close()
        for name in r.names:
            truth = r.truth(name)
            out.peak_ml = max(out.peak_ml, truth["peak_ml"]) if out.peak_ml == out.peak_ml else truth["peak_ml"]
            out.overflowed |= truth["overflowed"]
        dark = None
        if fault is not None and fault.blind:
            lasts = fault.minutes if fault.minutes < INF else 1e6
            dark = (self.watch.struck_s, self.watch.struck_s + 60.0 * (lasts + 6.0))
        out.rows_missed, out.rows_lost, out.rows_doubled = audit_rows(r, dark)
        out.exits = r.device.supervisor.exits - self._exits
        out.neighbours_lost = int((~r.loop.done[1:]).sum())
        journal, _ = read_journal(r.folder / "journal.jsonl")
        for name in r.names:
            if fault is None or not fault.rogue or (name != FAULTY and not fault.wide):
                doubled, repeats = audit_doses(journal, r.device.vials[name].doses, name, r.spans[0][0])
                out.doses_doubled, out.repeats = out.doses_doubled + doubled, out.repeats + repeats
