"""Replay memory and random streams."""

from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from dqn.replay import Replay
from dqn.streams import CALLS_PER_BLOCK, UniformStream

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


def _seeds(numbers: range) -> list[np.random.SeedSequence]:
    return [np.random.SeedSequence(n) for n in numbers]


def test_numbers_are_those_of_the_generator() -> None:
    stream = UniformStream(_seeds(range(1)), 2)
    rng = np.random.default_rng(np.random.SeedSequence(0))
    expected = rng.random((CALLS_PER_BLOCK + 1, 2))
    drawn = np.concatenate([stream.take(1)[0] for _ in range(CALLS_PER_BLOCK + 1)])
    np.testing.assert_array_equal(drawn, expected)


@pytest.mark.parametrize("calls", [3, CALLS_PER_BLOCK, 10 * CALLS_PER_BLOCK])
def test_several_calls_at_once_are_the_same_numbers(calls: int) -> None:
    """Block by block: a call that is told more than the block still holds gets what is left of it."""
    one, many = UniformStream(_seeds(range(2)), 2), UniformStream(_seeds(range(2)), 2)
    expected = np.concatenate([one.take(1) for _ in range(3 * CALLS_PER_BLOCK)], axis=1)
    parts = [many.take(calls)]
    while sum(part.shape[1] for part in parts) < 3 * CALLS_PER_BLOCK:
        parts.append(many.take(calls))
    np.testing.assert_array_equal(np.concatenate(parts, axis=1), expected)
    assert {part.shape[1] for part in parts} == {min(calls, CALLS_PER_BLOCK), *([2] if calls == 3 else [])}


def test_what_follows_from_a_block_is_computed_once() -> None:
    shapes: list[tuple[int, ...]] = []

    def doubled(block: NDArray[np.float64]) -> NDArray[np.float64]:
        shapes.append(block.shape)
        return 2.0 * block

    plain, stream = UniformStream(_seeds(range(2)), 3), UniformStream(_seeds(range(2)), 3, doubled)
    for _ in range(CALLS_PER_BLOCK + 1):
        np.testing.assert_array_equal(2.0 * plain.take(1), stream.take(1))
    assert shapes == [(2, CALLS_PER_BLOCK, 3)] * 2


@pytest.mark.parametrize("calls", [0, 1, CALLS_PER_BLOCK - 1, CALLS_PER_BLOCK, CALLS_PER_BLOCK + 1])
def test_continues_from_its_state(calls: int) -> None:
    one = UniformStream(_seeds(range(3)), 2)
    for _ in range(calls):
        one.take(1)
    other = UniformStream(_seeds(range(10, 13)), 2)
    other.load_state_dict(one.state_dict())
    for _ in range(CALLS_PER_BLOCK + 3):
        np.testing.assert_array_equal(one.take(1), other.take(1))
