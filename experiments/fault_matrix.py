"""Every fault at every moment of a run, in virtual time: `python -m experiments.fault_matrix`."""

from __future__ import annotations

import csv
import itertools
import logging
import math
import multiprocessing
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Executor, ProcessPoolExecutor, as_completed
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from conf.schema import check, part, require, setting
from envs.scenario import Scenario
from experiments.cli import files, frame
from experiments.reliability.case import MOMENTS, Case, Outcome
from experiments.reliability.faults import SICK, Fault, by_name
from hardware.chibio.overflow_guard import GuardConfig
from hardware.safety.config import SafetyConfig

__all__ = ["FaultMatrixConfig", "fault_matrix", "table"]

log = logging.getLogger(__name__)

WITHOUT_POLICY = ("pi", "pi_tuned", "mpc", "inverse", "threshold", "hold")


@dataclass(frozen=True)
class FaultMatrixConfig:
    """Which faults to try, and when. Raises: ValueError naming key, value and allowed range.

    Faults that overflow without a guard are run on a rig without as well. Without a guard's pump everything is run on
    that rig, and faults of the guard are left out. Healthy runs have no sensor outliers.
    """

    reactors: tuple[str, ...] = setting(("M0", "M1"), "the first falls sick, the others are its neighbours", some=True)
    scenario: Scenario = part(
        lambda: Scenario((0.8, 0.65, 0.5), (30.0, 30.0, 30.0), (37.0, 37.0, 37.0), 0.8), "of every run"
    )
    safety: SafetyConfig = part(SafetyConfig, "limits of the interlock")
    controller_kind: str = setting("inverse", "what decides the pump rate", choices=WITHOUT_POLICY)
    guard: GuardConfig = part(lambda: GuardConfig("Pump3", 0.95, 1.2), "overflow guard of the rig")
    faults: tuple[str, ...] = setting((), "names, as in docs/faults.md; empty: all")
    moments: tuple[str, ...] = setting(
        MOMENTS,
        "recovery; steady at the first setpoint; after the step; feed pump running",
        choices=MOMENTS,
        some=True,
    )
    controls: int = setting(10, "healthy runs: whatever the interlock says there is a false alarm", within=(0, 1000))
    seed: int = setting(0, "of all noise", at_least=0)
    workers: int = setting(0, "processes; 0: one per core", within=(0, 64))

    def __post_init__(self) -> None:
        check(self)
        by_name(self.faults)
        sick = f"{SICK} first, it is the one that falls sick"
        require(self.reactors[0] == SICK, "reactors", self.reactors, sick)
        setpoints = self.scenario.setpoints
        require(len(setpoints) >= 2, "scenario.setpoints", setpoints, "two phases or more")


def run_case(config: FaultMatrixConfig, name: str, moment: str, seed: int, guarded: bool) -> Outcome:
    """One case, in whatever process. Args: name: of the fault, "" for a healthy run. guarded: the rig has a guard."""
    fault = by_name((name,))[0] if name else None
    what = (config.reactors, config.scenario, config.safety, config.controller_kind, seed)
    return Case(fault, moment, *what, config.guard if guarded else GuardConfig()).run()


def all_cases(config: FaultMatrixConfig) -> list[tuple[str, str, int, bool]]:
    """(fault, moment, seed, rig with guard) of every case; controls first, the rig without guard last."""
    there = bool(config.guard.pump)
    faults = by_name(config.faults)
    rigs = [(f.name, there) for f in faults if there or not f.guard]
    rigs += [(f.name, False) for f in faults if there and f.overflow]
    controls = [("", "steady", config.seed + k, there) for k in range(config.controls)]
    return controls + [(name, moment, config.seed, guarded) for name, guarded in rigs for moment in config.moments]


@contextmanager
def pool(workers: int) -> Iterator[Executor]:
    """Fresh processes: a limit on file size, which one fault sets, is the process's."""
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(workers or None, mp_context=context) as executor:
        yield executor


def run_all(config: FaultMatrixConfig, tick: Callable[[], object]) -> list[Outcome]:
    """Every case, in order."""
    cases = all_cases(config)
    with pool(config.workers) as executor:
        futures = [executor.submit(run_case, config, *case) for case in cases]
        for future in as_completed(futures):
            future.result()
            tick()
        return [future.result() for future in futures]


def _number(value: float, form: str) -> str:
    return format(value, form) if math.isfinite(value) else "–"


def _span(values: Sequence[float], form: str) -> str:
    """Smallest to largest, one number if they look the same."""
    low, high = _number(min(values), form), _number(max(values), form)
    return low if low == high else f"{low} – {high}"


