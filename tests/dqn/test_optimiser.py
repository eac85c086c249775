"""The optimiser against torch's own."""

import pytest
import torch

from dqn.optimiser import Adam

pytestmark = pytest.mark.numeric


def _gradients(seed: int) -> list[torch.Tensor]:
    generator = torch.Generator().manual_seed(seed)
    return [torch.randn(3, 7, generator=generator) for _ in range(20)]


def test_steps_are_those_of_torch() -> None:
    """Twenty steps with the published constants, which are torch.optim.Adam's defaults."""
    start = torch.randn(3, 7, generator=torch.Generator().manual_seed(1))
    weights, gradient = start.clone(), torch.zeros(3, 7)
    ours = Adam(weights, gradient)
    parameter = torch.nn.Parameter(start.clone())
    theirs = torch.optim.Adam([parameter], 1e-3)
    for g in _gradients(2):
        gradient.copy_(g)
        ours.step(1e-3)
        parameter.grad = g.clone()
        theirs.step()
        torch.testing.assert_close(weights, parameter.detach(), rtol=1e-5, atol=1e-7)


def test_a_loaded_state_continues() -> None:
    weights, gradient = torch.ones(3, 7), torch.zeros(3, 7)
    whole = Adam(weights, gradient)
    gradients = _gradients(3)
    for g in gradients[:10]:
        gradient.copy_(g)
        whole.step(1e-3)
    copied, other_gradient = weights.clone(), torch.zeros(3, 7)
    resumed = Adam(copied, other_gradient)
    resumed.load_state_dict({key: value.clone() for key, value in whole.state_dict().items()})
    for g in gradients[10:]:
        gradient.copy_(g)
        other_gradient.copy_(g)
        whole.step(1e-3)
        resumed.step(1e-3)
    assert torch.equal(weights, copied)
