"""The optimiser against the published equations."""

import numpy as np
import pytest
import torch

from dqn.optimiser import Adam

pytestmark = pytest.mark.numeric


def test_steps_are_those_of_the_publication() -> None:
    """Kingma and Ba 2015, algorithm 1, with its constants, in double precision; the rate changes on the way."""
    rng = np.random.default_rng(2)
    weights, gradient = torch.from_numpy(rng.standard_normal((3, 7), dtype=np.float32)), torch.zeros(3, 7)
    expected, mean, square = weights.double().numpy(), np.zeros((3, 7)), np.zeros((3, 7))
    adam = Adam(weights, gradient)
    for t in range(1, 21):
        rate = 1e-3 if t < 15 else 2e-4
        g = rng.standard_normal((3, 7), dtype=np.float32)
        gradient.copy_(torch.from_numpy(g))
        adam.step(rate)
        mean, square = 0.9 * mean + 0.1 * g, 0.999 * square + 0.001 * g.astype(np.float64) ** 2
        expected -= rate * (mean / (1.0 - 0.9**t)) / (np.sqrt(square / (1.0 - 0.999**t)) + 1e-8)
        np.testing.assert_allclose(weights.numpy(), expected, rtol=1e-5, atol=1e-6)
