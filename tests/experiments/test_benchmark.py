"""What must hold of every comparison: the oracle is the bound, feedback beats none, noise is paired, seeds decide."""

import json
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import numpy as np
import pytest

from dqn import policy as policies
from envs.plant.plant import Plant
from envs.scenario import Scenario
from experiments.cli import frame
from experiments.comparison import run as comparison_run
from experiments.comparison import statistics as comparison
from experiments.comparison import studies
from experiments.comparison import trials as trials_module
from experiments.comparison.config import TABLE_2, BenchmarkConfig
from experiments.comparison.run import learned, with_seeds
from experiments.comparison.trials import Cell, DensityTrial, Loops, Window, cells, run_trial, windows
from experiments.laws import registry
from experiments.reporting import charts
from experiments.training import run as training
from tests.experiments.test_deploy import inverse_policy

ROOT = Path(__file__).parents[2]
STEPS = "setpoint_steps studies.setpoint_steps"
pytestmark = [pytest.mark.numeric, pytest.mark.xdist_group("benchmark")]  # its tests share loops


@cache
def load(*overrides: str) -> BenchmarkConfig:
    cfg = frame.compose("benchmark", overrides)
    return frame.load(cfg, BenchmarkConfig())


def config() -> BenchmarkConfig:
    return load()


@cache
def trial(controller: str, plant: str, scenario: str, replicates: int, seed: int = 0) -> DensityTrial:
    c, cell = config(), Cell(controller, plant, scenario)

    def law(vials: Plant) -> Any:
        return registry.build(c.controllers[controller], model=c.env, policy=inverse_policy(), plant=vials)

    return run_trial(cell, c.plants[plant], c.scenarios[scenario], law, c.env, replicates, seed)


def total(t: DensityTrial, metric: str) -> float:
    return float(np.mean([getattr(t.score(w), metric).mean() for w in windows(t.schedule)]) * len(windows(t.schedule)))


@pytest.mark.parametrize(
    "controller", ["dqn", "pi", "pi_tuned", "mpc", "adaptive_inverse", "threshold", "gain_scheduled", "hold"]
)
def test_nothing_beats_the_oracle_on_the_training_model_and_laws_of_a_true_model_reach_it(controller):
    """From one and the same OD. Over a schedule a limit cycle may enter a step from a luckier side.

    The tolerance is that of the oracle's discount: it minimises the discounted sum, ISE has none.
    """
    reaches = controller in ("mpc", "adaptive_inverse", "pi_tuned")
    for scenario in ("regulation", "setpoint_steps")[: 1 + reaches]:
        bound = total(trial("oracle", "nominal", scenario, 1), "ise")
        found = total(trial(controller, "nominal", scenario, 1), "ise")
        assert bound * (1.0 - 5e-5) <= found <= bound * (1.02 if reaches else np.inf)


def test_oracle_is_the_dynamic_programme_of_the_training_model():
    """On `nominal` its closed loop is that of envs.optimum with the same levels, setpoint by setpoint."""
    from envs.optimum import solve
    from envs.task import EnvConfig, step_factors

    model = EnvConfig(n_actions=129, start_od=(0.05, 4.0), setpoints=(0.5,))
    best, x, ise = solve(model, grid=6001), 0.7, 0.0
    t = trial("oracle", "nominal", "regulation", 1)
    x = float(t.od[0, 0])
    for k in range(60):
        assert t.od[0, k] == pytest.approx(x, rel=2e-4)
        x *= step_factors(model)[best.act(np.array([x]), np.array([0.5]))[0]]
        ise += (x - 0.5) ** 2
    assert ise == pytest.approx(float(np.sum((t.od[0, 1:] - 0.5) ** 2)), rel=1e-4)


def test_the_devices_pi_lands_where_the_published_one_does():
    """Range of the law over steps of the setpoint in this kind of simulation: ISE 0.036-0.093, ITAE 5.7-9.8.

    Source: docs/device.md, Regulation. The first window has no step: the recovery ends at its setpoint.
    """
    t = trial("pi", "nominal_noise", "setpoint_steps", 64)
    for window in windows(t.schedule)[1:]:
        score = t.score(window)
        assert 0.036 <= score.ise.mean() <= 0.093
        assert 5.7 <= score.itae.mean() <= 9.8


