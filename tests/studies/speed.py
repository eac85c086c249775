"""How fast things are, each beside a named rival in the same run: `python -m tests.studies.speed`.

A measurement is two callables that do the same work. They are timed in pairs, in alternating order, so that whatever
else the machine does meets both; what is reported is the median of each and the median of the paired ratios.
"""

import logging
import os
import platform
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from tqdm import tqdm
from tqdm.contrib.logging import logging_redirect_tqdm

from conf.schema import check, setting
from experiments.cli import files
from experiments.reporting import tables
from experiments.reporting.tables import Table, number
from tests.entry import command
from tests.studies import measurements
from tests.studies.measurements import Measurement, measure

__all__ = ["GROUPS", "SpeedConfig", "main", "table"]

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class SpeedConfig:
    """What to time."""

    groups: tuple[str, ...] = setting(("training", "environment", "controllers", "mpc"), "which measurements")
    runs: int = setting(
        5,
        "pairs per measurement, after one that is thrown away",
        within=(5, 1000),
        note="a median of fewer says little",
    )

    def __post_init__(self) -> None:
        check(self)
        unknown = [g for g in self.groups if g not in GROUPS]
        if unknown:
            raise ValueError(f"groups = {unknown[0]}: allowed {', '.join(GROUPS)}")


GROUPS: dict[str, Callable[[], Iterator[Measurement]]] = {
    "training": measurements.training,
    "environment": measurements.environment,
    "controllers": measurements.loops,
    "mpc": measurements.mpc,
}
"""Name -> measurements. Whoever adds one names a rival that does the same work."""


def speed(config: SpeedConfig, folder: Path) -> None:
    """Measure every group; summary.json, a table in tables/ and on the screen, a report."""
    from experiments.reporting import page

    found = []
    with logging_redirect_tqdm():
        for m in tqdm([m for g in config.groups for m in GROUPS[g]()], disable=None, unit="measurement"):
            found.append(measure(m, config.runs))
            log.info("%s: %.4g %s; %s: %.4g; ratio %.3g", m.name, found[-1]["ours"], m.unit, m.rival,
                     found[-1]["theirs"], found[-1]["ratio"])  # fmt: skip
    machine = f"{os.cpu_count()} cores, {platform.machine()}, Python {platform.python_version()}"
    files.write_json(folder / "summary.json", {"machine": machine, "measurements": found})
    tables.write([table(found, config.runs, machine)], folder / "tables")
    log.info("report %s", page.save(page.of_runs(folder, [folder]), folder))


def table(found: list[dict[str, Any]], runs: int, machine: str) -> Table:
    """The measurements as a table."""
    rows = tuple(
        (
            str(e["name"]), str(e["work"]), f"{number(e['ours'])} {e['unit']}",
            "–" if e["limit"] is None else f"{number(e['limit'])} {e['unit']}",
            str(e["rival"]), f"{number(e['theirs'])} {e['unit']}",
            f"{number(e['ratio'])} ({number(e['ratio_range'][0])} to {number(e['ratio_range'][1])})",
        )
        for e in found
    )  # fmt: skip
    columns = ("measurement", "work", "here", "limit", "rival", "rival's time", "rival / here (range)")
    return Table("speed", f"Speed, medians of {runs} paired runs", columns, rows, machine)


main = command(__file__, SpeedConfig(), speed)


if __name__ == "__main__":
    main()
