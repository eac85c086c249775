"""Where the numbers of a run go for looking at: TensorBoard events, and a CSV of the same scalars.

TensorBoard's own event writer is used, so that a bench without torch can show a run live.
"""

from __future__ import annotations

import csv
import time
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from tensorboard.compat.proto.event_pb2 import Event, SessionLog
from tensorboard.compat.proto.summary_pb2 import Summary
from tensorboard.plugins.hparams import summary_v2
from tensorboard.summary.writer.event_file_writer import EventFileWriter

__all__ = ["Events", "PopulationWriter", "interquartile_mean"]

MOST_CURVES = 64  # a population larger than this gets its statistics only


class Events:
    """TensorBoard events of one run.

    Args:
      folder: where the event file goes.
      first_step: on resume, events of an earlier life at this step and later are hidden.
    """

    def __init__(self, folder: Path, first_step: int = 0) -> None:
        self._writer = EventFileWriter(str(folder))
        if first_step:
            self._writer.add_event(
                Event(step=first_step, wall_time=time.time(), session_log=SessionLog(status=SessionLog.START))
            )

    def _add(self, summary: Summary, step: int) -> None:
        self._writer.add_event(Event(step=step, wall_time=time.time(), summary=summary))

    def scalar(self, tag: str, value: float, step: int) -> None:
        """One point of a curve."""
        self._add(Summary(value=[Summary.Value(tag=tag, simple_value=value)]), step)

    def picture(self, tag: str, png: Path, step: int) -> None:
        """A PNG file under TensorBoard's images. Raises: OSError for one that cannot be read."""
        image = Summary.Image(encoded_image_string=png.read_bytes(), colorspace=3, height=1, width=1)
        self._add(Summary(value=[Summary.Value(tag=tag, image=image)]), step)

    def hyper_parameters(self, values: Mapping[str, float | str | bool], metrics: Sequence[str]) -> None:
        """A row of TensorBoard's HPARAMS table; the metrics are the last values of these scalar tags."""
        keys = [summary_v2.HParam(name) for name in values]
        self._add(summary_v2.hparams_config_pb(keys, [summary_v2.Metric(tag) for tag in metrics]), 0)
        self._add(summary_v2.hparams_pb(dict(values)), 0)

    def flush(self) -> None:
        """Make everything so far visible to a reader."""
        self._writer.flush()

    def close(self) -> None:
        """Flush and close. Idempotent."""
        self._writer.close()


def interquartile_mean(values: NDArray[np.float64]) -> float:
    """Mean of the middle half (Agarwal 2021); robust like the median, and smoother over few seeds."""
    finite = np.sort(values[np.isfinite(values)])
    cut = finite.size // 4
    return float(finite[cut : finite.size - cut].mean()) if finite.size else float("nan")


class PopulationWriter:
    """Scalars of S agents: each agent's curve as a run of its own, and the population's statistics.

    One agent: tags stand in the run folder itself. Several: `agents/seedNNNN/` hold the single curves, and the run
    folder has tag/iqm, tag/min and tag/max over seeds. Every value is also a row of progress.csv.

    Args: folder: run folder. seeds: of the agents. first_step: step of the checkpoint a run is resumed from, or 0.
    """

    def __init__(self, folder: Path, seeds: Sequence[int], first_step: int = 0) -> None:
        purge = first_step + 1 if first_step else 0
        self.events = Events(folder, purge)
        singles = seeds if 1 < len(seeds) <= MOST_CURVES else []
        self._agents = [Events(folder / "agents" / f"seed{seed:04d}", purge) for seed in singles]
        self._seeds = list(seeds)
        self._path = folder / "progress.csv"
        kept = self._rows_until(first_step) if first_step else []
        self._file = open(self._path, "w", newline="", encoding="utf-8")  # noqa: SIM115  (closed in close)
        self._csv = csv.writer(self._file)
        self._csv.writerow(["step", "seed", "tag", "value"])
        self._csv.writerows(kept)

    def _rows_until(self, step: int) -> list[list[str]]:
        """Rows of an earlier life that belong to steps already in the checkpoint."""
        if not self._path.is_file():
            return []
        with open(self._path, newline="", encoding="utf-8") as f:
            rows = list(csv.reader(f))[1:]
        return [row for row in rows if len(row) == 4 and row[0].isdigit() and int(row[0]) <= step]

    def scalars(self, step: int, values: Mapping[str, NDArray[np.float64] | float]) -> None:
        """Write tag -> value at an environment step; arrays have one entry per agent."""
        for tag, value in values.items():
            each = np.atleast_1d(np.asarray(value, dtype=np.float64))
            if not np.isfinite(each).any():
                continue
            if each.size == 1:
                self.events.scalar(tag, float(each[0]), step)
            else:
                self.events.scalar(f"{tag}/iqm", interquartile_mean(each), step)
                self.events.scalar(f"{tag}/min", float(np.nanmin(each)), step)
                self.events.scalar(f"{tag}/max", float(np.nanmax(each)), step)
                for events, v in zip(self._agents, each, strict=False):
                    events.scalar(tag, float(v), step)
            names: Sequence[int | str] = self._seeds if each.size == len(self._seeds) else ["all"]
            self._csv.writerows([step, name, tag, repr(float(v))] for name, v in zip(names, each, strict=True))

    def flush(self) -> None:
        """Make everything so far visible to a reader."""
        self._file.flush()
        for events in (self.events, *self._agents):
            events.flush()

    def close(self) -> None:
        """Flush and close. Idempotent."""
        self._file.close()
        for events in (self.events, *self._agents):
            events.close()
