"""Bounds of the estimator's errors for which a policy of (error, growth share) is proven, for the supervisor."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


@dataclass(frozen=True)
class EstimateBounds:
    """Bounds on the errors of the estimates of e = ln(x/r)/B and s = mu h / B (envs/relative.py).

    full_pump: B, the decrease of ln x in one period at full pump rate, of the certified model.
    error: smallest bound of e's error. od: bound of the OD estimate's error, OD, the larger bound at a low OD.
    growth_share: bound of s's error. gain: relative error of a dose's effect.
    proven: range of s within which the band is proven. setpoints: likewise, OD.
    """

    full_pump: float
    error: float
    od: float
    growth_share: float
    gain: float
    proven: tuple[float, float]
    setpoints: tuple[float, float]

    def error_bound(self, od: Array) -> Array:
        """Largest |error of e| allowed at an estimated OD: max(error, ln(1 + od_error / OD) / B), shape of `od`."""
        ratio = np.divide(self.od, od, out=np.full_like(od, np.inf), where=od > 0.0)
        return np.maximum(self.error, np.log1p(ratio) / self.full_pump)

    def error_at(self, estimate: Array, setpoint: float | None) -> Array:
        """Bound the error at an estimate of e and a setpoint; None: `error` alone. Shape of `estimate`."""
        if setpoint is None:
            return np.full_like(estimate, self.error)
        return self.error_bound(setpoint * np.exp(self.full_pump * estimate))

    def estimate(self, e: Array, side: Array, setpoint: float | None) -> Array:
        """Return the farthest possible estimate of e on a side (1: above, -1: below), (N,); the inverse of `error_at`.

        With c the error of the OD and x = r exp(B e): above, ln(y) - ln(1 + c/y) = ln(x) gives y = (x + sqrt(x^2 +
        4 c x)) / 2; below, y + c = x. If the constant bound is larger, it applies.
        """
        far = e + side * self.error
        if setpoint is None:
            return np.asarray(far)
        od = setpoint * np.exp(self.full_pump * e)
        above = (od + np.sqrt(od**2 + 4.0 * self.od * od)) / 2.0
        found = np.where(side > 0, above, np.maximum(od - self.od, np.finfo(np.float64).tiny))
        by_od = np.log(found / setpoint) / self.full_pump
        return np.asarray(np.where(side > 0, np.maximum(far, by_od), np.minimum(far, by_od)))

    def hold(self, od: Array, error: Array, growth_share: Array, share_error: Array) -> NDArray[np.bool_]:
        """Return whether errors of e and s are within the bounds at this OD and this s; all (N,).

        nan is never within.
        """
        low, high = self.proven
        inside = (growth_share >= low) & (growth_share <= high)
        return np.asarray((error <= self.error_bound(od)) & (share_error <= self.growth_share) & inside)

    @classmethod
    def of(cls, values: Mapping[str, Any]) -> "EstimateBounds":
        """Read the bounds of a certificate. Raises: KeyError, TypeError, ValueError for a damaged one."""
        numbers = (float(values[key]) for key in ("full_pump", "error", "od", "growth_share", "gain"))
        pairs = ((float(low), float(high)) for low, high in (values["proven"], values["setpoints"]))
        found = cls(*numbers, *pairs)  # type: ignore[arg-type]
        sizes = found.full_pump, found.error, found.od, found.growth_share, found.gain, *found.proven, *found.setpoints
        if not (all(0.0 <= size < np.inf for size in sizes) and found.proven[0] < found.proven[1]):
            raise ValueError(f"bounds {sizes}: allowed numbers of 0 and more, ranges from low to high")
        return found
