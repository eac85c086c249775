"""Figure of a certificate: polygons of the policy, bands, entry times, and doses below the setpoint."""

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import PolyCollection
from matplotlib.figure import Figure

from experiments.certification.judge import PERFORMANCE, SAFETY, Certificate
from experiments.reporting.charts import COLOURS, new_figure


def figure(found: Certificate) -> Figure:
    """Draw four panels over the setpoint (or the growth share)."""
    made, (polygons, widths, entries, doses) = new_figure(11.0, 7.0, 2, 2)
    _polygons(polygons, found)
    asked = found.question
    middle = (asked.loop.low + asked.loop.high) / 2.0
    for k, proof in enumerate(p for p in found.proofs if p.case.name in asked.drawn):
        colour, name = COLOURS[k % len(COLOURS)], proof.case.name
        shown = np.where(proof.holdable, 1.0, np.nan)
        widths.plot(middle, shown * proof.half_width, color=colour, linewidth=1.3, label=name)
        widths.plot(middle, shown * proof.law_half_width, color=colour, linewidth=0.9, linestyle=":")
        entries.plot(middle, shown * (proof.later if asked.late else proof.entry), color=colour, linewidth=1.3)
    widths.set(xlabel=asked.what, ylabel=f"half-width, {asked.unit}", ylim=(0.0, None))
    widths.set_title("Band that the loop enters and never leaves (dotted: the one-line controller)")
    if np.isfinite(widths.dataLim.intervaly).all():  # else there is no band to draw
        widths.set(yscale="log", ylim=(0.7 * widths.dataLim.y0, 8.0 * widths.dataLim.y1))
    widths.legend(ncols=2, fontsize=7, loc="upper right")
    what = "periods after the one-line controller" if asked.late else "entry time over the pump's own"
    entries.set(xlabel=asked.what, ylabel=what)
    entries.set_title("Time into the band, from anywhere in the range of starts")
    for colour, level, depth in zip(COLOURS, found.levels, found.doses, strict=False):
        doses.plot(middle, depth, color=colour, linewidth=1.3, label=f"action {level} and higher")
    doses.set(xlabel=asked.what, ylabel="periods of growth", ylim=(0, None))
    doses.set_title("Largest distance below the setpoint with a dose")
    doses.legend()
    if failed := found.failed(SAFETY) or found.failed(PERFORMANCE):
        said = "Safe, but performance falls short" if found.safe else "Not safe"
        made.suptitle(f"{said}: {len(failed)} of {len(found.checks)} requirements fail, first {failed[0].name}")
    return made


def _polygons(ax: Axes, found: Certificate) -> None:
    regions = found.regions
    first = np.unique(regions.owner, return_index=True)[1]
    corners = np.split(regions.edges[:, 0], first[1:])
    drawn = PolyCollection([np.asarray(c) for c in corners], cmap="viridis", edgecolor="face", linewidth=0.2)
    drawn.set_array(regions.action.astype(np.float64))
    drawn.set_rasterized(True)
    ax.add_collection(drawn)
    (x0, x1), (y0, y1) = found.question.box
    ax.set(xlim=(x0, x1), ylim=(y0, y1), ylabel=found.question.what)
    ax.set_xlabel("reading, OD" if found.question.bounds is None else "estimate of e")
    ax.set_title(f"{len(corners)} polygons, coloured by action")
    ax.grid(False)
