"""The window: the stretch of a recording for one pair (mu, tau)."""

import numpy as np

from envs.identification.drift import Segment, drifts
from envs.identification.model import NotIdentifiable
from envs.identification.screening import FEWEST_READINGS, WEEK_MIN, Screened, Series

__all__ = ["SHORTEST_WINDOW_MIN", "choose_window", "longest"]

Window = tuple[int, int]

SHORTEST_WINDOW_MIN = 60.0


def choose_window(screened: Screened, along: tuple[Segment, ...], segment_min: float) -> tuple[Window, str]:
    """Return positions [first, end) of the window with most readings, and the reason as text.

    A window is consecutive segments of one stretch without drift, of at most a week. Windows with a segment that
    identifies tau, and without a segment in which dilution had no effect (`_failed`), are preferred. Raises:
    NotIdentifiable without a window of at least an hour.
    """
    clean = screened.series
    failed = _failed(clean, along)
    apart = float(np.median(np.diff(clean.time)))
    if segment_min < FEWEST_READINGS * apart:
        raise NotIdentifiable(
            f"rows are {apart:.3g} min apart, and a segment of {segment_min:g} min holds {segment_min / apart:.0f}; "
            f"allowed at least {FEWEST_READINGS}",
            f"check the unit of time, or say identify.segment_min={2 * FEWEST_READINGS * apart:.0f}",
        )
    count = np.concatenate([[0], np.cumsum(np.isfinite(clean.od))])
    best: Window | None = None
    most = (False, 0)
    for first, end in screened.stretches:
        inside = tuple(s for s in along if first <= s.first and s.end <= end)
        for i in range(len(inside)):
            for j in range(len(inside), i, -1):
                part, a, b = inside[i:j], inside[i].first, inside[j - 1].end
                lasts = SHORTEST_WINDOW_MIN <= _minutes(clean, a, b) <= WEEK_MIN
                tells = any(s.tau is not None for s in part) and not any(s in failed for s in part)
                size = tells, int(count[b] - count[a])
                if lasts and size > most and not drifts(part):
                    best, most = (a, b), size
    if best is None:
        a, b = longest(screened)
        raise NotIdentifiable(
            f"the longest trustworthy stretch, rows {clean.row[a]}-{clean.row[b - 1]}, lasts "
            f"{_minutes(clean, a, b):.0f} min; allowed at least {SHORTEST_WINDOW_MIN:.0f} min",
            "record for longer",
        )
    if best in screened.stretches:
        return best, "all trustworthy rows" if len(screened.stretches) == 1 else "the longest stretch without a pause"
    follows = [s for s in along if s.first == best[1]]
    capped = any(_minutes(clean, best[0], s.end) > WEEK_MIN for s in follows)
    return best, "the longest stretch without drift" + (", of a week at most" if capped else "")


def _failed(clean: Series, along: tuple[Segment, ...]) -> list[Segment]:
    """Find segments of at least median pump rate that identify no tau although most of them do.

    Causes are a failed feed or a collapsed culture: the recorded pump rate does not dilute.
    """
    pumped = [float(clean.pump_rate[s.first : s.end].mean()) for s in along]
    busy = [s for s, rate in zip(along, pumped, strict=True) if rate >= np.median(pumped) and rate > 0.0]
    silent = [s for s in busy if s.tau is None]
    return silent if 2 * len(silent) < len(busy) else []


def longest(screened: Screened) -> Window:
    """Choose the stretch with most readings."""
    return max(screened.stretches, key=lambda s: np.isfinite(screened.series.od[s[0] : s[1]]).sum())


def _minutes(clean: Series, a: int, b: int) -> float:
    return float(clean.time[b - 1] - clean.time[a])
