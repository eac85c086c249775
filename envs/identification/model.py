"""Model of a recording and common parts of its fits: trajectory, PMSE, estimates, identifiability of tau.

If u is constant from each row to the next, equation (5) of the paper has the exact solution

    x_i = x_0 exp(mu (t_i - t_0) - C_i / tau),    C_i = sum_{j<i} u_j (t_{j+1} - t_j),

so the simulated trajectory needs no integrator.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from envs.identification.screening import Series, pumped_volume

Array = NDArray[np.float64]

MIN_READINGS = 20
CONFIDENCE = 0.95
WORST_CONDITION = 1e8  # largest condition number of the scaled normal equations
WIDEST = 0.5  # largest half width of an interval, relative to the value
MIN_STEPS = 3  # rows that are needed at a low and at a high pump rate to determine tau


REMEDY = (
    "record with the pump stopped for 10 min every hour (this determines mu and tau to about 5 %), or in open loop "
    "like generate=true"
)


class NotIdentifiable(ValueError):
    """Error for rows that do not identify the parameters. why: the reason; remedy: how to record better."""

    def __init__(self, why: str, remedy: str = REMEDY) -> None:
        super().__init__(f"{why}; {remedy}")
        self.why, self.remedy = why, remedy


@dataclass(frozen=True)
class Parameter:
    """Estimate of a parameter with its 95 % interval, low to high."""

    value: float
    low: float
    high: float

    @property
    def half_width(self) -> float:
        """Half the width of the interval, in the unit of the parameter."""
        return 0.5 * (self.high - self.low)


def trajectory(time: Array, pump_rate: Array, mu: Array | float, tau: Array | float, start_od: Array | float) -> Array:
    """Compute x of equation (5) at the times of the rows, from the first row on; exact if u is constant between rows.

    Args:
      time: min, shape (n,) or (N, n). pump_rate: mL/s, same shape.
      mu: 1/min. tau: > 0. start_od: OD. Scalars or shape (N,).
    Returns: OD, shape (n,) for scalars and one recording, else (N, n).
    """
    mu, tau, start_od = (np.asarray(p, dtype=np.float64)[..., None] for p in (mu, tau, start_od))
    elapsed = time - time[..., :1]
    return np.asarray(start_od * np.exp(mu * elapsed - pumped_volume(time, pump_rate) / tau))


def pmse(od: Array, model: Array) -> float:
    """Return the percentage mean square error, 100 * sum (x - x_model)^2 / sum x^2, over the rows with a reading, %.

    Args: od: measured x, nan without a reading, shape (n,). model: x_model, same shape.
    """
    used = np.isfinite(od)
    return float(100.0 * np.sum((od[used] - model[used]) ** 2) / np.sum(od[used] ** 2))


def check_excitation(series: Series) -> None:
    """Refuse rows in which dilution and growth cannot be distinguished.

    Only a changing pump rate identifies tau: without feed 1/tau has no effect, and a constant rate identifies only
    mu - u/tau. The two lowest and the two highest rates are ignored, because single rows can be wrong.

    Raises: NotIdentifiable.
    """
    used = np.flatnonzero(np.isfinite(series.od))
    where = f"rows {series.row[0]}-{series.row[-1]}"
    if len(used) < MIN_READINGS:
        raise NotIdentifiable(
            f"{where}: {len(used)} usable readings; at least {MIN_READINGS} are needed", "record for longer"
        )
    rate = np.sort(series.pump_rate[used[0] : used[-1]])
    low, high = float(rate[MIN_STEPS - 1]), float(rate[-MIN_STEPS])
    if high == 0.0:
        ran = f"runs in {int((rate > 0.0).sum())} rows, at least {MIN_STEPS} are needed" if rate[-1] else "never runs"
        why = f"{where}: the pump {ran}, so tau cannot be determined"
        raise NotIdentifiable(why, "record while the pump runs and stops")
    if high - low < 1e-3 * high:
        raise NotIdentifiable(
            f"{where}: the pump runs at {high:g} mL/s in nearly all rows (another rate is needed in at least "
            f"{MIN_STEPS} rows), so growth and dilution cannot be distinguished"
        )
