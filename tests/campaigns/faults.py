"""Every fault at every moment of a run, of both families: `python -m tests.campaigns.faults`.

The emulated Chi.Bio is rehearsed in virtual time. At the Pioreactor rig real client processes control simulated vials
through the vendor's web server, task queue, jobs and broker, in real time.
"""

import logging
import math
import time
from collections.abc import Iterable
from concurrent.futures import as_completed
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from tqdm import tqdm
from tqdm.contrib.logging import logging_redirect_tqdm

from conf.schema import check, part, require, setting
from envs.scenario import Scenario
from experiments.cli import files, frame, stop
from experiments.laws.registry import on_device
from hardware.chibio.overflow_pump import OverflowPumpConfig
from hardware.pioreactor.config import PUBLISHED
from hardware.safety.config import SafetyConfig
from tests.campaigns import chibio_faults, pioreactor_faults
from tests.campaigns.chibio_case import ChiBioCase
from tests.campaigns.chibio_faults import FAULTY
from tests.campaigns.fault import FAMILIES, MOMENTS, VIRTUAL, Fault
from tests.campaigns.outcome import Outcome, declared, table, totals, write_cases
from tests.campaigns.pioreactor_case import PioreactorCase
from tests.campaigns.rehearsal import rehearsed
from tests.entry import command

__all__ = ["FAULTS", "Case", "FaultsConfig", "by_name", "faults"]

FAULTS = (*chibio_faults.FAULTS, *pioreactor_faults.FAULTS)


def by_name(names: Iterable[str]) -> tuple[Fault, ...]:
    """The named faults. Raises: ValueError naming one that does not exist and those that do."""
    known = {fault.name: fault for fault in FAULTS}
    wanted = tuple(names)
    for name in wanted:
        if name not in known:
            raise ValueError(f"faults = {name}: no such fault; allowed {', '.join(known)}")
    return tuple(known[name] for name in wanted)


log = logging.getLogger(__name__)


@dataclass(frozen=True)
class FaultsConfig:
    """Which faults to try, and when. Raises: ValueError naming key, value and allowed range.

    Faults that overflow without an overflow pump are run on a rig without as well. Without a pump everything is run on
    that rig, and its own faults are left out. Healthy runs have no sensor outliers.
    """

    families: tuple[str, ...] = setting(("chibio",), "all faults of these, where none is named", choices=FAMILIES)
    faults: tuple[str, ...] = setting((), "names, as in docs/faults.md and docs/pioreactor.md; empty: all of families")
    moments: tuple[str, ...] = setting(
        MOMENTS,
        "of a Chi.Bio: recovery; steady at the first setpoint; after the step; feed pump running. Of a Pioreactor: "
        "before the start; between doses; in one",
        choices=MOMENTS, some=True,
    )  # fmt: skip
    reactors: tuple[str, ...] = setting(("M0", "M1"), "the first falls sick, the others are its neighbours", some=True)
    scenario: Scenario = part(
        lambda: Scenario((0.8, 0.65, 0.5), (30.0, 30.0, 30.0), (37.0, 37.0, 37.0), 0.8), "of every run of a Chi.Bio"
    )
    safety: SafetyConfig = part(SafetyConfig, "limits of the interlock")
    controller_kind: str = setting("dqn", "a controller that can run a device; dqn is the policy that ships")
    overflow_pump: OverflowPumpConfig = part(lambda: OverflowPumpConfig("Pump3", 0.95, 1.2), "of the Chi.Bio's rig")
    controls: int = setting(10, "healthy runs: whatever the interlock says there is a false alarm", within=(0, 1000))
    kills: int = setting(5, "times that each kill at the Pioreactor rig is repeated in its run", within=(1, 100))
    speed: float = setting(5.0, "of that rig: growth faster than real time", within=(1, 30))
    settle: int = setting(2, "doses there after the last fault before the run is ended", within=(1, 100))
    package: str = setting(PUBLISHED, "version of the vendor's software on the package index, or a wheel's path")
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

    @property
    def wanted(self) -> tuple[Fault, ...]:
        """The faults to try; those of an overflow pump only where there is one."""
        named = by_name(self.faults) or tuple(f for f in FAULTS if f.family in self.families)
        return tuple(f for f in named if self.overflow_pump.pump or not f.of_overflow_pump)


