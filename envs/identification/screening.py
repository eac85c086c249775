"""Screening of a recording: reject readings of outliers and of frozen or broken sensors, and find gaps.

The criterion is the detrended log OD r = ln y - mu t + C/tau, with C the pumped volume (the integral of u) and a robust
preliminary estimate of mu and 1/tau from short differences. r changes slowly in every culture, so a jump of r comes
from the sensor or from somebody who touched the vial.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

OD_FLOOR = 1e-3  # smallest OD whose logarithm is used
OUTLIER_SD = 6.0
OUTLIER_SHARE = 0.05  # smallest deviation of an outlier over the OD; a robust loss handles smaller ones
OUTLIER_WINDOW = 11  # rows; finds bursts of up to five bad readings (bubbles: docs/biology.md, Sensor)
NOISE_WINDOW = 61
JUMP_LOG = 0.35  # ln of the smallest factor (1.4) between the medians of five readings before and after a jump
JUMP_SHARE = 0.1  # smallest jump over the recording's 95th OD percentile; smaller steps hardly affect a fit
JUMP_ROWS = 5
SHORT_ROWS = 10  # readings; a part between two jumps with fewer is a burst, not a regime
FROZEN_ROWS = 10
FEWEST_READINGS = 10  # least number of readings for an estimate
NOISY_FACTOR = 6.0
WEEK_MIN = 10080
MANY_ROWS = 1000  # more rows, at half a minute or less, are merged: pumps often run for longer than such an interval
LATE_MIN = 0.3  # min before the last reading of a merged minute from which readings are used
GAP_MIN = 5.0  # a longer pause, also longer than five usual intervals, is a gap: the pump's action in it is unknown


@dataclass(frozen=True, eq=False)
class Series:
    """Recording for the fit; all arrays have shape (n,).

    time: min, strictly increasing. od: OD, nan without a reading. pump_rate: mL/s, >= 0, constant from each row to the
    next. row: row number for messages, increasing.
    Raises: ValueError for other shapes or values.
    """

    time: Array
    od: Array
    pump_rate: Array
    row: NDArray[np.int64]

    def __post_init__(self) -> None:
        shapes = {self.time.shape, self.od.shape, self.pump_rate.shape, self.row.shape}
        if len(shapes) != 1 or self.time.ndim != 1:
            raise ValueError(f"series: shapes {sorted(shapes)}: allowed one shape (n,) for all four arrays")
        if not (np.diff(self.time) > 0).all() or not np.isfinite(self.time).all():
            raise ValueError("series: times must be finite and strictly increasing, in min")
        if not (self.pump_rate >= 0.0).all():
            raise ValueError("series: pump rates must be >= 0 mL/s")

    def part(self, first: int, end: int) -> Series:
        """Return the rows at positions [first, end) as a series."""
        s = slice(first, end)
        return Series(self.time[s], self.od[s], self.pump_rate[s], self.row[s])

    def rejecting(self, bad: Mask) -> Series:
        """Return the series with nan for the readings marked in `bad`, shape (n,); times and pump rates are kept."""
        return Series(self.time, np.where(bad, np.nan, self.od), self.pump_rate, self.row)


@dataclass(frozen=True, eq=False)
class Rejection:
    """Readings rejected for one reason. rows: their row numbers."""

    reason: str
    rows: NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class Screened:
    """Series without its faulty readings, and the rejections.

    stretches: positions [first, end) of the trustworthy parts between gaps, in order of time.
    """

    series: Series
    stretches: tuple[tuple[int, int], ...]
    rejections: tuple[Rejection, ...]


def pumped_volume(time: Array, pump_rate: Array) -> Array:
    """Return C_i = sum_{j<i} u_j (t_{j+1} - t_j), mL/s min, (..., n), C_0 = 0. C/tau is the accumulated dilution."""
    steps = pump_rate[..., :-1] * np.diff(time, axis=-1)
    start = np.zeros((*steps.shape[:-1], 1))
    return np.concatenate([start, np.cumsum(steps, axis=-1)], axis=-1)


def runs(mask: Mask) -> list[tuple[int, int]]:
    """Return positions [first, end) of the runs of True in a mask, shape (n,)."""
    edges = np.flatnonzero(np.diff(np.concatenate([[0], mask.astype(np.int8), [0]])))
    return [(int(a), int(b)) for a, b in edges.reshape(-1, 2)]


def merged(series: Series, longest: int = MANY_ROWS) -> Series:
    """Merge the rows of each minute if rows are half a minute or less apart and more than `longest` in number.

    A merged row has the time of its last reading and the median of the readings in the 18 s up to this time. So the
    order of doses and readings is kept. The pumped volume is kept, too.
    """
    if len(series.time) <= longest:
        return series
    minute = np.floor(series.time - series.time[0]).astype(np.int64)
    first = np.flatnonzero(np.diff(minute, prepend=-1))
    if 2 * len(first) > len(minute):
        return series
    count = np.diff(first, append=len(minute))
    read = np.isfinite(series.od)
    at = np.maximum.reduceat(np.where(read, np.arange(len(minute)), -1), first)
    at = np.where(at < 0, first + count - 1, at)
    od = np.where(series.time > np.repeat(series.time[at], count) - LATE_MIN, series.od, np.nan)
    order = np.lexsort((od, minute))  # nan last
    readings = np.add.reduceat(np.isfinite(od), first, dtype=np.int64)
    volume = pumped_volume(series.time, series.pump_rate)[at]
    rate = np.append(np.diff(volume) / np.diff(series.time[at]), series.pump_rate[at[-1]])
    middle = od[order[first + np.maximum(readings - 1, 0) // 2]]
    return Series(series.time[at], middle, np.maximum(rate, 0.0), series.row[first])


def row_spans(rows: NDArray[np.int64]) -> str:
    """Write row numbers as text: '3, 7-9'."""
    if not len(rows):
        return "none"
    parts = np.flatnonzero(np.diff(rows) > 1)
    first, last = rows[np.append(0, parts + 1)], rows[np.append(parts, len(rows) - 1)]
    spans = [f"{a}" if a == b else f"{a}-{b}" for a, b in zip(first[:6], last[:6], strict=True)]
    return ", ".join(spans) + (f" and {len(first) - 6} more" if len(first) > 6 else "")


def _slow_log_od(series: Series) -> Array:
    """Compute r of the module's docstring, shape (n,), nan without a reading."""
    volume = pumped_volume(series.time, series.pump_rate)
    log_od = np.log(np.maximum(series.od, OD_FLOOR))
    lag = 5
    if len(log_od) <= 2 * lag:
        return log_od
    rise = log_od[lag:] - log_od[:-lag]
    columns = np.stack([series.time[lag:] - series.time[:-lag], -(volume[lag:] - volume[:-lag])], axis=1)
    level = np.minimum(series.od[lag:], series.od[:-lag])
    ok = np.isfinite(rise)
    rise, columns, level = rise[ok], columns[ok], np.maximum(level[ok], OD_FLOOR)
    weight = level.copy()  # sd of ln y is sd(y) / y
    pilot = np.zeros(2)
    for _ in range(8):  # reweighted least squares: robust to a few jumps
        pilot = np.linalg.lstsq(columns * weight[:, None], rise * weight, rcond=1e-10)[0]
        error = (rise - columns @ pilot) * level
        scale = max(1.4826 * float(np.median(np.abs(error))), 1e-9)
        weight = level * np.minimum(1.0, 2.0 * scale / np.maximum(np.abs(error), 1e-300))
    slow: Array = log_od - pilot[0] * series.time + pilot[1] * volume
    return slow


