"""Figures of two species: growth curves, a run that controls the composition, and episodes of a training."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from envs.coculture.pair import PairConfig
from envs.identification.curves import Plateau
from envs.scenario import Scenario
from experiments.coculture.program import program_of
from experiments.record.record import Recordings
from experiments.reporting.charts import COLOURS, new_figure

Array = NDArray[np.float64]


def episodes(
    hours: Array,
    wanted: Array,
    learned: Array,
    best: Array,
    temperature: Array,
    best_temperature: Array,
    species: str,
) -> Figure:
    """Draw noise-free episodes of policy and optimum, one column each: share with setpoint, and thermostat targets.

    Args: hours: (K,). wanted, learned, best: setpoint, share of the policy, share of the optimum, (K, G).
      temperature, best_temperature: targets of policy and optimum, degC, (K, G). species: name of the second species.
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
    axes[0].set(ylabel=f"share of {species}", ylim=(0.0, 1.0))
    axes[0].legend()
    axes[columns].set_ylabel("thermostat, \N{DEGREE SIGN}C")
    return figure


def composition_figure_of(table: Recordings, scenarios: Sequence[Scenario], species: str, title: str) -> Figure:
    """Draw a run: share with setpoint and 95 % band, temperature, OD, pump rate and fluorescence."""
    figure, axes = new_figure(8.0, 9.0, 5, 1, sharex=True, height_ratios=[2.4, 1.2, 1.0, 0.8, 1.0])
    share, heat, density, pump, light = axes
    columns = {**table.columns, "od": table.od(), "setpoint": table.setpoints()}
    any_counted = False
    for n, (name, scenario) in enumerate(zip(table.names, scenarios, strict=True)):
        own, colour = {key: values[n] for key, values in columns.items()}, COLOURS[n % len(COLOURS)]
        hours = own["time_min"] / 60.0
        dashed: dict[str, Any] = {"color": "black" if n == 0 else colour, "linewidth": 0.9, "linestyle": "--"}
        share.fill_between(hours, own["ratio_low"], own["ratio_high"], color=colour, alpha=0.2, linewidth=0)
        share.plot(hours, own["ratio"], color=colour, linewidth=1.2, label=f"{name}, estimate and 95 % band")
        if "true_ratio" in own:
            label = "truth" if n == 0 else None
            share.plot(hours, own["true_ratio"], color="black", linewidth=0.9, linestyle=":", label=label)
        share.step(hours, own["ratio_setpoint"], where="post", label="setpoint" if n == 0 else None, **dashed)
        at, to = _announced(own, scenario)
        label = "next setpoint, when announced" if at.size and n == 0 else None
        share.plot(at / 60.0, to, linestyle="", marker=">", markersize=6.0, color=dashed["color"], label=label)
        mine = [(m.time_min, m.share, m.sd) for m in table.marks if m.reactor == name and m.share is not None]
        at, found, sd = np.array(mine, dtype=np.float64).reshape(-1, 3).T
        share.errorbar(
            at / 60.0, found, 1.96 * sd, linestyle="", marker="s", markersize=4.0, capsize=3.0, color=colour,
            markeredgecolor="black", ecolor="black", label="counted, 95 %" if at.size and not any_counted else None,
        )  # fmt: skip
        any_counted |= at.size > 0
        heat.plot(hours, own["temperature_degc"], color=colour, linewidth=1.0, label="vial" if n == 0 else None)
        target = own["temperature_target_degc"]
        heat.step(hours, target, where="post", label="thermostat" if n == 0 else None, **dashed)
        density.plot(hours, own["od"], color=colour, linewidth=0.8)
        density.step(hours, own["setpoint"], where="post", **dashed)
        pump.step(hours, 1000.0 * own["pump_rate_ml_s"], where="post", color=colour, linewidth=0.8)
        light.plot(hours, own["fluorescence"], color=colour, linewidth=0.8)
    share.set(ylabel=f"share of {species}", ylim=(0.0, 1.0))
    share.set_title(title)
    share.legend(ncols=2)
    heat.set_ylabel("temperature, °C")
    heat.legend(ncols=2)
    density.set_ylabel("OD")
    pump.set_ylabel("pump rate,\nµL/s")
    light.set(ylabel="fluorescence,\ncounts", xlabel="time, h")
    return figure


def _announced(own: Mapping[str, Array], scenario: Scenario) -> tuple[Array, Array]:
    """Return minutes and setpoints of the announcements in a reactor's run, up to its last sample."""
    began = np.nanmin(own["time_min"] - own["elapsed_min"], initial=np.inf)
    minute, share = program_of(scenario).announcements(scenario.announced_min)
    known = minute + began <= np.nanmax(own["time_min"], initial=-np.inf)
    return minute[known] + began, share[known]


def pair_figure(pair: PairConfig, points: Sequence[Sequence[Plateau]]) -> Figure:
    """Draw both growth curves with measured rates and 95 % intervals, their crossing, and the pigment production."""
    figure, (growth, pigment) = new_figure(7.5, 6.0, 2, 1, sharex=True, height_ratios=[2.0, 1.0])
    t = np.linspace(*pair.temperatures, 141)
    for k, (species, mine) in enumerate(zip((pair.first, pair.second), points, strict=True)):
        growth.plot(t, pair.rates(t)[:, k], color=COLOURS[k], label=species.name)
        at, value = [p.temperature for p in mine], [p.growth.value for p in mine]
        sides = [[p.growth.value - p.growth.low for p in mine], [p.growth.high - p.growth.value for p in mine]]
        growth.errorbar(at, value, sides, linestyle="", marker="o", markersize=4.0, capsize=3.0, color=COLOURS[k])
    even = pair.even_c
    growth.axvline(even, color="black", linewidth=0.8, linestyle=":", label=f"equal growth at {even:.2f} °C")
    growth.set(ylabel="growth rate, 1/h", ylim=(0.0, None))
    growth.legend()
    pigment.plot(t, pair.production(t), color=COLOURS[1])
    pigment.set(ylabel="pigment, counts\nper hour and OD", xlabel="temperature, °C", ylim=(0.0, None))
    return figure
