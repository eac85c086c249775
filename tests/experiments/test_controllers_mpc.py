"""The MPC: model, cost, swarm against exhaustive and gradient references, and the loop against the optimum."""

from itertools import product

import numpy as np
import pytest
from numpy.typing import NDArray

from envs.task import EnvConfig, step_factors
from experiments.laws.density.mpc import Mpc, MpcConfig, Problem
from experiments.laws.density.pso import SwarmConfig, minimise

pytestmark = pytest.mark.numeric

Array = NDArray[np.float64]
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
    swarm = cost_of(problem, problem.by_swarm(start, np.random.default_rng(0).spawn(n), SwarmConfig()))
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