@pytest.mark.slow
def test_every_controller_meets_the_same_vials_and_noise():
    """Recovery is undiluted, so all start alike; afterwards the sensor's error differs only by what scales with OD."""
    first = trial("hold", "bench", "setpoint_steps", 6)
    for controller in ("oracle", "pi_tuned", "threshold"):
        other = trial(controller, "bench", "setpoint_steps", 6)
        np.testing.assert_array_equal(first.od[:, 0], other.od[:, 0])
        errors = [(t.od - t.clean).ravel() for t in (first, other)]
        usual = np.abs(errors[0]) < 0.03
        assert np.corrcoef(errors[0][usual], errors[1][usual])[0, 1] > 0.9


def test_a_batch_is_its_replicates_and_seeds_decide():
    many, few = (trial("adaptive_inverse", "bench", "temperature_switch", n) for n in (6, 2))
    np.testing.assert_allclose(many.od[:2], few.od, rtol=1e-12)
    assert not np.allclose(few.od, trial("adaptive_inverse", "bench", "temperature_switch", 2, seed=1).od)


def test_samples_without_a_dose_are_counted_for_each_vial():
    """One reading in ten is an exact zero, and the law asks for 0.01 mL/s whatever is read: who gives none is held."""
    c = config()
    plant = replace(c.plants["nominal_noise"], sensor=replace(c.plants["nominal_noise"].sensor, zero_rate=0.1))

    def constant(vials):
        return registry.build(c.controllers["hold"], model=c.env, plant=vials)

    cell = Cell("hold", "zeros", "setpoint_steps")
    t = run_trial(cell, plant, c.scenarios["setpoint_steps"], constant, c.env, 8, 0)
    assert set(np.unique(t.rate)) == {0.0, c.env.mu * c.env.tau}
    none = (t.rate[:, :-1] == 0.0).sum(axis=1) + (t.od[:, -1] == 0.0)  # no dose follows the last sample anyway
    np.testing.assert_array_equal(t.held, none)
    assert (t.held >= (t.od == 0.0).sum(axis=1)).all()
    assert len(set(t.held)) > 3
    assert comparison.totals([t])[0].values["held"] == pytest.approx(none.mean())


def test_windows_are_named_by_what_tells_them_apart():
    scenarios = config().scenarios
    assert [w.label for w in windows(scenarios["setpoint_steps"])] == ["0.8", "0.65", "0.5"]
    assert [w.label for w in windows(scenarios["temperature_switch"])] == ["37", "30"]
    assert [w.label for w in windows(scenarios["day"])] == ["0-6 h", "6-12 h", "12-18 h", "18-24 h"]
    assert (windows(scenarios["setpoint_steps"])[1].start, windows(scenarios["setpoint_steps"])[1].end) == (30.0, 60.0)


def synthetic(controller: str, offset: np.ndarray) -> DensityTrial:
    """Two minutes at setpoint 1 with a constant error per replicate; pump and medium by hand."""
    n = offset.size
    ones = np.ones((n, 3))
    od = 1.0 + offset[:, None] * ones
    rate = np.tile([0.01, 0.013, 0.0], (n, 1))
    cell, schedule = Cell(controller, "p", "s"), Scenario((1.0,), (2.0,), (37.0,))
    return DensityTrial(
        cell, schedule, np.arange(3.0), 37.0 * ones, od, od - 0.001, rate,
        np.tile([1.0, 1.6, 2.4], (n, 1)), np.zeros(n), np.zeros(n, dtype=bool),
    )  # fmt: skip


def test_the_medium_of_a_window_is_that_from_its_start_to_its_end_at_any_period():
    slow = replace(synthetic("pi", np.zeros(2)), minute=np.array([0.0, 2.0, 4.0]))
    np.testing.assert_allclose(slow.media(Window("1", 1.0, 2.0, 4.0)), 2.4 - 1.6)


