"""Metrics of how well a setpoint was held, per window of a recording, for N reactors at once.

The paper's metrics contain 1/T, but it does not state T. Both conventions are computed:

    ise  = (1 / 1 min) int e(t)^2 dt       ise_mean  = (1 / window) int e(t)^2 dt
    itae = (1 / 1 min) int t |e(t)| dt     itae_mean = (1 / window) int t |e(t)| dt

with e = x - setpoint, t in min from the start of the window, integrals by the trapezoidal rule over the samples. The
published table is consistent only with the first convention (T = 1 min, the control period).
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

SETTLING_BAND = 0.05  # largest |e| of a settled culture, as a fraction of the setpoint
LATE_MIN = 120.0  # last minutes of a window over which the late error is averaged
STEADY_MIN = 10.0  # last minutes of a window over which the steady error is averaged


@dataclass(frozen=True, eq=False)
class WindowMetrics:
    """Metrics of N reactors in a window; arrays (N,), nan where there are fewer than two samples.

    settling_min: minutes until |e| stays inside the band to the end; nan if it does not.
    steady_abs_error: mean |e| over the last 10 min. abs_error: mean |e| over the window.
    """

    setpoint: float
    ise: Array
    itae: Array
    ise_mean: Array
    itae_mean: Array
    settling_min: Array
    steady_abs_error: Array
    abs_error: Array


def _carry_forward(values: Array, valid: NDArray[np.bool_]) -> Array:
    """Replace invalid values by the last valid value before them, or at the start by the first valid value."""
    index = np.where(valid, np.arange(values.shape[1]), -1)
    index = np.maximum.accumulate(index, axis=1)
    first = np.argmax(valid, axis=1)[:, None]
    return np.asarray(np.take_along_axis(values, np.where(index < 0, first, index), axis=1))


def window_metrics(minute: Array, od: Array, setpoint: float, start: float, end: float) -> WindowMetrics:
    """Compute the metrics of the samples with start <= minute <= end.

    A sample at the border of two windows belongs to both, each time with that window's setpoint.

    Args:
      minute: sample times, min, (N, K), rising along K; nan where there is no sample.
      od: (N, K); a nan reading is skipped, and the integral spans the gap.
      setpoint, start, end: setpoint and limits, min, of the window.
    """
    tolerance = 1e-6
    if not minute.size:
        minute = od = np.full((len(minute), 1), np.nan)
    valid = (minute >= start - tolerance) & (minute <= end + tolerance) & np.isfinite(od)
    enough = valid.sum(axis=1) >= 2
    t = _carry_forward(np.where(valid, minute - start, 0.0), valid)
    e = _carry_forward(np.where(valid, od - setpoint, 0.0), valid)
    length = end - start
    ise = np.asarray(np.trapezoid(e * e, t, axis=1))
    itae = np.asarray(np.trapezoid(t * np.abs(e), t, axis=1))
    outside = valid & (np.abs(e) > SETTLING_BAND * setpoint)
    last_outside = np.where(outside.any(axis=1), outside.shape[1] - 1 - np.argmax(outside[:, ::-1], axis=1), -1)
    later = valid & (np.arange(valid.shape[1]) > last_outside[:, None])
    settled = np.where(
        later.any(axis=1), np.take_along_axis(t, np.argmax(later, axis=1)[:, None], axis=1)[:, 0], np.nan
    )
    tail = valid & (t >= length - STEADY_MIN - tolerance)
    steady = np.where(tail, np.abs(e), 0.0).sum(axis=1) / np.maximum(tail.sum(axis=1), 1)

    def known(values: Array, where: NDArray[np.bool_] = enough) -> Array:
        return np.where(where, values, np.nan)

    return WindowMetrics(
        setpoint=setpoint,
        ise=known(ise),
        itae=known(itae),
        ise_mean=known(ise / length),
        itae_mean=known(itae / length),
        settling_min=known(settled),
        steady_abs_error=known(steady, enough & tail.any(axis=1)),
        abs_error=known(np.trapezoid(np.abs(e), t, axis=1) / length),
    )


def mean_errors(minute: Array, value: Array, setpoint: Array, start: float, end: float) -> tuple[Array, Array]:
    """Return the mean |value - setpoint| over the samples with start <= minute < end, and over their last two hours.

    Both have shape (N,), nan without samples. Args: minute, value, setpoint: (N, K), nan where missing.
    """
    error = np.abs(value - setpoint)
    inside = np.isfinite(error) & (minute >= start - 1e-6) & (minute < end - 1e-6)
    late = inside & (minute >= end - LATE_MIN - 1e-6)
    whole, last = (
        np.where(mask, error, 0.0).sum(axis=1) / np.where(mask.any(axis=1), mask.sum(axis=1), np.nan)
        for mask in (inside, late)
    )
    return whole, last
