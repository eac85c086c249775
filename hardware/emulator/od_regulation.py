"""The device's own regulation of optical density, as arithmetic on sysData (docs/device.md, Regulation)."""

from __future__ import annotations

import math
from typing import Any

from hardware.emulator.computer import AppError

__all__ = ["feed_duty", "zigzag"]


def feed_duty(data: dict[str, Any]) -> float:
    """Duty of the feed pump before clipping: P on ln(x / r) per minute, two integrators, none after a jump up.

    `data` is sysData with at least two records and a volume; OD.Integral and OD.Integral2 are updated.
    """
    od, times = data["OD"], data["time"]["record"]
    now, before = od["current"], od["record"][-1]
    target = od["target"] if od["target"] > 0 else 1e-6
    minutes = (times[-1] - times[-2]) / 60.0
    growth = math.log(now / target) / minutes if now > 0 and minutes != 0 else 0.0
    feed = growth / (240.0 / data["Volume"]["target"])
    error, change = now - target, now - before
    if error < 0.01:
        od["Integral"] = 0
    elif abs(change) < 0.05 and error > 0.025:
        od["Integral"] += 0.1 * error
    if abs(error) > 0.1 and abs(change) < 0.05:
        od["Integral2"] = 0
    elif abs(change) < 0.1:
        od["Integral2"] += 0.01 * error
        feed *= 0.7
    return 0.0 if change > 0.04 else float(feed + od["Integral"] + od["Integral2"])


def zigzag(data: dict[str, Any]) -> None:
    """Swing OD.target about its centre; estimate growth (1/h) while nothing is pumped.

    Raises: AppError for an OD of 0 or less, of which the device takes the logarithm.
    """
    state = data["Zigzag"]
    centre, now, zig = data["OD"]["target"], data["OD"]["current"], state["Zig"]
    cycles = data["Experiment"]["cycles"]
    last = data["OD"]["record"][-1] if data["OD"]["record"] else now
    if now < centre - zig and last < centre:
        if state["target"] != 5.0:
            state["SwitchPoint"] = cycles
        state["target"] = 5.0
    elif now > centre + zig and last > centre + zig:
        state["target"], state["SwitchPoint"] = centre - 1.5 * zig, cycles
    data["OD"]["target"] = state["target"]
    if cycles > 6 and cycles - state["SwitchPoint"] > 5:
        if not (now > 0 and last > 0):
            raise AppError("logarithm of an OD of 0 or less")
        growth = 60.0 * math.log(now / last)
        data["GrowthRate"]["current"] = 0.95 * data["GrowthRate"]["current"] + 0.05 * growth
