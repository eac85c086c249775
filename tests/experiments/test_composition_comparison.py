"""Comparison of the composition: numbers by hand, paired noise, the command, and wrong words."""

import json
import math
from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from dqn import policy
from envs.plant.plant import Plant
from envs.scenario import Scenario
from experiments.benchmark import benchmark
from experiments.cli import frame
from experiments.coculture import comparison
from experiments.coculture.comparison import ShareCell, ShareTrial, calibrate, policies_of, with_pair
from experiments.coculture.estimator import FACTOR, OFFSET, CompositionEstimator, CompositionEstimatorConfig
from experiments.coculture.policies import SHIPPED_COMPOSITION
from experiments.comparison import statistics
from experiments.comparison.config import BenchmarkConfig
from experiments.comparison.trials import cells, run_cell
from experiments.loop.loop import ClosedLoop
from tests.experiments.test_benchmark import load
from tests.experiments.test_deploy import inverse_policy

pytestmark = pytest.mark.numeric

PI, TWO = "studies.c.compositions=[pi]", "studies.c.plants=[coculture]"
STEPS = "studies.c.scenarios=[ratio_steps]"
SHORT = (
    "replicates=3", "workers=1", "studies.composition.scenarios=[ratio_steps]",
    "scenarios.ratio_steps.minutes=[30,60,60,60]",
)  # fmt: skip


@cache
def config() -> BenchmarkConfig:
    return with_pair(load(*SHORT))


def cell(law, plant="coculture", announced=True, calibrated=True):
    return ShareCell(law, plant, "ratio_steps", "share", "inverse", announced, calibrated)


@cache
def trial(law, plant="coculture", announced=True, calibrated=True):
    return run_cell(config(), cell(law, plant, announced, calibrated), None)


def made_up(share, law="proportional", setpoint=(math.nan, 0.5, 0.5, 0.4)):
    """One sample a minute, one phase a minute but the second, which has two."""
    share = np.array(share)
    return ShareTrial(
        cell(law), phases(1.0, 2.0, 1.0), np.arange(4.0), share, False, np.array(setpoint), share, share + 0.1,
        share - 0.05, share + 0.05, np.full(share.shape, 0.5),
    )  # fmt: skip


def phases(*minutes):
    return Scenario((0.5,) * len(minutes), minutes, (37.0,) * len(minutes))


def test_a_calibrated_estimator_begins_with_each_reactor_s_own_sensor():
    """The same 2 % and 5 counts for everybody: twelve reactors whose factors differ by more than a fifth."""
    plant = Plant(config().plants["coculture_mixed"], 12, np.random.default_rng(3))
    estimator = CompositionEstimator(CompositionEstimatorConfig())
    estimator.reset(12)
    calibrate(estimator, plant, 5)
    known, truth = estimator.mean, plant.draws
    factor = truth["fluorescence_factor"]
    assert np.ptp(factor) > 0.2
    np.testing.assert_allclose(known[..., FACTOR] / factor[:, None], 1.0, atol=4 * 0.02)
    np.testing.assert_allclose(known[..., OFFSET] - truth["fluorescence_offset"][:, None], 0.0, atol=4 * 5.0)
    assert len(np.unique(known[..., FACTOR] / factor[:, None])) == 12


@pytest.mark.parametrize("period_min", [1.0, 2.0, 0.5])
def test_the_last_two_hours_are_those_of_every_window(period_min):
    """Of 300 min, of 300 min in which the setpoint waves, of 90 min, which are all of them, and of 300 min."""
    minute = np.arange(0.0, 991.0, period_min)
    setpoint = np.select([minute < 300, minute < 600, minute < 690], [0.3, 0.4 + 0.1 * np.sin(minute), 0.5], 0.7)
    late = [(180, 300), (600, 690), (870, 990)]
    share = setpoint + np.select([(minute >= a) & (minute < b) for a, b in late], [0.01, 0.03, 0.05], 0.2)
    t = replace(made_up([[0.0]]), schedule=phases(300.0, 300.0, 90.0, 300.0), minute=minute, setpoint=setpoint)
    t = replace(t, share=share[None])
    assert comparison.last_hours(t)[0] == pytest.approx((120 * 0.01 + 90 * 0.03 + 120 * 0.05) / 330)
    wave = replace(t, setpoint=0.5 + 0.1 * np.sin(minute))
    assert math.isnan(comparison.last_hours(wave)[0])


