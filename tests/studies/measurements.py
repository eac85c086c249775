"""What `tests.studies.speed` times: pairs of callables that do the same work, and how they are timed fairly."""

import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial
from itertools import pairwise
from statistics import median
from typing import Any

import numpy as np
from scipy.optimize import minimize

from dqn.config import DQNConfig
from dqn.policy import ABSOLUTE, Policy
from envs.plant.plant import Plant, PlantConfig
from envs.scenario import Scenario
from envs.task import EnvConfig
from envs.vector_env import BioreactorVectorEnv
from experiments.cli import frame
from experiments.comparison.trials import Cell, run_trial
from experiments.laws import registry
from experiments.laws.base import Array, Controller
from experiments.laws.density.mpc import MpcConfig, Problem

__all__ = ["Measurement", "environment", "loops", "measure", "mpc", "training"]

COPIES = 4096
REPLICATES = 64
STATES = 64  # of the MPC's problem


@dataclass(frozen=True)
class Measurement:
    """name: what is timed; work: one sentence about it. rival: what `theirs` is. per: the time is divided by this.

    unit: of the time so divided, "s" or "ms per decision" etc., with `scale` turning seconds into it.
    limit: the time of ours that must not be exceeded, in that unit, or None.
    """

    name: str
    work: str
    rival: str
    ours: Callable[[], object]
    theirs: Callable[[], object]
    unit: str = "s"
    scale: float = 1.0
    per: int = 1
    limit: float | None = None


def seconds(work: Callable[[], object], repeats: int = 1) -> float:
    """How long one call takes, s: mean over so many in a row."""
    start = time.perf_counter()
    for _ in range(repeats):
        work()
    return (time.perf_counter() - start) / repeats


def measure(m: Measurement, runs: int) -> dict[str, Any]:
    """Time a measurement `runs` times in pairs, after one pair that is thrown away; one entry of summary.json."""
    pairs = []
    for k in range(runs + 1):
        order = (m.ours, m.theirs) if k % 2 else (m.theirs, m.ours)
        times = {call: seconds(call) for call in order}
        pairs.append((times[m.ours], times[m.theirs]))
    factor = m.scale / m.per
    kept = pairs[1:]
    ours = factor * median(a for a, _ in kept)
    return {
        "name": m.name,
        "work": m.work,
        "unit": m.unit,
        "ours": ours,
        "rival": m.rival,
        "theirs": factor * median(b for _, b in kept),
        "ratio": median(b / a for a, b in kept),
        "ratio_range": [min(b / a for a, b in kept), max(b / a for a, b in kept)],
        "runs": runs,
        "limit": m.limit,
        "within_limit": None if m.limit is None else ours < m.limit,
    }


def _one_thread(work: Callable[[], object]) -> None:
    """Work on one thread: the faster setting for networks of this size, for the rivals as for us."""
    import torch

    torch.set_num_threads(1)
    work()


def _train(config: DQNConfig) -> None:
    """The schedule from scratch, no evaluation, no files: what the rivals do, too."""
    from experiments.training import build
    from experiments.training.density import DensityTask

    def run() -> None:
        list(build.population(DensityTask(EnvConfig()), config, range(1)).run())

    _one_thread(run)


def training() -> Iterator[Measurement]:
    """10 000 steps, 9 500 updates of batch 64, 64x64 units (agent=paper), beside other implementations."""
    from tests.studies import rivals

    config = DQNConfig()
    for name, rival in (
        ("Stable-Baselines3 DQN", rivals.stable_baselines_dqn),
        ("single-file loop as CleanRL's", rivals.single_file_dqn),
    ):
        work = partial(_one_thread, partial(rival, config, 0))
        yield Measurement("training, one agent", "10 000 steps, 9 500 updates", name, partial(_train, config), work)


def environment() -> Iterator[Measurement]:
    """Control steps of 4 096 copies, autoreset included, beside Gymnasium's sync and the memory it must move."""
    from tests.studies import rivals

    rng = np.random.default_rng(0)
    actions = [rng.integers(0, 17, COPIES) for _ in range(8)]
    native, sync = BioreactorVectorEnv(COPIES), rivals.sync_vector_env(COPIES)
    native.reset(seed=0)
    sync.reset(seed=0)

    def steps(env: Any, n: int) -> None:
        for k in range(n):
            env.step(actions[k % len(actions)])

    # what a step must read and write: action, OD, setpoint, step count; OD, count, observation, reward, two flags
    fields = [
        (np.zeros(COPIES, dtype=d), np.zeros(COPIES, dtype=d)) for d in ("i8", "f8", "f8", "i8", "f8", "f8", "i2")
    ]

    def copies(n: int) -> None:
        for _ in range(n):
            for source, destination in fields:
                np.copyto(destination, source)

    per = 500 * COPIES
    yield Measurement("vector environment", f"{COPIES} copies, ten sub-steps, autoreset", "NumPy copy of its bytes",
                      lambda: steps(native, 500), lambda: copies(500), "ns per control step", 1e9, per)  # fmt: skip
    yield Measurement("vector environment, 10 steps", f"{COPIES} copies, ten sub-steps", "Gymnasium's sync vector env",
                      lambda: steps(native, 10), lambda: steps(sync, 10),
                      "ns per control step", 1e9, 10 * COPIES)  # fmt: skip


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
