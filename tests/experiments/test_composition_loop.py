"""The composition in the loop: what is shown to its controller, what comes of its targets, what is warned of."""

import json
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pytest

from envs.plant.plant import Plant
from envs.scenario import Scenario
from envs.task import EnvConfig
from experiments.coculture.base import SHARE, Array, Mask, ShareEstimate, Wanted
from experiments.coculture.charts import composition_figure_of
from experiments.coculture.estimator import CompositionEstimator
from experiments.coculture.signal import COLUMNS, Share, ShareWarnings
from experiments.laws import registry
from experiments.loop.loop import ClosedLoop, Step
from experiments.loop.signals import Sample, Signal
from experiments.record.record import Recordings
from experiments.record.summary import figure_of
from hardware.actuator import THERMOSTAT
from hardware.emulator.device import plant_preset
from hardware.reactor import Measurement
from hardware.safety.config import SafetyConfig
from hardware.safety.interlock import Interlock, kinds_of
from hardware.simulated import SimulatedConfig, SimulatedReactors
from hardware.storage.marks import Mark
from tests.experiments.composition_keeper import Reckoning

pytestmark = pytest.mark.numeric

HOLD = Scenario((0.5,), (10_000.0,), (33.2,), ratios=(0.7,))
PLANT = plant_preset("coculture")


class Scripted(Reckoning):
    """Says what the test tells it to: share, width of the band, target."""

    def __init__(self, ratio: float = 0.5, width: float = 0.1, target: float = 29.0) -> None:
        super().__init__()
        self.ratio, self.width, self.answer, self.seen = ratio, width, target, []

    def watch(self, od: Array, fluorescence: Array, temperature: Array, minute: Array, rows: Mask) -> None:
        self.seen.append((od, fluorescence, temperature, minute, rows))

    def act(self, estimate: ShareEstimate, wanted: Wanted, minute: Array, rows: Mask) -> Array:
        self.asked = wanted, minute, rows
        return np.full(minute.shape, self.answer)

    def explain(self) -> dict[str, Array]:
        n = self.told_ml.size
        low, high = self.ratio - self.width / 2.0, self.ratio + self.width / 2.0
        return {
            key: np.full(n, value) for key, value in (("ratio", self.ratio), ("ratio_low", low), ("ratio_high", high))
        }


def held(keeper: Any, schedules: list[Scenario], limits: ShareWarnings | None = None) -> Share:
    """A keeper is both estimator and law."""
    return Share(keeper, keeper, schedules, limits)


@dataclass
class Composed:
    """What the loop makes of a sample of a share."""

    target: Any
    columns: Any
    warnings: Any


def step(
    composition: Share, minute: float, believed: bool = True, elapsed: float | None = None, **safety: Any
) -> Composed:
    n = len(composition.schedules)
    at, fresh = np.full(n, minute), np.ones(n, dtype=np.bool_)
    light = np.full(n, 900.0 + minute)
    m = Measurement(60.0 * at, np.full(n, 0.5), np.full(n, 33.0), fresh, fluorescence=light)
    since = at if elapsed is None else np.full(n, elapsed)
    interlock = Interlock(n, SafetyConfig(**safety))
    phase, od, degc = np.zeros(n, dtype=np.intp), np.full(n, 0.5), np.full(n, 33.2)
    sample = Sample.of(m, interlock, fresh, np.full(n, believed), since, phase, od, degc)
    allowed = interlock.command(THERMOSTAT, composition.decide(sample))
    target = np.where(np.isfinite(allowed), allowed, degc)
    found = composition.find(sample, target)
    return Composed(target, found.columns, found.warnings)


def warned(composition: Share, minute: float, believed: bool = True) -> list[str]:
    (line,) = step(composition, minute, believed).warnings
    return kinds_of(line or "")


