"""The figure of a run that controlled a composition."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from experiments.reporting.charts import COLOURS, new_figure

__all__ = ["composition_figure"]

Array = NDArray[np.float64]
Columns = Mapping[str, Array]


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
