"""Measurements of `tests.studies.speed` on learning: training, updates, vector environment, start-up, scaling."""

import subprocess
import sys
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial
from itertools import pairwise
from statistics import median
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dqn.config import DQNConfig
from envs.task import EnvConfig
from envs.vector_env import BioreactorVectorEnv
from tests.studies.measurement import Measurement, seconds

__all__ = ["environment", "scaling", "start_up", "training", "update"]

POPULATION = 32
COPIES = 4096
ENTRY_POINTS = ("train", "deploy", "calibrate", "certify", "benchmark", "report")


def _one_thread(work: Callable[[], object], times: int = 1) -> None:
    """Call `work` so often on one thread: the faster setting for networks of this size, for the rivals as for us."""
    import torch

    torch.set_num_threads(1)
    for _ in range(times):
        work()


def _train(agents: int, config: DQNConfig) -> None:
    """The schedule from scratch, no evaluation, no files: what the rivals do, too."""
    from experiments.training import build
    from experiments.training.density import Density

    def run() -> None:
        for _ in build.population(Density(EnvConfig()), config, range(agents)).run():
            pass

    _one_thread(run)


def training() -> Iterator[Measurement]:
    """10 000 steps, 9 500 updates of batch 64, 64x64 units (agent=paper), beside other implementations."""
    from tests.studies import rivals

    config = DQNConfig()
    schedule = "10 000 steps, 9 500 updates"
    for name, rival in (
        ("Stable-Baselines3 DQN", rivals.stable_baselines_dqn),
        ("single-file loop as CleanRL's", rivals.single_file_dqn),
    ):
        work = partial(_one_thread, partial(rival, config, 0))
        yield Measurement("training, one agent", schedule, name, partial(_train, 1, config), work)
    yield Measurement(
        f"training, {POPULATION} agents",
        f"{schedule} each",
        "one run of Stable-Baselines3 DQN",
        partial(_train, POPULATION, config),
        partial(_one_thread, partial(rivals.stable_baselines_dqn, config, 0)),
    )


def _matrix_work(agents: int, batch: int, units: tuple[int, ...]) -> Callable[[], object]:
    """The matrix products of one DQN update and nothing else: two forward passes, one backward pass."""
    import torch

    shapes = list(pairwise(units))
    inputs = [torch.randn(agents, batch, i) for i, _ in shapes]
    outputs = [torch.randn(agents, batch, o) for _, o in shapes]
    weights = [torch.randn(agents, i, o) for i, o in shapes]
    # the last layer transposed, as in dqn.network
    outputs[-1], weights[-1] = (m.transpose(1, 2).contiguous() for m in (outputs[-1], weights[-1]))

    def work() -> None:
        for k, (x, y, w) in enumerate(zip(inputs[:-1], outputs[:-1], weights[:-1], strict=True)):
            torch.bmm(x, w)  # target network
            torch.bmm(x, w)  # online network
            torch.bmm(x.transpose(1, 2), y)  # gradient by the weights
            if k:
                torch.bmm(y, w.transpose(1, 2))  # gradient by the layer's input
        x, y, w = inputs[-1], outputs[-1], weights[-1]
        torch.bmm(w, x.transpose(1, 2))
        torch.bmm(w, x.transpose(1, 2))
        torch.bmm(y, x)
        torch.bmm(y.transpose(1, 2), w)

    return work


def update() -> Iterator[Measurement]:
    """One update beside the matrix products it cannot do without, at the rate this machine does them."""
    config = DQNConfig()
    for agents, repeats in ((1, 2000), (POPULATION, 200)):
        products = _matrix_work(agents, config.batch_size, (2, *config.hidden, 17))
        yield Measurement(
            f"update, {agents} agent(s)", "batch 64", "its matrix products alone",
            partial(_one_thread, _warm_update(agents, config), repeats), partial(_one_thread, products, repeats),
            "µs", 1e6, repeats,
        )  # fmt: skip


def _warm_update(agents: int, config: DQNConfig) -> Callable[[], None]:
    """The update of one group of agents whose replay memory is full, as a population's thread makes it."""
    import torch

    from dqn.population import fast_arithmetic
    from experiments.training import build
    from experiments.training.density import Density

    trainer = build.trainer(Density(EnvConfig()), replace(config, learn_start=config.total_steps), range(agents))
    for _ in trainer.run():
        pass
    fast_arithmetic()
    return torch.inference_mode()(trainer.agent.learn)


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


def start_up() -> Iterator[Measurement]:
    """How long `--help` takes, beside a Python process that only imports torch."""

    def process(*arguments: str) -> Callable[[], object]:
        return lambda: subprocess.run([sys.executable, *arguments], check=True, capture_output=True)

    for name in ENTRY_POINTS:
        yield Measurement(
            f"start-up, {name} --help", "a whole process", "python -c 'import torch'",
            process("-m", f"experiments.{name}", "--help"), process("-c", "import torch"),
        )  # fmt: skip


def scaling(runs: int) -> dict[str, tuple[NDArray[np.int64], NDArray[np.float64]]]:
    """Median cost over one size at a time: agents S and batch B of an update, copies N of an environment step,
    episodes of a training, each as (sizes, seconds)."""

    def timed(work: Callable[[], object], repeats: int) -> float:
        work()
        return median(seconds(work, repeats) for _ in range(runs))

    config = DQNConfig()

    def env_step(n: int) -> float:
        env = BioreactorVectorEnv(n)
        env.reset(seed=0)
        action = np.random.default_rng(0).integers(0, 17, n)
        return timed(lambda: env.step(action), 200)

    def training(n: int) -> float:
        return timed(partial(_train, 1, replace(config, total_steps=100 * n)), 1)

    costs: dict[str, tuple[list[int], Callable[[int], float]]] = {
        "agents S, one update": ([1, 2, 4, 8, 16, 32, 64, 128], lambda n: timed(_warm_update(n, config), 50)),
        "batch B, one update": (
            [16, 32, 64, 128, 256, 512], lambda n: timed(_warm_update(1, replace(config, batch_size=n)), 200)
        ),
        "copies N, one environment step": ([1, 16, 256, 4096, 65536], env_step),
        "episodes, one training": ([10, 20, 50, 100], training),
    }  # fmt: skip
    return {key: (np.array(sizes), np.array([cost(n) for n in sizes])) for key, (sizes, cost) in costs.items()}
