"""The overflow pump: on with its duty from the first dose to the end of the run, whatever happens in between."""

import json
import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from hardware.chibio import messages
from hardware.chibio.config import ChiBioConfig
from hardware.chibio.overflow_pump import OverflowPumpConfig
from hardware.chibio.protocol import parse_state
from hardware.emulator.device import DeviceOptions, plant_preset
from hardware.emulator.server import build, parser
from hardware.emulator.vial import VialConfig
from hardware.errors import DeviceStateError
from hardware.messages import NotLeftOff
from tests.hardware.driver_lab import DriverLab, begun
from tests.hardware.script import state

PUMP = OverflowPumpConfig("Pump3", 0.5)


def tubed(pump: OverflowPumpConfig = PUMP) -> DeviceOptions:
    return DeviceOptions(vial=VialConfig(overflow_pump=pump.pump))


def plumbed(pump: OverflowPumpConfig = PUMP, **config: Any) -> DriverLab:
    """Driver and emulated device with a second waste tube."""
    return DriverLab(options=tubed(pump), overflow_pump=pump, **config)


def guarded(rate: float | None = None, minutes: float = 0.0) -> DriverLab:
    """Such a lab whose run began `minutes` ago."""
    return begun(options=tubed(), overflow_pump=PUMP, rate=rate, minutes=minutes)


def posts(lab: DriverLab) -> list[str]:
    return [path for _, path in lab.wire.posts if "/Pump3/" in path]


def runs(lab: DriverLab) -> bool:
    """What the device holds of the overflow pump is what was configured."""
    pump = lab.device.apps["M0"].data["Pump3"]
    return bool(pump["ON"] == 1 and pump["target"] == PUMP.duty)


# -- configuration ---------------------------------------------------------------------------------------------------


def test_there_is_none_by_default() -> None:
    assert ChiBioConfig().overflow_pump == OverflowPumpConfig()
    assert not OverflowPumpConfig().pump
    lab = begun(minutes=3)
    lab.reactors.stop()
    assert set(posts(lab)) == {"/SetOutputOn/Pump3/0/M0"}


@pytest.mark.parametrize(
    ("on", "target", "seen"),
    [(1, 0.5, ""), (0, 0.5, "off"), *((1, duty, f"at a duty of {duty:g}") for duty in (0.1, 0.49, math.nan))],
)
def test_what_a_read_shows_of_it(on: int, target: float, seen: str) -> None:
    found = parse_state(json.dumps(state(Pump3__ON=on, Pump3__target=target)).encode())
    assert PUMP.wrong(found).startswith(seen)
    assert bool(PUMP.wrong(found)) == bool(seen)
    assert not OverflowPumpConfig().wrong(found)
    assert OverflowPumpConfig("Pump4", 0.5).wrong(found) == "off"  # it looks at its own pump
    assert (OverflowPumpConfig("Pump3", 0.5, 2.0).removes_ml_s, OverflowPumpConfig().removes_ml_s) == (1.0, 0.0)


# -- a run -----------------------------------------------------------------------------------------------------------


def test_it_is_verified_on_before_the_first_dose_and_stays_on_over_doses_until_the_end() -> None:
    lab = guarded()
    assert runs(lab)
    assert [(row["pump"], row["duty"], row["found"]) for row in lab.of("overflow_pump")] == [("Pump3", 0.5, "off")]
    lab.run(20)
    assert len(lab.of("intent")) >= 15
    assert posts(lab) == ["/SetOutputTarget/Pump3/M0/0.500000", "/SetOutputOn/Pump3/1/M0"]
    starts = [d.start_s for d in lab.device.vials["M0"].doses if d.pump == "Pump3"]
    assert np.diff(starts) == pytest.approx(63.5, abs=0.5)  # the device's own period, never begun anew
    assert lab.of("fault") == []
    assert not [row for row in lab.of("note") if "overflow pump" in row["note"]]
    lab.reactors.stop()
    assert lab.motors_off()
    assert lab.device.apps["M0"].data["Pump3"]["ON"] == 0
    lab.reactors.stop()
    lab.clock.sleep(200.0)
    assert lab.motors_off()


def test_a_trip_switches_the_others_off_and_leaves_it_on() -> None:
    lab = guarded(rate=0.02, minutes=3)
    while not lab.step().rows[0]:
        pass
    lab.clock.sleep(0.5)
    assert lab.truth()["motors"]["Pump2"] == 1
    assert lab.reactors.pumps_off(np.array([True])) == []
    assert not any(lab.truth()["motors"][p] for p in ("Pump1", "Pump2", "Pump4"))
    assert runs(lab)
    lab.fault("spectrometer_dead")
    lab.run(5)
    assert "spectrometer" in lab.kinds()
    assert runs(lab)


