"""Where records of a training go: TensorBoard events and a CSV that survives a crash."""

from __future__ import annotations

import csv
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray
from torch.utils.tensorboard import SummaryWriter
from torch.utils.tensorboard.summary import hparams

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = ["PopulationWriter", "interquartile_mean"]

MOST_CURVES = 64  # a population larger than this gets its statistics only


def interquartile_mean(values: NDArray[np.float64]) -> float:
    """Mean of the middle half (Agarwal 2021); robust like the median, and smoother over few seeds."""
    finite = np.sort(values[np.isfinite(values)])
    cut = finite.size // 4
    return float(finite[cut : finite.size - cut].mean()) if finite.size else float("nan")


class PopulationWriter:
    """Scalars of S agents: each agent's curve as a run of its own, and the population's statistics.

    One agent: tags stand in the run folder itself. Several: `agents/seedNNNN/` hold the single curves, and the run
    folder has tag/iqm, tag/min and tag/max over seeds. Every row is also appended to progress.csv.

    Args:
      folder: run folder. seeds: of the agents. first_step: on resume, later events of an earlier life are dropped.
    """

    def __init__(self, folder: Path, seeds: Sequence[int], first_step: int = 0) -> None:
        purge = first_step + 1 if first_step else None
        self.summary = SummaryWriter(str(folder), purge_step=purge)
        singles = seeds if 1 < len(seeds) <= MOST_CURVES else []
        self._agents = [SummaryWriter(str(folder / "agents" / f"seed{seed:04d}"), purge_step=purge) for seed in singles]
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
                self.summary.add_scalar(tag, each[0], step)
            else:
                self.summary.add_scalar(f"{tag}/iqm", interquartile_mean(each), step)
                self.summary.add_scalar(f"{tag}/min", np.nanmin(each), step)
                self.summary.add_scalar(f"{tag}/max", np.nanmax(each), step)
                for writer, v in zip(self._agents, each, strict=False):
                    writer.add_scalar(tag, v, step)
            names: Sequence[int | str] = self._seeds if each.size == len(self._seeds) else ["all"]
            self._csv.writerows([step, name, tag, repr(float(v))] for name, v in zip(names, each, strict=True))

    def figure(self, tag: str, figure: Figure, step: int) -> None:
        """Show a figure under TensorBoard's images."""
        figure.canvas.draw()
        pixels = np.asarray(figure.canvas.buffer_rgba())[..., :3]  # type: ignore[attr-defined]
        self.summary.add_image(tag, pixels, step, dataformats="HWC")

    def hyper_parameters(self, values: Mapping[str, float | str | bool], metrics: Mapping[str, float]) -> None:
        """A row of TensorBoard's HPARAMS table, in this run and not in a sub-run."""
        for event in hparams(dict(values), dict(metrics)):  # type: ignore[no-untyped-call]
            self.summary._get_file_writer().add_summary(event)  # type: ignore[no-untyped-call]

    def flush(self) -> None:
        """Make everything so far visible to a reader."""
        self._file.flush()
        for writer in (self.summary, *self._agents):
            writer.flush()

    def close(self) -> None:
        """Flush and close. Idempotent."""
        self._file.close()
        for writer in (self.summary, *self._agents):
            writer.close()