@pytest.mark.parametrize(("n", "low", "high"), [(10, 2, 9), (25, 8, 18), (64, 24, 41)])
def test_the_interval_of_a_median_is_that_of_the_sign_test(n, low, high):
    """Ranks of order statistics as tables print them (Conover 1999, Table A3), whatever the values are."""
    values = np.random.default_rng(n).permutation(np.arange(1.0, n + 1.0) ** 3)
    assert comparison.Spread(values).median_ci95 == [low**3, high**3]
    outlier = np.where(values == n**3, 1e9, values)
    assert comparison.Spread(outlier).median_ci95 == [low**3, high**3]
    assert np.isnan(comparison.Spread(values[:5]).median_ci95).all()  # five values have no such interval


def test_each_seed_of_a_folder_of_policies_is_a_row(tmp_path):
    for seed in (0, 3):
        policies.save(tmp_path / f"seed{seed:04d}.npz", inverse_policy())
    asked = load("+experiment=robust", f"policies.dqn_adaptive={tmp_path}")
    wide = with_seeds(asked)
    names = [f"dqn_adaptive_seed{seed:04d}" for seed in (0, 3)]
    assert [c for c in wide.studies["robust"].controllers if "adaptive_seed" in c] == names
    assert "dqn_adaptive" not in wide.studies["robust"].controllers
    assert [wide.policies[name] for name in names] == [str(tmp_path / f"seed{seed:04d}.npz") for seed in (0, 3)]
    with pytest.raises(frame.UserError, match=r"policies\.pi: .*dqn, dqn_paper, dqn_adap"):
        with_seeds(replace(asked, policies={"pi": str(tmp_path)}))


def test_a_sensor_that_shifts_and_a_pump_and_a_culture_that_change_do_so_at_their_minute():
    """On `bench` and its three upsets: alike up to minute 20, then what the preset says and nothing else."""
    plants = load("+experiment=robust").plants
    names = ("bench", "upset_growth", "upset_pump", "upset_sensor")
    vials = [Plant(plants[name], 3, np.random.default_rng(0)) for name in names]
    for minute in range(20):
        apparent = np.array([v.apparent_od for v in vials])
        np.testing.assert_allclose(apparent, np.broadcast_to(apparent[0], apparent.shape), rtol=1e-12)
        for v in vials:
            v.advance(1.0, np.full(3, 0.5 if minute else 1.0))
    same, growth, _, sensor = vials
    np.testing.assert_allclose(sensor.apparent_od - same.apparent_od, 0.04, rtol=1e-9)
    for v in vials:
        v.advance(1.0, np.zeros(3))
    assert (growth.culture.rates(growth.age_min)[:, 0] / same.culture.rates(same.age_min)[:, 0]) == pytest.approx(0.5)
    before = [v.feed.delivered_ml.copy() for v in vials]
    for v in vials:
        v.advance(1.0, np.full(3, 1.0))
    given = [v.feed.delivered_ml - b for v, b in zip(vials, before, strict=True)]
    np.testing.assert_allclose(given[2] / given[0], 0.5, rtol=1e-9)
    np.testing.assert_allclose(given[1], given[0], rtol=1e-12)


@pytest.mark.slow
def test_paper_is_all_recipes_and_each_loop_runs_once():
    recipes = ("regulation", "setpoint_steps", "temperature_switch", "comparison", "beyond")
    paper = load("+experiment=paper")
    assert paper.calibration
    assert paper.training
    assert paper.replicates == 3
    wanted = {cell for name in recipes for cell in cells(load(f"+experiment={name}"))}
    assert set(cells(paper)) == wanted
    assert len(cells(paper)) == len(wanted)
    wanted |= set(cells(load("+experiment=robust")))
    # the emulator runs on `healthy` and `shipped`; `mixed` is what it is tried on without a calibration
    # and two species have a comparison of their own
    plants = {p.stem for p in (ROOT / "conf" / "plant").glob("*.yaml") if not p.stem.startswith("coculture")}
    assert {cell.plant for cell in wanted} == plants - {"healthy", "shipped", "mixed"}


