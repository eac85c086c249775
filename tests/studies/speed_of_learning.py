"""Measurements of `tests.studies.speed` on learning: training and vector environment."""

from collections.abc import Callable, Iterator
from functools import partial
from typing import Any

import numpy as np

from dqn.config import DQNConfig
from envs.task import EnvConfig
from envs.vector_env import BioreactorVectorEnv
from tests.studies.measurement import Measurement

__all__ = ["environment", "training"]

COPIES = 4096


def _one_thread(work: Callable[[], object]) -> None:
    """Work on one thread: the faster setting for networks of this size, for the rivals as for us."""
    import torch

    torch.set_num_threads(1)
    work()


def _train(config: DQNConfig) -> None:
    """The schedule from scratch, no evaluation, no files: what the rivals do, too."""
    from experiments.training import build
    from experiments.training.density import Density

    def run() -> None:
        for _ in build.population(Density(EnvConfig()), config, range(1)).run():
            pass

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
