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
    """Weights of one network, flat: W and b of each layer uniform in +-1/sqrt(inputs) (the default of torch.nn.Linear).

    Args:
      sizes: units of feature, hidden and output layers. seed: the agent's own stream.
      zero_output: the last layer starts at 0, and with it every Q value.
    Returns: float32, shape (P,), laid out as `QNetwork` wants it.
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
    """C with Q = z C: row k is the polynomial of degree k in the action, scaled by (1 + k)^-decay.

    The polynomials are orthogonal on the A equidistant actions and have mean square 1 there (discrete Legendre or Gram
    polynomials). C is invertible, so the network can represent the same Q values. C changes the direction of gradient
    steps: a step for one action moves Q of similar actions equally, and differences of higher degree between actions
    are learned more slowly. Q is nearly a parabola in the pump rate, which three rows give exactly. A cosine series
    would flatten the parabola at the ends of the grid.

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

    M and c are constants, exported with the weights. All weights of all agents live in one tensor `flat`, shape (S, P),
    and the layers are views of it, so that a step of the optimiser or a copy is one operation. Gradients are written
    out by hand: two matrix products a layer, no graph.

    Memory order differs from shape in the last layer: its weights lie as (outputs, inputs) and Q as (S, A, B). Matrix
    products and reductions are faster with a long innermost axis, and there are more transitions than actions.

    Args:
      flat: weights, shape (S, P), laid out as by `initial_weights`.
      sizes: units of feature, hidden and output layers.
      matrix: M, shape (features, observations); None means that the features are the observation.
      offset: c, shape (features,).
      basis: C of `action_basis`, by which the outputs are multiplied; None means that they are the Q values.
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
        """(W, b) of each layer as views: W (S, in, out), b (S, 1, out)."""
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
        """M (F, O) and c (F,) as NumPy arrays."""
        return self._matrix.cpu().numpy().copy(), self._offset.cpu().numpy().copy()

    def output_map(self) -> np.ndarray:
        """C (A, A) as a NumPy array."""
        return np.eye(self.sizes[-1], dtype=np.float32) if self._basis is None else self._basis.cpu().numpy().copy()

    def forward(self, features: torch.Tensor) -> tuple[torch.Tensor, list[torch.Tensor]]:
        """Q values, shape (S, B, A), of features (S, B, F), and the inputs of each layer, for `backward`."""
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
        """Q values only; observation (S, B, observations) -> (S, B, A)."""
        return self.forward(self.features(observation))[0]

    def backward(self, inputs: list[torch.Tensor], grad_q: torch.Tensor) -> None:
        """Fill `grad` with the gradient of a loss whose derivative by Q is `grad_q`, shape (S, B, A)."""
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
