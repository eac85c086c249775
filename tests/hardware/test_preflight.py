"""Preflight: every check passes on a sound device and fails with a remedy on its trouble; blanks and weighed doses."""

import json
import math
from dataclasses import replace
from datetime import UTC, datetime
from email.utils import format_datetime
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from envs.bench import Bench
from hardware.chibio import messages
from hardware.chibio.config import ChiBioConfig
from hardware.chibio.dosing import PumpCalibration, ReactorCalibration
from hardware.chibio.overflow_pump import OverflowPumpConfig
from hardware.chibio.preflight import _board_clock, _disk, _link, _reactor, preflight
from hardware.chibio.procedures import dose_series, measure_blanks, warm_up
from hardware.chibio.protocol import parse_state
from hardware.clock import VirtualClock
from hardware.family import Check
from hardware.link.transport import Reply
from hardware.reactor import Measurement, Vitals
from tests.campaigns.rehearsal import SOUND
from tests.hardware.driver_lab import DriverLab, begun
from tests.hardware.script import state


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


def test_an_uncalibrated_device_and_a_stored_blank() -> None:
    lab = DriverLab(blanked=False)
    assert not checks(lab)["M0 blank"].ok
    assert "experiments.blank" in checks(lab)["M0 blank"].remedy
    stored = checks(lab, ReactorCalibration(SOUND.feed, SOUND.waste, 13123.0))["M0 blank"]
    assert (stored.ok, stored.detail) == (True, "13123 counts (stored)")


def test_an_absent_reactor_a_dead_sensor_a_lost_link() -> None:
    lab = DriverLab(("M0",))
    lab.config = type(lab.config)(reactors=("M0", "M5"))
    found = preflight(lab.wire, lab.clock, lab.config, [SOUND] * 2)
    assert [c.ok for c in found if c.name == "M5 present"] == [False]
    lab = begun()
    lab.fault("spectrometer_dead")
    lab.run(2)
    assert not checks(lab)["M0 light sensor"].ok
    lab.fault("crash")
    found = checks(lab)
    assert not found["connection"].ok
    assert "M0 present" not in found
    assert math.isfinite(lab.clock.now())


# -- each check by itself, from its limit on --------------------------------------------------------------------------


def pump(flow_ml_s: float = 1.0, date: str = "2026-02-03", device_id: str = "") -> PumpCalibration:
    return PumpCalibration(flow_ml_s, date=date, device_id=device_id)


SEEN = parse_state(json.dumps(state()).encode())


@pytest.mark.parametrize(
    ("name", "right", "wrong", "detail", "required"),
    [
        ("temperature", {"temperature": 44.9}, {"temperature": 45.1}, "45.1 degC", True),
        ("temperature", {"temperature": 10.1}, {"temperature": 9.9}, "9.9 degC", True),
        ("light sensor", {"raw": 5.0, "cycles": 1}, {"raw": 4.0, "cycles": 1}, "raw 4 after 1 cycles", True),
        ("light sensor", {"raw": 1.0, "cycles": 0}, {"raw": 1.0, "cycles": 7}, "raw 1 after 7 cycles", True),
        ("blank", {"blank": 60000.0}, {"blank": 60001.0}, "60001 counts (of the device)", True),
        ("blank", {"blank": 3000.0}, {"blank": 2999.0}, "2999 counts (of the device)", True),
        ("modes", {"modes": ()}, {"modes": ("Zigzag", "FP2")}, "Zigzag, FP2", True),
        ("modes", {"regulating": False}, {"regulating": True}, "OD regulation", False),
        ("pumps", {"pumps_on": (False, False, True, False)},
         {"pumps_on": (False, True, True, False)}, "Pump2 on", False),
    ],
)  # fmt: skip
def test_what_a_reactor_shows_is_judged_from_its_limit_on(
    name: str, right: dict[str, Any], wrong: dict[str, Any], detail: str, required: bool
) -> None:
    config = ChiBioConfig(overflow_pump=OverflowPumpConfig("Pump3"))
    for shown, ok in ((right, True), (wrong, False)):
        found = _reactor("M4", replace(SEEN, **shown), ReactorCalibration(pump(), pump()), config)
        (check,) = (check for check in found if check.name == f"M4 {name}")
        assert check.ok is ok
    assert (check.detail, check.required) == (detail, required)
    assert check.remedy
    assert str(check).startswith("FAIL" if required else "note")


@pytest.mark.parametrize(
    ("rig", "weighed", "strong", "detail"),
    [
        (ReactorCalibration(pump(2.0), pump(0.75)), True, True, "waste moves 1.5 times the feed in its on-time"),
        (ReactorCalibration(pump(2.0), pump(0.7)), True, False, "waste moves 1.4 times the feed"),
        (ReactorCalibration(pump(0.8), pump(date="")), False, True, "feed 2026-02-03, waste never weighed"),
        (ReactorCalibration(pump(device_id="7"), pump()), False, True, "on another unit"),
        (ReactorCalibration(pump(), pump(device_id="7")), False, True, "on another unit"),
    ],
)
def test_both_pumps_of_a_reactor_are_judged(rig: ReactorCalibration, weighed: bool, strong: bool, detail: str) -> None:
    found = {check.name: check for check in _reactor("M4", replace(SEEN, device_id="9"), rig, ChiBioConfig())}
    pumps, waste = found["M4 pump calibration"], found["M4 waste over feed"]
    assert (pumps.ok, pumps.required, waste.ok, waste.required) == (weighed, False, strong, True)
    assert detail in f"{pumps.detail} {waste.detail}"
    assert f"until then {rig.feed.flow_ml_s:g} mL/s is assumed" in pumps.remedy


