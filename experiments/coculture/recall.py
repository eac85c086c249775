"""An estimator that takes late samples: it goes back in time and replays all data since."""

import copy
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from experiments.coculture.base import Array, Mask, ShareEstimate
from experiments.coculture.estimator import CompositionEstimator

KEPT_MIN, EVERY_MIN = 2880.0, 60.0  # a plate is counted a day after it was spread; from each copy on all is replayed
AT_ONCE = 480  # readings and doses that are taken again with each new reading: some .2 s

Shown = tuple[float, str, tuple[Any, ...]]


@dataclass
class Chapter:
    """Copy of the estimator at a minute, and the calls it has had since: (minute, method, arguments)."""

    minute: float
    then: CompositionEstimator
    shown: list[Shown] = field(default_factory=list)


@dataclass
class Again:
    """Estimator copy that replays past data; the next item is entry `entry` of chapter `chapter`."""

    chapter: int
    estimator: CompositionEstimator
    entry: int = 0


class Recall:
    """An estimator, and its last two days.

    A share that was counted belongs to the minute at which the sample was drawn, which may be a day ago. Then a copy of
    the estimator goes back to the full hour before that, and takes again all readings, doses and samples in their
    order, as many with each new reading as the loop can wait for; once it has caught up it stands in for the estimator.
    The result equals a filter that had the sample at once. A resumed run replays its last two days (`retell`).
    """

    remembers = ("estimator", "earliest")

    def __init__(self, estimator: CompositionEstimator) -> None:
        self.estimator, self.earliest = estimator, copy.deepcopy(estimator)  # the latter: of the first chapter
        self._chapters: list[Chapter] = []
        self._again: Again | None = None

    def reset(self, n: int) -> None:
        self.estimator.reset(n)
        self._forget()
        self.earliest = copy.deepcopy(self.estimator)

    def _forget(self) -> None:
        self._chapters, self._again = [], None

    def calibrate(self, factor: Array, factor_sd: Array, offset: Array, offset_sd: float) -> None:
        self.estimator.calibrate(factor, factor_sd, offset, offset_sd)

    @property
    def begun(self) -> Mask:
        return self.estimator.begun

    @property
    def known(self) -> Array:
        """Up to which minute `retell` needs nothing of each culture; -inf where it needs all, (N,)."""
        return self.earliest.since

    @property
    def behind(self) -> bool:
        return self._again is not None

    def watch(self, od: Array, fluorescence: Array, temperature: Array, minute: Array, rows: Mask) -> None:
        if not rows.any():
            return
        now = float(minute[rows].max())
        if not self._chapters or now - self._chapters[-1].minute >= EVERY_MIN:
            self._begin(now)
        self._show(now, "watch", tuple(np.array(a) for a in (od, fluorescence, temperature, minute, rows)))
        self._catch_up()

    def _begin(self, now: float) -> None:
        """Begin a new chapter; forget what is older than two days, except what is just being replayed."""
        self._chapters.append(Chapter(now, copy.deepcopy(self.estimator)))
        while now - self._chapters[0].minute > KEPT_MIN and (self._again is None or self._again.chapter > 0):
            self._chapters.pop(0)
            if self._again is not None:
                self._again.chapter -= 1
        self.earliest = self._chapters[0].then

    def dosed(self, volume_ml: Array) -> None:
        if self._chapters:
            self._show(self._last(), "dosed", (np.array(volume_ml),))
        else:
            self.estimator.dosed(volume_ml)

    def sample(self, share: Array, sd: Array, minute: float, rows: Mask) -> bool:
        """Shares that were counted in samples drawn at a minute, with their sds, (N,); False: longer ago than is known.

        It is taken behind the readings of that minute. See `behind`.
        """
        if self._chapters and not self.earliest.begun.any():
            minute = max(minute, self._chapters[0].minute)  # of the inoculum: as if drawn with the first reading
        at = next((k for k in reversed(range(len(self._chapters))) if self._chapters[k].minute <= minute), None)
        if at is None:
            return False
        shown = self._chapters[at].shown
        place = next((k for k, (when, _, _) in enumerate(shown) if when > minute), len(shown))
        shown.insert(place, (minute, "sample", (np.array(share), np.array(sd), np.array(rows))))
        if self._again is None or at <= self._again.chapter:  # else it is met on the way
            self._again = Again(at, copy.deepcopy(self._chapters[at].then))
        self._catch_up()
        return True

    def retell(self, shown: Iterable[Shown]) -> None:
        """Replay what a resumed run was shown before the resume, in order, after what is `known`.

        Until the replay is complete, the estimate is the saved one.
        """
        self._forget()
        last = self.known
        for minute, method, arguments in shown:
            if method == "watch":
                last = np.where(arguments[-1], minute, last)
            if not self._chapters or minute - self._chapters[-1].minute >= EVERY_MIN:
                self._chapters.append(Chapter(minute, copy.deepcopy(self.earliest)))
            self._chapters[-1].shown.append((minute, method, arguments))
        if self._chapters:
            same = self.estimator.since >= last - 1e-3  # of these it is known what the device dosed since then, too
            self._chapters[-1].shown.append((self._last(), "gave", (self.estimator.given_ml.copy(), same)))
            self._again = Again(0, copy.deepcopy(self.earliest))

    def _last(self) -> float:
        shown = self._chapters[-1].shown
        return shown[-1][0] if shown else self._chapters[-1].minute

    def _show(self, minute: float, method: str, arguments: tuple[Any, ...]) -> None:
        self._chapters[-1].shown.append((minute, method, arguments))
        act: Callable[..., None] = getattr(self.estimator, method)
        act(*arguments)

    def _catch_up(self) -> None:
        """Replay some more of the past; once all of it is replayed, the copy becomes the estimator."""
        again = self._again
        for _ in range(AT_ONCE):
            if again is None:
                return
            shown = self._chapters[again.chapter].shown
            if again.entry < len(shown):
                _, method, arguments = shown[again.entry]
                getattr(again.estimator, method)(*arguments)
                again.entry += 1
            if again.entry == len(shown):
                again.chapter, again.entry = again.chapter + 1, 0
                if again.chapter == len(self._chapters):
                    self.estimator, self._again = again.estimator, None
                    return
                self._chapters[again.chapter].then = copy.deepcopy(again.estimator)

    def estimate(self) -> ShareEstimate:
        return self.estimator.estimate()

    def explain(self) -> dict[str, Array]:
        return self.estimator.explain()