@pytest.mark.parametrize(
    ("overrides", "parts"),
    [
        (f"{STEPS}.plants=[moon]", ["plants = moon", "nominal, "]),
        (f"{STEPS}.controllers=[pid]", ["controllers = pid", "dqn, dqn_paper, dqn_adaptive, inverse, pi"]),
        ("comparison studies.comparison.plants=[twin]", ["twin (with plant_file=FILE)"]),
        ("comparison plant_file=a.yaml", ["plant_file = a.yaml", "studies.NAME.plants=[nominal,twin]"]),
    ],
)
def test_a_wrong_override_is_one_line(overrides, parts):
    with pytest.raises((frame.UserError, ValueError)) as caught:
        load(*f"+experiment={overrides}".split())
    message = str(caught.value)
    assert "\n" not in message
    for part in parts:
        assert part in message


@pytest.mark.slow
def test_a_benchmark_of_one_seed_gives_one_summary_however_many_processes_run_it(tmp_path, monkeypatch):
    policies.save(tmp_path / "policy.npz", inverse_policy())
    asked = load("+experiment=setpoint_steps", f"policies.dqn={tmp_path / 'policy.npz'}", "replicates=3",
                 "studies.setpoint_steps.controllers=[dqn,pi]")  # fmt: skip
    texts = []
    for name, seed, workers in (("a", 0, 1), ("b", 0, 2), ("c", 1, 1)):
        (tmp_path / name).mkdir()
        comparison_run.benchmark(replace(asked, seed=seed, workers=workers), tmp_path / name)
        texts.append((tmp_path / name / "summary.json").read_text())
        assert (tmp_path / name / "report.html").is_file()
        monkeypatch.setattr(charts, "save", lambda *given: None)  # the figures of one run will do
        monkeypatch.setattr(comparison_run.page, "save", lambda page, folder: (folder / "report.html").touch())
        monkeypatch.setattr(comparison_run.pages, "of_benchmark", lambda folder: None)
    assert texts[0] == texts[1] != texts[2]
    summary = json.loads(texts[0])
    assert len(summary["rows"]) == 6
    assert [tuple(p.values()) for p in summary["paper"]] == [tuple(p) for p in TABLE_2]
    with np.load(tmp_path / "a" / "trajectories.npz") as stored:
        assert stored["setpoint_steps/nominal_noise/pi/od"].shape == (3, 91)


def test_nothing_to_run_is_one_line(tmp_path: Path) -> None:
    with pytest.raises(frame.UserError, match=r"\+experiment=") as caught:
        comparison_run.benchmark(config(), tmp_path)
    assert "\n" not in str(caught.value)


def test_the_calibration_is_of_the_config_s_own_model_and_control_period() -> None:
    """Six hours from the first row to the last, a row every other minute; drawn and counted."""
    found, drawing = studies.calibration(load("env.control_min=2", "env.mu=0.025", "env.tau=0.4", "seed=3"))
    rows = 180 + 1
    assert 0.8 * rows < found["n_used"] <= rows
    assert max(len(line.get_xdata()) for axes in drawing.figure.axes for line in axes.get_lines()) == rows
    for key, truth in (("mu", 0.025), ("tau", 0.4)):
        assert found[key]["truth"] == truth
        assert found[key]["value"] == pytest.approx(truth, rel=0.05)
        assert found[key]["ci95"][0] < found[key]["value"] < found[key]["ci95"][1]
    for value in ("6 h", "1 %", f"{found['pmse_pct']:.2g} %"):
        assert value in drawing.caption


