"""Days of a run with all reactors in virtual time: does anything grow, drift or get lost? `tests.campaigns.soak`."""

import logging
import time
from dataclasses import asdict
from pathlib import Path

import numpy as np

from experiments.cli import files, frame
from tests.campaigns.endurance import Day, SoakConfig, growth, soak_run
from tests.entry import command
from tests.studies.results import leave

__all__ = ["soak"]

log = logging.getLogger(__name__)

HELD_OD = 0.015  # five times what noise and dose spread leave of a sound loop
ASTRAY_MIN = 5.0  # an outlying reading costs a dose, two in a row cost two


def write_table(days: list[Day], folder: Path) -> None:
    """A line per day."""
    each = [asdict(day) for day in days]
    rows = [[f"{value:.4g}" if isinstance(value, float) else value for value in day.values()] for day in each]
    leave(folder, __file__, [key.replace("_", " ") for key in each[0]], rows)


def soak(config: SoakConfig, folder: Path) -> None:
    """Run, table, summary.json. Raises: UserError if something was lost, grew or drifted."""
    days: list[Day] = []
    began = time.monotonic()
    try:
        found = soak_run(config, folder, days)
    except KeyboardInterrupt:
        if days:
            write_table(days, folder)
        raise
    slopes = {key: round(growth(days, key), 2) for key in ("memory_mb", "journal_mb", "csv_mb", "events_mb")}
    wall = round(time.monotonic() - began, 1)
    summary = {**found, "growth_per_day": slopes, "wall_s": wall, "days": [asdict(d) for d in days]}
    files.write_json(folder / "summary.json", summary)
    write_table(days, folder)
    errors = [abs(v["fed_error_pct"]) for v in found["reactors"].values()]
    levels = [abs(v["ledger_ml"] - v["volume_ml"]) for v in found["reactors"].values()]
    log.info("growth per day %s; %d rows lost; feed booked within %.2f %%, level within %.2f mL; %.0f s", slopes,
             found["rows_lost"], max(errors), max(levels), wall)  # fmt: skip
    doubled = sum(v["doses_doubled"] for v in found["reactors"].values())
    worst = np.nanmax([d.worst for d in days])
    bad = {
        "rows lost or doubled": found["rows_lost"] + found["rows_doubled"] > 0,
        "doses doubled": doubled > 0,
        "feed not as booked (more than 2 %)": max(errors) > 2.0,
        "level not as booked (more than 1 mL)": max(levels) > 1.0,
        "memory grows (more than 5 MB a day)": slopes["memory_mb"] > 5.0,
        "pumps not off": not found["pumps_off"],
        f"a culture not held (mean error of a day above {HELD_OD:g} OD)": not worst <= HELD_OD,
        f"a culture astray (for more than {ASTRAY_MIN:g} min)": max(d.out_min for d in days) > ASTRAY_MIN,
    }
    if any(bad.values()):
        raise frame.UserError("; ".join(name for name, is_bad in bad.items() if is_bad))


main = command(__file__, SoakConfig(), soak)


if __name__ == "__main__":
    main()
