"""Preflight: every check passes on a sound device and fails with a remedy on the trouble it is for."""

import math
from dataclasses import replace
from pathlib import Path

import pytest

from hardware.check import Check
from hardware.chibio.dosing import PumpCalibration, ReactorCalibration
from hardware.chibio.overflow_pump import OverflowPumpConfig
from hardware.chibio.preflight import preflight
from tests.campaigns.rehearsal import SOUND
from tests.hardware.driver_lab import DriverLab


def checks(lab: DriverLab, rig: ReactorCalibration = SOUND) -> dict[str, Check]:
    found = preflight(lab.wire, lab.clock, lab.config, [rig] * len(lab.names), Path("."))
    return {check.name: check for check in found}


def test_a_sound_device_passes_and_nothing_is_switched() -> None:
    lab = DriverLab(("M0", "M1"), overflow_pump=OverflowPumpConfig("Pump3"))
    found = checks(lab)
    assert all(check.ok for check in found.values()), "\n".join(map(str, found.values()))
    assert {"disk", "connection", "board clock", "M0 present", "M1 blank", "M1 pump calibration"} <= set(found)
    assert {path.split("/")[1] for _, path in lab.wire.posts} == {"changeDevice", "MeasureTemp"}
    assert str(found["M0 modes"]) == "pass  M0 modes: none active"


def test_without_an_overflow_pump_a_note_says_what_may_happen_and_nothing_else_is_wrong() -> None:
    found = checks(DriverLab())
    assert [check.name for check in found.values() if not check.ok] == ["overflow pump"]
    assert str(found["overflow pump"]) == (
        "note  overflow pump: none: with a blocked waste tube a vial overflows after about 10 mL of feed -> a second "
        "waste tube on Pump3, backend.overflow_pump.pump=Pump3 (docs/device.md)"
    )


@pytest.mark.parametrize(
    ("pump", "feed_ml_s", "ok", "covers"),
    [
        (OverflowPumpConfig("Pump3", 0.1), 1.0, True, "covers a blocked waste tube;"),
        (OverflowPumpConfig("Pump3", 0.95), 1.0, True, "covers a blocked waste tube;"),
        (OverflowPumpConfig("Pump4", 0.95, 1.2), 1.0, True, "covers a blocked waste tube and a feed motor stuck on;"),
        (OverflowPumpConfig("Pump3", 0.1, 0.5), 1.5, False, "0.05 mL/s"),
    ],
)
def test_what_an_overflow_pump_covers(pump: OverflowPumpConfig, feed_ml_s: float, ok: bool, covers: str) -> None:
    found = checks(
        DriverLab(overflow_pump=pump), ReactorCalibration(PumpCalibration(flow_ml_s=feed_ml_s), SOUND.waste)
    )["overflow pump"]
    assert (found.ok, found.required) == (ok, False)
    assert covers in found.detail
    assert "verified on when the run starts" in found.detail


def test_an_overflow_pump_is_judged_by_the_strongest_feed_pump() -> None:
    """Of 1.14 mL/s that it takes, M0 feeds 0.8 and M1 1.5."""
    lab = DriverLab(("M0", "M1"), overflow_pump=OverflowPumpConfig("Pump4", 0.95, 1.2))
    weak, strong = (ReactorCalibration(PumpCalibration(flow_ml_s=flow), SOUND.waste) for flow in (0.8, 1.5))
    for rigs, covers in (((weak, strong), False), ((strong, weak), False), ((weak, weak), True)):
        found = preflight(lab.wire, lab.clock, lab.config, list(rigs), Path("."))
        (check,) = (check for check in found if check.name == "overflow pump")
        assert ("and a feed motor stuck on" in check.detail) == covers
        assert f"feed pump {0.8 if covers else 1.5:.2f} mL/s" in check.detail


def test_a_guard_that_runs_already_is_no_pump_left_on() -> None:
    lab = DriverLab(overflow_pump=OverflowPumpConfig("Pump3"))
    for path in ("/SetOutputTarget/Pump3/M0/0.1", "/SetOutputOn/Pump3/1/M0"):
        lab.device.handle("POST", path)
    assert checks(lab)["M0 pumps"].ok


@pytest.mark.parametrize(
    ("posts", "name", "required"),
    [
        (["/SetOutputOn/Zigzag/1/M0"], "M0 modes", True),
        (["/SetOutputOn/OD/1/M0"], "M0 modes", False),
        (["/SetOutputTarget/Pump1/M0/0.02", "/SetOutputOn/Pump1/1/M0"], "M0 pumps", False),
        (["/CalibrateOD/OD0/M0/500/0"], "M0 blank", True),
    ],
)
def test_trouble_on_the_device(posts: list[str], name: str, required: bool) -> None:
    lab = DriverLab()
    for path in posts:
        lab.device.handle("POST", path)
    check = checks(lab)[name]
    assert not check.ok
    assert check.remedy
    assert check.required == required
    assert str(check).startswith("FAIL" if required else "note")


def test_an_uncalibrated_device_and_a_stored_blank() -> None:
    lab = DriverLab(blanked=False)
    assert not checks(lab)["M0 blank"].ok
    assert "experiments.blank" in checks(lab)["M0 blank"].remedy
    assert checks(lab, ReactorCalibration(SOUND.feed, SOUND.waste, 14000.0))["M0 blank"].ok


def test_pumps_never_weighed_weighed_elsewhere_or_too_weak() -> None:
    lab = DriverLab()
    never = checks(lab, ReactorCalibration())["M0 pump calibration"]
    assert (never.ok, never.required) == (False, False)
    elsewhere = ReactorCalibration(
        PumpCalibration(date="2026-01-01", device_id="other"), PumpCalibration(date="2026-01-01")
    )
    assert "another unit" in checks(lab, elsewhere)["M0 pump calibration"].detail
    weak = checks(lab, ReactorCalibration(PumpCalibration(flow_ml_s=1.5), PumpCalibration(flow_ml_s=0.3)))[
        "M0 waste over feed"
    ]
    assert (weak.ok, weak.required) == (False, True)


def test_an_absent_reactor_a_dead_sensor_a_lost_link() -> None:
    lab = DriverLab(("M0",))
    lab.config = type(lab.config)(reactors=("M0", "M5"))
    found = preflight(lab.wire, lab.clock, lab.config, [SOUND] * 2)
    assert [c.ok for c in found if c.name == "M5 present"] == [False]
    lab = DriverLab()
    lab.reactors.begin()
    lab.fault("spectrometer_dead")
    lab.run(2)
    assert not checks(lab)["M0 light sensor"].ok
    lab.fault("crash")
    found = checks(lab)
    assert not found["connection"].ok
    assert "M0 present" not in found
    assert math.isfinite(lab.clock.now())


@pytest.mark.parametrize(("speed", "required", "remedy"), [(1.0, True, "faster link"), (60.0, False, "backend.speed")])
def test_slow_answers_end_a_run_on_a_bench_and_none_in_fast_motion(speed: float, required: bool, remedy: str) -> None:
    """A computer that is busy answers 40 ms late, which at speed 60 are 2.4 s."""
    lab = DriverLab()
    lab.config = replace(lab.config, speed=speed)
    lab.fault("slow_s", value=2.4)
    found = checks(lab)["connection"]
    assert (found.ok, found.required) == (False, required)
    assert found.detail == "2.40 s per answer"
    assert remedy in found.remedy
