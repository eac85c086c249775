"""A policy as a piecewise linear map of the plane, in double precision, and the error of single precision."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dqn.policy import Policy

__all__ = ["Array", "Network", "q_values", "rounding"]

Array = NDArray[np.float64]

UNIT = 2.0**-24  # relative rounding error of one operation in single precision
SLACK = 1e-9  # of a Q value; exceeds the rounding of the geometry in double precision


@dataclass(frozen=True, eq=False)
class Network:
    """q = W_L relu(... relu(W_1 (M z + c) + b_1)) + b_L of z in the plane; the weights are those of the file, exactly.

    weights (in, out) and biases (out,): the first pair is M^T and c and has no relu behind it.
    """

    weights: tuple[Array, ...]
    biases: tuple[Array, ...]

    @classmethod
    def of(cls, policy: Policy) -> "Network":
        """Read the network of a policy."""
        weights = (policy.input_matrix.T, *policy.weights)
        biases = (policy.input_offset, *policy.biases)
        return cls(*(tuple(np.asarray(a, dtype=np.float64) for a in arrays) for arrays in (weights, biases)))

    @property
    def hidden(self) -> list[tuple[Array, Array]]:
        """Layers with a relu, the first combined with the input map."""
        (m, *inner), (c, *offsets) = self.weights[:-1], self.biases[:-1]
        layers = list(zip(inner, offsets, strict=True))
        if layers:
            w, b = layers[0]
            layers[0] = (m @ w, c @ w + b)
        return layers

    @property
    def output(self) -> tuple[Array, Array]:
        """The last layer, likewise."""
        if len(self.weights) == 2:
            return self.weights[0] @ self.weights[1], self.biases[0] @ self.weights[1] + self.biases[1]
        return self.weights[-1], self.biases[-1]


def q_values(network: Network, points: Array) -> Array:
    """Q of points (N, 2) in double precision, shape (N, A)."""
    h = points
    for weight, bias in network.hidden:
        h = np.maximum(h @ weight + bias, 0.0)
    weight, bias = network.output
    return np.asarray(h @ weight + bias)


def rounding(network: Network, points: Array) -> Array:
    """Bound the error of Q in single precision at points (N, 2), shape (N, A).

    A sum of n products in any order is off by at most g (|h| |W| + |b|), g = (n + 1) u / (1 - (n + 1) u), u = 2^-24
    (Higham 2002, Accuracy and Stability of Numerical Algorithms, chapter 3). relu enlarges no error; an inactive unit
    passes only the part above zero. On a cell where the network is linear the bound is convex, so its largest value at
    the corners bounds the inside.
    """
    h, error = points, UNIT * np.abs(points)
    last = len(network.weights) - 1
    for k, (weight, bias) in enumerate(zip(network.weights, network.biases, strict=True)):
        size, n = np.abs(weight), weight.shape[0] + 1
        gamma = n * UNIT / (1.0 - n * UNIT)
        error = error @ size + gamma * ((np.abs(h) + error) @ size + np.abs(bias))
        h = h @ weight + bias
        if 0 < k < last:
            error = np.where(h > 0.0, error, np.maximum(h + error, 0.0))
            h = np.maximum(h, 0.0)
    return np.asarray(error) + SLACK
