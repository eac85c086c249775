"""PI laws by their difference equations, inverse control by least squares, the MPC by exhaustive references."""

from itertools import product

import numpy as np
import pytest
from numpy.typing import NDArray

from envs.task import EnvConfig, step_factors
from experiments.laws.density.estimator import EstimatorConfig
from experiments.laws.density.inverse import Inverse, InverseConfig
from experiments.laws.density.mpc import Mpc, MpcConfig, Problem, SwarmConfig, minimise
from experiments.laws.density.pi import ChiBioPI, ChiBioPIConfig, TunedPI, TunedPIConfig

pytestmark = pytest.mark.numeric

Array = NDArray[np.float64]


def play(
    controller: ChiBioPI | TunedPI, ods: list[float], setpoint: float, minutes: list[float] | None = None
) -> Array:
    """Pump rates for a sequence of readings of one reactor."""
    controller.reset(1)
    times = minutes or [float(k) for k in range(len(ods))]
    rates = [
        controller.act(np.array([x]), np.array([setpoint]), np.array([t]), np.array([True]))[0]
        for x, t in zip(ods, times, strict=True)
    ]
    return np.array(rates)


def test_the_devices_law_by_hand() -> None:
    ods = [0.55, 0.56, 0.57, 0.53, 0.505, 0.56, 0.62, 0.63, 0.48]
    by_hand = [
        0.0,  # cycle 1
        0.0,  # cycle 2
        # e .07, |dy| .01: P = .7 ln(1.14)/12 = .0076433, I1 = .007, I2 = .0007
        0.0076433 + 0.007 + 0.0007,
        # e .03, |dy| .04: P = .7 ln(1.06)/12 = .0033990, I1 = .007 + .003, I2 = .0007 + .0003
        0.0033990 + 0.010 + 0.0010,
        # e .005 < .01: I1 = 0; I2 = .0010 + .00005; P = .7 ln(1.01)/12 = .0005804
        0.0005804 + 0.00105,
        0.0,  # rose by .055: noise guard. I2 = .00105 + .0006
        0.0,  # rose by .06: noise guard. |e| = .12 but |dy| > .05, so I2 grows to .00285 and is not cleared
        0.02,  # e .13, |dy| .01: I2 cleared, P = ln(1.26)/12 = .01926 not reduced, I1 = .013: clamped
        0.0,  # e -.02: I1 = 0; |dy| .15: I2 kept; P < 0
    ]
    np.testing.assert_allclose(play(ChiBioPI(ChiBioPIConfig()), ods, 0.5), by_hand, atol=1e-7)


CALM, RISEN = [0.55, 0.56, 0.57, 0.53], [0.55, 0.56, 0.57, 0.53, 0.505, 0.56, 0.62]
PARTS: list[tuple[str, float, list[float], list[float] | None, float]] = [
    ("i1", 0.010, CALM, None, 20.0), ("i2", 0.0010, CALM, None, 20.0), ("i2", 0.00285, RISEN, None, 20.0),
    ("i1", 0.005, [0.55, 0.55, 0.55, 0.52], None, 20.0),  # from 0.01 to 0.025 it neither grows nor is cleared
    # a decision is made before its cycle is recorded, so a long gap shows one cycle later
    ("p", 0.7 * np.log(1.04) / 12.0, [0.52] * 3, [0.0, 1.0, 3.0], 20.0),
    ("p", 0.7 * np.log(1.04) / 2.0 / 12.0, [0.52] * 4, [0.0, 1.0, 3.0, 4.0], 20.0),
    ("p", 0.7 * np.log(1.04) / 24.0, [0.52] * 3, None, 10.0),  # in proportion to the volume
]  # fmt: skip


@pytest.mark.parametrize(("part", "value", "ods", "minutes", "volume_ml"), PARTS)
def test_the_parts_of_the_devices_law_by_hand(part, value, ods, minutes, volume_ml):
    pi = ChiBioPI(ChiBioPIConfig(), volume_ml)
    play(pi, ods, 0.5, minutes)
    assert pi.explain()[part][0] == pytest.approx(value)


