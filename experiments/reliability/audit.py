"""What a run recorded against what the emulated device did: samples and rows, doses and intents."""

import itertools
import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from experiments.reliability.rehearsal import Rehearsal
from hardware.emulator.vial import Dose, Sample

__all__ = ["SEEN_S", "audit_doses", "audit_rows"]

DEVICE_PERIOD_S = (60.0, 68.0)  # a pump left on repeats its dose so often
SEEN_S = 75.0  # a row's time is that of the arrival of its sample, at most so long after it was stored


def audit_rows(
    r: Rehearsal, dark: tuple[float, float] | None = None, samples: Mapping[str, Sequence[Sample]] | None = None
) -> tuple[int, int, int]:
    """Samples of the device against rows of the recordings: (missed, lost, doubled).

    Args:
      dark: clock times between which samples could not be read; those are missed, not lost.
      samples: of each reactor; None takes those that the device still remembers.
    """
    missed = lost = doubled = 0
    zero = r.spans[0][0]
    times = r.record.series("time_min") * 60.0 + zero
    for n, name in enumerate(r.names):
        rows = times[n, : len(r.record.rows[n])]
        doubled += int((np.diff(rows) <= 0.0).sum())
        over = bool(r.loop.done[n] or r.loop.stopped[n])
        end = rows[-1] if over and rows.size else math.inf
        for sample in r.device.vials[name].samples if samples is None else samples[name]:
            at = sample.stored_s
            alive = any(start + 30.0 <= at <= stop - 5.0 for start, stop in r.spans)
            if not alive or at > end:
                continue
            k = int(np.searchsorted(rows, at))
            if k == rows.size or rows[k] >= at + SEEN_S:
                if dark is not None and dark[0] - SEEN_S <= at <= dark[1]:
                    missed += 1
                else:
                    lost += 1
    return missed, lost, doubled


def audit_doses(journal: Sequence[Mapping[str, Any]], doses: Sequence[Dose], name: str, zero: float) -> tuple[int, int]:
    """Runs of a feed motor against the intents of a journal: (doubled, repeated by the device).

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
    repeats = 0
    before: dict[int, float] = {}
    for dose in doses:
        if dose.pump != "Pump1":
            continue
        k = int(np.searchsorted(starts, dose.start_s)) - 1
        if k < 0 or k in before:
            low, high = DEVICE_PERIOD_S
            own = k >= 0 and low <= dose.start_s - before[k] <= high
            repeats, doubled = repeats + own, doubled + (not own)
        before[k] = dose.start_s
    return doubled, repeats
