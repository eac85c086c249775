"""Policies made by hand: a network that is the proportional law, and the same with one fault each."""

from collections.abc import Callable
from typing import Any

import numpy as np

from dqn.policy import ABSOLUTE, FORMAT, RELATIVE, Policy

RATES = np.linspace(0.0, 0.02, 17)
MODEL = {"mu": 0.03, "tau": 1 / 3, "control_min": 1.0, "max_pump_rate": 0.02, "setpoints": [0.4, 0.5, 0.6, 0.7, 0.8]}
GAIN = 25.0  # share of the largest rate per OD; the law of r = 0.67
SPIKE = 0.5234567  # a setpoint between the trained ones


def network(first: Any, second: Any, output: Any) -> Policy:
    """Layers as (weight, bias), weight (in, out), of a policy that sees (OD, setpoint)."""
    layers = [tuple(np.asarray(a, dtype=np.float32) for a in layer) for layer in (first, second, output)]
    metadata = {"format": FORMAT, "observation": list(ABSOLUTE), "control_min": 1.0, "model": MODEL}
    return Policy(
        tuple(w for w, _ in layers), tuple(b for _, b in layers), np.eye(2, dtype=np.float32),
        np.zeros(2, np.float32), RATES, np.full(2, -np.inf, np.float32), np.full(2, np.inf, np.float32), metadata,
    )  # fmt: skip


def law(
    share: float = 0.5, gain: float = GAIN, add: Callable[[np.ndarray], None] | None = None, order: int = 1
) -> Policy:
    """argmax_a 2 z v_a - v_a^2, the level v_a nearest to z = share + gain (x - r).

    Units of the first layer: +-(z - share), +-1e6 (r - SPIKE), +-30 (x - 0.45), and two corners. The second passes on z
    and the corners and makes a bump, relu(1 - 1e6 |r - SPIKE| - 30 |x - 0.45|).

    Args: add: changes the output weights (5, 17), whose rows belong to z, -z, bump, low corner, high corner.
    """
    k = 1e6  # the bump is 2e-6 wide
    w1 = np.array([[gain, -gain, 0, 0, 30, -30, -50, 50], [-gain, gain, k, -k, 0, 0, -50, 50]])
    b1 = np.array([0, 0, -k * SPIKE, k * SPIKE, -13.5, 13.5, 25, -110])
    w2 = np.zeros((8, 5))
    w2[0, 0] = w2[1, 1] = w2[6, 3] = w2[7, 4] = 1.0
    w2[2:6, 2] = -1.0
    v = np.linspace(0.0, 1.0, 17)[::order]
    w3 = np.zeros((5, 17))
    w3[0], w3[1] = 2 * v, -2 * v
    if add is not None:
        add(w3)
    return network((w1, b1), (w2, [0, 0, 1, 0, 0]), (w3, 2 * share * v - v**2))


def random(seed: int) -> Policy:
    """Weights as they are before any training."""
    rng = np.random.default_rng(seed)
    sizes = [(2, 32), (32, 32), (32, 17)]
    return network(*((rng.normal(size=s) * np.sqrt(2 / s[0]), rng.normal(size=s[1]) * 0.1) for s in sizes))


def _add(row: int, action: int, weight: float) -> Callable[[np.ndarray], None]:
    def change(w3: np.ndarray) -> None:
        w3[row, action] += weight

    return change


def spike() -> Policy:
    return law(add=_add(2, 16, 50.0))


def low_corner(action: int = 16) -> Policy:
    """Full dose, or another one, where x + r < 0.5."""
    return law(add=_add(3, action, 100.0))


def high_corner() -> Policy:
    """No dose where x + r > 2.2."""
    return law(add=_add(4, 0, 100.0))


def swapped_level() -> Policy:
    """The second largest dose in place of the largest where x + r > 2.2."""
    return law(add=_add(4, 15, 0.5))


SHARES = (0.05, 0.97)


