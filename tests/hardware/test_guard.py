"""The overflow guard: on with its duty from the first dose to the end of the run, whatever happens in between."""

import json
import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from hardware.chibio.config import ChiBioConfig
from hardware.chibio.overflow_guard import GuardConfig
from hardware.chibio.protocol import parse_state
from hardware.chibio.resume import replay
from hardware.emulator.device import DeviceOptions
from hardware.emulator.plants import plant_preset
from hardware.emulator.server import build, parser
from hardware.emulator.vial_config import VialConfig
from hardware.errors import DeviceStateError
from tests.hardware.driver_lab import Bed
from tests.hardware.script import state

GUARD = GuardConfig("Pump3", 0.5)


def rig(guard: GuardConfig = GUARD, **config: Any) -> Bed:
    """Driver and emulated device with a second waste tube."""
    options = DeviceOptions(vial=VialConfig(overflow_pump=guard.pump))
    return Bed(options=options, guard=guard, **config)


def guard_posts(bed: Bed) -> list[str]:
    return [path for _, path in bed.wire.posts if "/Pump3/" in path]


def runs(bed: Bed) -> bool:
    """What the device holds of the guard's pump is what was configured."""
    pump = bed.device.apps["M0"].data["Pump3"]
    return bool(pump["ON"] == 1 and pump["target"] == GUARD.duty)


# -- configuration ---------------------------------------------------------------------------------------------------


