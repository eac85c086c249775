"""Network and losses against autograd, and the optimiser against its publication."""

import numpy as np
import pytest
import torch

from dqn.network import QNetwork, action_basis, initial_weights
from dqn.optimiser import Adam
from dqn.targets import advantage_target, compressed, expanded, huber_loss, loss_gradient, q_target

pytestmark = pytest.mark.numeric

SIZES = (3, 7, 5, 4)
AGENTS, BATCH = 3, 6


def _flat(sizes: tuple[int, ...] = SIZES) -> torch.Tensor:
    return torch.from_numpy(np.stack([initial_weights(sizes, np.random.SeedSequence(i)) for i in range(AGENTS)]))


def _twin(network: QNetwork, agent: int) -> torch.nn.Sequential:
    """The same network out of torch's modules, in double precision."""
    modules: list[torch.nn.Module] = []
    for weight, bias in network.layers:
        linear = torch.nn.Linear(weight.shape[1], weight.shape[2], dtype=torch.float64)
        with torch.no_grad():
            linear.weight.copy_(weight[agent].T)
            linear.bias.copy_(bias[agent, 0])
        modules += [linear, torch.nn.ReLU()]
    return torch.nn.Sequential(*modules[:-1])


@pytest.mark.parametrize("decay", [None, 0.0, 2.0])
def test_forward_and_backward_agree_with_autograd(decay: float | None) -> None:
    basis = None if decay is None else action_basis(SIZES[-1], decay)
    network = QNetwork(_flat(), SIZES, basis=basis)
    generator = torch.Generator().manual_seed(0)
    observation = torch.randn(AGENTS, BATCH, SIZES[0], generator=generator)
    slope = torch.randn(AGENTS, BATCH, SIZES[-1], generator=generator)
    q, inputs = network.forward(observation)
    for _ in range(2):  # the second overwrites what the first has left
        network.backward(inputs, slope)
    for i in range(AGENTS):
        twin = _twin(network, i)
        expected = twin(observation[i].double())
        expected = expected if basis is None else expected @ basis.double()
        torch.testing.assert_close(q[i].double(), expected, rtol=1e-5, atol=1e-6)
        (expected * slope[i]).sum().backward()
        linears = [m for m in twin if isinstance(m, torch.nn.Linear)]
        for linear, (weight, bias) in zip(linears, QNetwork(network.grad, SIZES).layers, strict=True):
            torch.testing.assert_close(weight[i].double(), linear.weight.grad.T, rtol=1e-4, atol=1e-5)
            torch.testing.assert_close(bias[i, 0].double(), linear.bias.grad, rtol=1e-4, atol=1e-5)


def test_maps_of_inputs_and_outputs_stay_with_other_weights_and_are_reported_as_copies() -> None:
    matrix, offset = torch.tensor([[3.0, -3.0], [0.0, 2.0], [1.0, 0.5]]), torch.tensor([0.0, -1.2, 0.25])
    sizes, basis, observation = (3, 4, 2), action_basis(2, 1.0), torch.rand(AGENTS, BATCH, 2)
    plain = QNetwork(_flat(sizes), sizes)
    first = QNetwork(0.5 * _flat(sizes), sizes, matrix.clone(), offset.clone(), basis.clone())
    for network in (first, first.with_weights(plain.flat)):
        for array, expected in zip((*network.input_map(), network.output_map()), (matrix, offset, basis), strict=True):
            np.testing.assert_array_equal(array, expected.numpy())
            array += 1.0
    expected = plain(observation @ matrix.T + offset) @ basis
    torch.testing.assert_close(network(observation), expected)
    for array, unit in zip((*plain.input_map(), plain.output_map()), (np.eye(3), np.zeros(3), np.eye(2)), strict=True):
        np.testing.assert_array_equal(array, unit)


def test_initial_weights_follow_torch_linear() -> None:
    """Uniform in +-1/sqrt(inputs), layer by layer; another seed gives other numbers."""
    sizes = (4, 400, 100)
    flat = initial_weights(sizes, np.random.SeedSequence(5))
    assert flat.dtype == np.float32
    assert flat.size == 4 * 400 + 400 + 400 * 100 + 100
    first, second = flat[:2000], flat[2000:]
    for part, bound in ((first, 0.5), (second, 0.05)):
        assert np.abs(part).max() <= bound
        assert np.std(part) == pytest.approx(bound / np.sqrt(3.0), rel=0.05)
        assert abs(np.mean(part)) < 0.05 * bound
    assert not np.array_equal(flat, initial_weights(sizes, np.random.SeedSequence(6)))


def test_action_basis_spans_everything_and_prefers_smooth_differences() -> None:
    for decay in (0.0, 0.5, 2.0):
        rows = action_basis(17, decay).double()
        lengths = 17.0 * (1.0 + torch.arange(17, dtype=torch.float64)) ** (-2.0 * decay)
        torch.testing.assert_close(rows @ rows.T, torch.diag(lengths), rtol=1e-4, atol=1e-5)  # orthogonal rows
        assert bool((rows[:, -1] > 0.0).all())
    linear = action_basis(17, 0.0)[1].double().diff()
    torch.testing.assert_close(linear, linear[:1].expand(16), rtol=1e-4, atol=0.0)
    basis = action_basis(17, 2.0).double()
    assert int(torch.linalg.matrix_rank(basis)) == 17
    torch.testing.assert_close(basis[0], torch.ones(17, dtype=torch.float64))
    moved = basis.T @ basis  # what a gradient step on one Q value does to all of them
    assert bool((moved[8, 8] >= moved[8]).all())
    assert float(moved[8, 7]) > float(moved[8, 3])


def test_three_functions_of_the_basis_make_a_parabola() -> None:
    """Any parabola of the action, at the ends of the grid too, without the other fourteen."""
    basis = action_basis(17, 3.0).double()
    action = torch.arange(17, dtype=torch.float64)
    q = 3.0 - 0.5 * (action - 12.3) ** 2
    weights = torch.linalg.lstsq(basis[:3].T, q[:, None]).solution
    torch.testing.assert_close((basis[:3].T @ weights)[:, 0], q, rtol=1e-5, atol=1e-4)


def test_outputs_may_start_at_zero() -> None:
    drawn = initial_weights((3, 8, 4), np.random.SeedSequence(3))
    flat = initial_weights((3, 8, 4), np.random.SeedSequence(3), zero_output=True)
    assert np.array_equal(flat[:32], drawn[:32])
    q = QNetwork(torch.from_numpy(flat[None]), (3, 8, 4))(torch.ones(1, 5, 3))
    assert torch.equal(q, torch.zeros(1, 5, 4))


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