@pytest.mark.parametrize(
    ("path", "found"), [("/SetOutputOn/Pump3/0/M0", "off"), ("/SetOutputTarget/Pump3/M0/0.1", "at a duty of 0.1")]
)
@pytest.mark.parametrize("anew", [False, True])
def test_another_client_that_changes_it_is_told_of_and_set_right(path: str, found: str, anew: bool) -> None:
    """Also where a new run found it on."""
    lab = guarded(minutes=3)
    if anew:
        lab.client()
        lab.reactors.begin()
        lab.run(3)
    lab.device.handle("POST", path)
    lab.run(2)
    assert runs(lab)
    assert [note["found"] for note in lab.notes(messages.PutRight)] == [found]
    assert lab.kinds() <= {"jump"} if anew else not lab.kinds()  # to a new run the culture is as it is
    assert lab.samples[0] >= 5


def test_a_pump_beside_it_that_someone_switches_on_is_still_found() -> None:
    lab = guarded(rate=0.0, minutes=3)
    for path in ("/SetOutputTarget/Pump4/M0/0.1", "/SetOutputOn/Pump4/1/M0"):
        lab.device.handle("POST", path)
    lab.run(3)
    assert "pump" in lab.kinds()
    assert lab.truth()["motors"]["Pump4"] == 0
    assert runs(lab)


def test_one_that_cannot_be_verified_on_is_an_alarm_with_a_remedy_and_no_dose_is_given() -> None:
    lab = guarded(rate=0.0, minutes=3)
    lab.device.handle("POST", "/SetOutputOn/Pump3/0/M0")
    lab.fault("lying", -1)
    lab.law.rate = 0.01
    before, given = lab.samples[0], len(lab.of("intent"))
    lab.run(5)
    reasons = [text for step in lab.steps if "overflow_pump:" in (text := step.reasons[0] or "")]
    assert "overflow pump Pump3 is off after" in reasons[0]
    assert "no dose" in reasons[0]
    assert "restart the device" in reasons[0]
    assert len(lab.of("intent")) == given
    assert lab.samples[0] >= before + 4  # its samples go on
    lab.fault("lying", 0)
    lab.run(3)
    assert runs(lab)
    assert lab.reactors.stations[0].book.fault is None
    assert len(lab.of("intent")) > given


@pytest.mark.parametrize(
    ("fault", "value", "error"), [("lying", 1, messages.NotReady), ("reset_before", -1, NotLeftOff)]
)
def test_a_run_does_not_begin_without_it_and_leaves_no_pump_on_or_says_so(fault: str, value: int, error: Any) -> None:
    lab = plumbed()
    lab.device.handle("POST", "/Experiment/1/M0")
    lab.clock.sleep(90.0)

    def deaf(path: str, real: Any) -> Any:
        on = path == "/SetOutputOn/Pump3/1/M0"
        reply = None if fault == "lying" else real(path)
        if on:
            lab.fault(fault, value)
        return reply or real(path)

    lab.on_post(deaf)
    with pytest.raises(error):
        lab.reactors.begin()
    assert fault != "lying" or lab.motors_off()


@pytest.mark.parametrize(
    ("moment", "error"),
    [
        ("/SetOutputOn/Pump3/1/M0", KeyboardInterrupt),
        ("/Experiment/1/M1", KeyboardInterrupt),
        ("/SetOutputOn/Pump3/1/M1", KeyboardInterrupt),
        ("", DeviceStateError),  # the second reactor is in another mode
    ],
)
def test_a_start_that_is_interrupted_or_fails_leaves_it_on_nowhere(moment: str, error: type[BaseException]) -> None:
    """Nobody looks at the bench any more, and it would suck air, or more, for days."""
    lab = DriverLab(("M0", "M1"), options=tubed(), overflow_pump=PUMP)
    lab.device.handle("POST", f"/SetOutputOn/Zigzag/{int(not moment)}/M1")

    def interrupted(path: str, real: Any) -> Any:
        reply = real(path)
        if path == moment:
            raise KeyboardInterrupt
        return reply

    lab.on_post(interrupted)
    with pytest.raises(error):
        lab.reactors.begin()
    assert lab.device.apps["M0"].data["Pump3"]["target"] == 0.5  # it had been on
    assert lab.motors_off()
    lab.clock.sleep(200.0)
    assert lab.motors_off()
    assert not any(lab.device.apps[name].data["Pump3"]["ON"] for name in lab.names)


