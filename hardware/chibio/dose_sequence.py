"""One dose from intent to verified off, what is carried to the next, and what the device may have repeated."""

import math
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from hardware.chibio.agenda import Agenda, Task
from hardware.chibio.config import ChiBioConfig
from hardware.chibio.connection import Connection
from hardware.chibio.diagnosis import fault_of
from hardware.chibio.dosing import DosePlan, PumpCalibration, ReactorCalibration, plan_dose
from hardware.chibio.logbook import Logbook
from hardware.chibio.protocol import FEED, PUMPS, WASTE, DeviceState
from hardware.chibio.resume import ReactorHistory, conclude, repeats_until
from hardware.errors import DeviceStateError, LinkError, ProtocolError, ReactorError
from hardware.storage.doses import Ending

__all__ = ["DoseSequence"]

DOSE_OFF_S = 2.0  # the device ends a dose by itself; the off command comes after it, whatever link and bus take
WASTE_FIRST_S = 1.0  # a motor starts 0.2 to 0.7 s after the answer: the waste motor must already turn when feed arrives


@dataclass(frozen=True)
class _Begun:
    """A dose whose end is not on record.

    on_s: run time at which its feed pump was switched on, before that at which it was intended, s. wasted, fed: its
    pumps were, or may have been, switched on. feed_off_s: run time at which the device took the feed's off, else nan.
    experiment: start time of the device's experiment in which it was begun.
    """

    plan: DosePlan
    on_s: float
    wasted: bool = False
    fed: bool = False
    feed_off_s: float = math.nan
    experiment: str = ""


