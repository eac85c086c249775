"""Whether intervals of mu and tau hold what they promise, at any length: `python -m tests.studies.intervals`.

Recordings of two simulators that share no code, calibrated as one from a device would be: six laws of pumping, three
lengths, growth that wanders by little and by much, doses that spread by 10 %.
"""

import logging
from concurrent.futures import Future
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from conf.schema import check, setting
from envs.identification.calibration import IdentifyConfig
from envs.identification.open_loop import OpenLoop
from experiments.calibration.config import CalibrateConfig
from experiments.calibration.study import against_truth, fitted, simulated
from experiments.cli import files
from experiments.cli.stop import Workers
from tests.entry import command
from tests.studies.results import leave
from tests.studies.second_simulator import Conditions, simulate

__all__ = ["IntervalsConfig", "intervals", "main"]

log = logging.getLogger(__name__)

LAWS = ("pi", "tuned_pi", "threshold", "proportional", "setpoint_steps", "open_loop")
WORDS = dict(
    zip(LAWS, ("device's PI", "tuned PI", "threshold", "proportional", "setpoint steps", "open loop"), strict=True)
)
SIMULATORS = ("own", "second")
LONG_H = 72.0  # from which on fewer recordings are drawn
COLUMNS = ("controller", "h", "wander", "accepted", "hold, %", "bias, %", "half width, %", "wrong, %")


@dataclass(frozen=True)
class IntervalsConfig:
    """Which recordings, and how many of each."""

    recordings: int = setting(200, "of each law, length and wander", within=(2, 10000))
    few: int = setting(50, f"of those of {LONG_H:g} h and more", within=(2, 10000))
    laws: tuple[str, ...] = setting(LAWS, "what moves the pump", choices=LAWS)
    hours: tuple[float, ...] = setting((6.0, 24.0, 72.0), "lengths", "h", within=(1, 100), some=True)
    wander: tuple[float, ...] = setting((0.05, 0.1), "sd of growth over mu", within=(0, 0.5), some=True)
    simulators: tuple[str, ...] = setting(SIMULATORS, "whose recordings", choices=SIMULATORS, some=True)
    workers: int = setting(0, "processes; 0 for one per core", within=(0, 256))
    seed: int = setting(1, "of the recordings", at_least=0)

    def __post_init__(self) -> None:
        check(self)


def one(law: str, hours: float, wander: float, n: int, seed: int, simulator: str) -> dict[str, Any]:
    """n recordings of one kind against their truth."""
    if simulator == "second":
        r = simulate(Conditions(law=law, hours=hours, wander=wander), n, seed)
        return against_truth(fitted(r.time, r.od, r.pump_rate, IdentifyConfig()), r.growth, r.tau)
    truth = OpenLoop(mu=0.03, tau=1.0 / 3.0, hours=hours, growth_cv=wander, dose_cv=0.1, seed=seed)
    config = CalibrateConfig(protocol=truth)
    if law != "open_loop":
        names = {"tuned_pi": "pi_tuned", "setpoint_steps": "pi"}
        setpoints = (0.8, 0.65, 0.5) if law == "setpoint_steps" else (0.5,)
        start = replace(truth, start_od=setpoints[0])
        config = replace(config, law=names.get(law, law), setpoints=setpoints, protocol=start)
    time, od, pump_rate, growth = simulated(config, n)
    return against_truth(fitted(time, od, pump_rate, config.identify), growth, np.full(n, truth.tau))


def intervals(config: IntervalsConfig, folder: Path) -> None:
    """All of them, in processes; a table for each simulator, as soon as it is complete."""
    kinds = [
        (law, hours, wander, config.few if hours >= LONG_H else config.recordings, config.seed, simulator)
        for simulator in config.simulators
        for law in config.laws
        for hours in config.hours
        for wander in config.wander
    ]
    with Workers(config.workers) as pool:
        waiting: list[Future[dict[str, Any]]] = [pool.submit(one, *kind) for kind in kinds]
        found: list[dict[str, Any]] = []
        rows: dict[str, list[tuple[str, ...]]] = {simulator: [] for simulator in config.simulators}
        for kind, future in zip(kinds, waiting, strict=True):
            found.append(future.result())
            rows[kind[5]].append(row(kind[:3], found[-1]))
            log.info("%s, %s: %s", kind[5], ", ".join(map(str, kind[:4])), " | ".join(rows[kind[5]][-1][3:]))
            leave(folder, __file__, COLUMNS, rows[kind[5]], kind[5])
    files.write_json(folder / "summary.json", {"kinds": kinds, "found": found})


def row(kind: tuple[str, float, float], numbers: dict[str, Any]) -> tuple[str, ...]:
    """A line of the table; mu / tau where there are two figures."""
    law, hours, wander = kind
    accepted = numbers["recordings"] - numbers["refused"]
    cells: tuple[str, ...] = ("–",) * 3
    if accepted:
        form = {"coverage_pct": "{:.1f}", "median_bias_pct": "{:+.1f}", "relative_half_width_pct": "{:.1f}"}
        cells = tuple(" / ".join(text.format(numbers[key][p]) for p in ("mu", "tau")) for key, text in form.items())
    share = f"{accepted} of {numbers['recordings']}"
    return (WORDS[law], f"{hours:g}", f"{100 * wander:g} %", share, *cells, f"{numbers['wrong_pct']:.1f}")


main = command(__file__, IntervalsConfig(), intervals)


if __name__ == "__main__":
    main()