def running_median(values: Array, width: int) -> Array:
    """Return the running median over `width` (odd) rows, ignoring nan, shape (n,); nan where all rows are nan."""
    half = width // 2
    padded = np.concatenate([np.full(half, np.nan), values, np.full(half, np.nan)])
    windows = np.sort(sliding_window_view(padded, width), axis=1)  # nan last
    count = np.isfinite(windows).sum(axis=1)
    rows = np.arange(len(values))
    median: Array = 0.5 * (windows[rows, np.maximum(count - 1, 0) // 2] + windows[rows, count // 2])
    return median


def _deviation(series: Series, slow: Array) -> tuple[Array, Array]:
    """Return the deviation of each reading from the OD expected from its neighbours, and this OD, each (n,)."""
    trend = np.log(np.maximum(series.od, OD_FLOOR)) - slow
    expected = np.exp(running_median(slow, OUTLIER_WINDOW) + trend)
    return series.od - expected, expected


def noise_sd(series: Series) -> float:
    """Return the noise of the sensor, OD: robust sd of a reading about its neighbours (11 rows)."""
    deviation, _ = _deviation(series, _slow_log_od(series))
    return float(1.4826 * np.nanmedian(np.abs(deviation)))


def screen(series: Series) -> Screened:
    """Find frozen, outlying and noisy readings, gaps, and impossible jumps.

    Jumps split the recording into regimes. The regime with the most readings is kept, the others are rejected. If a
    later regime is rejected, the last reading before it is, too: it may average over the jump. A gap rejects nothing.

    Returns: see `Screened`. Raises: ValueError if fewer than ten readings are left.
    """
    readings = np.isfinite(series.od)
    reasons: list[str] = []
    label = np.full(len(series.od), -1)

    def reject(bad: Mask, reason: str) -> Series:
        label[bad & readings] = len(reasons)  # of several reasons the last one counts
        reasons.append(reason)
        return series.rejecting(label >= 0)

    series = reject(_frozen(series.od), f"sensor frozen: the same OD {FROZEN_ROWS} times or more in a row")
    _check_left(series)
    slow = _slow_log_od(series)
    deviation, expected = _deviation(series, slow)
    local = 1.4826 * running_median(np.abs(deviation), NOISE_WINDOW)
    overall = float(np.nanmedian(local))
    limit = np.maximum(OUTLIER_SD * np.maximum(local, 0.3 * overall), OUTLIER_SHARE * expected)
    series = reject(np.abs(deviation) > limit, f"outlier: more than {OUTLIER_SD:g} sd from its neighbours")
    noisy = local > np.maximum(NOISY_FACTOR * overall, 2 * OUTLIER_SHARE * expected)
    series = reject(noisy, f"sensor noisy: scatter over {NOISY_FACTOR:g} times that of the recording")
    _check_left(series)
    gaps = _gaps(series.time)
    slow = np.where(np.isfinite(series.od), slow, np.nan)
    jumps = [j for j in _jumps(series, slow) if j not in gaps]
    for first, end, reason in list(_foreign_regimes(series, slow, jumps)):
        bad = np.zeros(len(series.od), dtype=np.bool_)
        bad[first:end] = True
        series = reject(bad, reason)
    usable = np.flatnonzero(np.isfinite(series.od))
    first, end = int(usable[0]), int(usable[-1]) + 1
    edges = [first, *(g for g in gaps if first < g < end), end]
    stretches = tuple((a, b) for a, b in pairwise(edges) if np.isfinite(series.od[a:b]).any())
    found = tuple(Rejection(r, series.row[label == k]) for k, r in enumerate(reasons) if (label == k).any())
    return Screened(series, stretches, found)


def _check_left(series: Series) -> None:
    left = int((series.od > 0.0).sum())
    if left < FEWEST_READINGS:
        raise ValueError(
            f"{left} trustworthy readings above zero, at least {FEWEST_READINGS} are needed: nearly all readings are "
            "frozen, zero or erratic; check the sensor"
        )


def _frozen(od: Array) -> Mask:
    """Mark all but the first reading in each run of FROZEN_ROWS or more equal readings."""
    frozen = np.zeros(len(od), dtype=np.bool_)
    for a, b in runs(np.concatenate([[False], od[1:] == od[:-1]])):
        if b - a + 1 >= FROZEN_ROWS:
            frozen[a:b] = True
    return frozen


def _gaps(time: Array) -> list[int]:
    """Return the position of the first row after each gap."""
    step = np.diff(time)
    if not len(step):
        return []
    return [int(i) + 1 for i in np.flatnonzero(step > max(GAP_MIN, 5.0 * float(np.median(step))))]


def _jumps(series: Series, slow: Array) -> list[int]:
    """Return the position of the first reading after each persistent jump."""
    valid = np.flatnonzero(np.isfinite(series.od))
    if len(valid) < 2 * JUMP_ROWS:
        return []
    r, y = slow[valid], series.od[valid]
    median_r = np.median(sliding_window_view(r, JUMP_ROWS), axis=1)
    median_y = np.median(sliding_window_view(y, JUMP_ROWS), axis=1)
    step = median_r[JUMP_ROWS:] - median_r[:-JUMP_ROWS]
    level = np.minimum(median_y[JUMP_ROWS:], median_y[:-JUMP_ROWS])
    size = np.maximum(level, OD_FLOOR) * np.expm1(np.abs(step))  # the jump in OD, without growth and dilution
    smallest = max(JUMP_SHARE * float(np.percentile(y, 95)), OUTLIER_SD * noise_sd(series))
    big = (np.abs(step) > JUMP_LOG) & (size > smallest)
    found = []
    for a, b in runs(big):
        first, end = a + JUMP_ROWS - 2, min(b + JUMP_ROWS + 1, len(r))
        within = np.arange(max(first, 1), end)
        found.append(int(valid[within[np.argmax(np.abs(r[within] - r[within - 1]))]]))
    return sorted(set(found))


def _foreign_regimes(series: Series, slow: Array, jumps: list[int]) -> Iterator[tuple[int, int, str]]:
    """Yield (first, end, reason) of each burst and of each regime except the one with the most readings.

    A burst is a short part after which the OD returns to its trend; the regimes around it are joined."""
    regimes = [[(a, b)] for a, b in zip([0, *jumps], [*jumps, len(series.od)], strict=True)]
    readings = [int(np.isfinite(series.od[r[0][0] : r[0][1]]).sum()) for r in regimes]
    bursts: list[tuple[int, int]] = []
    k = len(regimes) - 2
    while k > 0:
        before, (a, b), after = regimes[k - 1][-1], regimes[k][0], regimes[k + 1][0]
        if readings[k] < SHORT_ROWS and abs(_level(slow, before, last=True) - _level(slow, after)) < JUMP_LOG:
            bursts.append((a, b))
            regimes[k - 1 : k + 2] = [regimes[k - 1] + regimes[k + 1]]
            readings[k - 1 : k + 2] = [readings[k - 1] + readings[k + 1]]
        k = min(k - 1, len(regimes) - 2)
    for a, b in bursts:
        yield a, b, "burst: jumps away from the trend and comes back"
    kept = int(np.argmax(readings))
    for k, regime in enumerate(regimes):
        if k == kept:
            continue
        first, end = regime[0][0], regime[-1][1]
        at = first if k > kept else end
        guard = 1 if k > kept and at > 0 else 0
        yield first - guard, end, _jump_reason(series, at, k > kept)


def _level(slow: Array, regime: tuple[int, int], last: bool = False) -> float:
    part = slow[regime[0] : regime[1]]
    part = part[np.isfinite(part)]
    return float(np.median(part[-JUMP_ROWS:] if last else part[:JUMP_ROWS]))


def _jump_reason(series: Series, at: int, later: bool) -> str:
    before = np.flatnonzero(np.isfinite(series.od[:at]))[-1]
    after = at + np.flatnonzero(np.isfinite(series.od[at:]))[0]
    what = (
        f"OD jumps from {series.od[before]:.3g} to {series.od[after]:.3g} between rows {series.row[before]} and "
        f"{series.row[after]} ({series.time[after] - series.time[before]:.1f} min), faster than any culture, and does "
        "not return"
    )
    rose = series.od[after] > series.od[before]
    side = "after a jump" if later else "before a jump"
    return f"sensor broken or moved {side}: {what}" if rose == later else f"different conditions {side}: {what}"
