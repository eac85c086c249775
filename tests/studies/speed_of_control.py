"""Measurements of `tests.studies.speed` on control: closed loops of each controller, and the solvers of the MPC."""

from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from itertools import pairwise
from typing import Any

import numpy as np
from scipy.optimize import minimize

from dqn.policy import ABSOLUTE, Policy
from envs.plant.plant import Plant, PlantConfig
from envs.scenario import Scenario
from envs.task import EnvConfig
from experiments.cli import frame
from experiments.comparison.trials import Cell, run_trial
from experiments.laws import registry
from experiments.laws.base import Array, Controller
from experiments.laws.density.mpc import MpcConfig, Problem
from tests.studies.measurement import Measurement

__all__ = ["loops", "mpc"]

REPLICATES = 64
STATES = 64  # of the MPC's problem


def loops() -> Iterator[Measurement]:
    """Closed loops of 90 min on `nominal_noise`: 64 vials as a batch beside the same 64 one after another."""
    model = EnvConfig()
    plant = frame.load(frame.compose("plant/nominal_noise", []).plant, PlantConfig())
    scenario = Scenario((0.8, 0.65, 0.5), (30.0, 30.0, 30.0), (37.0, 37.0, 37.0), recovery_od=0.8)
    policy = _untrained_policy(model)

    def loop(config: Any, replicates: int, seed: int) -> None:
        def make(vials: Plant) -> Controller:
            law: Controller = registry.build(config, model=model, policy=policy, plant=vials)
            return law

        run_trial(Cell(config.kind, "nominal_noise", "setpoint_steps"), plant, scenario, make, model, replicates, seed)

    def one_by_one(config: Any) -> None:
        for seed in np.arange(REPLICATES):
            loop(config, 1, int(seed))

    what = f"{REPLICATES} vials x 90 min after recovery"
    for kind in ("pi", "dqn", "inverse"):
        chosen = registry.config(kind)
        yield Measurement(f"closed loop, {kind}", what, "as many vials one after another",
                          partial(loop, chosen, REPLICATES, 0), partial(one_by_one, chosen), limit=1.0)  # fmt: skip
    swarm = registry.config("mpc")
    gradient = replace(swarm, solver="gradient")
    yield Measurement("closed loop, mpc", f"{what}, particle swarm",
                      "the same with SciPy's L-BFGS-B, exact gradient", partial(loop, swarm, REPLICATES, 0),
                      partial(loop, gradient, REPLICATES, 0), limit=20.0)  # fmt: skip


def _untrained_policy(model: EnvConfig) -> Policy:
    """A 2-64-64-17 network with random weights; how long it takes does not depend on them."""
    rng = np.random.default_rng(0)
    sizes = (2, 64, 64, model.n_actions)
    weights = tuple(rng.normal(0.0, 0.3, (a, b)).astype(np.float32) for a, b in pairwise(sizes))
    biases = tuple(np.zeros(b, dtype=np.float32) for b in sizes[1:])
    unit, limit = np.eye(2, dtype=np.float32), np.full(2, np.inf, dtype=np.float32)
    metadata = {"observation": list(ABSOLUTE)}
    return Policy(weights, biases, unit, np.zeros(2, np.float32), model.pump_rates(), -limit, limit, metadata)


def mpc() -> Iterator[Measurement]:
    """The MPC's problem from random states, cold: the swarm beside two of SciPy's solvers."""
    model, config = EnvConfig(), MpcConfig()
    rng = np.random.default_rng(1)
    start, setpoint = rng.uniform(0.2, 1.0, STATES), rng.uniform(0.2, 1.0, STATES)
    cold = np.full((STATES, config.horizon), 0.5)

    def problem(rows: slice) -> Problem:
        return Problem(start[rows], setpoint[rows], model, config.penalty)

    def swarm(rows: slice) -> None:
        problem(rows).by_swarm(cold[rows], np.random.default_rng(0).spawn(STATES)[rows], config.swarm)

    def gradient(rows: slice) -> None:
        problem(rows).by_gradient(cold[rows])

    def slsqp(rows: slice) -> None:
        for k in range(STATES)[rows]:
            one = problem(slice(k, k + 1))

            def cost(v: Array, one: Problem = one) -> float:
                return one.value_and_gradient(v, 1e4)[0]

            minimize(cost, cold[k], method="SLSQP", bounds=[(0.0, 1.0)] * config.horizon)

    every = slice(0, STATES)
    what = f"{STATES} decisions at once"
    yield Measurement("mpc solve, batch", what, "SciPy L-BFGS-B, exact gradient, one after another",
                      lambda: swarm(every), lambda: gradient(every), "ms per decision", 1e3, STATES)  # fmt: skip
    yield Measurement("mpc solve, batch", what, "SciPy SLSQP, numerical gradient, one after another",
                      lambda: swarm(every), lambda: slsqp(every), "ms per decision", 1e3, STATES)  # fmt: skip
    yield Measurement("mpc solve, single", "one decision, as on the bench", "SciPy L-BFGS-B, exact gradient",
                      lambda: swarm(slice(0, 1)), lambda: gradient(slice(0, 1)), "ms per decision", 1e3)  # fmt: skip