def test_the_learning_curve_is_told_with_the_regret_of_the_policy_that_controls(tmp_path, monkeypatch):
    """That policy is best on the selection grid, another seed on the reported one."""

    def train(setup: Any, run: Path) -> None:
        policies.save(run / "policy.npz", inverse_policy())
        seeds = {"seeds": [5, 6, 7], "regret_pct": [1.25, 3.5, 0.75], "policy_seed": 6}
        rest = {"env_steps": 1200, "updates": 300, "steady_abs_error": [0.01] * 3, "config_hash": "x"}
        (run / "summary.json").write_text(json.dumps(seeds | rest))

    monkeypatch.setattr(training, "train", trained := Mock(side_effect=train))
    asked_for = load("+experiment=training", "seed=5", "train_seeds=3", "env.control_min=2")
    found, agents, (figure,) = learned(asked_for, {"dqn_paper"}, tmp_path)
    (s, _), _ = trained.call_args
    assert (s.seed, s.n_agents, s.env.control_min, s.agent) == (5, 3, 2.0, asked_for.agents["dqn_paper"])
    for value in ("3 seeds", "1200", "seed 6", "3.50 %"):
        assert value in figure["caption"]
    assert agents["dqn_paper"]["regret_pct"] == [1.25, 3.5, 0.75]
    assert list(found) == ["dqn_paper"]


def test_the_interlock_of_a_comparison_lets_the_config_s_pump_run_at_its_period() -> None:
    """Off or on, 0.03 mL/s over two minutes come to 3.6 mL, by which 20 mL are thinned to exp(-0.18)."""
    c = load("env.max_pump_rate=0.03", "env.control_min=2", "env.tau=0.3333333333", "plants.nominal.start_od=0.9")

    def bang(vials: Plant) -> Any:
        return registry.build(replace(c.controllers["threshold"], rate=0.03), model=c.env, plant=vials)

    schedule = Scenario((0.5,), (60.0,), (37.0,))
    t = run_trial(Cell("threshold", "nominal", "s"), c.plants["nominal"], schedule, bang, c.env, 2, 0)
    np.testing.assert_array_equal(t.minute, np.arange(0.0, 61.0, 2.0))
    assert set(np.unique(t.rate)) == {0.0, 0.03}
    np.testing.assert_array_equal(t.held, 0.0)
    on = t.rate[:, :-1] > 0.0
    np.testing.assert_allclose(np.diff(t.media_ml, axis=1), np.where(on, 3.6, 0.0), atol=1e-6)
    np.testing.assert_allclose(np.diff(np.log(t.clean), axis=1), np.where(on, 2.0 * 0.03 - 0.18, 2.0 * 0.03), atol=2e-3)


def test_every_trajectory_is_stored_by_its_scenario_plant_and_controller(tmp_path: Path) -> None:
    """Two controllers on two plants; OD as measured, without noise, mL/s and degC."""
    trials = [
        replace(synthetic(law, np.array([0.01 * k, 0.02 * k])), cell=Cell(law, plant, "s"))
        for k, (law, plant) in enumerate((("a", "p"), ("b", "p"), ("a", "q")), 1)
    ]
    comparison_run._store(trials, tmp_path)
    with np.load(tmp_path / "trajectories.npz") as stored:
        found = {key: values.tolist() for key, values in stored.items()}
    off = {"s/p/a": (0.01, 0.02), "s/p/b": (0.02, 0.04), "s/q/a": (0.03, 0.06)}
    assert set(found) == {f"{key}/{what}" for key in off for what in ("od", "clean", "rate", "temperature")}
    for key, errors in off.items():
        np.testing.assert_allclose(found[f"{key}/od"], [[1.0 + e] * 3 for e in errors], rtol=1e-6)
        np.testing.assert_allclose(found[f"{key}/clean"], [[0.999 + e] * 3 for e in errors], rtol=1e-6)
        np.testing.assert_allclose(found[f"{key}/rate"], [[0.01, 0.013, 0.0]] * 2, rtol=1e-6)
        np.testing.assert_allclose(found[f"{key}/temperature"], [[37.0] * 3] * 2)