def share_law(
    gain: float = 1.0,
    share: float = 1.0,
    add: tuple[int, int, float] | None = None,
    order: int = 1,
    offset: float = 0.0,
    levels: int = 1,
) -> Policy:
    """One-line controller of (error, growth share), exactly: argmax_a 2 z v_a - v_a^2, z = gain e + share s + offset.

    Hidden units +-z, relu(-50 - 50 (e + s)) and a bump 2e-6 wide in s, far from any grid: relu(1 - 1e6 |s - SPIKE|
    - 30 |e + 0.5|). add: (unit, action, weight) adds a unit to an action's Q. levels: every so-manyth level is chosen.
    """
    k = 1e6
    w1 = np.array([[gain, -gain, -50, 0, 0, 30, -30], [share, -share, -50, k, -k, 0, 0]])
    b1 = np.array([0, 0, -25, -k * SPIKE, k * SPIKE, 15, -15])
    w2 = np.zeros((7, 4))
    w2[0, 0] = w2[1, 1] = w2[2, 2] = 1.0
    w2[3:, 3] = -1.0
    v = np.linspace(0.0, 1.0, 17)[::order]
    w3 = np.zeros((4, 17))
    w3[0], w3[1] = 2 * v, -2 * v
    if add is not None:
        unit, action, weight = add
        w3[unit, action] += weight
    b3 = 2 * offset * v - v**2 - 10.0 * (np.arange(17) % levels != 0)
    return _relative([(w1, b1), (w2, np.array([0, 0, 0, 1])), (w3, b3)])


Ramp = tuple[float, float, float, float]
"""(a, b, c, k): from 0 to 1 as k (a e + b s + c) goes from 0 to 1."""


def bent_share_law(
    *bends: tuple[float, *tuple[Ramp, ...]],
    gain: float = 1.0,
    share: float = 1.0,
    offset: float = 0.0,
    never: tuple[int, ...] = (),
    swapped: tuple[int, int] = (0, 0),
) -> Policy:
    """The one-line controller of z = gain e + share s + offset + the sum of the bends.

    bends: (amount, ramp, ...): the amount where all ramps are 1, nothing where one is 0. never: levels that are not
    chosen. swapped: two levels that are given for one another.
    """
    ramps = [ramp for _, *of in bends for ramp in of]
    w1 = np.array([[gain, -gain, *(k * a for a, _, _, k in ramps for _ in range(2))],
                   [share, -share, *(k * b for _, b, _, k in ramps for _ in range(2))]])  # fmt: skip
    b1 = np.array([0.0, 0.0, *(k * c - above for _, _, c, k in ramps for above in (0.0, 1.0))])
    w2, b2 = np.zeros((w1.shape[1], 2 + len(bends))), np.zeros(2 + len(bends))
    w2[0, 0] = w2[1, 1] = 1.0
    unit = 2
    for n, (_, *of) in enumerate(bends, 2):
        b2[n] = 1.0 - len(of)
        for _ in of:
            w2[unit, n], w2[unit + 1, n] = 1.0, -1.0
            unit += 2
    v = np.linspace(0.0, 1.0, 17)
    w3 = 2.0 * np.outer([1.0, -1.0, *(amount for amount, *_ in bends)], v)
    b3 = 2.0 * offset * v - v**2
    b3[list(never)] -= 10.0
    here, there = list(swapped), list(swapped)[::-1]
    w3[:, here], b3[here] = w3[:, there], b3[there]
    return _relative([(w1, b1), (w2, b2), (w3, b3)])


def _relative(layers: list[tuple[np.ndarray, np.ndarray]]) -> Policy:
    """Layers as (weight, bias), weight (in, out), of a policy that sees (error, growth share)."""
    metadata = {"format": FORMAT, "observation": list(RELATIVE), "model": {"growth_shares": list(SHARES)}}
    return Policy(
        tuple(np.asarray(w, np.float32) for w, _ in layers), tuple(np.asarray(b, np.float32) for _, b in layers),
        np.eye(2, dtype=np.float32), np.zeros(2, np.float32), np.linspace(0.0, 1.0, 17),
        np.array([-1.15, 0.05], np.float32), np.array([1.15, 0.98], np.float32), metadata,
    )  # fmt: skip