def test_the_last_day_is_that_of_a_run_of_two_days_or_more():
    minute = np.arange(3000.0)
    share = np.where(minute >= 3000 - 1440, 0.51, 0.7)[None]
    t = made_up([[0.0]], setpoint=np.full(3000, 0.5))
    t = replace(t, schedule=phases(3000.0), minute=minute, share=share, estimate=share, low=share, high=share)
    assert comparison.share_row(t)[comparison.LAST_DAY] == pytest.approx(0.01)
    short = {key: getattr(t, key)[..., :2800] for key in ("minute", "share", "setpoint", "estimate", "low", "high")}
    assert math.isnan(comparison.share_row(replace(t, **short))[comparison.LAST_DAY])


def test_a_law_is_paired_with_the_vendors_beside_the_same_density_on_the_same_sensor():
    """Four kinds of vials, and laws that are off by so much less on each; whoever is told ahead meets the same ones."""
    kinds = [("inverse", False), ("pi_tuned", False), ("inverse", True), ("pi_tuned", True)]
    trials = []
    for k, (density, calibrated) in enumerate(kinds):
        for law, off, announced in (("proportional", 0.1, False), ("pi", 0.1 * (k + 2), True)):
            one = made_up([[0.9, 0.5 + off, 0.5 + off, 0.4 + off], [0.9, 0.5 + off, 0.5 + off, 0.4 + off]], law=law)
            trials.append(replace(one, cell=ShareCell(law, "coculture", "s", "share", density, announced, calibrated)))
    pairs = (pair.values for pair in statistics.pairs(trials, "pi"))
    found = {(p["density"], p["calibrated"]): p["difference"] for p in pairs}
    assert found == pytest.approx({kind: -0.1 * (k + 1) for k, kind in enumerate(kinds)})
    elsewhere = [replace(t, cell=replace(t.cell, plant="other")) for t in trials if t.cell.controller == "pi"]
    assert statistics.pairs([t for t in trials if t.cell.controller != "pi"] + elsewhere, "pi") == []


@pytest.mark.slow
def test_who_is_told_and_who_is_calibrated_makes_a_difference():
    assert trial("receding").foresight
    assert not trial("receding", announced=False).foresight
    assert not trial("pi").foresight
    assert np.abs(trial("receding").share - trial("receding", announced=False).share).max() > 1e-3
    sure, unsure = (trial("pi", "coculture_mixed", calibrated=c) for c in (True, False))
    assert (sure.high - sure.low)[:, -1].mean() < (unsure.high - unsure.low)[:, -1].mean()


def test_a_policy_that_is_named_holds_the_density_beside_a_share(tmp_path):
    """Here it lets the culture grow: the action of no dose is worth more than all others."""
    given = inverse_policy()
    worth = np.array([1e3, *given.biases[1][1:]], dtype=np.float32)
    policy.save(tmp_path / "mine.npz", replace(given, biases=(given.biases[0], worth)))
    mine = replace(config(), policies={"dqn": str(tmp_path / "mine.npz")})
    at = replace(cell("proportional"), density="dqn")
    ours, shipped = run_cell(mine, at, None), run_cell(config(), at, None)
    assert (np.diff(ours.od, axis=1) > 0.0).all()
    assert ours.od[:, -1].min() > 1.5
    assert 0.4 < shipped.od[:, -1].min() < shipped.od[:, -1].max() < 0.6


