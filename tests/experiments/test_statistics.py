"""Numbers of a comparison and of a window, by hand; how often an estimate was as near to the truth as it said."""

import math
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from scipy.stats import ttest_1samp

from envs.bench import Bench
from envs.plant.plant import Plant
from envs.scenario import Scenario
from envs.task import EnvConfig
from experiments.comparison import statistics
from experiments.comparison.statistics import SETTLING, Row, Spread, details, pairs, rows, total_scores, totals
from experiments.comparison.trials import Cell, DensityTrial, Trial, run_trial
from experiments.loop.metrics import mean_errors, window_metrics
from experiments.loop.signals import Density, within_2sd
from hardware.emulator.device import plant_preset

NAMES = {"signal": "density", "controller": "pi", "plant": "quiet", "scenario": "steps"}


def trial(controller: str = "pi", error: tuple[float, ...] = (0.1, 0.2)) -> DensityTrial:
    """Replicates that stay `error` above the setpoint for 20 min and for 30 more; their sensor reads 0.01 too much.

    The pump moves by 2 uL/s a minute in the first phase, by 5 in the second.
    """
    schedule = Scenario((0.5, 0.8), (20.0, 30.0), (37.0, 37.0))
    minute = np.arange(51.0)
    setpoint = np.where(minute < 20.0, 0.5, 0.8)
    od = setpoint + np.array(error)[:, None]
    rate = np.where(minute % 2 == 0, 0.01, np.where(minute < 20.0, 0.012, 0.015)) * np.ones_like(od)
    media = np.outer(np.arange(1.0, len(error) + 1), minute)  # 1, 2 mL a minute
    held = np.arange(3.0, 3.0 + len(error))
    overflowed = np.arange(len(error)) > 0
    cell, warm = Cell(controller, "quiet", "steps"), np.full_like(od, 37.0)
    return DensityTrial(cell, schedule, minute, warm, od, od - 0.01, rate, media, held, overflowed)


def test_the_interval_is_students() -> None:
    values = np.array([0.3, np.nan, 0.5, 0.1, np.inf, 0.7])
    found, finite = Spread(values), values[np.isfinite(values)]
    interval = ttest_1samp(finite, 0.0).confidence_interval(0.95)
    assert (found.n, found.mean) == (4, pytest.approx(0.4))
    assert found.sd == pytest.approx(math.sqrt((0.01 + 0.01 + 0.09 + 0.09) / 3.0))
    assert found.ci95 == pytest.approx([interval.low, interval.high])
    assert found.sign == 0
    assert [Spread(np.array(v)).sign for v in ([1.0, 1.1, 1.2], [-1.0, -1.1, -1.2], [1.0, -1.0])] == [1, -1, 0]
    alone, none = Spread(np.array([0.3])), Spread(np.array([np.nan]))
    assert (alone.n, alone.mean, alone.sign, none.n, none.sign) == (1, 0.3, 0, 0, 0)
    assert np.isnan([alone.sd, *alone.ci95, none.mean, none.sd]).all()
    same = Spread(np.array([0.2, 0.2]))
    assert (same.ci95, same.sign) == ([0.2, 0.2], 1)


def test_a_row_tells_means_over_replicates() -> None:
    one = trial()
    first, second = (row.values for row in rows([one]))
    assert first.items() >= {**NAMES, "window": "0.5", "setpoint": 0.5, "n": 2}.items()
    assert (second["window"], second["setpoint"]) == ("0.8", 0.8)
    # the last sample of a window is the first of the next: there the error is 0.3 more, over half a minute
    ise = [20.0 * e**2 + 0.5 * ((e + 0.3) ** 2 - e**2) for e in (0.1, 0.2)]
    itae = [200.0 * e + 0.5 * 20.0 * 0.3 for e in (0.1, 0.2)]
    for key, expected in (("ise", ise), ("itae", itae)):
        assert first[f"{key}_mean"] == pytest.approx(np.mean(expected))
        assert first[f"{key}_sd"] == pytest.approx(abs(expected[1] - expected[0]) / math.sqrt(2.0))
        half = 12.706204736 * abs(expected[1] - expected[0]) / 2.0  # Student's t with one degree of freedom
        assert first[f"{key}_ci95"] == pytest.approx([np.mean(expected) - half, np.mean(expected) + half])
    assert (second["ise_mean"], second["itae_mean"]) == pytest.approx((30.0 * 0.025, 450.0 * 0.15))
    assert second["steady_abs_error"] == pytest.approx(0.15)
    assert (first["media_ml"], second["media_ml"]) == (30.0, 45.0)