def test_every_loop_follows_the_policy_with_which_it_was_begun(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(trials_module, "run_cell", lambda config, cell, followed: (cell, followed))
    one, two, three = (Cell(law, "p", "s") for law in ("pi", "dqn", "dqn_adaptive"))
    policies_of = {one: None, two: ("a", None), three: ("b", None)}
    with Loops(replace(config(), workers=1)) as loops:
        for cell, followed in policies_of.items():
            loops.start([cell], followed)  # type: ignore[arg-type]
        assert loops.results() == {cell: (cell, followed) for cell, followed in policies_of.items()}


def test_a_learned_controller_follows_its_own_file_and_without_one_what_ships(tmp_path: Path) -> None:
    """Two names, two files: each with its own regret."""
    for name, regret in (("one", 2.5), ("two", 7.0)):
        given = inverse_policy()
        policies.save(tmp_path / f"{name}.npz", replace(given, metadata={**given.metadata, "regret_pct": regret}))
    given = {"dqn": str(tmp_path / "one.npz"), "dqn_paper": str(tmp_path / "two.npz")}
    found, agents, drawn = learned(replace(config(), policies=given), {"dqn", "dqn_paper", "dqn_adaptive"}, tmp_path)
    assert {name: policy.metadata.get("regret_pct") for name, (policy, _) in found.items() if name in given} == {
        "dqn": 2.5, "dqn_paper": 7.0,
    }  # fmt: skip
    assert {name: agents[name] for name in given} == {
        name: {"policy": given[name], "regret_pct": regret} for name, regret in (("dqn", 2.5), ("dqn_paper", 7.0))
    }
    assert agents["dqn_adaptive"]["policy"] == "shipped"
    assert drawn == []
    bounds = {name: bounds for name, (_, bounds) in found.items()}
    assert (bounds["dqn"], bounds["dqn_paper"]) == (None, None)
    assert bounds["dqn_adaptive"].full_pump == pytest.approx(0.06)  # 1 min of 0.02 mL/s over tau = 1/3 is certified


def test_the_calibration_of_another_seed_is_of_another_recording(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(studies, "calibrate", found := Mock(side_effect=ZeroDivisionError))
    for seed in (3, 3, 4):
        with pytest.raises(ZeroDivisionError):
            studies.calibration(replace(config(), seed=seed))
    one, again, other = (call.args[0].od for call in found.call_args_list)
    np.testing.assert_array_equal(one, again)
    assert np.mean(one != other) > 0.9
    assert found.call_args.args[1].method == "free_run"


def test_a_trial_keeps_readings_and_what_they_were_taken_of_apart_and_the_vials_own_temperature() -> None:
    """Readings scatter, the culture does not; half an hour after the switch it is at 30 degC."""
    t = trial("hold", "bench", "temperature_switch", 6)
    rough, smooth = (np.abs(np.diff(values[:, 10:25], 2, axis=1)).mean() for values in (t.od, t.clean))
    assert rough > 3.0 * smooth
    np.testing.assert_allclose(t.temperature[:, 29], 37.0, atol=0.5)
    assert (t.temperature[:, 33] > 30.5).all()
    np.testing.assert_allclose(t.temperature[:, -1], 30.0, atol=0.6)
    assert (np.diff(t.media_ml, axis=1) >= 0.0).all()
    given = 60.0 * t.rate[:, :-1].sum(axis=1)
    assert len(set(np.round(t.media_ml[:, -1] / given, 3))) == 6  # each pump has a gain of its own
    np.testing.assert_allclose(t.media_ml[:, -1] / given, 1.0, atol=0.5)


def test_a_vial_that_overflowed_is_told_by_its_own() -> None:
    """The second of three, whatever it was for."""
    c = config()

    def make(vials: Plant) -> Any:
        vials.vessel.overflowed[1] = True
        return registry.build(c.controllers["hold"], model=c.env, plant=vials)

    schedule = Scenario((0.5,), (3.0,), (37.0,))
    t = run_trial(Cell("hold", "nominal", "s"), c.plants["nominal"], schedule, make, c.env, 3, 0)
    assert t.overflowed.tolist() == [False, True, False]
    assert comparison.details([t])[0].values["overflowed"] == 1
