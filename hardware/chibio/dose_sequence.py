"""Doses of one reactor: from intent to verified off, with carried volumes and doses that the device repeated."""

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np

from conf.messages import Message
from hardware.chibio import messages
from hardware.chibio.agenda import Agenda, Task
from hardware.chibio.config import ChiBioConfig
from hardware.chibio.connection import DRAIN, Connection
from hardware.chibio.diagnosis import fault_of
from hardware.chibio.dosing import DosePlan, PumpCalibration, ReactorCalibration, plan_dose
from hardware.chibio.ending import SAME_S, conclude, found
from hardware.chibio.protocol import FEED, PERIOD_S, PUMPS, WASTE, DeviceState
from hardware.chibio.resume import NEVER, ReactorHistory
from hardware.errors import DeviceStateError, LinkError, ProtocolError, ReactorError
from hardware.logbook import Logbook
from hardware.messages import DoseUnderWay, NoDose, NoNewSample, OpenDose
from hardware.storage.doses import Given

DOSE_OFF_S = 2.0  # from the planned end of a dose to the off command, for delays of link and bus
WASTE_FIRST_S = 1.0  # from waste pump on to feed pump on: a motor starts 0.2 to 0.7 s after the answer
LATE_S = 3600.0  # a tunnel may deliver a command up to this long after the client gave up on it
OFF_AGAIN_S = 2.0  # before an off command is repeated
WINDOW_S = 38.0  # latest end of a dose after its sample; the next measurement begins after 47 s
REFUSALS = 4  # failed attempts in a row to switch the pumps off, until the experiment is ended
SLOW_S = 1.0  # a slower answer to a pump command is reported


def _change(before: float, now: float) -> Message | None:
    """Return a note on a changed target; None if the target is the same, or was unknown before."""
    same = math.isnan(before) or abs(now - before) <= SAME_S / PERIOD_S
    return None if same else messages.TargetChanged(before=before, now=now)