def test_odd_readings_do_not_pump_and_the_clamp_is_the_one_that_it_is_told() -> None:
    assert play(ChiBioPI(ChiBioPIConfig()), [0.0, 0.0, 0.0, -0.1], 0.5)[-1] == 0.0
    assert (
        play(ChiBioPI(ChiBioPIConfig()), [0.5, 0.5, 0.5], 0.0)[-1] == 0.02
    )  # setpoint 0: the device pumps at its clamp
    assert play(ChiBioPI(ChiBioPIConfig(max_pump_rate=0.007)), [0.9, 0.9, 0.9], 0.5)[-1] == 0.007


def test_tuned_pi_by_hand() -> None:
    """tau (K z + I) with K = 1/2, integral gain 1/16 and I starting at mu."""
    model = EnvConfig(mu=0.03, tau=1.0 / 3.0)
    z1, z2 = np.log(0.51 / 0.5), np.log(0.505 / 0.5)
    expected = [(0.03 + z1 / 2) / 3, (0.03 + z1 / 16 + z2 / 2) / 3]
    np.testing.assert_allclose(play(TunedPI(TunedPIConfig(), model), [0.51, 0.505], 0.5), expected)


def test_tuned_pi_with_other_times_and_a_stronger_pump_by_hand() -> None:
    """K = 1 / (2 + 3), and of I a part K h / (4 (2 + 3)) = 0.02 of z a period of 2 min; I begins at 0."""
    model = EnvConfig(mu=0.03, tau=0.4, control_min=2.0, max_pump_rate=0.05)
    config = TunedPIConfig(delay_min=2.0, closed_loop_min=3.0, feed_forward=False)
    z1, z2, z3 = np.log(0.6 / 0.5), np.log(0.57 / 0.5), np.log(0.9 / 0.5)
    expected = [0.4 * z1 / 5.0, 0.4 * (z2 / 5.0 + 0.02 * z1), 0.4 * (z3 / 5.0 + 0.02 * (z1 + z2))]
    assert 0.04 < expected[2] < 0.05
    pi = TunedPI(config, model)
    np.testing.assert_allclose(play(pi, [0.6, 0.57, 0.9], 0.5), expected)
    assert pi.explain()["p"][0] == pytest.approx(z3 / 5.0)


def test_tuned_pi_does_not_wind_up_at_full_pump_and_comes_back_from_it_by_itself() -> None:
    """K z alone asks for more than the pump gives; below the setpoint, still at full rate, I may fall again."""
    pi = TunedPI(TunedPIConfig(), EnvConfig())
    play(pi, [0.9, 0.85, 0.8], 0.5)
    assert pi.explain()["i"][0] == 0.03
    pi._integral[:] = 0.5
    assert pi.act(np.array([0.49]), np.array([0.5]), np.array([3.0]), np.array([True]))[0] == 0.02
    assert pi.explain()["i"][0] == pytest.approx(0.5 + np.log(0.98) / 16.0)


def test_tuned_pi_does_not_wind_up() -> None:
    """Climbing from 0.4 to 0.8 keeps the pump at 0 for 20 min; the integrator stands still meanwhile."""
    model = EnvConfig()
    pi = TunedPI(TunedPIConfig(), model)
    pi.reset(1)
    x, highest = 0.4, 0.0
    for k in range(60):
        u = pi.act(np.array([x]), np.array([0.8]), np.array([float(k)]), np.array([True]))[0]
        if u == 0.0:
            assert pi.explain()["i"][0] == model.mu
        x *= np.exp(model.mu - u / model.tau)
        highest = max(highest, x)
    assert highest < 0.8 * 1.01
    assert x == pytest.approx(0.8, abs=1e-3)


ONE = np.ones(1, dtype=bool)
PLAIN = {"noise_memory": 0.0, "warmth": 0.0, "warmth_sd": 0.0, "first_dose": 1.0, "first_dose_sd": 0.0, "hurry": 0.0}