@pytest.mark.parametrize(("answer", "target"), [(31.5, 31.5), (12.0, 29.0), (80.0, 36.0), (np.nan, 33.2)])
def test_a_target_goes_through_the_limits_and_one_that_is_no_number_leaves_the_schedules(answer, target):
    composed = step(held(Scripted(target=answer), [HOLD]), 5.0)
    assert composed.target == composed.columns["temperature_target_degc"] == target
    assert tuple(composed.columns) == COLUMNS


def test_the_limits_are_the_interlocks_and_a_target_at_one_of_them_may_be_stuck() -> None:
    limits = {"composition_low": 30.0, "composition_high": 35.0}
    assert step(held(Scripted(target=10.0), [HOLD]), 5.0, **limits).target == 30.0
    composition = held(Scripted(target=90.0), [HOLD])
    assert step(composition, 5.0, **limits).target == 35.0
    assert step(composition, 200.0, **limits).warnings[0].startswith("share_stuck")


@pytest.mark.parametrize(
    ("schedule", "elapsed"), [(replace(HOLD, ratios=()), 5.0), (replace(HOLD, ratios=(None,)), 5.0), (HOLD, np.nan)]
)
def test_where_no_share_is_asked_for_the_schedule_decides_and_the_controller_goes_on_watching(schedule, elapsed):
    """Neither where the schedule asks for none nor before it begins."""
    keeper = Scripted(target=30.0)
    composed = step(held(keeper, [schedule]), 5.0, elapsed=elapsed)
    assert composed.target == 33.2
    assert np.isnan(composed.columns["ratio_setpoint"]).all()
    od, fluorescence, temperature, minute, rows = keeper.seen[0]
    assert (od, fluorescence, temperature, minute, rows) == (0.5, 905.0, 33.0, 5.0, True)
    assert not keeper.asked[2].any()


def test_the_law_is_asked_only_where_something_is_believed_of_the_culture() -> None:
    """Of four cultures that are asked for a share one was never seen, one's reading is doubtful, one has no goal."""

    class Half(Scripted):
        begun = np.array([True, False, True, True])  # type: ignore[assignment]

    keeper, n = Half(target=30.0), 4
    share = held(keeper, [HOLD, HOLD, HOLD, replace(HOLD, ratios=(None,))])
    at, yes = np.full(n, 5.0), np.ones(n, dtype=np.bool_)
    believed = np.array([True, True, False, True])
    m = Measurement(60.0 * at, np.full(n, 0.5), np.full(n, 33.0), yes, fluorescence=np.full(n, 900.0))
    sample = Sample.of(m, Interlock(n), yes, believed, at, np.zeros(n, dtype=np.intp), at, at)
    np.testing.assert_array_equal(share.decide(sample), [30.0, 30.0, 30.0, np.nan])
    assert keeper.asked[2].tolist() == [True, False, False, False]
    assert keeper.seen[0][4].tolist() == believed.tolist()


def test_each_reactor_has_its_own_program_and_is_told_its_changes_as_far_ahead_as_its_scenario_says() -> None:
    phases = {"setpoints": (0.5, 0.5), "minutes": (100.0, 100.0), "temperatures": (33.2, 33.2)}
    steps = [Scenario(**phases, ratios=(0.3, 0.7), announce_min=ahead) for ahead in (60.0, 20.0)]
    keeper = Scripted()
    composed = step(held(keeper, [*steps, replace(HOLD, ratios=(0.4,))]), 500.0, elapsed=50.0)
    wanted, minute, _ = keeper.asked
    assert composed.columns["ratio_setpoint"].tolist() == [0.3, 0.3, 0.4]
    assert wanted.setpoint.tolist() == [0.3, 0.3, 0.4]
    assert wanted.following.tolist() == [0.7, 0.3, 0.4]
    assert wanted.minutes.tolist() == [50.0, 0.0, 0.0]
    assert minute.tolist() == [50.0] * 3  # since the program began


def phases(minutes: tuple[float, ...], ratios: tuple[float | None, ...], announce_min: float = 0.0) -> Scenario:
    n = len(minutes)
    return Scenario((0.5,) * n, minutes, (33.2,) * n, ratios=ratios, announce_min=announce_min)


