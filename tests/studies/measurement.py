"""One comparison of speed: two callables that do the same work, and how to time them fairly."""

import time
from collections.abc import Callable
from dataclasses import dataclass
from statistics import median
from typing import Any

__all__ = ["Measurement", "measure", "seconds"]


@dataclass(frozen=True)
class Measurement:
    """name: what is timed; work: one sentence about it. rival: what `theirs` is. per: the time is divided by this.

    unit: of the time so divided, "s" or "ms per decision" etc., with `scale` turning seconds into it.
    limit: the time of ours that must not be exceeded, in that unit, or None.
    """

    name: str
    work: str
    rival: str
    ours: Callable[[], object]
    theirs: Callable[[], object]
    unit: str = "s"
    scale: float = 1.0
    per: int = 1
    limit: float | None = None


def seconds(work: Callable[[], object], repeats: int = 1) -> float:
    """How long one call takes, s: mean over so many in a row."""
    start = time.perf_counter()
    for _ in range(repeats):
        work()
    return (time.perf_counter() - start) / repeats


def measure(m: Measurement, runs: int) -> dict[str, Any]:
    """Time a measurement `runs` times in pairs, after one pair that is thrown away; one entry of summary.json."""
    pairs = []
    for k in range(runs + 1):
        order = (m.ours, m.theirs) if k % 2 else (m.theirs, m.ours)
        times = {call: seconds(call) for call in order}
        pairs.append((times[m.ours], times[m.theirs]))
    factor = m.scale / m.per
    kept = pairs[1:]
    ours = factor * median(a for a, _ in kept)
    return {
        "name": m.name,
        "work": m.work,
        "unit": m.unit,
        "ours": ours,
        "rival": m.rival,
        "theirs": factor * median(b for _, b in kept),
        "ratio": median(b / a for a, b in kept),
        "ratio_range": [min(b / a for a, b in kept), max(b / a for a, b in kept)],
        "runs": runs,
        "limit": m.limit,
        "within_limit": None if m.limit is None else ours < m.limit,
    }
