"""Every fault at every moment of a run, in virtual time: `python -m tests.campaigns.faults`."""

import logging
import math
import time
from concurrent.futures import as_completed
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from tqdm import tqdm
from tqdm.contrib.logging import logging_redirect_tqdm

from conf.schema import check, part, require, setting
from envs.scenario import Scenario
from experiments.cli import files, frame
from experiments.cli.stop import Workers
from experiments.controllers.registry import on_device
from hardware.chibio.overflow_pump import OverflowPumpConfig
from hardware.safety.config import SafetyConfig
from tests.campaigns.chibio_case import MOMENTS, FaultCase
from tests.campaigns.chibio_faults import FAULTY, by_name
from tests.campaigns.outcome import Outcome, declared, table, totals, write_cases
from tests.campaigns.rehearsal import rehearsed
from tests.entry import command

__all__ = ["FaultMatrixConfig", "fault_matrix"]

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class FaultMatrixConfig:
    """Which faults to try, and when. Raises: ValueError naming key, value and allowed range.

    Faults that overflow without an overflow pump are run on a rig without as well. Without a pump everything is run on
    that rig, and its own faults are left out. Healthy runs have no sensor outliers.
    """

    reactors: tuple[str, ...] = setting(("M0", "M1"), "the first falls sick, the others are its neighbours", some=True)
    scenario: Scenario = part(
        lambda: Scenario((0.8, 0.65, 0.5), (30.0, 30.0, 30.0), (37.0, 37.0, 37.0), 0.8), "of every run"
    )
    safety: SafetyConfig = part(SafetyConfig, "limits of the interlock")
    controller_kind: str = setting("dqn", "a controller that can run a device; dqn is the policy that ships")
    overflow_pump: OverflowPumpConfig = part(lambda: OverflowPumpConfig("Pump3", 0.95, 1.2), "of the rig")
    faults: tuple[str, ...] = setting((), "names, as in docs/faults.md; empty: all")
    moments: tuple[str, ...] = setting(
        MOMENTS, "recovery; steady at the first setpoint; after the step; feed pump running", choices=MOMENTS, some=True
    )
    controls: int = setting(10, "healthy runs: whatever the interlock says there is a false alarm", within=(0, 1000))
    seed: int = setting(0, "of all noise", at_least=0)
    workers: int = setting(0, "processes; 0: one per core", within=(0, 64))

    def __post_init__(self) -> None:
        check(self)
        on_device(self.controller_kind)
        by_name(self.faults)
        sick = f"{FAULTY} first, it is the one that falls sick"
        require(self.reactors[0] == FAULTY, "reactors", self.reactors, sick)
        setpoints = self.scenario.setpoints
        require(len(setpoints) >= 2, "scenario.setpoints", setpoints, "two phases or more")


def run_case(config: FaultMatrixConfig, name: str, moment: str, seed: int, guarded: bool) -> Outcome:
    """One case, in whatever process. Args: name: of the fault, "" for a healthy run. guarded: with an overflow pump."""
    fault = by_name((name,))[0] if name else None
    pump = config.overflow_pump if guarded else OverflowPumpConfig()
    run = rehearsed(config.reactors, config.scenario, config.safety, config.controller_kind, pump)
    return FaultCase(fault, moment, run, seed).run()


def all_cases(config: FaultMatrixConfig) -> list[tuple[str, str, int, bool]]:
    """(fault, moment, seed, rig with overflow pump) of every case; controls first, the rig without one last."""
    there = bool(config.overflow_pump.pump)
    faults = by_name(config.faults)
    rigs = [(f.name, there) for f in faults if there or not f.of_overflow_pump]
    rigs += [(f.name, False) for f in faults if there and f.overflow]
    controls = [("", "steady", config.seed + k, there) for k in range(config.controls)]
    return controls + [(name, moment, config.seed, guarded) for name, guarded in rigs for moment in config.moments]


