"""Targets by hand on a chain of two states, losses against autograd."""

import pytest
import torch

from dqn.targets import advantage_target, compressed, expanded, huber_loss, loss_gradient, q_target

pytestmark = pytest.mark.numeric

GAMMA = 0.9
# Chain: in state 0 action 0 stays (reward 0), action 1 moves to state 1 (reward 1); state 1 is left by either action,
# back to state 0, with reward 2 for action 0 and 0 for action 1.
MOVES = [[0, 1], [0, 0]]
REWARDS = [[0.0, 1.0], [2.0, 0.0]]


def _all_transitions() -> tuple[torch.Tensor, torch.Tensor, torch.Tensor, torch.Tensor]:
    """State, action, reward, next state of all four pairs, each of shape (1, 4)."""
    pairs = [(s, a) for s in (0, 1) for a in (0, 1)]
    state = torch.tensor([[s for s, _ in pairs]])
    action = torch.tensor([[a for _, a in pairs]])
    reward = torch.tensor([[REWARDS[s][a] for s, a in pairs]])
    after = torch.tensor([[MOVES[s][a] for s, a in pairs]])
    return state, action, reward, after


def _exact() -> torch.Tensor:
    """Q* of the chain, shape (2, 2): V0 = 1 + g V1, V1 = 2 + g V0 (moving on always pays)."""
    v0 = (1.0 + 2.0 * GAMMA) / (1.0 - GAMMA**2)
    v1 = 2.0 + GAMMA * v0
    return torch.tensor([[GAMMA * v0, v0], [v1, GAMMA * v0]])


@pytest.mark.parametrize("alpha", [0.5, 0.9])
def test_advantage_learning_widens_gaps_and_keeps_values(alpha: float) -> None:
    """Its fixed point: the same V, the same greedy actions, gaps 1 / (1 - alpha) times as wide."""
    state, action, reward, after = _all_transitions()
    q = torch.zeros(2, 2)
    for _ in range(600):
        target = q_target(reward, torch.ones(1, 4), GAMMA, q[after])
        q = advantage_target(target, alpha, q[state], action).view(2, 2)
    exact = _exact()
    value = exact.amax(1, keepdim=True)
    torch.testing.assert_close(q, value - (value - exact) / (1.0 - alpha), rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize("huber", [0.0, 0.3])
def test_loss_and_gradient_agree_with_autograd(huber: float) -> None:
    generator = torch.Generator().manual_seed(1)
    q = torch.randn(3, 8, 5, generator=generator, dtype=torch.float64, requires_grad=True)
    action = torch.randint(0, 5, (3, 8), generator=generator)
    target = torch.randn(3, 8, generator=generator, dtype=torch.float64)
    td_error, gradient = loss_gradient(q.detach(), action, target, huber)
    chosen = q.gather(-1, action.unsqueeze(-1)).squeeze(-1)
    if huber:
        each = torch.nn.functional.huber_loss(chosen, target, reduction="none", delta=huber)
    else:
        each = 0.5 * (chosen - target) ** 2
    expected = each.mean(-1)
    torch.testing.assert_close(huber_loss(td_error, huber), expected.detach())
    expected.sum().backward()
    assert q.grad is not None
    torch.testing.assert_close(gradient, q.grad)


def test_the_root_scale_is_its_own_inverse_and_keeps_the_fixed_point() -> None:
    """Costs from 1e-6 to 10, and Q-iteration on the chain with rewards below 0: h(Q*) is where it ends."""
    costs = -torch.logspace(-6, 1, 40, dtype=torch.float64)
    for root in (0.03, 0.3):
        scaled = compressed(costs, root)
        torch.testing.assert_close(expanded(scaled, root), costs, rtol=1e-9, atol=1e-12)
        assert bool((scaled[1:] < scaled[:-1]).all())
    assert float(compressed(torch.tensor(-4.0), 1e-6)) == pytest.approx(-2.0, abs=1e-5)
    assert float(expanded(torch.tensor(0.7), 0.3)) == 0.0  # no cost lies above 0
    _, _, reward, after = _all_transitions()
    plain, scaled = torch.zeros(2, 2), torch.zeros(2, 2)
    for _ in range(300):
        plain = q_target(reward - 3.0, torch.ones(1, 4), GAMMA, plain[after]).view(2, 2)
        step = q_target(reward - 3.0, torch.ones(1, 4), GAMMA, expanded(scaled[after], 0.3))
        scaled = compressed(step, 0.3).view(2, 2)
    torch.testing.assert_close(scaled, compressed(plain, 0.3), rtol=1e-4, atol=1e-4)
    assert torch.equal(scaled.argmax(1), plain.argmax(1))