def test_the_recipe_asks_for_every_law_on_every_plant():
    recipe = load("+experiment=coculture")
    found = cells(recipe)
    assert len(found) == len(set(found)) == 80 + 4 + 40 + 3
    assert {c.controller for c in found} == set(recipe.compositions)


def test_a_policy_of_another_pair_is_refused_before_anything_runs(tmp_path):
    c = load("+experiment=coculture", "replicates=2", "pair=ecoli_psyringae")
    with pytest.raises(frame.UserError, match=r"policy's pair = .*; give composition_policies\.dqn=RUN, or studies"):
        benchmark(c, tmp_path)


def test_another_pair_grows_in_all_vials_of_two_species_and_in_no_other():
    """Its rate by hand at 33 degC, where its range ends: cardinal temperatures 0, 28 and 36 degC, .546 1/h at best."""
    over, under = (33.0 - 36.0) * 33.0**2, 28.0 * (28.0 * (33.0 - 28.0) - (28.0 - 36.0) * (28.0 - 2.0 * 33.0))
    rate = 0.546 / 60.0 * over / under
    given, own = load("+experiment=coculture", "pair=ecoli_psyringae"), load("+experiment=coculture")
    plants, usual = with_pair(given).plants, with_pair(own).plants
    for name, plant in plants.items():
        if plant.second.present:
            assert plant.pair.second.name == "P. syringae"
            assert plant.pair != usual[name].pair
            assert plant.start_temperature == pytest.approx(plant.pair.even_c)
            slower = usual[name].second.mu / usual["coculture"].second.mu
            assert plant.second.mu == pytest.approx(rate * slower)
        else:
            assert plant == usual[name]
    assert {plant.second.present for plant in plants.values()} == {True, False}
    t = with_pair(given).scenarios["ratio_steps"].temperatures[0]  # both grow alike there, to .1 degC
    over, under = (t - 36.0) * t**2, 28.0 * (28.0 * (t - 28.0) + 8.0 * (28.0 - 2.0 * t))
    assert 0.07727 * t - 1.66954 == pytest.approx(0.546 * over / under, rel=0.01)


@pytest.mark.slow
def test_the_command_leaves_numbers_figures_and_a_page(tmp_path):
    c = load(
        *SHORT, "studies.composition.plants=[coculture]", "studies.composition.controllers=[inverse]",
        "studies.composition.compositions=[pi,proportional,dqn_preview]",
    )  # fmt: skip
    benchmark(c, tmp_path)
    summary = json.loads((tmp_path / "summary.json").read_text())
    keys = {"controller", "preview", "plant", "scenario", "ratio_abs_error_mean", "ci95", "n", "od_min", "od_max"}
    assert [r["controller"] for r in summary["rows"]] == ["pi", "proportional", "dqn_preview"]
    assert [r["preview"] for r in summary["rows"]] == [False, False, True]
    assert all(keys <= set(r) for r in summary["rows"])
    for r in summary["rows"][:2]:
        t = trial(r["controller"], calibrated=r["calibrated"])
        asked = ~np.isnan(t.setpoint)
        error = np.abs(t.share[:, asked] - t.setpoint[asked]).mean(axis=1)
        assert (r["n"], r["ratio_abs_error_mean"]) == (3, pytest.approx(error.mean()))
        assert r["ratio_abs_error_sd"] == pytest.approx(error.std(ddof=1))
        assert (r["od_min"], r["od_max"]) == pytest.approx((t.od.min(), t.od.max()))
    assert {e["signal"] for e in summary["rows"] + summary["paired"]} == {"share"}
    assert [p["controller"] for p in summary["paired"]] == ["proportional", "dqn_preview"]
    page = (tmp_path / "report.html").read_text()
    assert all(law in page for law in ("pi", "proportional", "dqn_preview"))
    assert (tmp_path / "tables" / "ratio_steps_ratio_abs_error_mean.csv").is_file()
    for figure in summary["figures"]:
        assert (tmp_path / figure["file"]).is_file()