def inverse_of(model: EnvConfig | None = None, **beliefs: float) -> Inverse:
    """Inverse control on a filter with these beliefs."""
    return Inverse(InverseConfig(estimator=EstimatorConfig(**beliefs)), model or EnvConfig())  # type: ignore[arg-type]


@pytest.mark.parametrize("told", [False, True])
def test_filter_equals_least_squares_on_all_data(told: bool) -> None:
    """Without walks the estimate is the weighted least-squares fit of ln x0, mu, g with their priors.

    What it decides is dosed; or it is told what is, which is something else.
    """
    model = EnvConfig()
    still = {"mu_walk": 0.0, "gain_walk": 0.0, "pulse_cv": 0.0, "growth_cv": 0.0, "gate_sigma": 20.0}
    inverse = inverse_of(model, **PLAIN, **still)
    config = inverse.estimator.config
    rng = np.random.default_rng(1)
    inverse.reset(1)
    log_x, dosed, minute = np.log(0.6), 0.0, 0.0
    rows, values, weights = [], [], []
    for k in range(40):
        reading = np.exp(log_x) + 0.005 * rng.standard_normal()
        rows.append([1.0, minute, -dosed])
        values.append(np.log(reading))
        weights.append(reading / np.hypot(config.noise_floor, config.noise_relative * reading))
        setpoint = np.array([0.5 if k < 20 else 0.7])
        u = inverse.act(np.array([reading]), setpoint, np.array([minute]), ONE)[0]
        if told:
            u = u * rng.choice([0.0, 0.5, 1.0]) + 0.03 * (k == 25)
            inverse.dosed(np.array([40.0 * u]))
            inverse.dosed(np.array([20.0 * u]))  # in two parts, mL of a period
        step = 1.0 if k % 7 else 2.0  # now and then a reading is missed
        log_x += 0.024 * step - 0.9 * u / model.tau
        dosed += u / model.tau
        minute += step
    a = np.vstack([np.array(rows), [[0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]])
    b = np.append(values, [model.mu, 1.0])
    w = np.append(weights, [1.0 / config.mu_sd, 1.0 / config.gain_sd])
    x0, mu, gain = np.linalg.lstsq(a * w[:, None], b * w, rcond=None)[0]
    seen = inverse.explain()
    assert seen["mu"][0] == pytest.approx(mu, rel=1e-8)
    assert seen["gain"][0] == pytest.approx(gain, rel=1e-8)
    assert np.log(seen["od_estimate"][0]) == pytest.approx(np.dot([x0, mu, gain], rows[-1]), rel=1e-8)


def steady(inverse: Inverse, minutes: int) -> None:
    for k in range(minutes):
        inverse.act(np.array([0.5]), np.array([0.5]), np.array([float(k)]), ONE)


def test_an_outlier_changes_nothing_and_a_lasting_jump_is_believed() -> None:
    inverse = inverse_of()
    inverse.reset(1)
    steady(inverse, 30)
    before = inverse.explain()
    usual = inverse.act(np.array([0.5]), np.array([0.5]), np.array([30.0]), ONE)[0]
    for k in range(5):  # a bubble of five readings
        rate = inverse.act(np.array([0.7]), np.array([0.5]), np.array([31.0 + k]), ONE)[0]
        assert rate == pytest.approx(usual, rel=0.05)
    rate = inverse.act(np.array([0.7]), np.array([0.5]), np.array([36.0]), ONE)[0]
    assert rate == 0.02
    assert inverse.explain()["mu"][0] == pytest.approx(before["mu"][0], rel=0.05)
    assert inverse.explain()["od_estimate"][0] == pytest.approx(0.7)


def test_the_law_inverts_the_model_of_another_period_and_a_stronger_pump() -> None:
    """With the truth known exactly the next OD, 3 min on, is the setpoint, or the pump is at a bound."""
    known = {"mu_sd": 1e-5, "gain_sd": 0.0, "gain_walk": 0.0, "mu_walk": 0.0}
    inverse = inverse_of(EnvConfig(mu=0.025, tau=0.3, control_min=3.0, max_pump_rate=0.05), **known)
    inverse.reset(5)
    od, setpoint = np.array([0.42, 0.61, 0.3, 0.9, 0.2]), np.array([0.4, 0.5, 0.31, 0.5, 0.5])
    u = inverse.act(od, setpoint, np.zeros(5), np.ones(5, dtype=bool))
    np.testing.assert_allclose((od * np.exp(3.0 * (0.025 - u / 0.3)))[:3], setpoint[:3], rtol=1e-9)
    assert u[1] > 0.02
    np.testing.assert_array_equal(u[3:], [0.05, 0.0])


@pytest.mark.parametrize(("levels", "rates"), [(2, [0.0, 0.02]), (5, [0.0, 0.005, 0.01, 0.015, 0.02])])
def test_with_levels_it_gives_the_nearest_of_them_from_none_to_all(levels: int, rates: list[float]) -> None:
    """Of a inverse_of that knows the truth: u = tau (mu + ln(x / r)), over the range of the pump and beyond."""
    model = EnvConfig(mu=0.03, tau=1.0 / 3.0)
    known = EstimatorConfig(mu_sd=1e-5, gain_sd=0.0, gain_walk=0.0, mu_walk=0.0)
    od = 0.5 * np.exp(np.linspace(-0.05, 0.05, 23))
    stepped = Inverse(InverseConfig(levels=levels, estimator=known), model)
    stepped.reset(od.size)
    given = stepped.act(od, np.full(od.size, 0.5), np.zeros(od.size), np.ones(od.size, dtype=bool))
    exact = np.clip((0.03 + np.log(od / 0.5)) / 3.0, 0.0, 0.02)
    np.testing.assert_allclose(given, np.asarray(rates)[np.abs(exact[:, None] - rates).argmin(axis=1)], atol=1e-9)
    np.testing.assert_allclose(np.unique(given.round(9)), rates)


MODEL = EnvConfig()


def states(n: int, seed: int = 0) -> tuple[Array, Array]:
    """Random start ODs and setpoints; half of the starts are within 10 % of the setpoint."""
    rng = np.random.default_rng(seed)
    setpoint = rng.choice(np.asarray(MODEL.setpoints), n)
    od = np.where(rng.random(n) < 0.5, setpoint * rng.uniform(0.9, 1.1, n), rng.uniform(0.1, 1.1, n))
    return od, setpoint


def cost_of(problem: Problem, v: Array) -> Array:
    return problem.cost(v[:, None])[:, 0]


@pytest.mark.parametrize("integrator", ["euler", "rk4"])
def test_closed_form_of_the_step_is_the_models(integrator: str) -> None:
    model = EnvConfig(mu=0.021, tau=0.27, integrator=integrator, substeps=7)
    v = np.linspace(-0.2, 1.2, 31)
    factors, slope = Problem(np.ones(1), np.ones(1), model, 100.0).factors(v)
    np.testing.assert_allclose(factors, step_factors(model, v * model.max_pump_rate), rtol=1e-13)
    h = 1e-6
    above, below = (step_factors(model, (v + s) * model.max_pump_rate) for s in (h, -h))
    np.testing.assert_allclose(slope, (above - below) / (2 * h), rtol=1e-6)


def test_cost_by_hand() -> None:
    """Two steps with the pump off, then one outside the range."""
    problem = Problem(np.array([0.4]), np.array([0.5]), MODEL, 100.0)
    f = 1.003**10
    assert problem.cost(np.zeros((1, 1, 2)))[0, 0] == pytest.approx((0.4 * f - 0.5) ** 2 + (0.4 * f * f - 0.5) ** 2)
    outside = problem.cost(np.array([[[0.0, 1.001]], [[-0.001, 1.001]]])[:1])[0, 0]
    assert 100.0 < outside < 101.0
    assert problem.cost(np.array([[[-0.001, 1.001]]]))[0, 0] > 200.0


def test_gradient_of_the_cost_is_exact() -> None:
    problem = Problem(np.array([0.7]), np.array([0.5]), MODEL, 100.0)
    v = np.array([0.3, 0.9, 0.1, 0.6, 0.5])
    gradient = problem.value_and_gradient(v)[1]
    for k in range(5):
        step = 1e-6 * np.eye(5)[k]
        difference = (problem.value_and_gradient(v + step)[0] - problem.value_and_gradient(v - step)[0]) / 2e-6
        assert gradient[k] == pytest.approx(difference, rel=1e-5, abs=1e-10)


def test_no_grid_point_beats_the_solvers() -> None:
    """All 7^5 sequences of 7 pump rates, from 12 random states."""
    n = 12
    od, setpoint = states(n, seed=1)
    grid = np.array(list(product(np.linspace(0.0, 1.0, 7), repeat=5)))
    problem = Problem(od, setpoint, MODEL, 100.0)
    best = np.array(
        [Problem(od[i : i + 1], setpoint[i : i + 1], MODEL, 100.0).cost(grid[None]).min() for i in range(n)]
    )
    start = np.full((n, 5), 0.5)
    gradient = cost_of(problem, problem.by_gradient(start))
    found, _ = minimise(problem.cost, 0.0, 1.0, start, np.random.default_rng(0).spawn(n), SwarmConfig())
    swarm = cost_of(problem, found)
    assert np.all(gradient <= best + 1e-12)
    assert np.all(swarm <= best * 1.01 + 1e-6)
    # where the optimum is at the bounds the grid contains it
    saturated = np.abs(np.log(od / setpoint)) > 0.2
    assert saturated.sum() > 2
    np.testing.assert_allclose(gradient[saturated], best[saturated], rtol=1e-9)


def test_swarm_minimises_what_it_is_given() -> None:
    """A shifted ill-conditioned bowl outside the start box."""
    centre = np.array([[1.5, -0.5, 0.2], [0.1, 0.9, 2.0]])
    weight = np.array([1.0, 10.0, 100.0])
    swarm = SwarmConfig(particles=30, iterations=300)

    def bowl(x: Array) -> Array:
        return np.asarray((weight * (x - centre[: x.shape[0], None]) ** 2).sum(-1))

    best, cost = minimise(bowl, 0.0, 1.0, np.zeros((2, 3)), np.random.default_rng(0).spawn(2), swarm)
    np.testing.assert_allclose(best, centre, atol=1e-6)
    np.testing.assert_allclose(cost, bowl(best[:, None])[:, 0])


def test_decisions_repeat_and_seeds_matter() -> None:
    od, setpoint = states(4)

    def decide(seed: int) -> Array:
        mpc = Mpc(MpcConfig(seed=seed, swarm=SwarmConfig(particles=5, iterations=5)), MODEL)
        mpc.reset(4)
        return mpc.act(od, setpoint, np.zeros(4), np.ones(4, dtype=bool))

    np.testing.assert_array_equal(decide(0), decide(0))
    assert not np.array_equal(decide(0), decide(1))


def test_the_plan_is_explained() -> None:
    mpc = Mpc(MpcConfig(), MODEL)
    mpc.reset(2)
    rate = mpc.act(np.array([0.6, 0.4]), np.array([0.5, 0.5]), np.zeros(2), np.ones(2, dtype=bool))
    plan = mpc.explain()
    assert plan["planned_rate"].shape == plan["predicted_od"].shape == (2, 5)  # the paper looks five minutes ahead
    np.testing.assert_array_equal(plan["planned_rate"][:, 0], rate)
    np.testing.assert_allclose(plan["predicted_od"][:, 0], np.array([0.6, 0.4]) * step_factors(MODEL, rate))


def test_a_plan_is_in_the_rates_of_the_pump_that_is_there() -> None:
    """Half as much again as 0.02 mL/s, every other minute, three decisions ahead; before the first one mu tau."""
    model = EnvConfig(mu=0.02, tau=0.4, control_min=2.0, max_pump_rate=0.03)
    mpc = Mpc(MpcConfig(solver="gradient", horizon=3), model)
    mpc.reset(2)
    np.testing.assert_allclose(mpc.explain()["planned_rate"], np.full((2, 3), 0.008))
    od, setpoint = np.array([0.9, 0.502]), np.array([0.3, 0.5])
    rate = mpc.act(od, setpoint, np.zeros(2), np.ones(2, dtype=bool))
    plan = mpc.explain()
    assert rate[0] == 0.03
    np.testing.assert_allclose(plan["planned_rate"][:, 0], rate)
    steps = np.stack([step_factors(model, plan["planned_rate"][:, k]) for k in range(3)], axis=1)
    np.testing.assert_allclose(plan["predicted_od"], od[:, None] * np.cumprod(steps, axis=1))
    np.testing.assert_allclose(plan["predicted_od"][1], 0.5, rtol=1e-4)


def test_a_decision_begins_at_the_last_plan_a_period_on_and_of_each_reactor_at_its_own(monkeypatch):
    """The last move stands twice. The first reactor has no reading once, and keeps its plan for the next time."""
    plans = [np.array([[0.1, 0.2, 0.3], [0.4, 0.5, 0.6]]), np.array([[0.7, 0.8, 0.9]]), np.zeros((2, 3))]
    starts, problems = list[list[list[float]]](), list[Problem]()
    monkeypatch.setattr(
        Problem,
        "by_gradient",
        lambda problem, start: problems.append(problem) or starts.append(start.tolist()) or plans[len(starts) - 1],
    )
    mpc = Mpc(MpcConfig(solver="gradient", horizon=3), EnvConfig(mu=0.03, tau=0.4))
    mpc.reset(2)
    od, setpoint, both = np.array([0.5, 0.6]), np.array([0.4, 0.7]), np.ones(2, dtype=bool)
    rates = [mpc.act(od, setpoint, np.zeros(2), rows).tolist() for rows in (both, np.array([False, True]), both)]
    assert starts[1:] == [[[0.5, 0.6, 0.6]], [[0.2, 0.3, 0.3], [0.8, 0.9, 0.9]]]
    assert [[*p.start, *p.setpoint] for p in problems] == [[0.5, 0.6, 0.4, 0.7], [0.6, 0.7], [0.5, 0.6, 0.4, 0.7]]
    np.testing.assert_allclose(starts[0], 0.6)  # mu tau of 0.02 mL/s
    np.testing.assert_allclose(rates, [[0.002, 0.008], [0.002, 0.014], [0.0, 0.0]])


def test_a_swarm_is_never_worse_than_the_place_where_it_is_told_to_begin() -> None:
    """Each swarm its own place, far outside of the box."""
    start = np.array([[7.0, -3.0], [-5.0, 9.0]])
    rngs, swarm = np.random.default_rng(0).spawn(2), SwarmConfig(particles=3, iterations=2)
    found, cost = minimise(lambda x: ((x - start[:, None]) ** 2).sum(-1), 0.0, 1.0, start, rngs, swarm)
    np.testing.assert_array_equal(found, start)
    assert cost.tolist() == [0.0, 0.0]


def test_sixty_four_reactors_are_one_problem(monkeypatch: pytest.MonkeyPatch) -> None:
    """A decision evaluates the cost as often for all of them together as for one."""
    calls: list[int] = []
    cost = Problem.cost
    monkeypatch.setattr(Problem, "cost", lambda self, v: calls.append(v.shape[0]) or cost(self, v))
    for n in (1, 64):
        od, setpoint = states(n)
        mpc = Mpc(MpcConfig(swarm=SwarmConfig(particles=4, iterations=7)), MODEL)
        mpc.reset(n)
        mpc.act(od, setpoint, np.zeros(n), np.ones(n, dtype=bool))
    half = len(calls) // 2
    assert calls == [1] * half + [64] * half
    assert half > 7