@pytest.mark.parametrize(
    ("errors", "settling"),
    [
        ((0.0, 0.0, 0.0), 0.0),
        ((0.0, 0.0, 0.3), 0.0),
        ((0.0, 0.3, 0.3), math.nan),
        ((0.0, 0.3), math.nan),
        ((0.045,), math.nan),
        ((-0.035,), 0.0),
    ],
)
def test_settling_is_the_median_and_never_is_late(errors: tuple[float, ...], settling: float) -> None:
    """By the measured OD: 0.845 is beyond 5 % of 0.8 and 0.765 within, whatever a sensor without noise had shown."""
    one = trial(error=errors)
    assert rows([one])[1][SETTLING] == pytest.approx(settling, nan_ok=True)


def test_details_tell_the_rest() -> None:
    """The first replicate settled as it was measured, 0.035 below 0.8, and not as it was, 0.045 below."""
    first, second = (row.values for row in details([trial(error=(-0.035, -0.2))]))
    means = {"ise": (0.035**2 + 0.2**2) / 2.0, "itae": 0.1175, "clean": (0.045**2 + 0.21**2) / 2.0}
    assert (first["window_min"], first["effort_ul_s"]) == (20.0, pytest.approx(2.0))
    assert second == {
        **NAMES, "window": "0.8", "window_min": 30.0,
        "ise_per_window": pytest.approx(means["ise"]), "itae_per_window": pytest.approx(15.0 * means["itae"]),
        "clean_ise": pytest.approx(30.0 * means["clean"]), "clean_itae": pytest.approx(450.0 * 0.1275),
        "clean_abs_error": pytest.approx(0.1275),
        "floor_ise": pytest.approx(30.0 * 1e-4), "floor_itae": pytest.approx(4.5), "effort_ul_s": pytest.approx(5.0),
        "settled": 1, "overflowed": 1,
    }  # fmt: skip


def test_totals_are_sums_over_windows() -> None:
    """Of e from 0 to 20 min, where the last half minute goes to e + 0.3, and of e for 30 min; pump moves by time."""
    one = trial()
    [found] = (row.values for row in totals([one]))

    def ise(*errors: float) -> np.ndarray:
        return np.array([20.0 * e**2 + 0.5 * ((e + 0.3) ** 2 - e**2) + 30.0 * e**2 for e in errors])

    def itae(*errors: float) -> np.ndarray:
        return np.array([200.0 * e + 0.5 * 20.0 * 0.3 + 450.0 * e for e in errors])

    for of, errors in (("clean", (0.09, 0.19)), ("floor", (0.01, 0.01))):
        step = of != "floor"  # a floor has no setpoint, and no step in it
        assert found[f"{of}_ise"] == pytest.approx(ise(*errors).mean() if step else 50.0 * 1e-4)
        assert found[f"{of}_itae"] == pytest.approx(itae(*errors).mean() if step else 650.0 * 0.01)
    for key, each in (("ise", ise(0.1, 0.2)), ("itae", itae(0.1, 0.2))):
        half = 12.706204736 * abs(each[1] - each[0]) / 2.0  # Student's t with one degree of freedom
        assert found[f"{key}_mean"] == pytest.approx(each.mean())
        assert found[f"{key}_sd"] == pytest.approx(abs(each[1] - each[0]) / math.sqrt(2.0))
        assert found[f"{key}_ci95"] == pytest.approx([each.mean() - half, each.mean() + half])
    assert found["media_ml"] == pytest.approx(1.5 * 50.0)
    assert (found["n"], found["held"]) == (2, 3.5)
    assert found["effort_ul_s"] == pytest.approx((20.0 * 2.0 + 30.0 * 5.0) / 50.0)
    # the last eleven samples of the first window have one of the next setpoint among them
    assert found["clean_steady_abs_error"] == pytest.approx(0.14 + 0.5 * 0.3 / 11.0)
    still = replace(one, rate=np.where(one.minute < 20.0, one.rate, 0.0))
    assert totals([still])[0].values["effort_ul_s"] == pytest.approx(20.0 * 2.0 / 50.0)


