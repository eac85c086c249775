"""What a run recorded against what the emulated device did: samples and rows, doses and intents."""

import itertools
import math
from array import array
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hardware.emulator.vial import Dose, StoredSample
from tests.campaigns.rehearsal import Rehearsal

__all__ = ["Served", "audit_doses", "audit_rows", "fed_by", "rows_per_sample"]

DEVICE_PERIOD_S = (60.0, 68.0)  # a pump left on repeats its dose so often
ON_ITS_WAY_S = 5.0  # from the read that showed a sample to the time of its row, at most: requests before it is judged
FRESH_S = 55.0  # from the first read that showed a sample to the one that made its row, at most; a cycle takes 60
RISING_S = 30.0  # a program that starts does not watch yet
LEAVING_S = 5.0  # and one that ends does not any more
PATIENCE_S = 75.0  # a sample made so long before nothing could be read may be one that could not be read

Numbers = Sequence[float] | NDArray[np.float64]


def _numbers() -> "array[float]":
    return array("d")


@dataclass
class Served:
    """What one emulated reactor recorded, and when clients read its newest record. Times: device s.

    stored_s, od, culture_od: of every sample, as `StoredSample`. read_s: of every read.
    """

    stored_s: "array[float]" = field(default_factory=_numbers)
    od: "array[float]" = field(default_factory=_numbers)
    culture_od: "array[float]" = field(default_factory=_numbers)
    read_s: "array[float]" = field(default_factory=_numbers)

    def add(self, samples: Iterable[StoredSample], read_s: Iterable[float]) -> "Served":
        """Take in more of both; returns itself."""
        for sample in samples:
            self.stored_s.append(sample.stored_s)
            self.od.append(sample.od)
            self.culture_od.append(sample.culture_od)
        self.read_s.extend(read_s)
        return self


def rows_per_sample(
    row_s: Numbers, row_od: Numbers, served: Served, early_s: float = 0.01, late_s: float = ON_ITS_WAY_S
) -> tuple[NDArray[np.int64], int]:
    """Each row is given to the one sample that it shows: (rows of every sample, rows that show none).

    A row shows the sample that was the newest one at the last read before the row's time, for the first time not long
    before that, and its OD is that sample's to the last digit.

    Args:
      row_s, row_od: device time and OD of every row. served: of their reactor.
      early_s, late_s: how much a row's time may precede the read (two clocks compared) and come after it, s.
    """
    stored, reads = np.asarray(served.stored_s), np.asarray(served.read_s)
    count, strangers = np.zeros(stored.size, dtype=np.int64), 0
    newest = np.searchsorted(stored, reads, side="right") - 1  # the sample that each read showed
    began = reads[np.searchsorted(newest, newest)]  # when it was shown first
    usable = (newest >= 0) & (reads - began <= FRESH_S)
    newest, reads = newest[usable], reads[usable]
    for at, od in zip(row_s, row_od, strict=True):
        first, last = np.searchsorted(reads, [at - late_s, at + early_s])
        shown = [int(k) for k in newest[first:last] if served.od[k] == od or math.isnan(served.od[k])]
        if shown:
            count[shown[-1]] += 1
        else:
            strangers += 1
    return count, strangers


def audit_rows(
    r: Rehearsal, dark: tuple[float, float] | None = None, served: Mapping[str, Served] | None = None
) -> tuple[int, int, int]:
    """Samples of the device against rows of the recordings: (missed, lost, doubled).

    Doubled are rows beyond one for each sample: of a sample that has its row, or of none.

    Args:
      dark: clock times between which samples could not be read; those are missed, not lost.
      served: of each reactor; None takes what the device still remembers.
    """
    missed = lost = doubled = 0
    zero = r.spans[0][0]
    times, ods = r.record.series("time_min") * 60.0 + zero, r.record.series("od")
    for n, name in enumerate(r.names):
        size, vial = len(r.record.rows[n]), r.device.vials[name]
        own = served[name] if served is not None else Served().add(vial.samples, vial.reads)
        count, strangers = rows_per_sample(times[n, :size], ods[n, :size], own)
        doubled += strangers + int((count[count > 1] - 1).sum())
        end = _last_due(r, n, times[n, :size])
        for at in np.asarray(own.stored_s)[count == 0].tolist():
            watched = any(start + RISING_S <= at <= stop - LEAVING_S for start, stop in r.spans)
            if watched and at <= end:
                unreadable = dark is not None and dark[0] - PATIENCE_S <= at <= dark[1]
                missed, lost = missed + unreadable, lost + (not unreadable)
    return missed, lost, doubled


def _last_due(r: Rehearsal, n: int, rows: NDArray[np.float64]) -> float:
    """Clock time after which reactor `n` owes no row: its schedule was over, or it was given up; inf if neither."""
    if r.loop.done[n]:
        return r.spans[0][0] + 60.0 * float(r.loop.began[n] + r.loop.progress.totals[n])
    return float(rows[-1]) if r.loop.stopped[n] and rows.size else math.inf


def fed_by(rows: Iterable[Mapping[str, Any]]) -> set[str]:
    """The pumps that the intents among some rows of a journal feed by, and the feed pump."""
    return {"Pump1"} | {str(row["feed_pump"]) for row in rows if row["kind"] == "intent" and "feed_pump" in row}


def audit_doses(journal: Sequence[Mapping[str, Any]], doses: Sequence[Dose], name: str, zero: float) -> tuple[int, int]:
    """Runs of the motors that intents name against the intents of a journal: (doubled, repeated by the device).

    A run belongs to the newest intent before it. A second one for the same intent is the device's own repetition if it
    begins a pump period after the one before, else it is a doubled dose; so are two intents for one sample.

    Args: journal: rows; doses: of this reactor's pumps; name: of the reactor; zero: device time of run time 0, s.
    """
    experiment, samples, intents = "", [], []
    for row in journal:
        if row.get("reactor") == name and row["kind"] == "device":
            experiment = row["start_time"]  # a device that lost its memory counts samples from 0 again
        elif row.get("reactor") == name and row["kind"] == "intent":
            intents.append(row)
            samples.append((experiment, *row["sample"]))
    doubled = sum(a == b for a, b in itertools.pairwise(samples))
    starts = np.array([float(row["on_s"]) + zero for row in intents if row["feed_ml"] > 0.0])
    repeats, feeding = 0, fed_by(intents)
    before: dict[int, float] = {}
    for dose in doses:
        if dose.pump not in feeding:
            continue
        k = int(np.searchsorted(starts, dose.start_s)) - 1
        if k < 0 or k in before:
            low, high = DEVICE_PERIOD_S
            own = k >= 0 and low <= dose.start_s - before[k] <= high
            repeats, doubled = repeats + own, doubled + (not own)
        before[k] = dose.start_s
    return doubled, repeats
