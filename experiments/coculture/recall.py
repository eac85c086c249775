"""Estimator that uses late samples: it goes back to the time of the sample and replays all later data."""

import copy
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from experiments.coculture.base import Array, Mask, ShareEstimate
from experiments.coculture.estimator import CompositionEstimator

KEPT_MIN, EVERY_MIN = 2880.0, 60.0  # age of the oldest copy (plates are counted after a day); time between two copies
AT_ONCE = 480  # calls that are replayed with each new reading; this takes about 0.2 s

Shown = tuple[float, str, tuple[Any, ...]]


@dataclass
class Chapter:
    """Copy `then` of the estimator at `minute`, and the calls that followed. shown: (minute, method, arguments)."""

    minute: float
    then: CompositionEstimator
    shown: list[Shown] = field(default_factory=list)


@dataclass
class Again:
    """Copy of the estimator that replays past data. Its next call is number `entry` of chapter `chapter`."""

    chapter: int
    estimator: CompositionEstimator
    entry: int = 0


class Recall:
    """Estimator with a record of its last two days, for samples that are counted late.

    A counted share belongs to the minute at which the sample was drawn, which may be a day ago. A copy of the estimator
    from up to an hour before that minute then replays all readings, doses and samples in order, a limited number with
    each new reading. Once it has caught up, it replaces the estimator. The result is the same as if the sample had been
    known at once. A resumed run replays its last two days (`retell`).
    """

    remembers = ("estimator", "earliest")

    def __init__(self, estimator: CompositionEstimator) -> None:
        self.estimator, self.earliest = estimator, copy.deepcopy(estimator)  # earliest: copy of the first chapter
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
        """Minute up to which `retell` needs no data of each culture; -inf: it needs all data, (N,)."""
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
        """Begin a new chapter; drop chapters older than two days, unless they are being replayed."""
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
        """Use shares counted in samples that were drawn at `minute`; return False if that is too long ago.

        A sample counts as drawn after the readings of its minute. While `behind`, the estimate does not yet include it.
        Args: share, sd: counted shares and their sds, (N,). rows: cultures with a sample.
        """
        if self._chapters and not self.earliest.begun.any():
            minute = max(minute, self._chapters[0].minute)  # a sample of the inoculum counts at the first reading
        at = next((k for k in reversed(range(len(self._chapters))) if self._chapters[k].minute <= minute), None)
        if at is None:
            return False
        shown = self._chapters[at].shown
        place = next((k for k, (when, _, _) in enumerate(shown) if when > minute), len(shown))
        shown.insert(place, (minute, "sample", (np.array(share), np.array(sd), np.array(rows))))
        if self._again is None or at <= self._again.chapter:  # else the running replay includes it
            self._again = Again(at, copy.deepcopy(self._chapters[at].then))
        self._catch_up()
        return True

    def retell(self, shown: Iterable[Shown]) -> None:
        """Replay the calls since `known` of a resumed run; until this is complete, the estimate is the saved one."""
        self._forget()
        last = self.known
        for minute, method, arguments in shown:
            if method == "watch":
                last = np.where(arguments[-1], minute, last)
            if not self._chapters or minute - self._chapters[-1].minute >= EVERY_MIN:
                self._chapters.append(Chapter(minute, copy.deepcopy(self.earliest)))
            self._chapters[-1].shown.append((minute, method, arguments))
        if self._chapters:
            same = self.estimator.since >= last - 1e-3  # the saved estimator knows the doses since the last reading
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
        """Replay the next calls; after the last one, the copy becomes the estimator."""
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
