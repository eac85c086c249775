"""Adam on the flat weights of S agents."""

import torch

BETA1, BETA2, EPSILON = 0.9, 0.999, 1e-8
"""Constants of Adam as published (Kingma & Ba 2015, Algorithm 1)."""


class Adam:
    """Adam, w <- w - lr m^ / (sqrt(v^) + eps); m^ and v^ are bias-corrected running means of g and g^2 (Kingma 2015).

    A step calls the fused kernel of torch.optim.Adam(fused=True) directly. Torch's class also manages parameter groups
    and takes six times as long; for one agent, the direct call shortens an update by a tenth.

    Args:
      weights: changed in place by each step, any shape. gradient: read at each step, same shape.
    """

    def __init__(self, weights: torch.Tensor, gradient: torch.Tensor) -> None:
        self._weights, self._gradient = weights, gradient
        self._mean, self._square = torch.zeros_like(weights), torch.zeros_like(weights)
        self._steps = torch.zeros((), device=weights.device)

    def step(self, learning_rate: float) -> None:
        self._steps += 1
        torch._fused_adam_(
            [self._weights], [self._gradient], [self._mean], [self._square], [], [self._steps],
            lr=learning_rate, beta1=BETA1, beta2=BETA2, eps=EPSILON,
            weight_decay=0.0, amsgrad=False, maximize=False,
        )  # fmt: skip

    def state_dict(self) -> dict[str, torch.Tensor]:
        return {"mean": self._mean.cpu(), "square": self._square.cpu(), "steps": self._steps.cpu()}

    def load_state_dict(self, state: dict[str, torch.Tensor]) -> None:
        self._mean.copy_(state["mean"])
        self._square.copy_(state["square"])
        self._steps.copy_(state["steps"])