def test_pairs_are_differences_against_the_same_plant_and_scenario() -> None:
    mine, theirs = trial("mpc", (0.1, 0.2, 0.15)), trial("pi", (0.2, 0.3, 0.26))
    strange = replace(theirs, cell=Cell("dqn", "noisy", "steps"))
    found = [pair.values for pair in pairs([mine, theirs, strange], "pi")]
    assert [(p["controller"], p["against"], p["window"], p["metric"]) for p in found] == [
        ("mpc", "pi", window, metric) for window in ("0.5", "0.8") for metric in ("ise", "itae")
    ]
    late = found[3]  # the ITAE of the second window: 450 e
    assert late["difference"] == pytest.approx(450.0 * (0.15 - 0.76 / 3.0))
    assert late["percent"] == pytest.approx(100.0 * (0.45 / 0.76 - 1.0))
    assert (late["n"], late["verdict"], late["plant"], late["scenario"]) == (3, "lower", "quiet", "steps")
    assert late["ci95"] == pytest.approx(Spread(450.0 * np.array([-0.1, -0.1, -0.11])).ci95)
    whole = [pair.values for pair in pairs([mine, theirs], "pi", total_scores)]
    assert [(p["window"], p["metric"]) for p in whole] == [("all", "ise"), ("all", "itae")]
    assert whole[1]["difference"] == pytest.approx(650.0 * (0.15 - 0.76 / 3.0))
    assert pairs([mine, theirs], "mpc", total_scores)[1].values["verdict"] == "higher"
    same = pairs([replace(theirs, cell=Cell("dqn", "quiet", "steps")), theirs], "pi")
    assert {p.values["verdict"] for p in same} == {"no difference shown"}
    small = pairs([trial("mpc", (0.01, 0.011)), trial("pi", (0.02, 0.021))], "pi")
    assert small[2].values["percent"] == pytest.approx(100.0 * (0.01**2 + 0.011**2) / (0.02**2 + 0.021**2) - 100.0)
    perfect = replace(theirs, od=np.where(theirs.minute < 20.0, 0.5, 0.8) * np.ones((3, 1)))
    assert math.isnan(pairs([mine, perfect], "pi")[3].values["percent"])


def test_a_third_signal_has_rows_and_pairs(monkeypatch: pytest.MonkeyPatch) -> None:
    """What it adds is what a row holds and what laws are compared by; the rest is as for the others."""
    monkeypatch.setitem(statistics.ROWS, "heat", lambda t: [Row.of(t.names() | {"warmest": t.temperature.max()})])
    monkeypatch.setitem(statistics.SCORES, "heat", lambda t: [("all", "warmth", t.temperature.mean(axis=1))])
    density = trial("pi")
    mine, theirs = (
        Trial(Cell(name, "quiet", "steps", "heat"), density.schedule, density.minute, np.full((2, 3), warm))
        for name, warm in (("mine", 30.0), ("theirs", 31.0))
    )
    assert [r.signal for r in rows([density, mine])] == ["density", "density", "heat"]
    [found] = (pair.values for pair in pairs([density, trial("mine"), mine, theirs], "theirs"))
    assert (found["signal"], found["metric"], found["difference"], found["lower_in"]) == ("heat", "warmth", -1.0, 2)


def test_medians_of_costs_and_of_differences_are_those_of_the_replicates_and_not_their_means() -> None:
    """Seven vials, one of them far off; the interval of a median of seven is from the least to the largest."""
    off = (0.02, 0.01, 0.03, 0.04, 0.05, 0.06, 0.9)
    _, second = (row.values for row in rows([trial(error=off)]))
    assert (second["ise_median"], second["itae_median"]) == pytest.approx((30.0 * 0.04**2, 450.0 * 0.04))
    [whole] = (row.values for row in totals([trial(error=off)]))
    each = [20.0 * e**2 + 0.5 * ((e + 0.3) ** 2 - e**2) + 30.0 * e**2 for e in off]
    assert (whole["ise_median"], whole["itae_median"]) == pytest.approx((sorted(each)[3], 650.0 * 0.04 + 3.0))
    assert (whole["n"], whole["held"]) == (7, 6.0)
    late = pairs([trial("mpc", tuple(0.1 + e for e in off)), trial("pi", (0.1,) * 7)], "pi")[3].values
    assert (late["difference"], late["median"]) == pytest.approx((450.0 * sum(off) / 7.0, 450.0 * 0.04))
    assert late["median_ci95"] == pytest.approx([450.0 * 0.01, 450.0 * 0.9])
    assert late["lower_in"] == 0


