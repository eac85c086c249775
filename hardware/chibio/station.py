"""One Chi.Bio reactor under control: start, sample gate, single-shot dose, recovery (docs/device.md, Dosing).

A `Station` adds to the verified conversation (`unit.py`) what has to be remembered from minute to minute. Its longer
actions are tasks on the agenda it shares with its neighbours.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable
from typing import Any

import numpy as np

from hardware.chibio.agenda import Agenda, Task
from hardware.chibio.config import ChiBioConfig
from hardware.chibio.connection import Log, Unit
from hardware.chibio.dosing import DosePlan, Rig, plan_dose
from hardware.chibio.overflow_guard import Guard
from hardware.chibio.protocol import FEED, PERIOD_S, WASTE, DeviceState
from hardware.chibio.resume import Saved
from hardware.clock import Clock
from hardware.errors import DeviceStateError, IdentityError, LinkError, ProtocolError, ReactorError
from hardware.reactor import Fault

__all__ = ["Station"]

CYCLE_S = 60.07  # median of 3275 real cycles (docs/device.md, Cycle)
OLD_CYCLE_S = 70.0  # a stopped cycle thread wakes up to 65 s later and switches everything off once more
FIRST_SAMPLE_S = 13.5  # from a cycle's start until its sample is on record
DOSE_OFF_S = 2.0  # the device ends a dose by itself; the off command comes after it, whatever link and bus take
WASTE_FIRST_S = 1.0  # a motor starts 0.2 to 0.7 s after the answer: fluid must not come before it is taken off
OWN_WILL = ("Zigzag", "Custom", "Chemostat")  # modes that act on the pumps


def _link_fault(error: ReactorError) -> Fault:
    return Fault("link", str(error), "check cable, network and server")


class Station:
    """One reactor under control.

    Args:
      unit: its verified conversation.
      rig: its calibration.
      config: shared values.
      agenda, clock: shared; what must happen later is put on the agenda.
      log: must never raise (see `ChiBioReactors`); `intend` may raise and then nothing is dosed.
      zero: clock time at which the run began.

    Attributes: od, temperature, raw, time_s of the newest sample (nan before the first); arrived_s, the clock time
      at which it appeared; fault; guard, against overflow; busy while the reactor is being started or recovered;
      next_poll; notes for the next receipt; repeated_ml and repeated_waste_ml, what the device may have dosed again on
      its own.
    """

    def __init__(
        self, unit: Unit, rig: Rig, config: ChiBioConfig, agenda: Agenda, clock: Clock, log: Log, intend: Log
    ) -> None:
        self.unit, self.rig, self.config = unit, rig, config
        self._agenda, self._clock, self._log, self._intend_log = agenda, clock, log, intend
        self.guard = Guard(unit, config.guard, log, self.tell)
        self.zero = clock.now()
        self.od = self.temperature = self.raw = self.time_s = math.nan
        self.arrived_s = self.next_poll = clock.now()
        self.fault: Fault | None = None
        self.news = False  # the fault changed since someone last looked
        self.busy = self.dosing = False
        self.notes: list[str] = []
        self.repeated_ml = self.repeated_waste_ml = 0.0
        self.handed_over = math.nan  # setpoint of the on-board regulation, nan while this program controls
        self._target_c = config.temperature
        self._heat = True
        self._blank = math.nan
        self._start_time = ""
        self._sample: tuple[float, int] | None = None  # newest one delivered
        self._acted: tuple[float, int] | None = None  # newest one a dose was decided for
        self._offsets: deque[float] = deque(maxlen=3)  # arrival minus the device's own time, samples seen at once
        self._late_s = 0.0  # how much later than possible the newest sample was seen
        self._looked = False  # the last look found nothing new, so the next sample will be seen when it appears
        self._carry_ml, self._doses = 0.0, 0
        self._stuck = ""  # why the pumps could not be verified off

    @property
    def name(self) -> str:
        """Position, M0 to M7."""
        return self.unit.name

    def elapsed(self) -> float:
        """Run time, s."""
        return self._clock.now() - self.zero

    # ------------------------------------------------------------------------------------------- start and recovery

    def restore(self, saved: Saved) -> None:
        """Take over identity and memory of an earlier run; the pumps, but for the guard, are verified off afterwards.

        A reactor that regulates itself as it was handed over is not interrupted.
        Raises: ReactorError if the reactor is not reachable, another unit, or its pumps stay on.
        """
        self.unit.device_id = saved.device_id
        self._acted, self._carry_ml, self._doses = saved.sample, saved.carry_ml, saved.doses
        if math.isfinite(saved.temperature):
            self._target_c = saved.temperature
        state = self.unit.read()
        self._blank = next((b for b in (saved.blank, self.rig.blank) if math.isfinite(b)), state.blank)
        self.guard.was_on = saved.guarded
        self.handed_over = saved.handed_over
        left_alone = self._regulates(state)
        if not left_alone:
            if state.regulating:  # or it would switch them on again
                self._end_regulation()
            self.pumps_off()
            if running := self._running(state):
                self.tell(f"pumps were found on and switched off: {running}")
        if saved.open:  # the device repeats what was left on every 63 s (docs/device.md, Pumps)
            times = max(math.floor((self.elapsed() - saved.on_s) / PERIOD_S), 0)
            self.repeated_ml = saved.feed_ml * times * state.pumps_on[0]
            self.repeated_waste_ml = saved.waste_ml * times * state.pumps_on[1]
            followed = f"{self.repeated_ml:.2f} mL may have followed"
            if times > 0 and not state.pumps_on[0]:
                followed = "repeated every 63 s until something else switched the pump off: unknown, not booked"
            self.tell(f"a dose of {saved.feed_ml:.2f} mL was left open; {followed}")
            self._log("dose_end", {"reactor": self.name, "verified_off": True, "repeated_ml": self.repeated_ml})

    def bring_up(self, waited: bool = False) -> Task:
        """Task: an experiment that runs with the right blank and targets; a running one is adopted, not restarted.

        Args:
          waited: an old cycle thread is known to have ended.
        Raises (from its steps): ReactorError.
        """
        self.busy = True
        try:
            state = self.unit.read()
            while state.measuring:  # a blank changed in the middle of a measurement would spoil it
                yield 2.0
                state = self.unit.read()
            if not state.running and state.cycles > 0 and not waited and not state.ended:
                yield OLD_CYCLE_S
            self._prepare()
            state = self.unit.read()
            if math.isfinite(state.sample_s):
                self._sample = (state.sample_s, state.cycles)  # of unknown age: wait for the next one
            self._offsets.clear()
            if not state.running:
                self._start()
                if state.cycles == 0:  # then the device's own time begins now, and so does the first cycle
                    self._offsets.append(self._clock.now() + FIRST_SAMPLE_S)
                if not self._heat:  # a start switches the thermostat on
                    self.heat_off()
            if math.isfinite(self.handed_over):
                self._regulate_again()
            self._start_time = self.guard.keep(self.unit.read()).start_time
            self.arrived_s = self.next_poll = self._clock.now()
            identity = {"reactor": self.name, "device_id": self.unit.device_id, "blank": self._blank}
            self._log("device", {**identity, "temperature": self._target_c, "start_time": self._start_time})
        finally:
            self.busy = False

    def _prepare(self) -> None:
        """Blank and targets as they belong to this run; on-board regulation off, unless it was handed over to that."""
        unit, state = self.unit, self.unit.read()
        if acting := [m for m in state.modes if m in OWN_WILL]:
            raise DeviceStateError(f"{self.name}: {', '.join(acting)} is on; switch it off in the device's web page")
        if state.regulating and not math.isfinite(self.handed_over):
            self._end_regulation()
        if abs(state.blank - self._blank) > 0.5:
            unit.post(f"/CalibrateOD/OD0/{self.name}/{self._blank:.6f}/0")
        for item, value, wanted in (
            ("Volume", state.volume_ml, self.config.volume_ml),
            ("Stir", state.stir_target, self.config.stir),
            ("Thermostat", state.temperature_target, self._target_c),
        ):
            if abs(value - wanted) > 1e-5:
                unit.target(item, wanted)
        state = unit.read()
        if abs(state.blank - self._blank) > 0.5 or abs(state.temperature_target - self._target_c) > 1e-3:
            raise DeviceStateError(
                f"{self.name} did not take its settings: blank {state.blank:.1f} (asked {self._blank:.1f}), thermostat "
                f"{state.temperature_target} degC (asked {self._target_c}); run the preflight"
            )

    def _start(self) -> None:
        """Start the experiment; the state is read before every try, because a second start stops it."""
        for _ in range(3):
            if self.unit.read().running:
                return
            try:
                self.unit.post(f"/Experiment/1/{self.name}")
                self.guard.was_on = False  # a start switches every pump off
            except LinkError:
                self._clock.sleep(self.config.retry_s)
        if not self.unit.read().running:
            raise DeviceStateError(f"{self.name}: the experiment does not start; look at the device's terminal")

    def _recover(self, kind: str) -> Task:
        """Task: pumps off, then a running experiment again, by way of a stop if its thread is dead."""
        try:
            self.pumps_off()
            if kind == "stalled":
                self.unit.post(f"/Experiment/0/{self.name}")
                yield OLD_CYCLE_S
            else:
                self._sample = self._acted = None
            yield from self.bring_up(waited=True)
            self.tell(f"recovered from: {kind}")
        finally:
            self.busy = False
            self.arrived_s = self._clock.now()  # a further recovery waits its time

    # ------------------------------------------------------------------------------------------------- measurement

    def poll(self) -> bool:
        """Look at the reactor; True if it has a new sample. Trouble becomes `fault`."""
        self.next_poll = self._clock.now() + self.config.retry_s
        try:
            state = self.guard.keep(self.unit.read())
        except (LinkError, ProtocolError) as error:
            return self._report(_link_fault(error))
        except IdentityError as error:
            return self._report(Fault("identity", str(error), "reactors were exchanged: start a new run"))
        except DeviceStateError as error:
            if self.unit.state is None:
                return self._report(Fault("absent", str(error), "plug it in with the server stopped"))
            return self._report(Fault("selection", str(error), "close the device's web page everywhere"))
        return False if self.busy else self._judge(state)

    def _judge(self, state: DeviceState) -> bool:
        """What a verified state means; True if it brings a new sample."""
        now = self._clock.now()
        self.next_poll = now + self.config.poll_s
        # cycles counts cycles begun: a sample that was seen late may carry the number of the next one already
        is_new = math.isfinite(state.sample_s) and (
            self._sample is None or (state.sample_s != self._sample[0] and state.cycles >= self._sample[1])
        )
        age = 0.0 if is_new else now - self.arrived_s
        fault = self._diagnose(state, age)
        self._report(fault)
        recoverable = fault is not None and (
            fault.kind == "restarted" or (fault.kind == "stalled" and age > self.config.lost_s)
        )
        if fault is not None and recoverable and self.config.recover:
            self.busy = True
            self._agenda.add(self._recover(fault.kind))
        if is_new and (fault is None or fault.kind in ("mode", "pump", "guard")):
            self._take(state, now)
            return True
        self._looked = not is_new
        return False

    def _diagnose(self, state: DeviceState, age_s: float) -> Fault | None:
        if state.start_time != self._start_time or not state.started:
            return Fault(
                "restarted",
                f"the experiment of {self._start_time} is gone, cycles {state.cycles}, blank {state.blank:.0f}",
                "blank and targets are restored and the experiment is started again; check the board's power",
            )
        if not state.running:
            return Fault("stopped", "the experiment was stopped by someone", "start it in the device's web page")
        if abs(state.blank - self._blank) > 0.5:
            return Fault(
                "blank",
                f"the blank was changed from {self._blank:.1f} to {state.blank:.1f}",
                f"set it back (raw {self._blank:.1f}, OD 0) or start a new run",
            )
        if self._stuck:
            return Fault("pump", self._stuck, "switch the pump board off by hand")
        running = self._running(state)
        if running and not self.dosing and not math.isfinite(self.handed_over):
            return Fault("pump", f"pumps on: {running}, not by this program", "close the device's web page everywhere")
        acting = [m for m in state.modes if m in OWN_WILL]
        handed_over = math.isfinite(self.handed_over)
        if acting or (not self._regulates(state) if handed_over else state.regulating):
            what = ", ".join(acting) or self._regulation(state)
            return Fault("mode", f"{what}: not as this program left it", "set it back in the device's web page")
        if age_s > self.config.stale_s:
            return Fault(
                "stalled",
                f"no new sample for {age_s:.0f} s, cycles {state.cycles}",
                f"after {self.config.lost_s:.0f} s its experiment is restarted; look at the device's terminal",
            )
        if self.guard.trouble:
            return Fault("guard", self.guard.trouble, "close the device's web page everywhere; restart the device")
        return None

    def _take(self, state: DeviceState, now: float) -> None:
        """Make a new sample the newest one, note it down, and look after heater and stirrer."""
        self._sample = (state.sample_s, state.cycles)
        self.arrived_s, self.time_s = now, now - self.zero
        self.od, self.temperature, self.raw = state.sample_od, state.sample_temperature, state.raw
        self._time_arrival(now - state.sample_s)
        self.next_poll = now + CYCLE_S - (2.5 if self._looked else 20.0)
        self._looked = False
        reading = {"od": self.od, "temperature": self.temperature, "raw": self.raw, "blank": state.blank}
        timing = {"late_s": self._late_s, "read_s": self.unit.took_s}
        self._log("sample", {"reactor": self.name, "sample": self._sample, **reading, **timing})
        if self._late_s > 30.0 or self.dosing:
            return  # the stirrer may be off for the next measurement already
        self._look_after(state)

    def _look_after(self, state: DeviceState) -> None:
        """Heating and stirring as this run wants them: a quick restart loses them silently, a web page changes them."""
        targets = (
            ("Thermostat", state.temperature_target, self._target_c),
            ("Stir", state.stir_target, self.config.stir),
        )
        switches = (("Thermostat", state.heating, self._heat), ("Stir", state.stirring, self.config.stir > 0.0))
        for item, value, wanted in targets:
            if abs(value - wanted) > 1e-3:
                self._mend(f"{item} was set to {value:g}", f"set back to {wanted:g}", self.unit.target, item, wanted)
        for item, on, needed in switches:
            if needed and not on:
                self._mend(f"{item} was off", "switched on again", self.unit.switch, item, True)

    def _mend(self, found: str, done: str, request: Callable[[str, Any], None], item: str, value: float) -> None:
        try:
            request(item, value)
            self.tell(f"{found} and was {done}")
        except ReactorError as error:
            self.tell(f"{found} and could not be {done}: {error}")

    def _time_arrival(self, offset: float) -> None:
        """How much later than possible this sample was seen: its offset against the smallest of recent ones.

        Only samples that were waited for are a measure, so after three of them a step of the board's clock, which
        looks the same, is forgotten.
        """
        if self._offsets and not -30.0 < offset - min(self._offsets) < 65.0:
            self.tell(f"the board's clock moved by {min(self._offsets) - offset:.0f} s against this computer's")
            self._offsets.clear()
        if self._looked or (self._offsets and offset < min(self._offsets)):
            self._offsets.append(offset)
        self._late_s = offset - min(self._offsets) if self._offsets else math.inf  # already there at the first look

    def _report(self, fault: Fault | None) -> bool:
        """Set or clear the fault; False, because a fault brings no sample."""
        before, self.fault = self.fault, fault
        if (before.kind if before else None) != (fault.kind if fault else None):
            self.news = True
            self._log("fault", {"reactor": self.name, "fault": str(fault) if fault else None})
        return False

    # --------------------------------------------------------------------------------------------------- actuation

    def dose(self, rate: float) -> DosePlan:
        """Begin the dose for the newest sample; returns what was, or may have been, begun.

        Nothing is begun, and a note says why, if that sample was acted on already, is too old for a dose to end
        before the next measurement, or the reactor has a fault.
        Raises: ValueError for a rate that is negative or not finite; what the intent's log raises.
        """
        plan = plan_dose(rate, self._carry_ml, self._doses, self.rig, self.config.dosing)
        if reason := self._obstacle(plan.waste_s):
            self.tell(f"no dose: {reason}")
            return DosePlan()
        self._acted, self._carry_ml = self._sample, plan.carry_ml
        self._doses += plan.feed_duty > 0.0
        if plan.carry_ml > 0.0 and rate > 0.0:
            self.tell(f"{plan.carry_ml:.3f} mL is less than the pump can deliver: kept for the next dose")
        if plan.shortfall_ml > 0.0:
            self.tell(f"the dose was cut by {plan.shortfall_ml:.3f} mL to the feed limit")
        self._intend(plan, rate)
        return plan if plan.feed_duty > 0.0 and self._begin(plan) else DosePlan()

    def _obstacle(self, waste_s: float) -> str:
        """Why nothing may be dosed now; "" if nothing stands against it."""
        if math.isfinite(self.handed_over):
            return "handed over to the on-board regulation"
        if self.busy or self.fault is not None:
            return str(self.fault or "being started")
        if self._sample is None or self._sample == self._acted:
            return "no new sample"
        if self.dosing:
            return "the previous dose has not ended"
        past = self._clock.now() - self.arrived_s + self._late_s
        if math.isinf(past):
            return "its sample is of unknown age, the next one is waited for"
        if past + waste_s > self.config.window_s:
            return f"{past:.0f} s after its sample appeared it would not end before the next measurement"
        return ""

    def _intend(self, plan: DosePlan, rate: float) -> None:
        """Write down what is about to be done. Only then may it be done: a resumed run acts once per sample."""
        duties = {"feed_duty": plan.feed_duty, "waste_duty": plan.waste_duty}
        volumes = {"feed_ml": plan.feed_ml, "waste_ml": plan.waste_ml, "carry_ml": plan.carry_ml}
        memory = {"doses": self._doses, "on_s": self.elapsed()}
        self._intend_log(
            "intent", {"reactor": self.name, "sample": self._acted, "rate": rate, **duties, **volumes, **memory}
        )

    def _begin(self, plan: DosePlan) -> bool:
        """Targets, read back, then on; True if the pumps run or may run. The end is planned before anything is on."""
        unit = self.unit
        try:
            unit.target(WASTE, plan.waste_duty)
            unit.target(FEED, plan.feed_duty)
            state = unit.read()
            told = np.allclose(state.pump_targets[:2], (plan.feed_duty, plan.waste_duty), rtol=0.0, atol=1e-5)
            running = self._running(state)
            if not told or running or not state.running or state.regulating:
                raise DeviceStateError(f"targets {state.pump_targets[:2]}, pumps on: {running or 'none'}: not as set")
            past = self._clock.now() - self.arrived_s + self._late_s
            if past + plan.waste_s > self.config.window_s:
                raise DeviceStateError(f"the device answers too slowly ({past:.0f} s after the sample)")
        except ReactorError as error:
            self.tell(f"no dose: {error}")
            self._agenda.add(self._finish(DosePlan()))
            return False
        self.dosing = True
        self._agenda.add(self._feed_off(), WASTE_FIRST_S + plan.feed_s + DOSE_OFF_S)
        self._agenda.add(self._finish(plan), plan.waste_s + DOSE_OFF_S)
        try:
            unit.switch(WASTE, True)
            self._clock.sleep(WASTE_FIRST_S)
            unit.switch(FEED, True)
        except ReactorError as error:  # never repeated: whether it runs is unknown, that it ends is certain
            self.tell(f"the answer to a pump command was lost, counted as dosed: {error}")
        return True

    def _feed_off(self) -> Task:
        """Task: feed pump off, again and again until the device has heard it."""
        while self.dosing:
            try:
                self.unit.switch(FEED, False)
                return
            except (LinkError, ProtocolError) as error:
                self._report(_link_fault(error))
            except ReactorError:
                pass
            yield min(self.config.retry_s, 2.0)

    def _finish(self, plan: DosePlan) -> Task:
        """Task: the pumps off, verified, however long it takes; then the dose is on record as ended."""
        due = self._clock.now()  # the moment the dose should be over
        self.dosing = True
        for refusals in range(10**9):
            pause = min(self.config.retry_s, 2.0)
            try:
                self.pumps_off(tries=1)
                break
            except (LinkError, ProtocolError) as error:
                self._report(_link_fault(error))
            except DeviceStateError as error:
                if self.unit.state is None:
                    pause = 30.0  # absent or exchanged: nothing may be sent to it
                else:
                    self._stuck = str(error)
                    if refusals == 3:
                        self.escalate()
            yield pause
        self._stuck = ""
        repeats = math.floor((self._clock.now() - due) / PERIOD_S)
        if repeats > 0 and plan.feed_ml > 0.0:  # the device may have repeated the dose in the meantime
            self.repeated_ml += repeats * plan.feed_ml
            self.repeated_waste_ml += repeats * plan.waste_ml
            self.tell(f"the pumps were verified off late: the dose may have been repeated {repeats} times")
        self.dosing = False
        self._log("dose_end", {"reactor": self.name, "verified_off": True, "repeated_ml": repeats * plan.feed_ml})

    def pumps_off(self, tries: int = 3) -> None:
        """All pumps off, verified, but for the overflow guard's. Raises: as `Unit.pumps_off`."""
        self.unit.pumps_off(tries, self.config.guard.others)

    def give_up(self) -> None:
        """All pumps off for good, verified; on-board regulation too, or it would dose again. Raises: ReactorError."""
        if math.isfinite(self.handed_over):
            self.unit.switch("OD", False)
            self._log("regulate", {"reactor": self.name, "setpoint": None})
            self.handed_over = math.nan
            self.tell("on-board regulation switched off: the reactor is given up")
        self.pumps_off(tries=1)

    def _running(self, state: DeviceState) -> str:
        """Names of the pumps that are on beside the overflow guard's."""
        return ", ".join(p for p in state.running_pumps if p in self.config.guard.others)

    def escalate(self) -> None:
        """A pump that stays on: end the experiment (which switches everything off), then touch the bus."""
        for path in (f"/Experiment/0/{self.name}", f"/MeasureTemp/IR/{self.name}"):
            try:
                self.unit.post(path)
            except ReactorError as error:
                self._log("escalation", {"reactor": self.name, "path": path, "error": str(error)})

    def set_temperature(self, target_c: float) -> None:
        """Thermostat target, degC; nan leaves it. A failure becomes a note, and the next call tries again."""
        if math.isnan(target_c) or abs(target_c - self._target_c) < 1e-6:
            return
        try:
            self.unit.target("Thermostat", target_c)
        except ReactorError as error:
            self.tell(f"thermostat target {target_c} degC not set, tried again with the next sample: {error}")
            return
        self._target_c = target_c
        self._log("temperature", {"reactor": self.name, "temperature": target_c})

    def set_blank(self, raw: float) -> None:
        """Make `raw` counts read as OD 0, here and on the device. Raises: ReactorError, also outside 3000 to 60000."""
        self.unit.post(f"/CalibrateOD/OD0/{self.name}/{raw:.6f}/0")
        self._blank = raw

    def heat_off(self) -> None:
        """Thermostat and heater off, and not switched on again. Raises: ReactorError."""
        self._heat = False
        self.unit.switch("Thermostat", False)
        self.unit.switch("Heat", False)

    def regulate(self, setpoint: float) -> None:
        """Hand over to the on-board regulation, which feeds at most 0.02 of full power; target and ON read back.

        Written down before it is done: a run that is killed in between hands over when it is resumed.
        Raises: ReactorError.
        """
        self.pumps_off()
        self._log("regulate", {"reactor": self.name, "setpoint": setpoint})
        self.unit.target("OD", setpoint)
        self.unit.switch("OD", True)
        state = self.unit.read()
        if not (state.regulating and abs(state.regulation_target - setpoint) <= 1e-5):
            raise DeviceStateError(f"{self.name}: {self._regulation(state)} after it was switched on at {setpoint:g}")
        self.handed_over = setpoint

    def _end_regulation(self) -> None:
        self.unit.switch("OD", False)
        if not math.isfinite(self.handed_over):
            self.tell("the on-board OD regulation was found on and switched off: this run controls")

    def _regulates(self, state: DeviceState) -> bool:
        """Whether it regulates itself as it was handed over; False if it never was."""
        return state.regulating and abs(state.regulation_target - self.handed_over) <= 1e-5

    @staticmethod
    def _regulation(state: DeviceState) -> str:
        return f"on-board OD regulation is {'on' if state.regulating else 'off'}, target {state.regulation_target:g}"

    def _regulate_again(self) -> None:
        """It was handed over for good, so it stays so over a restart of program or device. Raises: ReactorError."""
        state = self.unit.read()
        what = "left to it"
        if not self._regulates(state):
            self.regulate(self.handed_over)
            what = f"handed over again, because its {self._regulation(state)}"
        self.tell(f"handed over to the on-board regulation at OD {self.handed_over:g} earlier in this run: {what}")

    def tell(self, note: str) -> None:
        """A note for the next receipt and the log."""
        self.notes.append(note)
        self._log("note", {"reactor": self.name, "note": note})