class Board:
    """A board whose clock runs by so many seconds in one real second; an answer takes `takes_s` of device time."""

    def __init__(self, clock: VirtualClock, runs: float, takes_s: float = 0.0) -> None:
        self.clock, self.runs, self.takes_s = clock, runs, takes_s

    def get(self, path: str) -> Reply:
        self.clock.sleep(self.takes_s)
        shown = datetime(2026, 1, 5, tzinfo=UTC).timestamp() + self.runs * self.clock.now()
        return Reply(200, b"{}", format_datetime(datetime.fromtimestamp(shown, UTC), usegmt=True))


@pytest.mark.parametrize(
    ("speed", "runs", "ok", "seen"),
    [
        (1.0, 1.0, True, "+0.0 s"),
        (1.0, 1.4, True, "+2.0 s"),
        (1.0, 1.6, False, "+3.0 s"),
        (1.0, 0.4, False, "-3.0 s"),
        (0.25, 4.0, True, "+0.0 s"),  # 5 s of the device are 20 s here, and on the board
        (0.25, 1.0, False, "-15.0 s"),
    ],
)
def test_a_board_s_clock_runs_as_this_computer_s_does(speed: float, runs: float, ok: bool, seen: str) -> None:
    clock = VirtualClock(100.0)
    check = _board_clock(Board(clock, runs), clock, ChiBioConfig(speed=speed))  # type: ignore[arg-type]
    assert (check.ok, check.detail) == (ok, f"{seen} against this computer")


@pytest.mark.parametrize(
    ("takes_s", "speed", "ok", "required"), [(1.9, 1.0, True, True), (2.1, 1.0, False, True), (2.1, 5.0, False, False)]
)
def test_an_answer_takes_less_than_two_seconds(takes_s: float, speed: float, ok: bool, required: bool) -> None:
    clock = VirtualClock()
    check = _link(Board(clock, 1.0, takes_s), clock, speed)  # type: ignore[arg-type]
    assert (check.ok, check.required, check.detail) == (ok, required, f"{takes_s:.2f} s per answer")


@pytest.mark.parametrize(("free_mb", "ok"), [(1001.0, True), (999.0, False)])
def test_a_disk_has_a_gigabyte_left(monkeypatch: pytest.MonkeyPatch, free_mb: float, ok: bool) -> None:
    monkeypatch.setattr("shutil.disk_usage", lambda folder: SimpleNamespace(free=free_mb * 1e6))
    check = _disk(Path("runs"))
    assert (check.ok, check.detail) == (ok, f"{free_mb:.0f} MB free")
    assert check.remedy == "free at least 1000 MB under runs"


def test_the_fullest_vial_overflows_first() -> None:
    lab = DriverLab(("M0", "M1"))
    bench = Bench(volume_ml=14.0, volumes_ml={"M0": 26.0})
    found = preflight(lab.wire, lab.clock, lab.config, [SOUND] * 2, None, bench)
    (check,) = (check for check in found if check.name == "overflow pump")
    assert "a vial overflows after about 4 mL of feed" in check.detail


def test_a_blank_is_the_mean_of_the_counts_of_its_own_reactor() -> None:
    lab = begun(("M0", "M1"), od=0.001, blanked=False)
    mean, sd = measure_blanks(lab.reactors, 5)
    for i, name in enumerate(lab.names):
        counts = [row["raw"] for row in lab.of("sample") if row["reactor"] == name][:5]
        assert len(set(counts)) == 5
        assert mean[i] == pytest.approx(sum(counts) / 5.0)
        assert sd[i] == pytest.approx(np.sqrt(sum((c - mean[i]) ** 2 for c in counts) / 4.0))
        assert lab.device.apps[name].data["OD0"]["target"] == pytest.approx(mean[i], abs=1e-6)


def test_no_blank_is_taken_while_something_is_wrong() -> None:
    lab = begun(od=0.001, blanked=False)
    before = lab.device.apps["M0"].data["OD0"]["target"]
    lab.clock.sleep(5.0)
    lab.device.handle("POST", "/SetOutputTarget/Pump1/M0/0.01")
    lab.device.handle("POST", "/SetOutputOn/Pump1/1/M0")
    with pytest.raises(messages.FaultsStand):
        measure_blanks(lab.reactors, 5)
    assert lab.device.apps["M0"].data["OD0"]["target"] == before


