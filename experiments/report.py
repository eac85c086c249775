"""Report of a run folder or a sweep: one self-contained HTML page, and its tables.

`python -m experiments.report run=RUN` shows one run, `runs=SWEEP` compares the jobs of a sweep.
"""

import json
import logging
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from omegaconf import DictConfig

from conf import presets
from conf.schema import setting
from experiments.cli import files, frame, sweep, words
from experiments.reporting.sweep_results import Result

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class ReportConfig:
    """Config of a report."""

    run: str = setting("latest", "a run folder, a folder of run folders, or `latest`: the newest run below runs/")
    runs: str | None = setting(None, "the folder of a sweep, or `latest`: compare its jobs on one page; replaces run")


def _summary(run: Path) -> Any:
    try:
        summary = json.loads((run / "summary.json").read_text("utf-8"))
        json.dumps(summary, ensure_ascii=False).encode()
    except (ValueError, RecursionError) as error:
        raise frame.UserError(f"run={run}: summary.json is damaged ({error}); repeat the run") from None
    return summary


def write(folder: Path) -> Path:
    """Write report.html and tables/ into a folder; return the page's path.

    A benchmark has its own kind of page. The page of any other run shows its summary and figures. A folder of runs
    (e.g. of `make run`) gets a section for each run. Raises: frame.UserError without a run.
    """
    from experiments.record import aftermath
    from experiments.reporting import page

    runs = [folder] if (folder / "summary.json").is_file() else sorted(p.parent for p in folder.glob("*/summary.json"))
    if not runs:
        raise frame.UserError(f"run={folder}: no summary.json in this folder; give the folder of a finished run")
    summaries = [_summary(run) for run in runs]
    runs.sort(key=lambda run: not (run / "recordings").is_dir())  # the deployment comes first
    compared = runs == [folder] and isinstance(summaries[0], dict) and "beside_paper" in summaries[0]
    try:
        if compared:
            from experiments.comparison.page import of_benchmark  # loads SciPy

            return page.save(of_benchmark(folder), folder)
        return page.save(page.of_runs(folder, runs, aftermath.write), folder)
    except (OSError, ValueError, RecursionError) as error:
        raise frame.UserError(f"run={folder}: {error}") from None
    except (LookupError, TypeError, AttributeError) as error:
        if not compared:
            raise
        why = f"{type(error).__name__}: {error}"
        raise frame.UserError(f"run={folder}: not the summary.json of a benchmark ({why}); repeat the run") from None


def compare(folder: Path) -> Path:
    """Write report.html and tables/ into the folder of a sweep; return the page's path.

    Raises: frame.UserError without a sweep.
    """
    from experiments.reporting import page, sweep_page

    if not folder.is_dir():
        raise frame.UserError(f"runs={folder}: no such folder; give the folder of a sweep")
    swept = sweep.read(folder)
    try:
        own = [a for a in swept.arguments if not a.startswith("hydra/")] if swept else []
        expected = sweep.jobs(words.normalise(own, swept.command)) if swept else None
    except frame.UserError:
        expected = None  # a file of the command line is missing: use the jobs that have a folder
    jobs = [_result(job) for job in sweep.survey(folder, expected)]
    if not jobs:
        raise frame.UserError(f"runs={folder}: no job of a sweep in this folder; give a folder written by train -m")
    command = swept.command if swept else folder.resolve().parent.name
    return page.save(
        sweep_page.of_sweep(folder, command, jobs, swept.again() if swept else "start the sweep anew"), folder
    )


def _result(job: sweep.Job) -> Result:
    """Build a job's result for the page, with the values that the job's command line sets."""
    overrides = dict(line.split("=", 1) for line in job.overrides if "=" in line and not line.startswith("hydra."))
    if preset := overrides.pop("hparams_search", None):  # list the preset's values: a single run is not a search
        path = presets.ROOT / "hparams_search" / f"{preset}.yaml"
        own: Any = files.load_yaml(path) if path.is_file() else {}
        fixed = {str(k): str(v) for k, v in own.items() if k not in ("defaults", "hydra")}
        overrides = fixed | overrides
    done = job.state == "finished" and (job.folder / "summary.json").is_file()
    found = _summary(job.folder) if done else {}
    config = files.load_yaml(job.folder / "config.yaml") if done else None
    task = str((config.get("env") or {}).get("kind", "density")) if isinstance(config, DictConfig) else "density"
    summary = found if isinstance(found, dict) else {}
    return Result(job.folder, overrides, job.state, job.error, job.objective, summary, task)


def find(name: str, root: Path = Path("runs")) -> Path:
    """Find a run folder by its path or by `latest`. Raises: frame.UserError with the remedy."""
    if name != "latest":
        if not Path(name).is_dir():
            raise frame.UserError(f"run={name}: no such folder; give the folder of a finished run")
        return Path(name)
    found = sorted(root.glob("*/*/summary.json"), key=lambda p: p.stat().st_mtime)
    if not found:
        raise frame.UserError(f"run=latest: no finished run under {root}; give run=FOLDER")
    return found[-1].parent


def report(config: ReportConfig, folder: Path) -> None:
    """Write the report of a run or sweep into its folder; `folder` gets only the log."""
    if config.runs is not None:
        log.info("report %s", compare(Path(config.runs)))
    else:
        log.info("report %s", write(find(config.run)))


main = frame.EntryPoint("report", ReportConfig(), report)


if __name__ == "__main__":
    main()
