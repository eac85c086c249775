"""The figure of two species: growth and pigment against temperature."""

from collections.abc import Sequence

import numpy as np
from matplotlib.figure import Figure

from envs.coculture.pair import PairConfig
from envs.identification.curves import Plateau
from experiments.reporting.charts import COLOURS, new_figure

__all__ = ["pair_figure"]


def pair_figure(pair: PairConfig, points: Sequence[Sequence[Plateau]]) -> Figure:
    """Both curves with what was recorded and its 95 % intervals, where they cross, and production of pigment."""
    figure, (growth, pigment) = new_figure(7.5, 6.0, 2, 1, sharex=True, height_ratios=[2.0, 1.0])
    t = np.linspace(*pair.temperatures, 141)
    for k, (species, mine) in enumerate(zip((pair.first, pair.second), points, strict=True)):
        growth.plot(t, pair.rates(t)[:, k], color=COLOURS[k], label=species.name)
        at, value = [p.temperature for p in mine], [p.growth.value for p in mine]
        sides = [[p.growth.value - p.growth.low for p in mine], [p.growth.high - p.growth.value for p in mine]]
        growth.errorbar(at, value, sides, linestyle="", marker="o", markersize=4.0, capsize=3.0, color=COLOURS[k])
    even = pair.even_c
    growth.axvline(even, color="black", linewidth=0.8, linestyle=":", label=f"alike at {even:.2f} °C")
    growth.set(ylabel="growth rate, 1/h", ylim=(0.0, None))
    growth.legend()
    pigment.plot(t, pair.production(t), color=COLOURS[1])
    pigment.set(ylabel="pigment, counts\nper hour and OD", xlabel="temperature, °C", ylim=(0.0, None))
    return figure