def test_there_is_none_by_default() -> None:
    assert ChiBioConfig().guard == GuardConfig()
    assert not GuardConfig().pump
    bed = Bed()
    bed.reactors.begin()
    bed.run(3)
    bed.reactors.stop()
    assert set(guard_posts(bed)) == {"/SetOutputOn/Pump3/0/M0"}


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"pump": "Pump2"}, "guard.pump = Pump2: allowed Pump3, Pump4, or '' for none"),
        ({"pump": "3"}, "guard.pump = 3: allowed"),
        ({"pump": "Pump3", "duty": 1.0}, "guard.duty = 1.0: allowed 0.1 to 0.95"),
        ({"duty": 0.05}, "guard.duty = 0.05: allowed"),
        ({"duty": math.nan}, "guard.duty = nan: allowed"),
        ({"flow_ml_s": 0.0}, "guard.flow_ml_s = 0.0 mL/s: allowed"),
    ],
)
def test_values_out_of_range_name_key_value_and_range(values: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        GuardConfig(**values)


@pytest.mark.parametrize(
    ("on", "target", "seen"), [(1, 0.5, ""), (0, 0.5, "off"), (1, 0.1, "at a duty of 0.1"), (1, math.nan, "at a duty")]
)
def test_what_a_read_shows_of_it(on: int, target: float, seen: str) -> None:
    found = parse_state(json.dumps(state(Pump3__ON=on, Pump3__target=target)).encode())
    assert GUARD.astray(found).startswith(seen)
    assert bool(GUARD.astray(found)) == bool(seen)
    assert not GuardConfig().astray(found)


# -- a run -----------------------------------------------------------------------------------------------------------


def test_it_is_verified_on_before_the_first_dose_and_stays_on_over_doses_until_the_end() -> None:
    bed = rig()
    bed.reactors.begin()
    assert runs(bed)
    assert [(row["pump"], row["duty"], row["found"]) for row in bed.of("guard")] == [("Pump3", 0.5, "off")]
    bed.run(20)
    assert len(bed.of("intent")) >= 15
    assert guard_posts(bed) == ["/SetOutputTarget/Pump3/M0/0.500000", "/SetOutputOn/Pump3/1/M0"]
    starts = [d.start_s for d in bed.device.vials["M0"].doses if d.pump == "Pump3"]
    assert np.diff(starts) == pytest.approx(63.5, abs=0.5)  # the device's own period, never begun anew
    assert bed.of("fault") == []
    assert not [row for row in bed.of("note") if "guard" in row["note"]]
    bed.reactors.stop()
    assert bed.motors_off()
    assert bed.device.apps["M0"].data["Pump3"]["ON"] == 0
    bed.reactors.stop()
    bed.clock.sleep(200.0)
    assert bed.motors_off()


def test_a_trip_switches_the_others_off_and_leaves_it_on() -> None:
    bed = rig()
    bed.controller = lambda m: np.full(1, 0.02)
    bed.reactors.begin()
    bed.run(3)
    while not bed.step().fresh[0]:
        pass
    bed.clock.sleep(0.5)
    assert bed.truth()["motors"]["Pump2"] == 1
    assert bed.reactors.pumps_off(np.array([True])) == []
    assert not any(bed.truth()["motors"][p] for p in ("Pump1", "Pump2", "Pump4"))
    assert runs(bed)
    bed.fault("spectrometer_dead")
    bed.run(5)
    assert "spectrometer" in bed.kinds()
    assert runs(bed)


@pytest.mark.parametrize(
    ("path", "found"), [("/SetOutputOn/Pump3/0/M0", "found off"), ("/SetOutputTarget/Pump3/M0/0.1", "a duty of 0.1")]
)
def test_another_client_that_changes_it_is_told_of_and_set_right(path: str, found: str) -> None:
    bed = rig()
    bed.reactors.begin()
    bed.run(3)
    bed.device.handle("POST", path)
    bed.run(2)
    assert runs(bed)
    notes = [row["note"] for row in bed.of("note") if "overflow guard" in row["note"]]
    assert len(notes) == 1
    assert found in notes[0]
    assert bed.kinds() == set()
    assert bed.samples[0] >= 5


def test_a_pump_beside_it_that_someone_switches_on_is_still_found() -> None:
    bed = rig()
    bed.controller = lambda m: np.zeros(1)
    bed.reactors.begin()
    bed.run(3)
    for path in ("/SetOutputTarget/Pump4/M0/0.1", "/SetOutputOn/Pump4/1/M0"):
        bed.device.handle("POST", path)
    bed.run(3)
    assert "pump" in bed.kinds()
    assert bed.truth()["motors"]["Pump4"] == 0
    assert runs(bed)


def test_one_that_cannot_be_verified_on_is_an_alarm_with_a_remedy_and_no_dose_is_given() -> None:
    bed = rig()
    bed.controller = lambda m: np.zeros(1)
    bed.reactors.begin()
    bed.run(3)
    bed.device.handle("POST", "/SetOutputOn/Pump3/0/M0")
    bed.fault("lying", -1)
    bed.controller = lambda m: np.full(1, 0.01)
    before, given = bed.samples[0], len(bed.of("intent"))
    bed.run(5)
    told = [v.reasons[0] or "" for v in bed.verdicts if "guard" in v.kinds[0]]
    assert "the overflow guard, Pump3, is off after it was set to 0.5 and on" in told[0]
    assert "no dose" in told[0]
    assert "restart the device" in told[0]
    assert len(bed.of("intent")) == given
    assert bed.samples[0] >= before + 4  # its samples go on
    bed.fault("lying", 0)
    bed.run(3)
    assert runs(bed)
    assert bed.reactors.stations[0].fault is None
    assert len(bed.of("intent")) > given


def test_a_run_does_not_begin_without_it_and_leaves_no_pump_on() -> None:
    bed = rig()
    bed.device.handle("POST", "/Experiment/1/M0")
    bed.clock.sleep(90.0)
    inner = bed.wire.inner
    real = inner.post

    def deaf(path: str) -> Any:
        bed.fault("lying", int(path == "/SetOutputOn/Pump3/1/M0"))
        return real(path)

    inner.post = deaf  # type: ignore[method-assign]
    with pytest.raises(DeviceStateError, match="Pump3, is off after it was set to 0.5 and on; run the preflight"):
        bed.reactors.begin()
    assert bed.motors_off()


def test_a_start_that_fails_at_one_reactor_leaves_no_guard_on_at_another() -> None:
    options = DeviceOptions(vial=VialConfig(overflow_pump="Pump3"))
    bed = Bed(("M0", "M1"), options=options, guard=GUARD)
    bed.device.handle("POST", "/SetOutputOn/Zigzag/1/M1")
    with pytest.raises(DeviceStateError, match="Zigzag"):
        bed.reactors.begin()
    assert bed.device.apps["M0"].data["Pump3"]["target"] == 0.5  # it had been on
    assert bed.motors_off()


def test_a_start_that_fails_and_cannot_switch_it_off_again_says_so() -> None:
    bed = rig()
    bed.device.handle("POST", "/Experiment/1/M0")
    bed.clock.sleep(90.0)
    inner = bed.wire.inner
    real = inner.post

    def dying(path: str) -> Any:
        reply = real(path)
        if path == "/SetOutputOn/Pump3/1/M0":
            bed.fault("reset_before", -1)
        return reply

    inner.post = dying  # type: ignore[method-assign]
    with pytest.raises(DeviceStateError, match="reset; overflow guard not verified off: M0: .*reset"):
        bed.reactors.begin()


def test_a_device_that_lost_its_memory_gets_it_back() -> None:
    bed = rig()
    bed.reactors.begin()
    bed.run(5)
    bed.fault("worker_wipe")
    bed.run(4)
    assert "restarted" in bed.kinds()
    assert runs(bed)
    assert bed.reactors.stations[0].fault is None


def test_a_stopped_experiment_keeps_it() -> None:
    bed = rig()
    bed.reactors.begin()
    bed.run(3)
    bed.device.handle("POST", "/Experiment/0/M0")
    bed.run(5)  # its last cycle ends with everything off
    assert "stopped" in bed.kinds()
    assert runs(bed)


def test_a_reactor_handed_over_to_its_own_regulation_keeps_it_beyond_the_end_of_the_run() -> None:
    bed = rig()
    bed.reactors.begin()
    bed.run(5)
    assert bed.reactors.regulate(np.array([True]), np.array([0.5])) == []
    bed.run(10)
    assert runs(bed)
    assert bed.reactors.stations[0].fault is None
    bed.reactors.stop()
    bed.clock.sleep(600.0)
    assert runs(bed)
    assert bed.truth()["od"] == pytest.approx(0.5, abs=0.1)


# -- resume ----------------------------------------------------------------------------------------------------------


def resume(bed: Bed, dead_s: float) -> None:
    began, rows = bed.reactors.elapsed(), json.loads(json.dumps(bed.rows))
    bed.clock.sleep(dead_s)
    bed.client()
    bed.reactors.begin(replay(rows), began + dead_s)


def test_a_resumed_run_finds_it_on_and_does_not_interrupt_it() -> None:
    bed = rig()
    bed.reactors.begin()
    bed.run(3)
    before = guard_posts(bed)
    resume(bed, 500.0)
    bed.run(5)
    assert guard_posts(bed) == before
    assert runs(bed)
    starts = [d.start_s for d in bed.device.vials["M0"].doses if d.pump == "Pump3"]
    assert np.diff(starts) == pytest.approx(63.5, abs=0.5)
    bed.reactors.stop()
    assert bed.motors_off()


def test_a_resumed_run_tells_that_it_was_off_meanwhile() -> None:
    bed = rig()
    bed.reactors.begin()
    bed.run(3)
    for k in (1, 2, 3, 4):  # what the board agent does when nobody asks for two minutes
        bed.device.handle("POST", f"/SetOutputOn/Pump{k}/0/M0")
    resume(bed, 300.0)
    assert runs(bed)
    assert ["the overflow guard was found off" in row["note"] for row in bed.of("note")][-1]


# -- what it prevents ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("guard", "peak"), [(GuardConfig("Pump4", 0.1), 23.5), (GuardConfig(), 30.0)])
def test_a_blocked_waste_tube_at_the_largest_feed(guard: GuardConfig, peak: float) -> None:
    bed = rig(guard)
    bed.controller = lambda m: np.full(1, 0.02)
    bed.reactors.begin()
    bed.fault("waste_gain_factor", 0.0)
    bed.run(30)
    assert bed.truth()["peak_ml"] == pytest.approx(peak, abs=1.0)
    assert bed.truth()["overflowed"] == (not guard.pump)


@pytest.mark.parametrize(("flow_ml_s", "overflows"), [(1.0, True), (1.2, False)])
def test_a_feed_motor_stuck_at_full_power_needs_a_guard_that_is_the_stronger_pump(
    flow_ml_s: float, overflows: bool
) -> None:
    """0.95 of the time at the feed pump's own 1 mL/s is less than the feed: the headroom is gone in minutes."""
    guard = GuardConfig("Pump3", 0.95, flow_ml_s)
    plant = plant_preset("healthy")
    plant = replace(plant, pump=replace(plant.pump, overflow_ml_s=flow_ml_s))
    bed = Bed(options=DeviceOptions(vial=VialConfig(overflow_pump="Pump3"), plant=plant), guard=guard)
    bed.reactors.begin()
    bed.run(3)
    bed.fault("feed_stuck_open")
    bed.run(60)
    assert "falls" in bed.kinds()
    assert bed.truth()["overflowed"] == overflows


def test_the_emulator_has_one_if_it_is_told_so() -> None:
    device = build(parser().parse_args(["--overflow-pump", "Pump4", "--overflow-flow", "1.3", "--plant", "bench"]))
    assert device.vials["M0"].config.overflow_pump == "Pump4"
    assert device.vials["M0"].plant.config.pump.overflow_ml_s == 1.3
    assert build(parser().parse_args([])).vials["M0"].config.overflow_pump == ""
    with pytest.raises(ValueError, match="vial.overflow_pump = Pump2: allowed Pump3, Pump4"):
        VialConfig(overflow_pump="Pump2")