def until(end: float, *begins: float) -> list[float]:
    """Every tenth minute up to `end`, from the last of `begins` on, and the others as they are."""
    return [*begins[:-1], *np.arange(begins[-1], end, 10.0)]


HISTORIES: dict[str, tuple[Scenario, Callable[[float], float], float, float, list[float]]] = {
    "too large: nearer is less": (HOLD, lambda t: 0.9 if t < 100 else 0.93 if t < 190 else 0.87, 36.0, 300, [180.0]),
    "until it moves by what counts": (
        HOLD, lambda t: 0.5 if t < 270 else 0.515 if t < 280 else 0.53, 29.0, 480, [*until(280, 180), *until(480, 460)]
    ),
    "near": (HOLD, lambda t: 0.61, 29.0, 600, []),
    "colder than the upper limit": (HOLD, lambda t: 0.5, 35.9, 600, []),
    "warmer than the lower limit": (HOLD, lambda t: 0.5, 29.2, 600, []),
    "another setpoint": (phases((200, 400), (0.7, 0.9)), lambda t: 0.5, 29.0, 600, until(600, 180, 190, 380)),
    "the same after a pause": (
        phases((200, 100, 400), (0.7, None, 0.7)), lambda t: 0.5, 29.0, 600, until(600, 180, 190, 480)
    ),
    "towards what is announced, and lost again after it": (
        phases((400, 400), (0.3, 0.7), 360),
        lambda t: 0.3 if t < 100 else min(0.3 + 0.001 * (t - 100), 0.7) if t < 700 else 0.45, 29.0, 1000,
        until(1000, 870),
    ),
    "towards what is asked, away from what is announced": (
        phases((400, 400), (0.9, 0.3), 360), lambda t: 0.5 + 0.0008 * t, 29.0, 400, [],
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", HISTORIES)
def test_stuck_is_what_came_no_nearer_for_three_hours_at_full_authority(name: str) -> None:
    schedule, share, target, end, expected = HISTORIES[name]
    keeper, told = Scripted(target=target), []
    composition = held(keeper, [schedule])
    for minute in np.arange(0.0, end, 10.0):
        keeper.ratio = share(minute)
        if warned(composition, minute):
            told.append(minute)
    assert told == expected


@pytest.mark.parametrize(("per_h", "stuck"), [(0.01, False), (0.0, True)])
def test_a_share_that_lags_behind_a_sine_is_stuck_only_if_it_stands_still(per_h: float, stuck: bool) -> None:
    keeper = Scripted(ratio=0.2)
    composition = held(keeper, [Scenario((0.5,), (2400.0,), (33.2,), ratio_sine=(0.5, 0.4, 1200.0))])
    told = []
    for minute in np.arange(600.0, 900.0, 10.0):  # from 0.5 up to 0.9, ever further away
        keeper.ratio += per_h * 10.0 / 60.0
        told.append(bool(warned(composition, minute)))
    assert any(told) == stuck


def test_an_estimate_that_stays_wide_is_uncertain() -> None:
    keeper = Scripted(ratio=0.7, width=0.5)
    composition = held(keeper, [HOLD])
    told = [minute for minute in np.arange(0.0, 200.0, 10.0) if warned(composition, minute) == ["share_uncertain"]]
    assert told == list(np.arange(120.0, 200.0, 10.0))
    (line,) = step(composition, 200.0).warnings
    assert line.startswith("share_uncertain: share between 0.45 and 0.95; reported; check the fluorescence")
    keeper.width = 0.4
    assert warned(composition, 210.0) == []
    keeper.width = np.nan  # no estimate at all
    assert warned(composition, 320.0) == []
    assert warned(composition, 330.0) == ["share_uncertain"]


def test_of_two_cultures_each_is_warned_of_by_its_own_share_goal_and_thermostat() -> None:
    """The first one's target is inside the limits; the second one's share has not fallen, at 36 degC."""
    keeper = Scripted()
    keeper.ratio, keeper.answer = np.array([0.5, 0.3]), np.array([31.0, 36.0])  # type: ignore[assignment]
    keeper.width = np.array([0.1, 0.2])  # type: ignore[assignment]
    composition = held(keeper, [HOLD, replace(HOLD, ratios=(0.05,))])
    for minute in np.arange(0.0, 180.0, 10.0):
        assert step(composition, minute).warnings == [None, None]
    first, second = step(composition, 180.0).warnings
    assert first is None
    stuck = "share_stuck: share 0.30, setpoint 0.05, not nearer for 3.0 h with the thermostat at 36.0 degC; reported"
    assert second.startswith(stuck)
    keeper.width = np.array([0.5, 0.2])  # type: ignore[assignment]
    for minute in np.arange(190.0, 290.0, 10.0):
        assert step(composition, minute).warnings[0] is None
    first, second = step(composition, 291.0).warnings  # the estimate was narrow at minute 180
    assert first is None
    first, second = step(composition, 300.0).warnings
    assert first.startswith("share_uncertain: share between 0.25 and 0.75; reported")
    assert kinds_of(second) == ["share_stuck"]


class Retold(Scripted):
    """Keeps what it is told of an earlier life."""

    known = np.array([10.0, 12.0])

    def retell(self, shown: Any) -> None:
        self.told = [(minute, method, *(a.tolist() for a in arguments)) for minute, method, arguments in shown]


def test_what_an_earlier_life_recorded_is_told_in_order_each_reactor_as_far_as_it_is_not_known() -> None:
    """Light out of range is none, a row that was not believed no reading; a share comes before the dose after it."""
    nan, keeper = float("nan"), Retold()
    share = held(keeper, [HOLD, HOLD])
    keys = ("time_min", "od", "fluorescence", "temperature_degc", "believed", "volume_ml")
    first = [(10.0, 0.5, 900.0, 33.0, 1, 0.4), (11.0, 0.51, 900.0, 33.1, 1, 0.6), (13.0, 0.9, 900.0, 33.2, 0, 0.7)]
    second = [(12.0, 0.4, 500.0, 31.0, 1, 0.5), (12.5, 0.41, 65535.0, 31.1, 1, 0.0), (13.5, 0.42, 4.0, 31.2, 1, nan)]
    rows = [dict(zip(keys, zip(*each, strict=True), strict=True)) for each in (first, second)]
    counted = [(1, 0.25, 0.02, 12.5), (0, 0.6, 0.05, 10.0), (1, 0.3, 0.04, 11.5), (0, 0.7, 0.03, 11.0)]
    share.retell(rows, counted, (5.0, 65534.0))
    mine, other = [True, False], [False, True]

    assert json.dumps(keeper.told) == json.dumps([
        (11.0, "watch", [0.51, nan], [900.0, nan], [33.1, nan], [11.0, nan], mine),
        (11.0, "sample", [0.7, nan], [0.03, 0.03], mine),
        (11.0, "dosed", [0.6, 0.0]),
        (12.5, "watch", [nan, 0.41], [nan, nan], [nan, 31.1], [nan, 12.5], other),
        (12.5, "sample", [nan, 0.25], [0.02, 0.02], other),
        (13.0, "dosed", [0.7, 0.0]),
        (13.5, "watch", [nan, 0.42], [nan, nan], [nan, 31.2], [nan, 13.5], other),
    ])  # fmt: skip


def vials(n: int) -> SimulatedReactors:
    names = tuple(f"M{k}" for k in range(n))
    return SimulatedReactors(Plant(PLANT, n, np.random.default_rng(3)), SimulatedConfig(reactors=names))


def loop(
    reactors: SimulatedReactors,
    keeper: Any,
    scenario: Scenario,
    limits: ShareWarnings | None = None,
    law_of_share: Any = None,
) -> ClosedLoop:
    n = len(reactors.names)
    law = registry.build(registry.config("inverse"), model=EnvConfig())
    further: list[Signal] = [Share(keeper, law_of_share or keeper, [scenario] * n, limits)]
    return ClosedLoop(reactors, law, Interlock(n), scenario, further=further)


def test_the_vials_follow_the_target_and_the_controller_is_told_what_went_in() -> None:
    keeper, reactors = Reckoning(), vials(2)
    steps = list(loop(reactors, keeper, replace(HOLD, minutes=(300.0,))).run())
    assert keeper.looks.tolist() == [len(steps)] * 2
    np.testing.assert_allclose(keeper.told_ml, np.sum([s.volume_ml for s in steps], axis=0))
    assert keeper.told_ml.min() > 30.0
    np.testing.assert_allclose(steps[-1].columns["ratio"], reactors.plant.culture.share, atol=0.01)
    np.testing.assert_allclose(reactors.plant.culture.share, 0.7, atol=0.02)
    assert {float(s.columns["temperature_target_degc"][0]) for s in steps[1:100]} == {29.0}
    assert abs(steps[60].temperature - 29.0).max() < 0.1


def test_a_warning_stands_beside_what_the_interlock_says() -> None:
    keeper = Scripted(ratio=0.1, width=0.9)
    limits = ShareWarnings(stuck_h=0.1, wide_h=0.1)
    reactors = vials(1)
    run = loop(reactors, keeper, HOLD, limits)
    for _ in range(10):
        last = run.step()
    assert kinds_of(last.reasons[0] or "") == ["share_stuck", "share_uncertain"]
    reactors.plant.sensor.frozen[:] = True
    for _ in range(5):
        last = run.step()
    assert kinds_of(last.reasons[0] or "")[0] == "frozen"  # nothing is believed, nothing is said of the share
    assert len(kinds_of(last.reasons[0] or "")) == 1


KINDS = ("proportional", "pi", "midpoint")
SCHEDULE = Scenario((0.5, 0.5), (40.0, 80.0), (33.2, 33.2), ratios=(0.4, 0.6), announce_min=30.0)
LENGTH, CUT = 110, 55


@pytest.mark.parametrize("kind", KINDS)
def test_a_resumed_run_decides_what_one_without_a_pause_decides(kind: str) -> None:
    def fresh(reactors: SimulatedReactors) -> ClosedLoop:
        limits = ShareWarnings(wide=0.01, wide_h=0.5)
        config = registry.config(kind, SHARE)
        law = registry.build(config, SHARE)
        return loop(reactors, CompositionEstimator(config.estimator), SCHEDULE, limits, law)

    def told(steps: list[Step]) -> list[Any]:
        return [[s.columns["temperature_target_degc"].tolist(), s.columns["ratio"].tolist(), s.reasons] for s in steps]

    reactors = vials(2)
    whole = fresh(reactors)
    expected = told([whole.step() for _ in range(LENGTH)])
    reactors = vials(2)
    first = fresh(reactors)
    steps = [first.step() for _ in range(CUT)]
    state = json.loads(json.dumps(first.state()))
    second = fresh(reactors)
    second.restore(state)
    assert told(steps + [second.step() for _ in range(LENGTH - CUT)]) == expected
    assert [bool(reasons[0]) for _, _, reasons in expected] == [False] * 30 + [True] * (LENGTH - 30)


def test_a_fluorescence_that_no_sensor_gives_is_recorded_and_not_shown() -> None:
    keeper, reactors = Recorded(), vials(1)
    run = loop(reactors, keeper, HOLD)
    run.step()
    assert reactors.plant.fluorescence is not None
    reactors.plant.fluorescence.dead[:] = True
    last = run.step()
    assert last.columns["fluorescence"] == [0.0]
    assert kinds_of(last.reasons[0] or "") == ["fluorescence"]
    assert [bool(np.isfinite(light[0])) for light in keeper.light] == [True, False]


class Recorded(Reckoning):
    """Keeps what light it was shown."""

    def __init__(self) -> None:
        super().__init__()
        self.light: list[Array] = []

    def watch(self, od: Array, fluorescence: Array, temperature: Array, minute: Array, rows: Mask) -> None:
        self.light.append(fluorescence)
        super().watch(od, fluorescence, temperature, minute, rows)


def test_what_is_said_of_a_counted_share_is_that_reactors() -> None:
    class Told(Scripted):
        behind = False

        """Moves the share of the reactor that was sampled to what was counted."""

        def explain(self) -> dict[str, Array]:
            return {"ratio": self.shares, "ratio_low": self.shares - 0.1, "ratio_high": self.shares + 0.1}

        def sample(self, share: Array, sd: Array, minute: float, rows: Mask) -> bool:
            self.shares = np.where(rows, share, self.shares)
            return True

    keeper = Told()
    composition = held(keeper, [HOLD, HOLD])
    keeper.shares = np.array([0.11, 0.52])
    assert composition.counted(1, 0.44, 0.03, 7.0) == ("estimate 0.520 without the count; 0.440 with the count", False)
    np.testing.assert_allclose(keeper.shares, [0.11, 0.44])
    said, doubtful = composition.counted(0, 0.44, 0.03, 7.0)  # .33 off, sds .03 and .051
    assert said.endswith(
        "; the count is 6 standard deviations off: check reactor and species, unless the share changed"
    )
    assert doubtful


def test_a_change_is_announced_in_the_figure_once_its_time_has_come_and_a_recovery_has_no_setpoint() -> None:
    """Two programs that begin 40 and 25 min into the run; a count before a beginning stands at its own time."""
    minutes = np.arange(0.0, 200.0, 2.0)
    began, rest = np.array([[40.0], [25.0]]), np.full((2, minutes.size), 0.4)
    elapsed = np.where(minutes >= began, minutes - began, np.nan)
    columns = {"time_min": np.tile(minutes, (2, 1)), "elapsed_min": elapsed, "believed": np.ones_like(rest)}
    columns |= dict.fromkeys(("ratio", "ratio_low", "ratio_high", "ratio_setpoint", "od", "setpoint"), rest)
    columns |= dict.fromkeys(("temperature_degc", "temperature_target_degc", "fluorescence", "pump_rate_ml_s"), rest)
    columns["phase"] = np.where(np.isnan(elapsed), -1.0, 0.0)
    marks = [Mark(60.0, "M1", "", None, 0.6, 0.05), Mark(90.0, "M0", "", 12.0), Mark(20.0, "M0", "", None, 0.8, 0.01)]
    phases = {"setpoints": (0.5, 0.5), "temperatures": (33.2, 33.2)}
    scenarios = [
        Scenario(**phases, minutes=(100.0, 60.0), ratios=(0.3, 0.7), announce_min=30.0),
        Scenario(**phases, minutes=(90.0, 60.0), ratios=(0.2, 0.5), announce_min=50.0),
    ]
    first, second = [110.0 / 60.0, 0.7], [65.0 / 60.0, 0.5]
    for rows, told in ((41, [[], [second]]), (minutes.size, [[first], [second]])):  # to minute 80, and all
        table = Recordings(
            ("M0", "M1"), {key: values[:, :rows] for key, values in columns.items()}, [[], []], [], marks
        )
        share, _, density, *_ = composition_figure_of(table, scenarios, "B. subtilis", "title").axes
        assert [line.get_xydata().tolist() for line in share.lines if line.get_marker() == ">"] == told
    for ax in (density, figure_of(table, scenarios, "").axes[0]):
        asked = [line.get_xydata() for line in ax.lines if line.get_linestyle() == "--"]
        assert [60.0 * xy[np.isfinite(xy[:, 1]), 0].min() for xy in asked] == pytest.approx([40.0, 26.0])
    drawn = [bar.lines[0].get_xydata().tolist() for bar in share.containers if len(bar.lines[0].get_xdata())]
    assert drawn == [[[20 / 60, 0.8]], [[1.0, 0.6]]]
