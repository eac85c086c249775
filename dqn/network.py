"""S independent Q-networks evaluated together: multilayer perceptrons whose weights carry a leading agent axis."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from dqn.policy import FORMAT, Policy

Layer = tuple[torch.Tensor, torch.Tensor]


def initial_weights(sizes: Sequence[int], seed: np.random.SeedSequence, zero_output: bool = False) -> np.ndarray:
    """Draw the weights of one network: W and b of each layer uniform in +-1/sqrt(inputs), as in torch.nn.Linear.

    Args:
      sizes: number of features, of units in each hidden layer, and of outputs. seed: random stream of the agent.
      zero_output: whether the last layer, and so every Q value, starts at 0.
    Returns: float32, shape (P,), in the order that `QNetwork` needs.
    """
    rng = np.random.default_rng(seed)
    parts = []
    for layer, (inputs, outputs) in enumerate(pairwise(sizes)):
        bound = 1.0 / np.sqrt(inputs)
        weight, bias = rng.uniform(-bound, bound, (inputs, outputs)), rng.uniform(-bound, bound, outputs)
        last = layer == len(sizes) - 2
        if last and zero_output:
            weight[:], bias[:] = 0.0, 0.0
        parts += [(weight.T if last else weight).ravel(), bias]
    return np.concatenate(parts).astype(np.float32)


def action_basis(actions: int, decay: float) -> torch.Tensor:
    """Return C, with Q = z C for the outputs z: row k is (1 + k)^-decay times the polynomial of degree k in the action.

    The polynomials are orthogonal on the A equidistant actions and have mean square 1 there (discrete Legendre or Gram
    polynomials). C is invertible, so the network can represent the same Q values. C changes the direction of gradient
    steps: a step for one action moves Q of similar actions about equally, and differences of higher degree between
    actions are learned more slowly. Q is nearly a parabola in the pump rate, which three rows represent exactly. A
    cosine series would flatten the parabola at the ends of the grid.

    Args: actions: A. decay: >= 0.
    Returns: shape (A, A), float32.
    """
    grid = np.linspace(-1.0, 1.0, actions)
    powers = np.polynomial.legendre.legvander(grid, actions - 1)
    orthonormal, triangle = np.linalg.qr(powers)
    rows = (orthonormal * np.sign(np.diag(triangle))).T * np.sqrt(actions)
    return torch.from_numpy((rows / (1.0 + np.arange(actions))[:, None] ** decay).astype(np.float32))


class QNetwork:
    """Q(observation, .) = W3 relu(W2 relu(W1 f + b1) + b2) + b3 with f = M observation + c, for S agents at once.

    M and c are constants, exported with the weights. All weights of all agents are in one tensor `flat`, shape (S, P),
    and the layers are views of this tensor. So an optimiser step or a copy is one operation. The gradients are coded by
    hand: two matrix products per layer, no graph.

    The last layer is transposed in memory: its weights are stored as (outputs, inputs) and Q as (S, A, B). Matrix
    products and reductions are faster with a long innermost axis, and there are more transitions than actions.

    Args:
      flat: weights, shape (S, P), in the order of `initial_weights`.
      sizes: number of features, of units in each hidden layer, and of outputs.
      matrix: M, shape (features, observations); None: the features are the observation.
      offset: c, shape (features,).
      basis: C of `action_basis`, which multiplies the outputs; None: the outputs are the Q values.
    """

    def __init__(
        self,
        flat: torch.Tensor,
        sizes: Sequence[int],
        matrix: torch.Tensor | None = None,
        offset: torch.Tensor | None = None,
        basis: torch.Tensor | None = None,
    ) -> None:
        self.flat = flat
        self.sizes = tuple(sizes)
        self.layers = self._views(flat)
        self._transposed = [(weight.transpose(1, 2), bias.transpose(1, 2)) for weight, bias in self.layers]
        self.grad = torch.zeros_like(flat)
        self._grads = self._views(self.grad)
        self._grad_last = self._grads[-1][0].transpose(1, 2)  # (S, A, in)
        self._matrix = torch.eye(self.sizes[0], device=flat.device) if matrix is None else matrix
        self._offset = torch.zeros(self.sizes[0], device=flat.device) if offset is None else offset
        self._mapped = matrix is not None
        self._basis = basis
        self._mix = None if basis is None else basis.T.expand(flat.shape[0], -1, -1)  # C^T for every agent

    def _views(self, flat: torch.Tensor) -> list[Layer]:
        """Return (W, b) of each layer as views of `flat`: W (S, in, out), b (S, 1, out)."""
        views = []
        start = 0
        for i, o in pairwise(self.sizes):
            middle, end = start + i * o, start + i * o + o
            views.append((flat[:, start:middle].view(-1, i, o), flat[:, middle:end].view(-1, 1, o)))
            start = end
        views[-1] = (views[-1][0].view(-1, o, i).transpose(1, 2), views[-1][1])  # memory order: see the class
        return views

    def with_weights(self, flat: torch.Tensor) -> QNetwork:
        """Return the same network with other weights, shape (S', P)."""
        matrix, offset = (self._matrix, self._offset) if self._mapped else (None, None)
        return QNetwork(flat, self.sizes, matrix, offset, self._basis)

    def features(self, observation: torch.Tensor) -> torch.Tensor:
        """Compute f = M observation + c; observation (S, ..., B, observations) -> (S, ..., B, F)."""
        if self._mapped:
            return torch.matmul(observation, self._matrix.T).add_(self._offset)
        return observation

    def input_map(self) -> tuple[np.ndarray, np.ndarray]:
        """Return M (F, O) and c (F,) as NumPy arrays."""
        return self._matrix.cpu().numpy().copy(), self._offset.cpu().numpy().copy()

    def output_map(self) -> np.ndarray:
        """Return C (A, A) as a NumPy array."""
        return np.eye(self.sizes[-1], dtype=np.float32) if self._basis is None else self._basis.cpu().numpy().copy()

    def forward(self, features: torch.Tensor) -> tuple[torch.Tensor, list[torch.Tensor]]:
        """Compute Q values, (S, B, A), from features (S, B, F); also return the inputs of each layer for `backward`."""
        h = features
        inputs = [h]
        for weight, bias in self.layers[:-1]:
            h = torch.baddbmm(bias, h, weight).relu_()
            inputs.append(h)
        weight, bias = self._transposed[-1]
        q = torch.baddbmm(bias, weight, h.transpose(1, 2))
        if self._mix is not None:
            q = torch.bmm(self._mix, q)
        return q.transpose(1, 2), inputs

    def __call__(self, observation: torch.Tensor) -> torch.Tensor:
        """Compute the Q values only; observation (S, B, observations) -> (S, B, A)."""
        return self.forward(self.features(observation))[0]

    def backward(self, inputs: list[torch.Tensor], grad_q: torch.Tensor) -> None:
        """Write the gradient of a loss into `grad`, given the loss's derivative by Q, `grad_q`, shape (S, B, A)."""
        delta = grad_q if self._mix is None else torch.bmm(grad_q, self._mix)
        torch.bmm(delta.transpose(1, 2), inputs[-1], out=self._grad_last)
        torch.sum(delta, 1, keepdim=True, out=self._grads[-1][1])
        for k in range(len(self.layers) - 1, 0, -1):
            back = torch.bmm(delta, self._transposed[k][0])
            delta = torch.ops.aten.threshold_backward(back, inputs[k], 0.0)  # relu's derivative, in one pass
            grad_weight, grad_bias = self._grads[k - 1]
            torch.bmm(inputs[k - 1].transpose(1, 2), delta, out=grad_weight)
            torch.sum(delta, 1, keepdim=True, out=grad_bias)


def export(
    network: QNetwork,
    agent: int,
    flat: torch.Tensor,
    actions: NDArray[np.float64],
    limits: tuple[NDArray[np.float64], NDArray[np.float64]],
    metadata: dict[str, Any],
) -> Policy:
    """Export the greedy policy of one agent; the basis C is multiplied into the last layer.

    Args:
      network: source of layer sizes, input map and basis. agent: index into `flat`.
      flat: weights of all agents, shape (S, P); e.g. the best weights instead of those in `network`.
      actions: the action grid, shape (A,). limits: lowest and highest observation, each (O,).
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