MIN, NAN = np.arange(31.0), math.nan
LATE = np.arange(91.0) - 30.0
HOLES = np.isin(MIN, (3, 4)), np.isin(MIN, (7, 20))
FEW = np.array([[0.0, 30.0, NAN], [29.0, NAN, NAN], [0.0, 1.0, 19.9], [0.0, 1.0, 20.0]]) + 30.0
METRICS: dict[str, tuple[np.ndarray, np.ndarray, tuple[float, float], dict[str, list[float]]]] = {
    "settled is the first moment after which the band is kept; at minute 14 it is left once more": (
        MIN, np.select([MIN < 10, MIN == 14], [0.8, 0.53], 0.5), (0.0, 30.0),
        {"settling_min": [15.0], "steady_abs_error": [0.0]},
    ),
    "two samples make a metric, one makes none, the end needs its own; time counts from the window": (
        FEW, np.where(np.isfinite(FEW), 0.6, NAN), (30.0, 60.0),
        {"ise": [0.3, NAN, 0.199, 0.2], "itae": [45.0, NAN, 19.8005, 20.0], "settling_min": [NAN] * 4,
         "steady_abs_error": [0.1, NAN, NAN, 0.1]},
    ),
    "a linear error is bridged exactly where samples are missing, by their time or their OD": (
        np.stack([MIN, np.where(HOLES[0], NAN, MIN)]), 0.5 + 0.01 * np.stack([MIN, np.where(HOLES[1], NAN, MIN)]),
        (0.0, 30.0), {"abs_error": [0.15, 0.15], "ise": [0.9005, 0.9011]},
    ),
    "no sample": (np.empty((2, 0)), np.empty((2, 0)), (0.0, 30.0), {key: [NAN] * 2 for key in (
        "ise", "itae", "ise_mean", "itae_mean", "settling_min", "steady_abs_error")}),
    "20 % too high for 12 min and 4 % too low, or too low for 20 min and 4 % too high: trapezia of |e|": (
        np.stack([LATE, LATE]) + 30.0,
        0.5 + np.stack([np.where(LATE < 12.0, 0.1, -0.02), np.where(LATE < 20.0, -0.1, 0.02)]), (30.0, 60.0),
        {"settling_min": [12.0, 20.0], "abs_error": [1.52 / 30.0, 2.16 / 30.0], "ise": [0.1224, 0.1992],
         "ise_mean": [0.1224 / 30.0, 0.1992 / 30.0]},
    ),
    "the steady error is of the last ten minutes with both their ends: not of 19, but of 20 and 30": (
        np.stack([MIN, MIN]), 0.52 + np.stack([0.38 * (MIN == 19) + 0.11 * (MIN == 20), -0.11 * (MIN == 30)]),
        (0.0, 30.0), {"steady_abs_error": [(0.13 + 0.2) / 11, (0.09 + 0.2) / 11]},
    ),
    "without its first two and last two samples it is integrated over the others": (
        MIN, np.where((MIN > 1) & (MIN < 29), 0.6, NAN), (0.0, 30.0),
        {"ise": [0.26], "itae": [0.1 * (28.0**2 - 2.0**2) / 2], "abs_error": [2.6 / 30.0]},
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", METRICS)
def test_metrics_of_a_window_by_hand(name: str) -> None:
    minute, od, window, expected = METRICS[name]
    found = window_metrics(np.atleast_2d(minute), np.atleast_2d(od), 0.5, *window)
    for key, values in expected.items():
        np.testing.assert_allclose(getattr(found, key), values, atol=1e-12, err_msg=key)
    np.testing.assert_allclose(found.itae_mean, found.itae / (window[1] - window[0]))


def test_the_last_two_hours_begin_no_earlier_than_the_window():
    """300 min at 0.2 from the setpoint, then 90 min at 0.03: all of these are its last two hours. Then 200 min, of
    which the first 80 are 0.2 away and the last 120 0.05."""
    minute = np.arange(591.0)[None]
    error = np.select([minute < 300, minute < 390, minute < 470], [0.2, 0.03, 0.2], 0.05)
    found = [mean_errors(minute, 0.5 - error, np.full_like(minute, 0.5), *w) for w in ((300.0, 390.0), (390.0, 590.0))]
    assert [value[0] for value in found[0]] == pytest.approx([0.03, 0.03])
    assert [value[0] for value in found[1]] == pytest.approx([(80 * 0.2 + 120 * 0.05) / 200, 0.05])


class Told:
    """Doses the share at rest; says that a supervisor acts wherever it was not asked, and e to be `off` too high."""

    def __init__(self, off: float = 0.0) -> None:
        self.off = off

    def reset(self, n: int) -> None:
        self._asked, self._od, self._setpoint = np.zeros(n, dtype=bool), np.zeros(n), np.ones(n)

    def act(self, od: Any, setpoint: Any, minute: Any, rows: Any) -> Any:
        self._asked, self._od, self._setpoint = rows, od, setpoint
        return np.full(len(od), 0.01)

    def explain(self) -> dict[str, Any]:
        n = len(self._od)
        with np.errstate(divide="ignore", invalid="ignore"):
            error = np.log(self._od / self._setpoint) / 0.06 + self.off
        estimates = {"error": error, "growth_share": np.full(n, 0.5), "supervised": 1.0 - self._asked}
        return estimates | dict.fromkeys(("error_sd", "growth_share_sd"), np.full(n, 0.1))


@pytest.mark.parametrize("flow", [1.0, 0.5])
def test_a_smaller_vial_rests_at_the_same_share_of_its_own_largest_rate(flow: float) -> None:
    """0.03 1/min of 0.06: 1.2 mL a minute from 20 mL, and 0.72 from 12; also by a pump of half the flow."""
    volumes, bench = np.array([12.0, 20.0]), Bench()
    preset = plant_preset("nominal")
    plant = Plant(replace(preset, pump=replace(preset.pump, gain_ml_s=flow)), 2, np.random.default_rng(0), volumes)
    law = Told()
    law.reset(2)
    density = Density(law, volumes / 20.0, bench.max_rate)
    density.known(plant, flow, bench)
    assert density.truth is not None
    error, share = density.truth(np.array([0.4, 0.6]))
    np.testing.assert_allclose(share, 0.5, rtol=1e-9)
    np.testing.assert_allclose(error, np.log(plant.apparent_od / [0.4, 0.6]) / 0.06, rtol=1e-9)


def test_a_dose_is_told_by_what_it_is_of_the_bench_s_vial() -> None:
    """.7 mL into 14 mL dilute as 1 mL into 20; what a tube kept counts as well."""
    told: list[Any] = []
    law: Any = SimpleNamespace(dosed=lambda ml: told.append(ml.tolist()), restore=None)
    Density(law, np.array([0.7, 1.0])).dosed(np.array([0.7, 0.7]), np.array([0.14, 0.2]), np.array([1, 1]))
    assert told == [pytest.approx([1.2, 0.9])]


def test_another_period_has_another_full_pump() -> None:
    """2 min of 0.01 mL/s are as much as 1 min of 0.02; growth in 2 min is twice as much: 0.06 of 0.06."""
    bench = Bench(period_s=120.0, max_rate=0.01)
    plant = Plant(plant_preset("nominal"), 1, np.random.default_rng(0))
    density = Density(Told(), 1.0, bench.max_rate)
    density.known(plant, 1.0, bench)
    assert density.truth is not None
    np.testing.assert_allclose(density.truth(np.array([0.5]))[1], 1.0, rtol=1e-9)


def test_two_standard_deviations_count_on_either_side() -> None:
    off = np.array([-2.1, -1.9, 0.0, 1.9, 2.1, np.nan])
    why = {"error": 0.3 + 0.1 * off, "error_sd": np.full(6, 0.1), "true_error": np.full(6, 0.3)}
    np.testing.assert_array_equal(within_2sd(why)["error"], [0.0, 1.0, 1.0, 1.0, 0.0, np.nan])
    assert list(within_2sd(why)) == ["error"], "the truth of the other is not known"


@pytest.mark.parametrize(("off", "inside"), [(0.0, 1.0), (-0.19, 1.0), (-0.21, 0.0), (0.21, 0.0)])
def test_decisions_are_counted_from_where_the_schedule_begins(off: float, inside: float) -> None:
    """The culture grows for some minutes to 0.5 first, in which the law is not asked."""
    schedule = Scenario((0.5,), (20.0,), (37.0,), recovery_od=0.5)
    preset = replace(plant_preset("nominal"), start_od=0.4)
    found = run_trial(Cell("told", "nominal", "hold"), preset, schedule, lambda _: Told(off), EnvConfig(), 3, 0)
    np.testing.assert_array_equal(found.told["supervised"], [0.0] * 3)
    np.testing.assert_allclose(found.told["error"], inside)
    np.testing.assert_allclose(found.told["growth_share"], 1.0)


def test_totals_tell_the_mean_over_vials_in_per_cent() -> None:
    told = {"supervised": np.array([0.0, 0.0, 0.3]), "growth_share": np.array([1.0, 1.0, 0.7])}
    [found] = (row.values for row in totals([replace(trial(error=(0.1, 0.2, 0.6)), told=told)]))
    assert found["supervised_pct"] == pytest.approx(10.0)
    assert found["share_2sd_pct"] == pytest.approx(90.0)
    assert "error_2sd_pct" not in found