class DoseSequence:
    """The doses of one reactor, one at a time, at most one per sample.

    A dose is planned, written down, set, read back and switched on; its ends are tasks on the agenda. A pump that is ON
    repeats its dose every 63 s until it is switched off, so a late end means that more was dosed than planned.

    Attributes: running, whether a dose is under way: its pumps are on, or not yet verified off; stuck, why they could
      not be verified off; escalated, whether the experiment was ended for that, and not started again since; endings,
      of doses that the device has repeated, until somebody books and clears them.
    """

    def __init__(
        self,
        connection: Connection,
        calibration: ReactorCalibration,
        config: ChiBioConfig,
        agenda: Agenda,
        book: Logbook,
    ) -> None:
        self._connection, self._calibration, self._config = connection, calibration, config
        self._agenda, self._clock, self._book = agenda, connection.clock, book
        self.running = False
        self.stuck = ""
        self.escalated = False
        self.endings: list[Ending] = []
        self._begun: _Begun | None = None
        self._acted: tuple[float, int] | None = None  # newest sample a dose was decided for
        self._carry_ml, self._doses = 0.0, 0

    def restore(self, history: ReactorHistory, state: DeviceState) -> None:
        """Continue as an earlier life of the run left it; the pumps were verified off after `state` was read.

        The device repeats a dose that was left open every 63 s, whatever becomes of the program.
        """
        self._acted, self._carry_ml, self._doses = history.sample, history.carry_ml, history.doses
        if history.open:
            self._conclude(*conclude(history, state, self._book.elapsed(), self._config.deadman_s))

    @property
    def carry_ml(self) -> float:
        """Asked for and put off to the next dose, because it is less than the pump can deliver, mL."""
        return self._carry_ml

    def forget_sample(self) -> None:
        """The device's records begin anew: no dose was decided for any sample in them."""
        self._acted = None

    def begin(
        self, rate: float, sample: tuple[float, int] | None, appeared_s: float, refusal: str, pump: str = FEED
    ) -> DosePlan:
        """Begin the dose for `sample`; returns what was, or may have been, begun.

        Nothing is begun, and a note says why, if that sample was acted on already, is too old for a dose to end
        before the next measurement, or the reactor may not be dosed at all.

        Args:
          rate: mean feed rate, mL/s.
          sample: its key, None if there is none; appeared_s: clock time at which it appeared, -inf if unknown.
          refusal: why the reactor may not be dosed, "" if it may.
          pump: that gives it: the feed pump, or a supply pump, whose doses are carried nowhere.
        Raises: ValueError for a rate that is negative or not finite; what the intent's log raises.
        """
        plan = self._plan(rate, pump)
        if reason := refusal or self._obstacle(sample, appeared_s, plan.waste_s):
            self._book.tell(f"no dose: {reason}")
            return DosePlan()
        self._acted = sample
        if pump == FEED:
            self._carry_ml = plan.carry_ml
        self._doses += plan.feed_duty > 0.0
        if plan.carry_ml > 0.0 and rate > 0.0 and pump == FEED:
            self._book.tell(f"{plan.carry_ml:.3f} mL is less than the pump can deliver: kept for the next dose")
        if plan.shortfall_ml > 0.0:
            self._book.tell(f"the dose was cut by {plan.shortfall_ml:.3f} mL to the feed limit")
        if plan.feed_duty > 0.0:  # before it is written down: a signal in between must not leave it without an end
            self._begun = _Begun(plan, self._book.elapsed())
        self._intend(plan, rate)
        return plan if plan.feed_duty > 0.0 and self._switch_on(plan, appeared_s) else DosePlan()

    def _plan(self, rate: float, pump: str) -> DosePlan:
        """The dose by a pump; every pump but the feed has its declared flow and starts without a carry."""
        if pump == FEED:
            return plan_dose(rate, self._carry_ml, self._doses, self._calibration, self._config.dosing)
        if pump not in self._config.supply.pumps:
            return DosePlan(pump=pump)
        own = replace(self._calibration, feed=self._calibrated(pump))
        return replace(plan_dose(rate, 0.0, self._doses, own, self._config.dosing), pump=pump)

    def _calibrated(self, pump: str) -> PumpCalibration:
        """Flow of the pump that feeds."""
        return self._calibration.feed if pump == FEED else self._config.supply.calibration(pump)

    def _obstacle(self, sample: tuple[float, int] | None, appeared_s: float, waste_s: float) -> str:
        """Why no dose may be given for this sample now; "" if nothing stands against it."""
        if sample is None or sample == self._acted:
            return "no new sample"
        if self.running:
            return "the previous dose has not ended"
        past = self._clock.now() - appeared_s
        if math.isinf(past):
            return "its sample is of unknown age, the next one is waited for"
        if past + waste_s > self._config.window_s:
            return f"{past:.0f} s after its sample appeared it would not end before the next measurement"
        return ""

    def _intend(self, plan: DosePlan, rate: float) -> None:
        """Write down what is about to be done. Only then may it be done: a resumed run acts once per sample."""
        self._book.intend(
            sample=self._acted, rate=rate, feed_duty=plan.feed_duty, waste_duty=plan.waste_duty, feed_ml=plan.feed_ml,
            waste_ml=plan.waste_ml, carry_ml=self._carry_ml, doses=self._doses, on_s=self._book.elapsed(),
            **({} if plan.pump == FEED else {"feed_pump": plan.pump}),
        )  # fmt: skip

    def _switch_on(self, plan: DosePlan, appeared_s: float) -> bool:
        """Targets, read back, then on; True if the feed runs or may run. The end is planned before anything is on."""
        try:
            self._set_targets(plan, appeared_s)
        except ReactorError as error:
            self._book.tell(f"no dose: {error}")
            self._agenda.add(self._finish())
            return False
        self.running = True
        self._agenda.add(self._feed_off(plan.pump), WASTE_FIRST_S + plan.feed_s + DOSE_OFF_S)
        self._agenda.add(self._finish(), plan.waste_s + DOSE_OFF_S)
        fed = False
        try:
            self._mark(wasted=True)
            self._connection.switch(WASTE, True)
            self._clock.sleep(WASTE_FIRST_S)
            fed, on_s = True, self._book.elapsed()
            self._mark(fed=True, on_s=on_s)
            self._book.log("feed_on", on_s=on_s)  # before it is done: a resumed run must know that it may have been fed
            self._connection.switch(plan.pump, True)
        except ReactorError as error:  # never repeated: whether it runs is unknown, that it ends is certain
            counted = "counted as dosed" if fed else "no dose was begun"
            self._book.tell(f"the answer to a pump command was lost, {counted}: {error}")
        return fed

    def _mark(self, **known: Any) -> None:
        """Note what has become of the dose under way."""
        if self._begun is not None:
            self._begun = replace(self._begun, **known)

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
            raise DeviceStateError(f"targets {tuple(targets)}, pumps on: {on or 'none'}: not as set")
        self._mark(experiment=state.start_time)
        past = self._clock.now() - appeared_s
        if past + plan.waste_s > self._config.window_s:
            raise DeviceStateError(f"the device answers too slowly ({past:.0f} s after the sample)")

    def _feed_off(self, pump: str) -> Task:
        """Task: feed pump off, again and again until the device has heard it."""
        while self.running:
            try:
                self._connection.switch(pump, False)
                self._mark(feed_off_s=self._book.elapsed())
                return
            except (LinkError, ProtocolError) as error:
                self._book.report(fault_of(error, present=True))
            except ReactorError:
                pass
            yield min(self._config.retry_s, 2.0)

    def _finish(self) -> Task:
        """Task: the pumps off, verified, however long it takes; then the dose is on record as ended."""
        self.running = True
        for refusals in range(10**9):
            pause = min(self._config.retry_s, 2.0)
            try:
                self._connection.pumps_off(1, self._config.overflow_pump.others)
                break
            except (LinkError, ProtocolError) as error:
                self._book.report(fault_of(error, present=True))
            except DeviceStateError as error:
                if self._connection.state is None:
                    pause = 30.0  # absent or exchanged: nothing may be sent to it
                else:
                    self.stuck = str(error)
                    if self._begun is not None and self._begun.plan.pump in self._connection.state.running_pumps:
                        self._mark(feed_off_s=math.nan)  # it was answered, not done
                    if refusals == 3:
                        self.escalated = True
                        self._connection.escalate()
            yield pause
        self.ended(self._book.elapsed())

    def ended(self, off_s: float) -> None:
        """The pumps were switched off at run time `off_s` and verified: a dose under way is over, and so on record."""
        self.running, self.stuck = False, ""
        if (begun := self._begun) is None:
            return
        self._begun = None
        ending, note = self._ending(begun, off_s), ""
        state = self._connection.state
        if begun.experiment and state is not None and state.start_time != begun.experiment:
            note = "the device was restarted in a dose, which ended it"
            ending = replace(ending, feed_times=0, waste_times=0)
        elif ending.feed_times > 0:
            note = f"the pumps were verified off late: the dose may have been repeated {ending.feed_times} times"
        self._conclude(ending, note)

    def _ending(self, begun: _Begun, off_s: float) -> Ending:
        """What a dose gave until its pumps were off: less than planned where it was cut short, more where late."""
        plan, calibration = begun.plan, self._calibration
        feed_off_s = off_s if math.isnan(begun.feed_off_s) else begun.feed_off_s
        ending = Ending(begun.on_s, pump=0 if plan.pump == FEED else PUMPS.index(plan.pump) + 1)
        if begun.wasted:
            waste_ml = calibration.waste.volume(min(plan.waste_s, off_s - begun.on_s))
            ending = replace(ending, waste_ml=waste_ml, waste_times=repeats_until(off_s, begun.on_s))
        if begun.fed:
            feed_ml = self._calibrated(plan.pump).volume(min(plan.feed_s, feed_off_s - begun.on_s))
            ending = replace(ending, feed_ml=feed_ml, feed_times=repeats_until(feed_off_s, begun.on_s))
        return ending

    def _conclude(self, ending: Ending, note: str) -> None:
        """A dose is over: on record, and its repetitions wait to be booked."""
        if note:
            self._book.tell(note)
        self._book.log("dose_end", **ending.row())
        if ending.feed_times or ending.waste_times:
            self.endings.append(ending)