class DoseSequence:
    """The doses of one reactor: one at a time, at most one per sample.

    A dose is planned, written to the journal, set, read back and switched on; tasks on the agenda end it. A pump that
    is ON repeats its dose every 63 s until it is switched off, so a dose that ends late delivers more than planned.

    Args: agenda: shared by all reactors; holds the tasks that end a dose. past: returns the reactor's history from the
      rows of this run, including those before a resume.
    Attributes: running: a dose is under way: its pumps are on, or not yet verified off. stuck: why the pumps could not
      be verified off, or "". escalated: the experiment was ended for this reason and has not started again. extra:
      volumes given beyond those booked when doses began; the caller books and clears them. acted: key of the newest
      sample for which a dose was decided, None if the device's records began anew. stray_s: clock time at which a pump
      without a dose was last seen on or reported.
    """

    def __init__(
        self, connection: Connection, calibration: ReactorCalibration, config: ChiBioConfig, agenda: Agenda,
        book: Logbook, past: Callable[[], ReactorHistory],
    ) -> None:  # fmt: skip
        self._connection, self._calibration, self._config = connection, calibration, config
        self._agenda, self._book, self._past, self._clock = agenda, book, past, connection.clock
        self.running = False
        self.stuck = ""
        self.escalated = False
        self.extra: list[Given] = []
        self.acted: tuple[float, int] | None = None
        self._due_s = math.inf  # clock time at which the dose under way should be over
        self._given_up: dict[str, float] = {}  # pump: run time of an unanswered command that may still be carried out
        self.stray_s = -math.inf
        self._strays: dict[str, tuple[Message, float, float, float]] = {}  # pumps on without a dose, for `_book_stray`
        self._targets: dict[str, float] = {}  # targets of the feed pumps, as last read
        self._quiet_s = 0.0  # newest run time at which every pump that was on had a dose
        self._undrained = False
        self._doubt_s = math.nan  # run time of the last answer before a request in a dose failed, nan if none failed

    def restore(self) -> None:
        """Restore the state before a resume; the caller must then verify the pumps off."""
        history = self._past()
        self._quiet_s = history.seen_s
        self.acted = history.sample
        if history.open:
            self._book.tell(OpenDose(ml=history.feed_ml))

    @property
    def carry_ml(self) -> float:
        """Requested volume kept for the next dose, because the pump cannot deliver so little, mL."""
        return self._past().carry_ml

    @property
    def unsettled(self) -> bool:
        """Whether a dose should be over but its volume is still unknown; a new sample waits a short time for it."""
        return self.running and not self.stuck and self._clock.now() > self._due_s and not math.isnan(self._doubt_s)

    def begin(
        self,
        rate: float,
        sample: tuple[float, int] | None,
        appeared_s: float,
        refusal: Message | None,
        pump: str = FEED,
    ) -> DosePlan:
        """Begin the dose for `sample`; return the dose that was, or may have been, begun. A note explains a refusal.

        Args: rate: mean feed rate, mL/s. sample: key of the newest sample, or None. appeared_s: clock time at which the
          sample appeared, -inf if unknown. refusal: reason against a dose, or None. pump: pump that gives the dose;
          only the feed pump carries volumes over.
        Raises: ValueError for a rate that is negative or not finite; what the journal raises.
        """
        plan = self._plan(rate, pump)
        if reason := refusal or self._obstacle(sample, appeared_s, plan.waste_s):
            self._book.tell(NoDose(why=reason))
            return DosePlan()
        self.acted = sample
        if plan.carry_ml > 0.0 and rate > 0.0 and pump == FEED:
            self._book.tell(messages.KeptForNextDose(ml=plan.carry_ml))
        if plan.shortfall_ml > 0.0:
            self._book.tell(messages.DoseCut(ml=plan.shortfall_ml))
        self._intend(plan, rate)
        return plan if plan.feed_duty > 0.0 and self._switch_on(plan, appeared_s) else DosePlan()

    def _plan(self, rate: float, pump: str) -> DosePlan:
        """Plan the dose of a pump; a spare pump uses its configured flow and carries nothing over."""
        if pump == FEED:
            return plan_dose(rate, self.carry_ml, self._past().doses, self._calibration)
        if pump not in self._config.supply.pumps:
            return DosePlan(pump=pump)
        own = replace(self._calibration, feed=self._calibrated(pump))
        return replace(plan_dose(rate, 0.0, self._past().doses, own), pump=pump)

    def _calibrated(self, pump: str) -> PumpCalibration:
        return self._calibration.feed if pump == FEED else self._config.supply.calibration(pump)

    def _obstacle(self, sample: tuple[float, int] | None, appeared_s: float, waste_s: float) -> Message | None:
        """Return why no dose may be given for this sample now; None if it may."""
        if sample is None or sample == self.acted:
            return NoNewSample()
        if self.running:
            return DoseUnderWay()
        past_s = self._clock.now() - appeared_s
        if math.isinf(past_s):
            return messages.UnknownAge()
        if past_s + waste_s > WINDOW_S:
            return messages.SampleTooOld(past_s=past_s)
        if past_s + 2.0 * self._connection.took_s + waste_s > WINDOW_S:  # time for `_set_targets`
            return messages.TooSlow(past_s=past_s)
        return None

    def _intend(self, plan: DosePlan, rate: float) -> None:
        """Write the dose to the journal before it begins, so that a resumed run gives no second dose for the sample."""
        doses = self._past().doses + (plan.feed_duty > 0.0)
        self._book.write(
            "intent",
            sample=self.acted, rate=rate, feed_duty=plan.feed_duty, waste_duty=plan.waste_duty, feed_ml=plan.feed_ml,
            waste_ml=plan.waste_ml, carry_ml=plan.carry_ml if plan.pump == FEED else self.carry_ml, doses=doses,
            on_s=self._book.elapsed(),
            **({} if plan.pump == FEED else {"feed_pump": plan.pump}),
        )  # fmt: skip

    def _switch_on(self, plan: DosePlan, appeared_s: float) -> bool:
        """Set and read back the targets, switch on, plan the end; return whether the feed pump runs or may run."""
        self.running, fed, wasted_s = True, False, self._clock.now()
        try:
            self._set_targets(plan, appeared_s)
            self._connection.switch(WASTE, True)
            wasted_s = self._clock.now()
            self._clock.sleep(WASTE_FIRST_S)
            fed, asked_s = True, self._clock.now()
            self._book.log("feed_on", on_s=self._book.elapsed())  # before the command: a resumed run must know
            self._connection.switch(plan.pump, True)
            if self._clock.now() - asked_s > SLOW_S:
                self._book.tell(messages.SlowLink(took_s=self._clock.now() - asked_s))
        except ReactorError as error:  # never repeated: the pump may run, and its end is planned below
            self._in_doubt()
            self._book.tell(messages.CommandLost(pump=plan.pump, error=error) if fed else NoDose(why=error))
        finally:
            now, fed_s = self._clock.now(), plan.feed_s + DOSE_OFF_S if fed else 0.0
            if fed:
                self._agenda.add(self._feed_off(plan.pump), fed_s)
            left_s = max(wasted_s + plan.waste_s + DOSE_OFF_S - now, fed_s) if wasted_s < now else 0.0
            self._due_s = now + left_s
            self._agenda.add(self._finish(), left_s)
        return fed

    def _set_targets(self, plan: DosePlan, appeared_s: float) -> None:
        """Set both duties and read them back. Raises: ReactorError if the device is not ready for this dose in time."""
        connection = self._connection
        connection.target(WASTE, plan.waste_duty)
        connection.target(plan.pump, plan.feed_duty)
        state = connection.read()
        targets = [state.pump_targets[PUMPS.index(pump)] for pump in (plan.pump, WASTE)]
        as_set = np.allclose(targets, (plan.feed_duty, plan.waste_duty), rtol=0.0, atol=1e-5)
        on = self._config.overflow_pump.others_on(state)
        if not as_set or on or not state.running or state.regulating:
            raise messages.NotAsSet(targets=tuple(targets), pumps=on or "none")
        past_s = self._clock.now() - appeared_s
        if past_s + plan.waste_s > WINDOW_S:
            raise messages.TooSlow(past_s=past_s)

    def _feed_off(self, pump: str) -> Task:
        """Task: send the feed pump's off command until the device answers."""
        while self.running and self._connection.state is not None:
            try:
                self._look_first()
                self._connection.switch(pump, False)
                return
            except (LinkError, ProtocolError) as error:
                self._in_doubt()
                self._book.report(fault_of(error, present=True))
            except ReactorError:
                pass
            yield self._pause_s()

    def _pause_s(self) -> float:
        """Return the pause until the next attempt, s; it is longer while the reactor is absent or exchanged."""
        return OFF_AGAIN_S if self._connection.state is not None else 30.0

    def _finish(self) -> Task:
        """Task: try until all pumps are verified off, then record the end of the dose."""
        refusals = 0
        while True:
            try:
                self.settle()
                return
            except (LinkError, ProtocolError) as error:
                self._book.report(fault_of(error, present=True))
            except DeviceStateError as error:
                if self._connection.state is not None:
                    self.stuck, refusals = str(error), refusals + 1
                    if refusals == REFUSALS:
                        self.escalated = True
                        self._connection.escalate()
            yield self._pause_s()

    def settle(self, tries: int = 1, overflow_pump: bool = False) -> None:
        """Switch all pumps off, verified, the overflow pump only if requested; record the end of a dose under way.

        If an answer was missing, the device is read first, because its state shows what became of the dose.
        Raises: as `Connection.pumps_off`.
        """
        connection = self._connection
        try:
            self._look_first()
            connection.pumps_off(tries, PUMPS if overflow_pump else self._config.overflow_pump.others)
        except ReactorError as error:
            if isinstance(error, DeviceStateError) and connection.state is not None:
                self._look(connection.state, self._book.elapsed())
            self._in_doubt()
            raise
        self.running, self.stuck, self._due_s, self._doubt_s = False, "", math.inf, math.nan
        if (known := self._past()).open:
            self._conclude(known)
        for pump, stray in self._strays.items():
            self._book_stray(pump, *stray)
        self._strays.clear()
        self._quiet_s = self._book.elapsed()

    def _in_doubt(self) -> None:
        """Note that a request was not answered: since the last answer it is unknown what the device did."""
        if math.isnan(self._doubt_s):
            self._doubt_s = self._book.elapsed() - max(self._clock.now() - self._connection.heard_s, 0.0)

    def _look_first(self) -> None:
        """Read the pumps before they are switched off; a failed read is an error after a missing answer or a resume."""
        left = self._past().open and not self.running
        seen_s = self._past().seen_s if left else self._doubt_s
        try:
            state = self._connection.read()
        except ReactorError:
            if math.isnan(seen_s):
                return
            raise
        self.watch(state)
        self._look(state, seen_s)
        self._doubt_s = seen_s if math.isnan(seen_s) else self._book.elapsed()

    def watch(self, state: DeviceState, ours: bool = True) -> None:
        """Note each feed pump that is on or has a new target without a dose. Args: ours: only this program may dose."""
        known, now = self._past(), self._book.elapsed()
        if not ours or state.start_time != known.start_time:
            self._targets.clear()
        for pump in (FEED, *self._config.supply.pumps):
            target, before = state.pump_targets[PUMPS.index(pump)], self._targets.get(pump, math.nan)
            self._targets[pump], change = target, _change(before, target)
            if not ours or (known.open and pump == known.feed_pump):
                continue
            if pump in state.running_pumps:
                self._strays.setdefault(pump, (change or messages.RanAgain(), target, self._quiet_s, now))
            elif pump not in self._strays and change:
                self._book_stray(pump, change, target, self._quiet_s, math.nan)
        if self._strays:
            self.stray_s = self._clock.now()
        else:
            self._quiet_s = now

    def _look(self, state: DeviceState, seen_s: float) -> None:
        """Record what a read shows of an open dose. Args: seen_s: run time of the last answer; nan: none is missing."""
        known, now, stopped = self._past(), self._book.elapsed(), None
        if not known.open:
            return
        try:
            ago_s = {} if math.isnan(seen_s) else self._connection.switched_off()
            stopped = {pump: now - s for pump, s in ago_s.items() if now - s > known.on_s}
        except ReactorError as error:
            self._book.tell(messages.AgentSaysNothing(error=error))
        if stopped:
            self._book.tell(messages.AgentSwitchedOff(pumps=", ".join(stopped)))
        if known.experiment not in ("", state.start_time):
            self._book.tell(messages.RestartedInDose())
        seen_s, silence_s = now if math.isnan(seen_s) else seen_s, self._config.deadman_s
        if added := found(known, state, now, seen_s, silence_s, stopped, killed=not self.running):
            self._book.log("found", **added)
        for part, pump, set_s in (("feed", known.feed_pump, known.feed_s), ("waste", WASTE, known.waste_s)):
            if f"{part}_anew" in added:
                change = _change(set_s / PERIOD_S, state.pump_targets[PUMPS.index(pump)])
                self._book.tell(messages.ChangedInDose(pump=pump, cause=change or messages.RanAgain()))

    def _conclude(self, known: ReactorHistory) -> None:
        pump = self._calibrated(known.feed_pump)
        ending, note = conclude(known, self._book.elapsed(), pump, self._calibration.waste)
        if note:
            self._book.tell(note)
        self._book.log("dose_end", **ending.row())
        booked_ml = known.feed_ml if known.fed else 0.0
        self.extra += ending.beyond(booked_ml)
        may_be_late = self._book.elapsed() < self._given_up.get(known.feed_pump, -math.inf) + LATE_S
        if known.fed and may_be_late and not note:
            self._book.tell(messages.DosePerhapsTwice(ml=ending.feed_ml, twice_ml=2.0 * ending.feed_ml))
        if known.fed and math.isnan(known.feed_on[1]):
            self._given_up[known.feed_pump] = known.on_s

    def _book_stray(self, pump: str, cause: Message, target: float, off_s: float, seen_s: float) -> None:
        """Book what a pump gave without a dose. Args: off_s, seen_s: run times, last seen off, and seen on (or nan)."""
        self.stray_s = self._clock.now()
        known = self._past()
        dose_s = PERIOD_S * target if target > 0.0 else 0.0
        if known.feed_pump == pump and abs(dose_s - known.feed_s) <= SAME_S:
            seen_s = math.nan  # an old answer that arrives again looks the same
        other = replace(
            known, open=True, feed_ml=0.0, feed_s=dose_s, feed_pump=pump, on_s=off_s, fed=True, wasted=False,
            feed_on=(off_s, seen_s), feed_off=NEVER, feed_anew=NEVER,
        )  # fmt: skip
        ending, _ = conclude(other, self._book.elapsed(), self._calibrated(pump), self._calibration.waste)
        self._given_up.pop(pump, None)
        state = self._connection.state
        alone = state is None or not (state.regulating or state.pumping_modes)  # else the waste pump has run beside it
        given = [replace(one, waste_ml=one.waste_ml * (not alone)) for one in ending.beyond(0.0)]
        for one in given:
            self._book.log("given", **one.row("without a dose"))
        most_ml, low_ml = sum(one.feed_ml for one in given), sum(one.low_ml for one in given)
        self._book.tell(messages.GivenWithoutDose(pump=pump, low_ml=low_ml, most_ml=most_ml, cause=cause))
        self.extra += given
        self._undrained = self._undrained or (alone and bool(given))

    def drain(self) -> None:
        """Run the waste pump for a while if a vial got medium without it. Raises: ReactorError."""
        if not self._undrained or self.running:
            return
        self._undrained, self.running, now_s = False, True, self._book.elapsed()
        self._agenda.add(self._finish(), PERIOD_S * DRAIN + DOSE_OFF_S)
        self._due_s = self._clock.now() + PERIOD_S * DRAIN + DOSE_OFF_S
        self._connection.drain()
        drained = Given(now_s, 0.0, 0.0, self._calibration.waste.volume(PERIOD_S * DRAIN))
        self._book.log("given", **drained.row("drained"))
        self.extra.append(drained)