def test_a_row_of_a_share_tells_root_mean_square_cover_and_densities_of_all_its_samples():
    """The estimate is off in two of eight samples; the band lies above the truth in one and below it in two."""
    share = [[0.9, 0.6, 0.5, 0.5], [0.9, 0.5, 0.5, 0.4]]
    t = made_up(share, setpoint=(math.nan, 0.5, 0.6, 0.4))
    off = np.array([[0.0, 0.3, 0.0, 0.0], [0.0, 0.0, 0.0, -0.1]])
    low, high = t.low.copy(), t.high.copy()
    low[0, 1], high[1, 2:] = 0.7, 0.3
    od = np.array([[0.4, 0.5, 0.6, 0.5], [0.5, 0.5, 0.5, 0.9]])
    row = comparison.share_row(replace(t, estimate=t.share + off, low=low, high=high, od=od)).values
    assert row["n"] == 2
    assert row["estimate_rms"] == pytest.approx(math.sqrt((0.09 + 0.01) / 8.0))
    assert row["band_covers"] == pytest.approx(5.0 / 8.0)
    assert (row["od_min"], row["od_mean"], row["od_max"]) == pytest.approx((0.4, 0.55, 0.9))
    assert row["ratio_abs_error_mean"] == pytest.approx(0.2 / 3.0)  # of 0.1 and 0.1 / 3
    half = 12.706204736 * 0.1 / 3.0  # Student's t with one degree of freedom
    assert row["ci95"] == pytest.approx([0.2 / 3.0 - half, 0.2 / 3.0 + half])
    assert row["ratio_abs_error_sd"] == pytest.approx(0.2 / 3.0 / math.sqrt(2.0))
    assert row["ratio_abs_error_last2h"] == pytest.approx(0.05)  # the one window in which the setpoint rests


def begun(monkeypatch, cell, **changes):
    """Vials and estimator of a cell, before its first sample."""
    loops = []
    monkeypatch.setattr(ClosedLoop, "run", lambda loop: iter(loops.append(loop) or ()))
    with pytest.raises(TypeError):  # nothing was seen
        run_cell(replace(config(), **changes), cell, None)
    return loops[0].reactors.plant, loops[0].signals[1].estimator.estimator


def test_the_seed_of_the_config_is_that_of_vials_and_of_what_is_known_of_their_sensors(monkeypatch):
    """The same seed gives the same vials to two laws, another one others, with other errors of the calibration."""
    one, same, other = (
        begun(monkeypatch, cell(law, "coculture_mixed"), seed=seed)
        for law, seed in (("pi", 4), ("receding", 4), ("pi", 5))
    )
    for key in one[0].draws:
        np.testing.assert_array_equal(one[0].draws[key], same[0].draws[key])
    factors = [each[0].draws["fluorescence_factor"] for each in (one, other)]
    assert (factors[0] != factors[1]).all()
    errors = [each[1].mean[:, 0, FACTOR] / factor for each, factor in zip((one, other), factors, strict=True)]
    assert (np.abs(errors[0] - errors[1]) > 1e-6).all()
    np.testing.assert_array_equal(one[1].mean, same[1].mean)


def test_a_share_is_held_behind_the_interlock_of_a_real_run(monkeypatch):
    """A sensor that repeats itself is not believed for long, whatever the law asks for."""
    schedule = Scenario((0.3, 0.35), (10.0, 90.0), (31.0, 35.0), ratios=(None, 0.05))
    monkeypatch.setattr(Plant, "read_od", lambda plant: np.full(plant.n, 0.4))
    found = run_cell(replace(config(), scenarios={"ratio_steps": schedule}), cell("bang_bang"), None)
    np.testing.assert_array_equal(found.setpoint, [math.nan] * 10 + [0.05] * 91)
    assert (np.diff(found.od[:, 9:], axis=1) > 0.0).all(), "undiluted, above the setpoints"


