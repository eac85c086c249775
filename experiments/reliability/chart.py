"""The figure of the fault matrix."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure

from experiments.reliability.outcome import Outcome
from experiments.reporting.charts import COLOURS, new_figure

__all__ = ["fault_map"]


def fault_map(outcomes: Sequence[Outcome], moments: Sequence[str]) -> Figure:
    """Fault by moment: time until it was reported (number, min) over the largest OD error it caused (colour).

    A dash means that it was not reported; a frame, that the case did not go as declared.
    """
    names = list(dict.fromkeys(o.label for o in outcomes))
    error = np.full((len(names), len(moments)), np.nan)
    figure, (ax,) = new_figure(3.6 + 1.1 * len(moments), 1.2 + 0.2 * len(names))
    ax.grid(False)
    for o in outcomes:
        row, column = names.index(o.label), list(moments).index(o.moment)
        error[row, column] = max(o.peak_error, 0.01)
        text = f"{o.detected_s / 60.0:.1f}" if math.isfinite(o.detected_s) else "–"
        dark = o.peak_error > 0.4
        ax.text(column, row, text, ha="center", va="center", fontsize=6, color="white" if dark else "black")
        if not o.ok:
            ax.plot(column, row, marker="s", markersize=14, markerfacecolor="none", markeredgecolor=COLOURS[1])
    image = ax.imshow(error, norm=LogNorm(0.02, 2.0), cmap="cividis_r", aspect="auto")
    ax.set_xticks(range(len(moments)), list(moments), fontsize=8)
    ax.set_yticks(range(len(names)), names, fontsize=7)
    ax.set_title("minutes until reported (–: not reported)", fontsize=9)
    bar = figure.colorbar(image, ax=ax, shrink=0.4, extend="both")
    bar.set_label("largest OD error of the culture", fontsize=8)
    return figure