class Told:
    """Two reactors whose counts and temperatures are told minute by minute; `blanks` are those that were set."""

    def __init__(self, counts: list[tuple[float, float]], degc: list[tuple[float, float]]) -> None:
        self.names, self.config = ("M0", "M6"), SimpleNamespace(temperature=33.0)
        self.counts, self.degc, self.minute, self.blanks = counts, degc, 0, dict[str, float]()
        self.stations = [
            SimpleNamespace(set_blank=lambda v, name=name: self.blanks.update({name: v})) for name in self.names
        ]

    def elapsed(self) -> float:
        return 60.0 * self.minute

    def measure(self) -> Measurement:
        k, self.minute = min(self.minute, len(self.counts) - 1), self.minute + 1
        vitals = Vitals(np.zeros(2), np.array(self.counts[k]), (None, None))
        degc = np.array(self.degc[min(k, len(self.degc) - 1)])
        return Measurement(np.full(2, self.elapsed()), np.full(2, 0.0), degc, np.ones(2, bool), vitals)


@pytest.mark.parametrize(
    ("counts", "refused"),
    [
        ((3000.0, 3004.0), None),
        ((2990.0, 3000.0), (2995.0, 7.0)),
        ((59990.0, 60000.0), None),
        ((60000.0, 60010.0), (60005.0, 7.0)),
        ((14000.0, 14380.0), None),  # their sd is 1.9 % of their mean
        ((14000.0, 14420.0), (14210.0, 297.0)),
    ],
)
def test_a_blank_that_none_can_be_is_refused_and_no_reactor_is_set(counts: Any, refused: Any) -> None:
    told = Told([(12000.0, counts[0]), (12010.0, counts[1]), (99.0, 99.0)], [(33.0, 33.0)])
    if refused is None:
        mean, _ = measure_blanks(told, 2)  # type: ignore[arg-type]
        assert told.blanks == {"M0": 12005.0, "M6": pytest.approx(sum(counts) / 2.0)}
        assert mean[1] == told.blanks["M6"]
    else:
        with pytest.raises(messages.NoBlank) as error:
            measure_blanks(told, 2)  # type: ignore[arg-type]
        assert error.value.fields == {"reactor": "M6", "counts": refused[0], "sd": pytest.approx(refused[1], abs=0.5)}
        assert told.blanks == {}


def test_a_vial_that_does_not_become_warm_is_named_with_its_temperature() -> None:
    """The first is within 0.5 degC of its 33 all along, the second warms by half a degree a minute."""
    warming = [(33.4, 25.0 + 0.5 * k) for k in range(60)]
    told = Told([(9000.0, 9000.0)] * 60, warming)
    with pytest.raises(messages.NotWarm) as error:
        list(warm_up(told, 0.5, 6.5))  # type: ignore[arg-type]
    assert list(error.value.fields.values()) == ["M6", 28.0, 7.0, 33.0, 0.5]
    told = Told([(9000.0, 9000.0)] * 60, warming)
    said = list(warm_up(told, 0.5, 30.0, every_min=5.0))  # type: ignore[arg-type]
    assert said == [(1.0, 25.0), (6.0, 27.5), (11.0, 30.0), (16.0, 32.5)]
    assert told.minute == 17  # 32.5 and 33 degC are two samples in a row


class Pump:
    """A connection that remembers when it was asked for what."""

    name = "M2"

    def __init__(self, clock: VirtualClock, running: bool = False) -> None:
        self.clock, self.running, self.asked = clock, running, list[tuple[Any, ...]]()

    def read(self) -> Any:
        return SimpleNamespace(running=self.running)

    def pumps_off(self) -> None:
        self.asked.append((self.clock.now(), "off"))

    def target(self, pump: str, duty: float) -> None:
        self.asked.append((self.clock.now(), pump, duty))

    def switch(self, pump: str, on: bool) -> None:
        self.asked.append((self.clock.now(), pump, on))


def test_doses_that_are_weighed_last_as_long_as_the_device_takes_for_them() -> None:
    """63 s of a duty of 0.02, and 2 s in which the motor may start late; then 2 s of rest."""
    clock = VirtualClock()
    pump = Pump(clock)
    assert list(dose_series(pump, clock, "Pump2", 0.02, 3)) == [1, 2, 3]  # type: ignore[arg-type]
    assert pump.asked[:2] == [(0.0, "off"), (0.0, "Pump2", 0.02)]
    on, off = ([at for at, *what in pump.asked[2:] if what == words] for words in (["Pump2", True], ["off"]))
    assert on == pytest.approx([0.0, 5.26, 10.52])
    assert off[:3] == pytest.approx([3.26, 8.52, 13.78])
    assert off[3:] == [clock.now()]
    series = dose_series(pump, clock, "Pump1", 0.02, 9)  # type: ignore[arg-type]
    next(series)
    before = len(pump.asked)
    series.close()  # somebody has seen enough
    assert [what for _, *what in pump.asked[before:]] == [["off"]]
    with pytest.raises(messages.ExperimentRuns):
        next(dose_series(Pump(clock, running=True), clock, "Pump1", 0.02, 1))  # type: ignore[arg-type]
