"""Recordings of other labs: does the estimator predict them, who alarms, what does calibrate say?

`python -m tests.studies.recordings folder=FOLDER`, with the files at the addresses below; one page, report.html. No
data are in the project.
"""

import logging
from collections.abc import Iterable
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from conf.schema import check, setting
from envs.bench import Bench
from envs.identification.calibration import calibrate
from envs.identification.model import NotIdentifiable
from envs.identification.screening import Series, merged
from envs.task import EnvConfig
from experiments.cli import files, frame
from experiments.recordings.reader import read_recording
from experiments.replays.replay import replay
from experiments.reporting.page import Page, save
from experiments.reporting.tables import Table, number
from hardware.errors import RecordingError
from hardware.safety.config import SafetyConfig
from hardware.watched import WatchedInterlock
from tests.entry import command
from tests.studies.supervision import shipped

log = logging.getLogger(__name__)

EYESPY: dict[str, Any] = {"columns": {"od": "Eyespy_sct_V", "fed": "pump_inflow_time_s"}, "pump_ml_s": 1 / 75}
TURBIDOSTAT: dict[str, Any] = {"columns": {"od": "neph", "fed": "pumptime.s"}, "pump_ml_s": 0.252 * 20 / 189}
SOURCES: dict[str, tuple[str, str, dict[str, Any]]] = {
    "lanl/chemostat_regression": ("lanl/**/example_data.csv", "LICENSE file", {}),
    "livingphysics/bioreactor_v3": ("livingphysics/[be]*_data.csv", "no file", EYESPY),
    "ariellangevin/eVOLVER_data-analysis": ("evolver/**/OD/*_OD.txt", "no file", {"pump_ml_s": 0.8}),
    "ingolia-lab/turbidostat": ("ingolia/**/tstat.txt", "no file", TURBIDOSTAT),
    "gchure/diauxic_flux_parity": ("gchure/**/raw/*data.csv", "LICENSE file", {}),
    "nahanoo/ChiBioFlow": ("chibioflow/**/*_data.csv", "LICENSE file", {}),
}
"""github.com/NAME: files, licence, and what `read_recording` has to be told of them."""
FEWEST = 60  # rows, and readings that were predicted


@dataclass(frozen=True)
class RecordingsConfig:
    """Which recordings."""

    folder: str = setting("", "with the files of each source")
    most: int = setting(1000, "of one source", within=(1, 1000))
    workers: int = setting(2, "processes", within=(1, 256))
    hours: float = setting(1000.0, "of each from its first row", "h", within=(1, 1000))

    def __post_init__(self) -> None:
        check(self)


def row(path: Path, options: dict[str, Any], hours: float) -> tuple[str, ...]:
    """What a replay with the policy that ships and a calibration come to; few columns for what cannot be read."""
    try:
        r = read_recording(path, **options)
    except RecordingError as error:
        return (path.stem, *["–"] * 5, f"refused: {str(error).partition(': ')[2][:60]}")
    raw = Series(r.time_min - r.time_min[0], r.od, r.pump_rate, r.row)
    raw = raw.part(0, int(np.searchsorted(raw.time, 60.0 * hours)))
    if len(raw.od) < FEWEST:
        return (path.stem, *["–"] * 5, "too short")
    fast = float(np.median(np.diff(raw.time))) < 0.5
    series = merged(raw, longest=0) if fast else raw
    bench = Bench(period_s=round(60.0 * float(np.median(np.diff(series.time))), 3))
    law = shipped()
    setpoint = float(np.clip(np.nanmedian(series.od), 0.02, 1.5))
    warm = np.interp(series.time, raw.time, r.temperature[: len(raw.time)])
    found = replay(series, warm, law, WatchedInterlock(1, SafetyConfig(), bench), setpoint, EnvConfig())
    if np.isfinite(found.one).sum() < FEWEST:
        return (path.stem, *["–"] * 5, "the interlock refuses almost all readings")
    try:
        result = calibrate(merged(raw))
        said = f"{result.verdict.word}: mu {result.mu.value:.4f}, tau {result.tau.value:.3f}"
    except NotIdentifiable as error:
        said = f"record again: {error.why[:60]}"
    except ValueError as error:
        said = f"refused: {str(error)[:60]}"
    shares = (100.0 * float(np.nanmean(v)) if np.isfinite(v).any() else None for v in (found.one, found.ten))
    rest = 100.0 * (1.0 - found.believed.mean()), 100.0 * float((found.acted > 0.0).mean())
    return (path.stem, number(float(series.time[-1]) / 60.0), *map(number, (*shares, *rest)), said)


def unlike(paths: Iterable[Path]) -> list[Path]:
    """Leave out files that copy an earlier one byte for byte."""
    return list({path.read_bytes(): path for path in reversed(sorted(paths))}.values())[::-1]


def recordings(config: RecordingsConfig, folder: Path) -> None:
    """A row for each recording, a table for each source."""
    page, rows = Page("On other labs' recordings", "predicted and replayed by the policy that ships"), []
    page.section("Recordings")
    columns = (
        "recording",
        "h",
        "innovations inside 95 %, %",
        "ten ahead, %",
        "not believed, %",
        "filter alarm, %",
        "calibrate",
    )
    with ProcessPoolExecutor(config.workers) as pool:
        for name, (pattern, licence, options) in SOURCES.items():
            jobs = []
            for path in unlike(Path(config.folder).glob(pattern))[: config.most]:
                doses = Path(str(path).replace("/OD/", "/pump_log/").replace("_OD.txt", "_pump_log.txt"))
                more = options if doses == path else {**options, "doses": doses}
                jobs.append(pool.submit(row, path, more, config.hours))
            mine = []
            for job in jobs:
                mine.append(job.result())
                log.info("%s", "  ".join(mine[-1]))
            label = name.partition("/")[2]
            page.table(Table(label, f"github.com/{name}, licence: {licence}", columns, tuple(mine)))
            rows += [(name, *one) for one in mine]
    if not rows:
        raise frame.UserError(f"folder={config.folder}: holds none of {', '.join(p for p, *_ in SOURCES.values())}")
    inside = np.array([float(one[3]) for one in rows if one[3] != "–"])
    held = 100.0 * float(np.mean((inside >= 90.0) & (inside <= 98.0))) if len(inside) else 0.0
    log.info("inside their band in 90 to 98 %% of readings: %.0f %% of %d recordings", held, len(inside))
    files.write_json(folder / "summary.json", {"rows": rows, "held_pct": held, "median_pct": float(np.median(inside))})
    save(page, folder)


main = command(__file__, RecordingsConfig(), recordings)


if __name__ == "__main__":
    main()
