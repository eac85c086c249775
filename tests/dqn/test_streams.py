"""Random numbers: agent i draws the same ones alone and among others, and goes on after a restart."""

import numpy as np
import pytest
import torch

from dqn.streams import CALLS_PER_BLOCK, UniformStream

CPU = torch.device("cpu")


def _seeds(numbers: range) -> list[np.random.SeedSequence]:
    return [np.random.SeedSequence(n) for n in numbers]


def test_agent_of_a_population_equals_the_agent_alone() -> None:
    many = UniformStream(_seeds(range(8)), 3, CPU)
    alone = [UniformStream(_seeds(range(i, i + 1)), 3, CPU) for i in range(8)]
    for _ in range(2 * CALLS_PER_BLOCK + 5):
        together = many.next()
        assert together.shape == (8, 3)
        for i in range(8):
            assert torch.equal(together[i], alone[i].next()[0])


def test_numbers_are_those_of_the_generator() -> None:
    stream = UniformStream(_seeds(range(1)), 2, CPU)
    rng = np.random.default_rng(np.random.SeedSequence(0))
    expected = rng.random((CALLS_PER_BLOCK + 1, 2))
    drawn = torch.cat([stream.next() for _ in range(CALLS_PER_BLOCK + 1)])
    np.testing.assert_array_equal(drawn.numpy(), expected)


def test_seeds_differ() -> None:
    stream = UniformStream(_seeds(range(2)), 4, CPU)
    numbers = stream.next()
    assert not torch.equal(numbers[0], numbers[1])


@pytest.mark.parametrize("calls", [0, 1, CALLS_PER_BLOCK - 1, CALLS_PER_BLOCK, CALLS_PER_BLOCK + 1])
def test_continues_from_its_state(calls: int) -> None:
    one = UniformStream(_seeds(range(3)), 2, CPU)
    for _ in range(calls):
        one.next()
    other = UniformStream(_seeds(range(10, 13)), 2, CPU)
    other.load_state_dict(one.state_dict())
    for _ in range(CALLS_PER_BLOCK + 3):
        assert torch.equal(one.next(), other.next())