@pytest.mark.parametrize("trouble", ["restarted", "stopped"])
def test_a_device_that_lost_its_memory_or_ended_its_experiment_gets_it_back(trouble: str) -> None:
    lab = guarded(minutes=5)
    if trouble == "restarted":
        lab.fault("worker_wipe")
    else:
        lab.device.handle("POST", "/Experiment/0/M0")  # its last cycle ends with everything off
    lab.run(5)
    assert trouble in lab.kinds()
    assert runs(lab)
    assert (lab.reactors.stations[0].book.fault is None) == (trouble == "restarted")


def test_a_start_of_its_own_that_switches_it_off_is_no_change_by_somebody_else() -> None:
    """A cycle thread that died: the experiment is ended and started again, which switches every pump off."""
    lab = guarded(minutes=5)
    before = len(posts(lab))
    lab.fault("cycle_dead")
    lab.run(20)
    assert any((row["name"], row["fields"]) == ("RestartedAfter", {"kind": "stalled"}) for row in lab.of("note"))
    assert "/SetOutputOn/Pump3/1/M0" in posts(lab)[before:]
    assert runs(lab)
    assert not [row["note"] for row in lab.of("note") if "overflow pump" in row["note"]]


def test_a_reactor_handed_over_to_its_own_regulation_keeps_it_beyond_the_end_of_the_run() -> None:
    lab = guarded(minutes=5)
    assert lab.reactors.regulate(np.array([True]), np.array([0.5])) == []
    lab.run(10)
    assert runs(lab)
    assert lab.reactors.stations[0].book.fault is None
    lab.reactors.stop()
    lab.clock.sleep(600.0)
    assert runs(lab)
    assert lab.truth()["od"] == pytest.approx(0.5, abs=0.1)


# -- resume ----------------------------------------------------------------------------------------------------------


def test_a_resumed_run_finds_it_on_and_does_not_interrupt_it() -> None:
    lab = guarded(minutes=3)
    before = posts(lab)
    lab.resume(500.0)
    lab.run(5)
    assert posts(lab) == before
    assert runs(lab)
    starts = [d.start_s for d in lab.device.vials["M0"].doses if d.pump == "Pump3"]
    assert np.diff(starts) == pytest.approx(63.5, abs=0.5)
    lab.reactors.stop()
    assert lab.motors_off()


def test_a_resumed_run_tells_that_it_was_off_meanwhile() -> None:
    lab = guarded(minutes=3)
    for k in (1, 2, 3, 4):  # what the board agent does when nobody asks for two minutes
        lab.device.handle("POST", f"/SetOutputOn/Pump{k}/0/M0")
    lab.resume(300.0)
    lab.run(2)
    assert runs(lab)
    assert lab.notes(messages.PutRight)[-1]["found"] == "off"


# -- what it prevents ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("pump", "peak"), [(OverflowPumpConfig("Pump4", 0.1), 23.5), (OverflowPumpConfig(), 30.0)])
def test_a_blocked_waste_tube_at_the_largest_feed(pump: OverflowPumpConfig, peak: float) -> None:
    lab = plumbed(pump)
    lab.law.rate = 0.02
    lab.reactors.begin()
    lab.fault("waste_gain_factor", 0.0)
    lab.run(30)
    assert lab.truth()["peak_ml"] == pytest.approx(peak, abs=1.0)
    assert lab.truth()["overflowed"] == (not pump.pump)


@pytest.mark.parametrize(("flow_ml_s", "overflows"), [(1.0, True), (1.2, False)])
def test_a_feed_motor_stuck_at_full_power_needs_one_that_is_stronger(flow_ml_s: float, overflows: bool) -> None:
    """0.95 of the time at the feed pump's own 1 mL/s is less than the feed: the headroom is gone in minutes."""
    pump = OverflowPumpConfig("Pump3", 0.95, flow_ml_s)
    plant = plant_preset("healthy")
    plant = replace(plant, pump=replace(plant.pump, overflow_ml_s=flow_ml_s))
    options = DeviceOptions(vial=VialConfig(overflow_pump="Pump3"), plant=plant)
    lab = begun(options=options, overflow_pump=pump, minutes=3)
    lab.fault("feed_stuck_open")
    lab.run(15)
    assert "falls" in lab.kinds()
    assert lab.truth()["overflowed"] == overflows


def test_the_emulator_has_one_if_it_is_told_so() -> None:
    device = build(parser().parse_args(["--overflow-pump", "Pump4", "--overflow-flow", "1.3", "--plant", "bench"]))
    assert device.vials["M0"].config.overflow_pump == "Pump4"
    assert device.vials["M0"].plant.config.pump.overflow_ml_s == 1.3
    assert build(parser().parse_args([])).vials["M0"].config.overflow_pump == ""
    with pytest.raises(ValueError, match="vial.overflow_pump = Pump2: allowed Pump3, Pump4"):
        VialConfig(overflow_pump="Pump2")