def run_all(config: FaultMatrixConfig, folder: Path) -> list[Outcome]:
    """Every case, in order; a bar on a terminal, the first and every 50th case in a log.

    Stopped, it leaves those that are done in cases.csv. Each worker is a fresh process, because a limit on file size,
    which one fault sets, is the process's.
    """
    cases = all_cases(config)
    with (
        Workers(config.workers) as workers,
        logging_redirect_tqdm(),
        tqdm(total=len(cases), disable=None, unit="case") as bar,
    ):
        futures = [workers.submit(run_case, config, *case) for case in cases]
        try:
            for done, future in enumerate(as_completed(futures), 1):
                future.result()
                bar.update()
                if bar.disable and (done == 1 or done % 50 == 0):
                    log.info("%d of %d cases", done, len(cases))
        except KeyboardInterrupt:
            if ended := [f.result() for f in futures if f.done() and f.exception() is None]:
                write_cases(folder / "cases.csv", ended)
            raise
        return [future.result() for future in futures]


def draw(outcomes: list[Outcome], moments: tuple[str, ...], folder: Path) -> None:
    """Fault by moment: minutes until it was reported | until the culture was back; colour: the largest OD error.

    A dash means that it was not reported, or not back; a frame, that the case did not go as declared.
    """
    from matplotlib.colors import LogNorm

    from experiments.reporting.charts import COLOURS, new_figure, save

    names = list(dict.fromkeys(o.label for o in outcomes))
    error = np.full((len(names), len(moments)), np.nan)
    figure, (ax,) = new_figure(3.6 + 1.1 * len(moments), 1.2 + 0.2 * len(names))
    ax.grid(False)
    for o in outcomes:
        row, column = names.index(o.label), moments.index(o.moment)
        error[row, column] = max(o.peak_error, 0.01)
        told, back = o.detected_s / 60.0, o.recovery_min
        text = " | ".join(
            (f"{told:.1f}" if math.isfinite(told) else "–", f"{back:.0f}" if math.isfinite(back) else "–")
        )
        dark = o.peak_error > 0.4
        ax.text(column, row, text, ha="center", va="center", fontsize=6, color="white" if dark else "black")
        if not o.ok:
            ax.plot(column, row, marker="s", markersize=14, markerfacecolor="none", markeredgecolor=COLOURS[1])
    image = ax.imshow(error, norm=LogNorm(0.02, 2.0), cmap="cividis_r", aspect="auto")
    ax.set_xticks(range(len(moments)), moments, fontsize=8)
    ax.set_yticks(range(len(names)), names, fontsize=7)
    ax.set_title("minutes until reported | until back after the fault (–: never)", fontsize=9)
    bar = figure.colorbar(image, ax=ax, shrink=0.4, extend="both")
    bar.set_label("largest OD error of the culture", fontsize=8)
    save(figure, folder / "figures", "fault_matrix")


def fault_matrix(config: FaultMatrixConfig, folder: Path) -> None:
    """Run the matrix, write cases.csv, table.md, summary.json and the figure. Raises: UserError if it fails."""
    began = time.monotonic()
    faults = [f for f in by_name(config.faults) if config.overflow_pump.pump or not f.of_overflow_pump]
    outcomes = run_all(config, folder)
    if not outcomes:
        raise frame.UserError("nothing to run: give faults or controls")
    write_cases(folder / "cases.csv", outcomes)
    rigs = [[o for o in outcomes if o.guarded], [o for o in outcomes if not o.guarded]]
    heads = (f"With an overflow pump ({config.overflow_pump.pump} at {config.overflow_pump.duty:g})", "Without")
    parts = [f"## {head}\n\n{table(rig)}" for head, rig in zip(heads, rigs, strict=True) if rig]
    (folder / "table.md").write_text("\n".join([*parts, declared(faults)]), encoding="utf-8")
    struck = [o for o in outcomes if o.fault != "none"]
    if struck:
        draw(struck, config.moments, folder)
    total = totals(outcomes)
    seconds = {"wall_s": round(time.monotonic() - began, 1)}
    files.write_json(folder / "summary.json", {**total, **seconds, "cases_list": [o.as_dict() for o in outcomes]})
    for o in outcomes:
        if not o.ok:
            log.warning("%s, %s: %s (%s)", o.label, o.moment, ", ".join(o.wrong), o.outcome)
    log.info("%s", ", ".join(f"{key.replace('_', ' ')} {value}" for key, value in {**total, **seconds}.items()))
    log.info("table %s, cases %s", folder / "table.md", folder / "cases.csv")
    if total["not_as_declared"]:
        raise frame.UserError(
            f"{total['not_as_declared']} of {len(outcomes)} cases did not go as declared; see the log"
        )


main = command(__file__, FaultMatrixConfig(), fault_matrix)


if __name__ == "__main__":
    main()
