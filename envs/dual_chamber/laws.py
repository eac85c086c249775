"""Laws of the mixing chamber, from what is believed of it to the doses of a minute; and the reservoir's own law."""

from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from envs.dual_chamber.optimum import Model, best_dose
from envs.dual_chamber.rig import LEVEL, RESERVOIR, RigConfig, taken
from envs.dual_chamber.task import mixture, steady_dose

__all__ = ["PI", "FeedForward", "Law", "Planned", "hold_reservoir", "spare_reservoir"]

Array = NDArray[np.float64]

GAIN_OD, GAIN_RATIO = 0.3, 0.3  # 1/min, of ln(X / X*) and of rho* - rho
INTEGRAL_OD, INTEGRAL_RATIO = 0.02, 0.005  # 1/min^2, a tenth of the loop's bandwidth and below


class Law(Protocol):
    """Chooses the doses of the mixing chamber. Rows are independent."""

    def act(self, state: Array, ratio: float, minute: int) -> Array:
        """Doses fresh and reservoir, mL, with a column for the supply left at zero, (N, 3).

        Args: state: believed, (N, 4). ratio: the share asked for. minute: since the program began.
        """
        ...


def hold_reservoir(config: RigConfig, state: Array, dose: Array) -> Array:
    """Supply of fresh medium that brings xR back to its density within the minute, mL, (N,).

    It holds the density, not the level: more than VR (e^mu2 - 1) a minute cannot be taken for long.
    Args: dose: asked of the reservoir in the same minute, mL, (N,).
    """
    left = state[:, LEVEL] - taken(config, state[:, LEVEL], np.clip(dose, 0.0, config.largest_ml))
    needed = state[:, RESERVOIR] / config.reservoir_od * np.exp(config.mu_slow) - 1.0
    return np.asarray(np.maximum(needed, 0.0) * left)


def spare_reservoir(config: RigConfig, state: Array, dose: Array, steady: Array, margin: float) -> Array:
    """The dose from the reservoir that leaves it able to grow what the steady state takes, mL, (N,).

    A reservoir held at its density makes VR (e^mu2 - 1) a minute. Once its level is below the steady dose over
    e^mu2 - 1 it loses more than it makes, until it is empty; above `margin` times that level doses are free, below it
    they are at most the steady one. Args: dose: asked of the reservoir; steady: that of the setpoint, mL, (N,).
    """
    critical = steady / np.expm1(config.mu_slow)
    return np.asarray(np.minimum(dose, np.maximum(state[:, LEVEL] - margin * critical, steady)))


def _doses(fresh: Array, slow: Array) -> Array:
    return np.stack([fresh, slow, np.zeros_like(fresh)], axis=-1)


class FeedForward:
    """The doses of the steady state, and proportional feedback where gains are given.

      D2 = (mu1 - mu2) rho* X* / xR + k_r (rho* - rho),    D1 = mu1 - D2 + k_x ln(X / X*) + (D2 - D2*) xR / X*

    The last term leaves X alone where D2 works on the share. Args: gain_od, gain_ratio: k_x, k_r, 1/min.
    """

    def __init__(self, config: RigConfig, od: float, gain_od: float = 0.0, gain_ratio: float = 0.0) -> None:
        self._config, self._od, self._gains = config, od, (gain_od, gain_ratio)

    def act(self, state: Array, ratio: float, minute: int) -> Array:
        """As `Law.act`."""
        c, (total, share) = self._config, mixture(state)
        fresh, slow = steady_dose(c, self._od, ratio, state[:, RESERVOIR])
        gain_od, gain_ratio = (c.volume_ml * gain for gain in self._gains)
        more = np.clip(slow + gain_ratio * (ratio - share), 0.0, c.largest_ml) - slow
        beside = more * (1.0 - state[:, RESERVOIR] / self._od)
        return _doses(fresh - beside + gain_od * np.log(total / self._od), slow + more)


class PI:
    """A PI controller for each flow that knows no growth rate: fresh medium by ln(X / X*), reservoir by rho* - rho.

    Integrals stay within what a pump gives. Args: n: rigs.
    """

    def __init__(self, config: RigConfig, od: float, n: int) -> None:
        self._config, self._od = config, od
        self._integral = np.zeros((n, 2))

    def act(self, state: Array, ratio: float, minute: int) -> Array:
        """As `Law.act`."""
        c, (total, share) = self._config, mixture(state)
        error = np.stack([np.log(total / self._od), ratio - share], axis=-1)
        summed = self._integral + c.volume_ml * np.array([INTEGRAL_OD, INTEGRAL_RATIO]) * error
        wanted = c.volume_ml * np.array([GAIN_OD, GAIN_RATIO]) * error + summed
        free = ((wanted > 0.0) | (error > 0.0)) & ((wanted < c.largest_ml) | (error < 0.0))
        self._integral = np.where(free, np.clip(summed, 0.0, c.largest_ml), self._integral)
        return _doses(wanted[:, 0], wanted[:, 1])


class Planned:
    """The best pair of doses on a grid of them: of this minute, or with the cost of what follows.

    Args: values: None, the myopic law; by setpoint, {ratio: V} with V (G,), the optimum that takes the setpoint for
      lasting; or after each minute, a list of V, the optimum that knows the program.
    """

    def __init__(self, config: RigConfig, od: float, of: Model, values: dict[float, Array] | list[Array] | None = None):
        self._config, self._od, self._model, self._values = config, od, of, values

    def act(self, state: Array, ratio: float, minute: int) -> Array:
        """As `Law.act`."""
        values = self._values
        value = None if values is None else values[ratio] if isinstance(values, dict) else values[minute]
        return best_dose(self._config, self._model, state, self._od, np.full(len(state), ratio), value)
