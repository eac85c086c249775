"""Bounds on the estimator's errors within which a policy of (error, growth share) is proven, for the supervisor."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


@dataclass(frozen=True)
class EstimateBounds:
    """Bounds on the errors of the estimates of e = ln(x/r)/B and s = mu h / B (envs/relative.py).

    full_pump: B, the decrease of ln x in one period at full pump rate. error: bound on the error of e. od: bound on the
    error of the OD, OD; at a low OD it allows a larger error of e (`error_bound`). growth_share: bound on the error of
    s. gain: bound on the relative error of a dose's effect. proven: range of s for which the band is proven. setpoints:
    lowest and highest setpoint for which it is proven, OD.
    """

    full_pump: float
    error: float
    od: float
    growth_share: float
    gain: float
    proven: tuple[float, float]
    setpoints: tuple[float, float]

    def error_bound(self, od: Array) -> Array:
        """Return the largest allowed |error of e| at estimated ODs: max(error, ln(1 + self.od / od) / B), (N,)."""
        ratio = np.divide(self.od, od, out=np.full_like(od, np.inf), where=od > 0.0)
        return np.maximum(self.error, np.log1p(ratio) / self.full_pump)

    def error_at(self, estimate: Array, setpoint: float | None) -> Array:
        """Return the bound on the error of e at estimates of e and a setpoint (None: `error`), same shape."""
        if setpoint is None:
            return np.full_like(estimate, self.error)
        return self.error_bound(setpoint * np.exp(self.full_pump * estimate))

    def estimate(self, e: Array, side: Array, setpoint: float | None) -> Array:
        """Return the most distant possible estimate of a true e, above (side 1) or below it (side -1), (N,).

        This is the inverse of `error_at`. With c the bound on the OD error and x = r exp(B e), the estimated OD above
        is y = (x + sqrt(x^2 + 4 c x)) / 2, from ln(y) - ln(1 + c/y) = ln(x); below, y = x - c. If `error` allows a more
        distant estimate, it applies.
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
        """Return whether the errors of e and s are within the bounds at this OD and this s, (N,); False for nan.

        Args: od: estimated OD; error: of e; growth_share: estimate of s; share_error: of s; all (N,).
        """
        low, high = self.proven
        inside = (growth_share >= low) & (growth_share <= high)
        return np.asarray((error <= self.error_bound(od)) & (share_error <= self.growth_share) & inside)

    @classmethod
    def of(cls, values: Mapping[str, Any]) -> "EstimateBounds":
        """Read the bounds from a certificate. Raises: KeyError, TypeError, ValueError if it is damaged."""
        numbers = (float(values[key]) for key in ("full_pump", "error", "od", "growth_share", "gain"))
        pairs = ((float(low), float(high)) for low, high in (values["proven"], values["setpoints"]))
        found = cls(*numbers, *pairs)  # type: ignore[arg-type]
        sizes = found.full_pump, found.error, found.od, found.growth_share, found.gain, *found.proven, *found.setpoints
        if not (all(0.0 <= size < np.inf for size in sizes) and found.proven[0] < found.proven[1]):
            raise ValueError(f"bounds {sizes}: allowed finite numbers of at least 0, ranges from low to high")
        return found
