"""Estimator and law in one: readings in, thermostat target out."""

import numpy as np

from envs.coculture.rates import EQUAL_RATES_C
from experiments.composition.base import Array, Law, Mask, Wanted
from experiments.composition.estimator import CompositionEstimator

__all__ = ["CompositionController"]


class CompositionController:
    """Holds the composition of N cultures by their temperature, beside whatever holds their density.

    Args: estimator: what is believed; law: what is done about it.
    """

    remembers = ("estimator", "law")

    def __init__(self, estimator: CompositionEstimator, law: Law) -> None:
        self.estimator, self.law = estimator, law

    def reset(self, n: int) -> None:
        """Forget everything; n cultures from here on."""
        self.estimator.reset(n)
        self.law.reset(n)

    def watch(self, od: Array, fluorescence: Array, temperature: Array, minute: Array, rows: Mask) -> None:
        """Take readings, also while no share is asked for; see `CompositionEstimator.watch`."""
        self.estimator.watch(od, fluorescence, temperature, minute, rows)

    def dosed(self, volume_ml: Array) -> None:
        """Fresh medium that went in since this was last called, mL, (N,)."""
        self.estimator.dosed(volume_ml)

    def target(self, wanted: Wanted, minute: Array, rows: Mask) -> Array:
        """Thermostat targets, 29 to 36 degC, (N,); of value where a share is asked for and the culture was seen.

        Args: wanted: what the program asks for now. minute: since the program began, (N,). rows: whose readings are
          new; only these decide, the others keep their target.
        """
        on = rows & np.isfinite(wanted.setpoint) & self.estimator.begun
        target = self.law.act(self.estimator.estimate(), wanted, minute, on)
        return np.where(self.estimator.begun, target, EQUAL_RATES_C)

    def explain(self) -> dict[str, Array]:
        """See `CompositionEstimator.explain`."""
        return self.estimator.explain()
