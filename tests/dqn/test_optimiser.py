"""The optimiser against torch's own, and its schedules at their corners and in between."""

from __future__ import annotations

import pytest
import torch

from dqn.optimiser import Adam, decayed, linear


def _steps(generator: torch.Generator) -> list[tuple[float, torch.Tensor]]:
    return [(10.0 ** (-3 - k % 3), torch.randn(3, 7, generator=generator)) for k in range(20)]


def test_steps_are_those_of_torch() -> None:
    """Twenty steps with a changing learning rate and the published constants, torch.optim.Adam's defaults."""
    start = torch.randn(3, 7, generator=torch.Generator().manual_seed(1))
    weights, gradient = start.clone(), torch.zeros(3, 7)
    ours = Adam(weights, gradient, 1e-3)
    parameter = torch.nn.Parameter(start.clone())
    theirs = torch.optim.Adam([parameter], 1e-3)
    for rate, g in _steps(torch.Generator().manual_seed(2)):
        gradient.copy_(g)
        ours.learning_rate = rate
        ours.step()
        parameter.grad = g.clone()
        theirs.param_groups[0]["lr"] = rate
        theirs.step()
        torch.testing.assert_close(weights, parameter.detach(), rtol=1e-5, atol=1e-7)


def test_a_loaded_state_continues() -> None:
    weights, gradient = torch.ones(3, 7), torch.zeros(3, 7)
    whole = Adam(weights, gradient, 1e-3)
    steps = _steps(torch.Generator().manual_seed(3))
    for _, g in steps[:10]:
        gradient.copy_(g)
        whole.step()
    copied, other_gradient = weights.clone(), torch.zeros(3, 7)
    resumed = Adam(copied, other_gradient, 1e-3)
    resumed.load_state_dict({key: value.clone() for key, value in whole.state_dict().items()})
    for _, g in steps[10:]:
        gradient.copy_(g)
        other_gradient.copy_(g)
        whole.step()
        resumed.step()
    assert torch.equal(weights, copied)


@pytest.mark.parametrize(("step", "expected"), [(0, 1.0), (250, 0.525), (500, 0.05), (501, 0.05), (10**6, 0.05)])
def test_linear(step: int, expected: float) -> None:
    assert linear(1.0, 0.05, 500, step) == pytest.approx(expected)


def test_linear_of_no_length_is_its_end() -> None:
    assert linear(1.0, 0.05, 0, 0) == 0.05


@pytest.mark.parametrize(("step", "expected"), [(0, 2.0), (699, 2.0), (700, 2.0), (850, 1.0), (1000, 0.0), (1001, 0.0)])
def test_decay_over_the_last_part(step: int, expected: float) -> None:
    assert decayed(2.0, 0.3, 1000, step) == pytest.approx(expected)


def test_no_decay() -> None:
    assert decayed(2.0, 0.0, 1000, 999) == 2.0
    assert decayed(2.0, 0.0, 1000, 5000) == 2.0