def test_each_law_follows_the_policy_that_is_named_for_it(tmp_path):
    """One of them a file of one's own, the other what ships."""
    own = policy.load(SHIPPED_COMPOSITION["dqn"])
    policy.save(tmp_path / "own.npz", replace(own, metadata={**own.metadata, "regret_pct": 12.5}))
    named = replace(config(), composition_policies={"dqn": str(tmp_path / "own.npz")})
    found = policies_of(named, ["dqn", "dqn_preview", "pi"], tmp_path / "run")
    assert found["pi"] is None
    assert found["dqn"][0].metadata["regret_pct"] == 12.5
    preview = policy.load(SHIPPED_COMPOSITION["dqn_preview"])
    assert found["dqn_preview"][0].metadata == preview.metadata


def test_every_scenario_of_a_share_is_drawn_with_its_own_laws_on_its_own_first_plant():
    """Seven laws are too many for curves: those stay that are always shown; the other scenario has two, and a plant."""
    seven = ("pi", "receding", "proportional", "dqn", "midpoint", "dqn_preview", "optimum")
    share = [[0.9, 0.6, 0.5, 0.5], [0.9, 0.5, 0.5, 0.4]]
    trials = []
    for scenario, plants, laws in (("steps", ("one", "two"), seven), ("sine", ("two",), ("receding", "pi"))):
        for plant in plants:
            for law in laws:
                found = made_up(share, law=law)
                found = replace(
                    found, cell=ShareCell(law, plant, scenario, "share", "inverse"), foresight=law == "optimum"
                )
                trials.append(replace(found, temperature=np.full((2, 4), 30.0 + len(trials))))
    drawn = {d.name: d for d in comparison._drawn(trials, statistics.rows(trials))}
    assert {name: d.title for name, d in drawn.items()} == {
        "composition_steps_laws": "steps: every controller and plant",
        "composition_steps_shares": "steps: shares on one",
        "composition_sine_laws": "sine: every controller and plant", "composition_sine_shares": "sine: shares on two",
    }  # fmt: skip
    curves = {key: drawn[f"composition_{key}_shares"].figure.axes for key in ("steps", "sine")}
    told = ["pi", "proportional", "dqn", "midpoint", "dqn_preview", "optimum, with preview"]
    assert [ax.get_title() for ax in curves["steps"][:6]] == told
    assert [float(ax.lines[0].get_ydata()[0]) for ax in curves["steps"][6:]] == [30.0, 32.0, 33.0, 34.0, 35.0, 36.0]
    assert [ax.get_title() for ax in curves["sine"][:2]] == ["receding", "pi"]
    assert [float(ax.lines[0].get_ydata()[0]) for ax in curves["sine"][2:]] == [44.0, 45.0]
    for key, plants in (("steps", ["one", "two"]), ("sine", ["two"])):
        (axes,) = drawn[f"composition_{key}_laws"].figure.axes
        assert [text.get_text() for text in axes.get_yticklabels()] == plants


@pytest.mark.parametrize(
    ("overrides", "says"),
    [
        ("studies.composition.compositions=[pid]", "studies.composition.compositions = pid: allowed"),
        (f"{PI} studies.c.plants=[nominal] {STEPS}", "studies.c.plants = nominal: allowed plants with two species"),
        (f"{PI} {TWO} studies.c.scenarios=[day]", "studies.c.scenarios = day: allowed scenarios with ratios"),
        (f"+experiment=comparison {PI}", "all have compositions, or all have none"),
        ("composition_policies.pi=x.npz", "composition_policies = pi: allowed dqn, dqn_preview"),
    ],
)
def test_wrong_words_end_in_one_line(overrides, says):
    with pytest.raises(frame.UserError, match=says):
        load(*overrides.split())
