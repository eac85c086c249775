"""Random numbers: agent i draws the same ones alone and among others, and goes on after a restart."""

import numpy as np
import pytest
from numpy.typing import NDArray

from dqn.streams import CALLS_PER_BLOCK, UniformStream


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
