"""The ring against a plain list."""

from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from dqn.replay import Replay

AGENTS, OBSERVATIONS = 3, 2
CPU = torch.device("cpu")


def _step(rng: np.random.Generator, agents: int = AGENTS) -> dict[str, NDArray[Any]]:
    """One transition per agent, as `Replay.add` takes it."""
    return {
        "s_tm1": rng.standard_normal((agents, OBSERVATIONS)).astype(np.float32),
        "a_tm1": rng.integers(0, 17, agents),
        "r_t": rng.standard_normal(agents).astype(np.float32),
        "s_t": rng.standard_normal((agents, OBSERVATIONS)).astype(np.float32),
        "continues": rng.random(agents) < 0.5,
    }


@settings(deadline=None, max_examples=25)
@given(capacity=st.integers(1, 9), added=st.integers(1, 30), seed=st.integers(0, 2**31))
def test_holds_the_last_ones_like_a_list(capacity: int, added: int, seed: int) -> None:
    rng = np.random.default_rng(seed)
    replay = Replay(AGENTS, capacity, OBSERVATIONS, CPU)
    naive: list[dict[str, NDArray[Any]]] = []
    for k in range(added):
        step = _step(rng)
        replay.add(**step)
        if len(naive) < capacity:
            naive.append(step)
        else:
            naive[k % capacity] = step
    assert replay.size == len(naive)
    uniform = rng.random((AGENTS, 16))
    batch = replay.sample(uniform)
    for i in range(AGENTS):
        for j in range(16):
            expected = naive[int(uniform[i, j] * len(naive))]
            for name, drawn in batch._asdict().items():
                np.testing.assert_array_equal(drawn[i, j].numpy(), expected[name][i])


def test_a_minibatch_is_a_copy_with_its_types_also_of_the_last_row() -> None:
    replay = Replay(AGENTS, 7, OBSERVATIONS, CPU)
    for _ in range(7):
        replay.add(**_step(np.random.default_rng(1)))
    last = np.full((AGENTS, 5), np.nextafter(1.0, 0.0))
    batch = replay.sample(last)
    assert batch.a_tm1.dtype == torch.int64
    assert [tuple(field.shape) for field in batch] == [(3, 5, 2), (3, 5), (3, 5), (3, 5, 2), (3, 5)]
    batch.s_t.add_(100.0)
    assert replay.sample(last).s_t.abs().max() < 50.0


def test_empty_memory_is_refused() -> None:
    with pytest.raises(ValueError, match="replay memory is empty"):
        Replay(AGENTS, 4, OBSERVATIONS, CPU).sample(np.zeros((AGENTS, 1)))