@dataclass(frozen=True)
class Case:
    """A fault, "" for a healthy run, at a moment. guarded: on a rig with an overflow pump."""

    fault: str
    moment: str
    seed: int
    guarded: bool = False

    def run(self, config: FaultsConfig, folder: Path) -> Outcome:
        """In whatever process. Args: folder: of the command."""
        fault = by_name((self.fault,))[0] if self.fault else None
        if fault is not None and fault.family == "pioreactor":
            times = config.kills if fault.often else 1
            place = folder / f"{self.fault}-{self.moment}"
            with stop.pausing("once pumps and rig are off") as stopping:
                return PioreactorCase(
                    fault, self.moment, place, config.speed, self.seed, config.package, times, config.settle, stopping
                ).run()
        pump = config.overflow_pump if self.guarded else OverflowPumpConfig()
        run = rehearsed(config.reactors, config.scenario, config.safety, config.controller_kind, pump)
        return ChiBioCase(fault, self.moment, run, self.seed).run()


def all_cases(config: FaultsConfig) -> list[Case]:
    """Every case; controls first, the Chi.Bio's rig without an overflow pump last."""
    there, found = bool(config.overflow_pump.pump), config.wanted
    rigs = [(f, there and f.family == "chibio") for f in found]
    rigs += [(f, False) for f in found if there and f.overflow and f.family == "chibio"]
    virtual = not found or any(f.family == "chibio" for f in found)
    controls = [Case("", "steady", config.seed + k, there) for k in range(config.controls if virtual else 0)]
    return controls + [
        Case(f.name, m, config.seed, guarded) for f, guarded in rigs for m in f.moments if m in config.moments
    ]


def run_all(config: FaultsConfig, folder: Path) -> list[Outcome]:
    """Every case, in order; a bar on a terminal, in a log the first, every 50th and each at the Pioreactor rig.

    Each worker is a fresh process, because a limit on file size, which one fault sets, is the process's.
    """
    cases = all_cases(config)
    with (
        stop.Workers(config.workers) as workers,
        logging_redirect_tqdm(),
        tqdm(total=len(cases), disable=None, unit="case") as bar,
    ):
        futures = [workers.submit(case.run, config, folder) for case in cases]
        for done, future in enumerate(as_completed(futures), 1):
            o = future.result()
            bar.update()
            if bar.disable and (done == 1 or done % 50 == 0):
                log.info("%d of %d cases", done, len(cases))
            if o.family == "pioreactor":
                log.info("%s, %s: %s", o.label, o.moment, ", ".join(o.wrong) or "ok")
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


def faults(config: FaultsConfig, folder: Path) -> None:
    """Try all, write cases.csv, table.md, summary.json and the figure. Raises: UserError if one fails."""
    began = time.monotonic()
    outcomes = run_all(config, folder)
    if not outcomes:
        raise frame.UserError("nothing to run: give faults that have such moments, or controls")
    write_cases(folder / "cases.csv", outcomes)
    virtual = [o for o in outcomes if o.family == "chibio"]
    rigs = {
        f"With an overflow pump ({config.overflow_pump.pump} at {config.overflow_pump.duty:g})": [
            o for o in virtual if o.guarded
        ],
        "Without": [o for o in virtual if not o.guarded],
        "At the Pioreactor rig": [o for o in outcomes if o.family == "pioreactor"],
    }
    parts = [f"## {head}\n\n{table(rig)}" for head, rig in rigs.items() if rig]
    (folder / "table.md").write_text("\n".join([*parts, declared(config.wanted)]), encoding="utf-8")
    struck = [o for o in virtual if o.fault != "none"]
    if struck:
        draw(struck, tuple(m for m in VIRTUAL if m in config.moments), folder)
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


main = command(__file__, FaultsConfig(), faults)


if __name__ == "__main__":
    main()
