"""The stretch of a recording that one pair (mu, tau) may describe."""

import numpy as np

from envs.identification.drift import Segment, drifts, segments
from envs.identification.free_run import fit
from envs.identification.model import NotIdentifiable, check_excitation
from envs.identification.screening import Screened, Series

__all__ = ["SHORTEST_WINDOW_MIN", "choose_window"]

Window = tuple[int, int]

MOST_EDGES = 60  # window borders of a free run are tried at this many places at most
SHORTEST_WINDOW_MIN = 60.0


def choose_window(
    screened: Screened, along: tuple[Segment, ...], method: str, limit: float, segment_min: float
) -> tuple[Window, str]:
    """Positions [first, end) of the window with most readings, and the reason in words.

    prediction_error: consecutive segments of one stretch whose estimates do not drift. free_run: as the paper judges,
    a free-running fit below `limit` (PMSE, %) whose segments do not drift.
    Raises: NotIdentifiable when there is none of an hour at least.
    """
    if method == "free_run":
        return _free_running(screened, limit, segment_min)
    clean = screened.series
    count = np.concatenate([[0], np.cumsum(np.isfinite(clean.od))])
    best: Window | None = None
    for first, end in screened.stretches:
        inside = tuple(s for s in along if first <= s.first and s.end <= end)
        for i in range(len(inside)):
            for j in range(len(inside), i, -1):
                a, b = inside[i].first, inside[j - 1].end
                longer = best is None or count[b] - count[a] > count[best[1]] - count[best[0]]
                if longer and _minutes(clean, a, b) >= SHORTEST_WINDOW_MIN and not drifts(inside[i:j], method):
                    best = (a, b)
    if best is None:
        raise NotIdentifiable(_too_short(screened))
    return best, _covers(screened, best) + "segments fitted alone agree with one another"


def _minutes(clean: Series, a: int, b: int) -> float:
    return float(clean.time[b - 1] - clean.time[a])


def _longest(screened: Screened) -> Window:
    """The stretch with most readings."""
    return max(screened.stretches, key=lambda s: np.isfinite(screened.series.od[s[0] : s[1]]).sum())


def _too_short(screened: Screened) -> str:
    clean, (a, b) = screened.series, _longest(screened)
    return (
        f"the longest trustworthy stretch, rows {clean.row[a]}-{clean.row[b - 1]}, lasts {_minutes(clean, a, b):.0f} "
        f"min; allowed at least {SHORTEST_WINDOW_MIN:.0f} min; record for longer"
    )


def _covers(screened: Screened, window: Window) -> str:
    whole = len(screened.stretches) == 1 and window == screened.stretches[0]
    return "all trustworthy rows: " if whole else "the longest stretch without drift: "


def _free_running(screened: Screened, limit: float, segment_min: float) -> tuple[Window, str]:
    found = _longest_free_run(screened, limit, segment_min)
    clean = screened.series
    if found is None:
        whole = _longest(screened)
        if _minutes(clean, *whole) < SHORTEST_WINDOW_MIN:
            raise NotIdentifiable(_too_short(screened))
        check_excitation(clean.part(*whole))  # the likeliest reasons first, each in its own words
        error_pct = fit(clean.part(*whole), robust=False).pmse_pct
        raise NotIdentifiable(
            f"no window of {SHORTEST_WINDOW_MIN:.0f} min or more is described by one pair (mu, tau) within a PMSE of "
            f"{limit:.2g} % (all rows: {error_pct:.2g} %); the recording drifts or is too noisy; raise "
            "identify.pmse_limit, or choose a window by rows=FIRST:END identify.window=all"
        )
    n = int(np.isfinite(clean.od[found[0] : found[1]]).sum())
    why = f"one free-running trajectory describes its {n} readings within {limit:.2g} %"
    return found, _covers(screened, found) + why


def _longest_free_run(screened: Screened, limit: float, segment_min: float) -> Window | None:
    clean = screened.series
    count = np.concatenate([[0], np.cumsum(np.isfinite(clean.od))])
    best: Window | None = None
    most = 0
    for first, end in screened.stretches:
        step = max(20, -(-(end - first) // MOST_EDGES))
        edges = [*range(first, end - step // 2, step), end]
        for i, a in enumerate(edges[:-1]):
            for b in reversed(edges[i + 1 :]):
                if count[b] - count[a] <= most or _minutes(clean, a, b) < SHORTEST_WINDOW_MIN:
                    break
                part = clean.part(a, b)
                try:
                    check_excitation(part)
                    good = fit(part, robust=False).pmse_pct <= limit
                except NotIdentifiable:
                    continue
                alone = Screened(part, ((0, len(part.od)),), ())
                if good and not drifts(segments(alone, segment_min, "free_run"), "free_run"):
                    best, most = (a, b), int(count[b] - count[a])
                    break
    return best
