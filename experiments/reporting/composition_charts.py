"""Pictures of the composition of two species: a run that controlled it, and episodes of a training."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from experiments.reporting.charts import COLOURS, new_figure

__all__ = ["composition_figure", "episodes"]

Array = NDArray[np.float64]
Columns = Mapping[str, Array]


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


def composition_figure(columns: Columns, names: Sequence[str], title: str = "") -> Figure:
    """Share with its setpoint and the estimate's 95 % band, temperature with its target, OD, fluorescence.

    Args:
      columns: of the recordings, (N, K) each, nan where a reactor has no sample: time_min, ratio, ratio_low,
        ratio_high, ratio_setpoint, temperature_degc, temperature_target_degc, od, setpoint, fluorescence; true_ratio
        where it is known. names: N labels.
    """
    figure, axes = new_figure(8.0, 8.0, 4, 1, sharex=True, height_ratios=[2.2, 1.2, 1.0, 1.0])
    share, heat, density, light = axes
    for n, name in enumerate(names):
        own, colour = {key: values[n] for key, values in columns.items()}, COLOURS[n % len(COLOURS)]
        hours = own["time_min"] / 60.0
        dashed: dict[str, Any] = {"color": "black" if n == 0 else colour, "linewidth": 0.9, "linestyle": "--"}
        share.fill_between(hours, own["ratio_low"], own["ratio_high"], color=colour, alpha=0.2, linewidth=0)
        share.plot(hours, own["ratio"], color=colour, linewidth=1.2, label=f"{name}, estimate and 95 % band")
        if "true_ratio" in own:
            label = "truth" if n == 0 else None
            share.plot(hours, own["true_ratio"], color="black", linewidth=0.9, linestyle=":", label=label)
        share.step(hours, own["ratio_setpoint"], where="post", label="setpoint" if n == 0 else None, **dashed)
        heat.plot(hours, own["temperature_degc"], color=colour, linewidth=1.0, label="vial" if n == 0 else None)
        target = own["temperature_target_degc"]
        heat.step(hours, target, where="post", label="thermostat" if n == 0 else None, **dashed)
        density.plot(hours, own["od"], color=colour, linewidth=0.8)
        density.step(hours, own["setpoint"], where="post", **dashed)
        light.plot(hours, own["fluorescence"], color=colour, linewidth=0.8)
    share.set(ylabel="share of the second species", ylim=(0.0, 1.0))
    share.set_title(title)
    share.legend(ncols=2)
    heat.set_ylabel("temperature, °C")
    heat.legend(ncols=2)
    density.set_ylabel("OD")
    light.set(ylabel="fluorescence, counts", xlabel="time, h")
    return figure
