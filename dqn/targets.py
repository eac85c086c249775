"""TD targets and losses as pure functions; S agents, B transitions, A actions."""

import torch


def q_target(r_t: torch.Tensor, continues: torch.Tensor, gamma: float, q_t: torch.Tensor) -> torch.Tensor:
    """Compute the target y = r + gamma c max_a Q_target(s', a) (Mnih 2015).

    Args: r_t: r, (S, B); continues: c, (S, B); q_t: Q_target(s', .), (S, B, A).
    Returns: shape (S, B).
    """
    return torch.addcmul(r_t, continues, q_t.amax(-1), value=gamma)


def compressed(value: torch.Tensor, root: float) -> torch.Tensor:
    """Return h(z) = c - sqrt(c^2 - z) for values z <= 0, any shape: the scale on which costs are learned (Pohlen 2018).

    Costs are squared errors, so values span many orders of magnitude; their roots are as large as the errors. In a
    deterministic task the fixed point of h(r + gamma max h^-1(Q)) is h(Q*), with the same greedy policy.
    Args: root: c > 0; h is nearly linear for |z| well below c^2.
    """
    return root - torch.sqrt(root * root - value.clamp(max=0.0))


def expanded(q: torch.Tensor, root: float) -> torch.Tensor:
    """Return h^-1(q) = c^2 - (c - q)^2, any shape; q is first limited to at most 0, because no cost is negative."""
    return root * root - torch.square(root - q.clamp(max=0.0))


def advantage_target(target: torch.Tensor, alpha: float, q_tm1: torch.Tensor, a_tm1: torch.Tensor) -> torch.Tensor:
    """Compute y - alpha (max_a Q_target(s, a) - Q_target(s, a_tm1)), the target of advantage learning (Baird 1999).

    The fixed point has the same greedy policy and the same maximum V as Q-learning. Its gaps V - Q(s, a) are
    1 / (1 - alpha) times larger, so an error of the network confuses fewer actions (Bellemare 2016, eq. 10).

    Args: target: y, (S, B); q_tm1: Q_target(s, .), (S, B, A); a_tm1: action, (S, B) int64.
    Returns: shape (S, B).
    """
    return target - alpha * (q_tm1.amax(-1) - q_tm1.gather(-1, a_tm1.unsqueeze(-1)).squeeze(-1))


def loss_gradient(
    q_tm1: torch.Tensor, a_tm1: torch.Tensor, target: torch.Tensor, huber: float
) -> tuple[torch.Tensor, torch.Tensor]:
    """Compute the TD errors d = Q(s, a) - y and the gradient of each agent's `huber_loss` by all Q values.

    Args: q_tm1: Q(s, .), (S, B, A); a_tm1: action, (S, B) int64; target: y, (S, B); huber: 0 means squared error.
    Returns: d (S, B), dL/dQ (S, B, A).
    """
    action = a_tm1.unsqueeze(-1)
    d = q_tm1.gather(-1, action).squeeze(-1) - target
    slope = d if huber == 0.0 else d.clamp(-huber, huber)
    gradient = torch.zeros_like(q_tm1).scatter_(-1, action, slope.unsqueeze(-1) / d.shape[-1])
    return d, gradient


def huber_loss(td_error: torch.Tensor, huber: float) -> torch.Tensor:
    """Compute L = mean_B l(d), (S, B) -> (S,): l(d) = d^2 / 2, for |d| > huber the tangent to it (Huber 1964)."""
    slope = td_error if huber == 0.0 else td_error.clamp(-huber, huber)
    return (slope * (td_error - 0.5 * slope)).mean(-1)
