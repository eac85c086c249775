"""The mixing chamber as a control task: its density X and the share rho of the slow strain, both at once.

With X = x1 + x2 and rho = x2 / X the balances of `rig.py` become

  X'/X = mu1 - (mu1 - mu2) rho - D1 - D2 + D2 xR / X,      logit(rho)' = D2 xR / (X rho) - (mu1 - mu2)

so the share is raised as fast as the reservoir's pump gives and falls no faster than its logit by mu1 - mu2 a minute.
The cost of a minute is (X / X* - 1)^2 + (rho - rho*)^2: the bands that count as settled, 5 % of X* and .05 of rho,
weigh the same in it, and both errors are numbers without a unit.
"""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from envs.dual_chamber.rig import RigConfig

__all__ = ["cost", "fall_min", "mixture", "settled", "start", "steady_dose"]

Array = NDArray[np.float64]

BAND_OD, BAND_RATIO = 0.05, 0.05  # relative and absolute, what counts as settled (arXiv 2511.08554, at second hand)


def mixture(state: Array) -> tuple[Array, Array]:
    """X and rho of states (..., 4)."""
    total = state[..., 0] + state[..., 1]
    return total, state[..., 1] / total


def start(config: RigConfig, od: Any, ratio: Any) -> Array:
    """States (..., 4) of density and share, the reservoir full and at its density."""
    parts = (od * (1.0 - ratio), od * ratio, config.reservoir_od, config.reservoir_ml)
    return np.stack(np.broadcast_arrays(*parts), axis=-1).astype(np.float64)


def cost(state: Array, od: Any, ratio: Any) -> Array:
    """(X / X* - 1)^2 + (rho - rho*)^2 of states (..., 4)."""
    total, share = mixture(state)
    return np.asarray((total / od - 1.0) ** 2 + (share - ratio) ** 2)


def steady_dose(config: RigConfig, od: Any, ratio: Any, reservoir_od: Any) -> tuple[Array, Array]:
    """Doses a minute (fresh, reservoir), mL, under which X and rho repeat: D1 + D2 = mu1, D2 = (mu1 - mu2) rho X / xR.

    Of pulses exactly: v1 + v2 = V (e^mu1 - 1) and v2 = V rho X / xR (e^(mu1 - mu2) - 1).
    """
    difference = np.expm1(config.mu_fast - config.mu_slow)
    slow = config.volume_ml * difference * np.asarray(ratio) * od / reservoir_od
    return np.asarray(config.volume_ml * np.expm1(config.mu_fast) - slow), np.asarray(slow)


def fall_min(config: RigConfig, before: float, after: float) -> float:
    """Least time in which the share falls, min: (logit before - logit after) / (mu1 - mu2)."""
    logits = [np.log(r / (1.0 - r)) for r in (before, after)]
    return float((logits[0] - logits[1]) / (config.mu_fast - config.mu_slow))


def settled(od: Array, ratio: Array, wanted_od: float, wanted_ratio: float) -> Array:
    """Minutes after which both stay in their bands to the end of a window, (N,); nan if never. od, ratio: (K, N)."""
    inside = (np.abs(od / wanted_od - 1.0) <= BAND_OD) & (np.abs(ratio - wanted_ratio) <= BAND_RATIO)
    stays = np.logical_and.accumulate(inside[::-1])[::-1]
    return np.where(stays[-1], 1.0 + stays.argmax(axis=0), np.nan)
