"""Pictures of the composition of two species."""

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from experiments.reporting.charts import COLOURS, new_figure

__all__ = ["episodes"]

Array = NDArray[np.float64]


def episodes(
    hours: Array, wanted: Array, learned: Array, best: Array, temperature: Array, best_temperature: Array
) -> Figure:
    """Noise-free episodes, a column each: share with setpoint and optimum, temperatures chosen.

    Args: hours: (K,). wanted, learned, best: shares, (K, G). temperature, best_temperature: targets, degC, (K, G).
    """
    columns = wanted.shape[1]
    figure, axes = new_figure(2.6 * columns, 4.6, 2, columns, sharex=True, sharey="row", height_ratios=[2, 1])
    for g in range(columns):
        top, bottom = axes[g], axes[columns + g]
        top.step(hours, wanted[:, g], where="pre", color="black", linewidth=1.0, linestyle="--", label="setpoint")
        top.plot(hours, learned[:, g], color=COLOURS[0], linewidth=1.5, label="learned")
        top.plot(hours, best[:, g], color=COLOURS[1], linewidth=1.0, label="optimum")
        bottom.step(hours, temperature[:, g], where="pre", color=COLOURS[0], linewidth=1.2)
        bottom.step(hours, best_temperature[:, g], where="pre", color=COLOURS[1], linewidth=0.8)
        bottom.set_xlabel("hours")
    axes[0].set(ylabel="share of P. putida", ylim=(0.0, 1.0))
    axes[0].legend()
    axes[columns].set_ylabel("thermostat, \N{DEGREE SIGN}C")
    return figure
