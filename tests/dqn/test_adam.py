"""The optimiser against torch's own."""

from __future__ import annotations

import torch

from dqn.adam import Adam


def _steps(generator: torch.Generator) -> list[tuple[float, torch.Tensor]]:
    return [(10.0 ** (-3 - k % 3), torch.randn(3, 7, generator=generator)) for k in range(20)]


def test_steps_are_those_of_torch() -> None:
    """Twenty steps with a changing learning rate, beta2 and eps of its own, equal to torch.optim.Adam's."""
    start = torch.randn(3, 7, generator=torch.Generator().manual_seed(1))
    weights, gradient = start.clone(), torch.zeros(3, 7)
    ours = Adam(weights, gradient, 1e-3, beta2=0.99, eps=1e-4)
    parameter = torch.nn.Parameter(start.clone())
    theirs = torch.optim.Adam([parameter], 1e-3, (0.9, 0.99), 1e-4)
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
    whole = Adam(weights, gradient, 1e-3, beta2=0.999, eps=1e-8)
    steps = _steps(torch.Generator().manual_seed(3))
    for _, g in steps[:10]:
        gradient.copy_(g)
        whole.step()
    copied, other_gradient = weights.clone(), torch.zeros(3, 7)
    resumed = Adam(copied, other_gradient, 1e-3, beta2=0.999, eps=1e-8)
    resumed.load_state_dict({key: value.clone() for key, value in whole.state_dict().items()})
    for _, g in steps[10:]:
        gradient.copy_(g)
        other_gradient.copy_(g)
        whole.step()
        resumed.step()
    assert torch.equal(weights, copied)
