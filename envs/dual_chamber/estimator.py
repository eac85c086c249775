"""Which strain is how dense, from the density of both together: an extended Kalman filter of logarithms.

State (ln x1, ln x2, ln xR), Jazwinski 1970. Doses are believed as asked for; growth adds a constant to a logarithm, and
a dose moves ln x2 towards the reservoir by w xR / (V x2 + w xR), so that a minute's Jacobian has rows that sum to one.
Read are x1 + x2, xR and, where fluorescence is measured, x1. Without it the strains are told apart by growth alone: an
error d of mu1 shows as an error d / (mu1 - mu2) of the share (docs/dual_chamber.md, Estimate).
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from conf.schema import check, setting
from envs.dual_chamber.rig import FAST, LEVEL, RESERVOIR, SLOW, Readings, RigConfig, advance, taken

__all__ = ["Estimator", "EstimatorConfig"]

Array = NDArray[np.float64]


@dataclass(frozen=True)
class EstimatorConfig:
    """What the filter trusts. Raises: ValueError naming key, value and allowed range."""

    growth_sd: float = setting(0.005, "what a minute adds to each logarithm", within=(0, 0.1))
    dose_sd: float = setting(0.03, "relative error of a dose", within=(0, 1))
    od_sd: float = setting(0.005, "of a reading of OD", "OD", above=0.0, at_most=0.2)
    fluorescence_sd: float = setting(0.01, "of a reading of fluorescence, in OD of the fast strain", "OD", above=0.0,
                                     at_most=0.2)  # fmt: skip
    start_sd: float = setting(0.3, "of each logarithm at the start", above=0.0, at_most=3.0)

    def __post_init__(self) -> None:
        check(self, "estimator")


class Estimator:
    """N filters. Args: rig: believed constants; start: believed state, (N, 4); fluorescence: whether it is read.

    State: `state` (N, 4), the level by the doses alone; `covariance` of the three logarithms, (N, 3, 3).
    """

    def __init__(self, config: EstimatorConfig, rig: RigConfig, start: Array, fluorescence: bool) -> None:
        self.config, self._rig, self._seen = config, rig, fluorescence
        self.state = start.copy()
        self.covariance = np.tile(
            np.diag([config.start_sd**2, config.start_sd**2, config.od_sd**2]), (len(start), 1, 1)
        )

    def update(self, dose: Array, readings: Readings) -> None:
        """A minute: doses asked for, (N, 3), and what was read at its end."""
        self._predict(dose)
        seen = [
            (readings.od, (FAST, SLOW), self.config.od_sd),
            (readings.reservoir_od, (RESERVOIR,), self.config.od_sd),
        ]
        if self._seen:
            seen.append((readings.fluorescence, (FAST,), self.config.fluorescence_sd))
        for value, columns, sd in seen:
            self._correct(value, columns, sd)

    def _predict(self, dose: Array) -> None:
        c, rig, before = self.config, self._rig, self.state
        given = taken(rig, before[:, LEVEL], dose[:, 1])
        came = given * before[:, RESERVOIR]
        new = came / (rig.volume_ml * before[:, SLOW] + came)
        filled = before[:, LEVEL] - given + dose[:, 2]
        thinned = (dose[:, 0] / rig.volume_ml, given / rig.volume_ml, dose[:, 2] / filled)
        jacobian = np.tile(np.eye(3), (len(new), 1, 1))
        jacobian[:, SLOW, SLOW], jacobian[:, SLOW, RESERVOIR] = 1.0 - new, new
        zero = np.zeros_like(new)
        moved = np.stack(  # by a relative error of each dose, (N, 3, 3)
            [
                np.stack([-thinned[0], -thinned[1], zero], -1),
                np.stack([-thinned[0], new - thinned[1], zero], -1),
                np.stack([zero, zero, -thinned[2]], -1),
            ],
            axis=1,
        )
        self.state = advance(rig, before, dose)
        self.covariance = jacobian @ self.covariance @ jacobian.mT + c.growth_sd**2 * np.eye(3)
        self.covariance += c.dose_sd**2 * moved @ moved.mT

    def _correct(self, value: Array, columns: tuple[int, ...], sd: float) -> None:
        """One reading: the sum of `columns` of the state, with its noise."""
        row = np.zeros((len(value), 3))
        row[:, columns] = self.state[:, columns]  # d x / d ln x = x
        spread = np.einsum("nij,nj->ni", self.covariance, row)
        gain = spread / (np.einsum("ni,ni->n", row, spread) + sd**2)[:, None]
        step = np.clip(gain * (value - row.sum(axis=1))[:, None], -1.0, 1.0)
        self.state[:, :LEVEL] *= np.exp(step)
        self.covariance = self.covariance - gain[:, :, None] * spread[:, None, :]
