"""Conversion of one torch agent's weights to `dqn.policy.Policy`."""

from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from dqn.network import QNetwork
from dqn.policy import FORMAT, Policy

__all__ = ["export"]


def export(
    network: QNetwork,
    agent: int,
    flat: torch.Tensor,
    actions: NDArray[np.float64],
    limits: tuple[NDArray[np.float64], NDArray[np.float64]],
    metadata: dict[str, Any],
) -> Policy:
    """Export the greedy policy of one agent; a basis of the outputs is multiplied into the last layer.

    Args:
      network: source of layer sizes and input map. agent: index into `flat`.
      flat: weights of all agents, shape (S, P); e.g. the best ones, not those of `network`.
      actions: the action grid, shape (A,). limits: of the observation, low and high, each (O,).
      metadata: observation, model, config_hash and other values to check or show.
    """
    own = QNetwork(flat[agent : agent + 1].detach().cpu().clone(), network.sizes)
    weights = [weight[0].numpy().copy() for weight, _ in own.layers]
    biases = [bias[0, 0].numpy().copy() for _, bias in own.layers]
    weights[-1], biases[-1] = weights[-1] @ network.output_map(), biases[-1] @ network.output_map()
    matrix, offset = network.input_map()
    return Policy(
        weights=tuple(weights),
        biases=tuple(biases),
        input_matrix=matrix,
        input_offset=offset,
        actions=np.asarray(actions, dtype=np.float64),
        low=np.asarray(limits[0], dtype=np.float32),
        high=np.asarray(limits[1], dtype=np.float32),
        metadata={"format": FORMAT, **metadata},
    )