def table(outcomes: Sequence[Outcome]) -> str:
    """Markdown: one row per fault over all moments; single cases are in cases.csv."""
    head = (
        "fault", "told after, min", "by", "response", "peak mL", "peak OD error", "rows missed", "rows lost",
        "doses doubled", "pumps off", "as declared",
    )  # fmt: skip
    lines = ["| " + " | ".join(head) + " |", "|" + "---|" * len(head)]
    for name in dict.fromkeys(o.label for o in outcomes):
        mine = [o for o in outcomes if o.label == name]
        told = [o.detected_s / 60.0 for o in mine if o.reason]
        cells = [
            name if mine[0].fault != "none" else f"{name} ({len(mine)} healthy runs)",
            (_span(told, ".1f") + (f" ({len(told)} of {len(mine)})" if len(told) < len(mine) else "")) if told else "–",
            ", ".join(dict.fromkeys(o.reason for o in mine if o.reason)) or "–",
            ", ".join(dict.fromkeys(o.response for o in mine if o.response)) or "–",
            _span([o.peak_ml for o in mine], ".1f"),
            _span([o.peak_error for o in mine], ".2f"),
            str(sum(o.rows_missed for o in mine)),
            str(sum(o.rows_lost + o.rows_doubled for o in mine)),
            str(sum(o.doses_doubled for o in mine)),
            f"{sum(o.pumps_off for o in mine)} of {len(mine)}",
            "yes"
            if all(o.ok for o in mine)
            else "**no**: " + ", ".join(dict.fromkeys(w for o in mine for w in o.wrong)),
        ]
        lines.append("| " + " | ".join(cells) + " |")
    return "\n".join(lines) + "\n"


def declared(faults: Sequence[Fault]) -> str:
    """Markdown: what is not detected, or overflows without a guard, and why."""
    lines = [
        "| fault | what happens | not detected because | without a guard it overflows because |",
        "|---|---|---|---|",
    ]
    for f in faults:
        if f.why_not or f.overflow:
            lines.append(f"| {f.name} | {f.what} | {f.why_not or '(detected)'} | {f.overflow or '–'} |")
    return "\n".join(lines) + "\n"


def totals(outcomes: Sequence[Outcome]) -> dict[str, Any]:
    """The sums by which the matrix passes or fails."""
    healthy = [o for o in outcomes if o.fault == "none"]
    bare = [o for o in outcomes if not o.guarded]
    return {
        "cases": len(outcomes),
        "faults": len({o.fault for o in outcomes} - {"none"}),
        "overflows": sum(o.overflowed for o in outcomes if o.guarded),
        "cases_without_guard": len(bare),
        "overflows_without_guard": sum(o.overflowed for o in bare),
        "rows_lost": sum(o.rows_lost for o in outcomes),
        "rows_doubled": sum(o.rows_doubled for o in outcomes),
        "doses_doubled": sum(o.doses_doubled for o in outcomes),
        "doses_repeated_by_the_device": sum(o.repeats for o in outcomes),
        "undetected": sum("not detected" in o.wrong for o in outcomes),
        "software_ended": sum(o.exits for o in outcomes),
        "neighbours_lost": sum(o.neighbours_lost for o in outcomes),
        "pumps_not_off": sum("pumps not off" in o.wrong for o in outcomes),
        "false_alarms": sum(o.early_alarms + o.neighbour_alarms for o in outcomes)
        + sum(sum(o.kinds.values()) for o in healthy),
        "healthy_runs": len(healthy),
        "healthy_peak_error": max((o.peak_error for o in healthy), default=math.nan),
        "not_as_declared": sum(not o.ok for o in outcomes),
    }


def write_cases(path: Path, outcomes: Sequence[Outcome]) -> None:
    """cases.csv: one row per case."""
    rows = [o.as_dict() for o in outcomes]
    with open(path, "w", newline="", encoding="utf-8") as f:
        writer = csv.DictWriter(f, list(rows[0]))
        writer.writeheader()
        for row in rows:
            counts = {k: " ".join(f"{name} x{n}" for name, n in row[k].items()) for k in ("kinds", "notes")}
            writer.writerow({**row, **counts, "wrong": ", ".join(row["wrong"])})


def fault_matrix(config: FaultMatrixConfig, folder: Path) -> None:
    """Run the matrix, write cases.csv, table.md, summary.json and the figure. Raises: UserError if it fails."""
    from tqdm import tqdm
    from tqdm.contrib.logging import logging_redirect_tqdm

    from experiments.reliability import chart as charts_faults
    from experiments.reporting import charts

    began = time.monotonic()
    faults = [f for f in by_name(config.faults) if config.guard.pump or not f.guard]
    total_cases, over = len(all_cases(config)), itertools.count(1)
    with logging_redirect_tqdm(), tqdm(total=total_cases, disable=None, unit="case") as bar:

        def tick() -> None:
            bar.update()
            if (done := next(over)) % 50 == 0 and bar.disable:
                log.info("%d of %d cases", done, total_cases)

        outcomes = run_all(config, tick)
    if not outcomes:
        raise frame.UserError("nothing to run: give faults or controls")
    write_cases(folder / "cases.csv", outcomes)
    rigs = [[o for o in outcomes if o.guarded], [o for o in outcomes if not o.guarded]]
    heads = (f"With an overflow guard ({config.guard.pump} at {config.guard.duty:g})", "Without")
    parts = [f"## {head}\n\n{table(rig)}" for head, rig in zip(heads, rigs, strict=True) if rig]
    (folder / "table.md").write_text("\n".join([*parts, declared(faults)]), encoding="utf-8")
    sick = [o for o in outcomes if o.fault != "none"]
    if sick:
        charts.save(charts_faults.fault_map(sick, config.moments), folder / "figures", "fault_matrix")
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


main = frame.Command("fault_matrix", FaultMatrixConfig(), fault_matrix)


if __name__ == "__main__":
    main()
