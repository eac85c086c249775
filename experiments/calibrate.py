"""Fit mu and tau to a recording and write a model file for `train`: `python -m experiments.calibrate`.

`generate=true` writes a simulated recording instead. `coverage=N` counts how often the intervals contain the truth.
"""

from contextlib import closing
from dataclasses import replace
from importlib import resources
from pathlib import Path

import numpy as np

from envs.identification.calibration import calibrate
from envs.identification.model import NotIdentifiable
from envs.identification.screening import Series, merged
from envs.identification.twin import Twin, twin
from envs.identification.verdict import Calibration, growth_alone
from experiments.calibration.config import CalibrateConfig
from experiments.calibration.result import environment_yaml, refusal, summary, twin_yaml
from experiments.calibration.study import coverage, simulated
from experiments.cli import files, frame
from experiments.reporting.verdict import verdict
from hardware.errors import RecordingError
from hardware.storage.recorder import Recorder

COLUMNS = ("time_min", "od", "pump_rate_ml_s")


def body(config: CalibrateConfig, folder: Path) -> float | None:
    """Calibrate, generate a recording, or study the coverage, according to the config.

    Returns: PMSE of a calibration, or coverage of a study, in %. Raises: frame.UserError.
    """
    if config.generate:
        _generate(config, folder)
        return None
    if config.coverage:
        return coverage(config, folder)
    return _calibrate(config, folder)


def _calibrate(config: CalibrateConfig, folder: Path) -> float:
    source = config.data or str(resources.files("experiments") / "data" / "open_loop.csv")
    print(f"reading {config.data or 'the shipped recording'}", flush=True)
    with frame.refusing(RecordingError):
        recording = config.read(source)
    read = Series(recording.time_min, recording.od, recording.pump_rate, recording.row)
    raw = merged(read)
    if raw is not read:
        merging = f"{len(read.time)} rows merged into {len(raw.time)} rows, each of a minute or more"
        recording = replace(recording, notes=(*recording.notes, merging))
    hours = (raw.time[-1] - raw.time[0]) / 60
    fed_ml = 60.0 * float(raw.pump_rate[:-1] @ np.diff(raw.time))
    where = f"{recording.source}: rows {read.row[0]}-{read.row[-1]}, {hours:.1f} h, {fed_ml:.4g} mL fed"
    print(f"{where}; fitting", flush=True)
    try:
        result = calibrate(raw, config.identify, recording.doubts)
    except NotIdentifiable as error:
        alone = None if recording.doubts else growth_alone(raw)
        line, content = refusal(error, alone, recording)
        files.write_json(folder / "summary.json", {**content, "data": source})
        raise frame.UserError(f"{source}: {line}") from None
    except ValueError as error:
        raise frame.UserError("; ".join([f"{source}: {error}", *recording.notes])) from None
    name = Path(source).name
    environment = folder / f"{config.name}.yaml"
    content = summary(result, recording, raw)
    files.write_json(folder / "summary.json", {**content, "data": source, "env_file": str(environment)})
    try:
        environment.write_text(environment_yaml(result, name), encoding="utf-8")
    except ValueError as error:
        raise frame.UserError(f"{source}: no training model: {error}; the fit is in {folder}/summary.json") from None
    behind = twin(raw, result, config.identify.segment_min)
    written = _write_twin(folder / "twin.yaml", behind, name)
    _draw(folder, raw, result, behind, name, config.identify.segment_min)
    if told := verdict(content, {"data": config.data}):
        print("\n".join(["", told.claim, *(f"  {item}" for item in told.items), told.remark]))
    for what in content["rejected"]:
        print(f"  rejected rows {what['rows']} ({what['n']}): {what['reason']}")
    print("\n".join(f"  {note}" for note in recording.notes), f"files {environment}, {written}", sep="\n")
    print(f"next, train on this model: python -m experiments.train env_file={environment}")
    print(f"next, for a page with all results: python -m experiments.report run={folder}")
    return result.pmse_pct


def _write_twin(path: Path, behind: Twin, source: str) -> str:
    """Write the plant; return its path, or a message if a fitted value is out of range for a plant."""
    try:
        text = twin_yaml(behind, source)
    except ValueError as error:
        why = str(error) if len(str(error)) < 200 else f"{str(error)[:80]} ... {str(error)[-80:]}"
        return f"no {path.name}: {why}; leave out the rows where the culture changes: rows=FIRST:END"
    path.write_text(text, encoding="utf-8")
    return str(path)


def _draw(folder: Path, raw: Series, result: Calibration, behind: Twin, name: str, segment_min: float) -> None:
    from experiments.reporting.calibration_charts import drift_figure, fit_figure, twin_figure
    from experiments.reporting.charts import save
    from experiments.reporting.tensorboard import Events

    figures = {
        "fit": fit_figure(raw, result, f"{name}: measured and model"),
        "drift": drift_figure(result, f"{name}: each segment of about {segment_min:g} min fitted alone"),
        "twin": twin_figure(raw, result, behind, f"{name}: recording and twin"),
    }
    with closing(Events(folder)) as events:
        results = {"mu_per_min": result.mu.value, "tau": result.tau.value, "pmse_pct": result.pmse_pct}
        events.scalars({f"calibration/{tag}": value for tag, value in results.items()}, 0)
        for i, segment in enumerate(result.segments):
            found = {"mu_per_min": segment.mu, "tau": segment.tau}
            events.scalars({f"drift/{tag}": p.value for tag, p in found.items() if p is not None}, i)
        for key, figure in figures.items():
            events.picture(f"calibration/{key}", save(figure, folder / "figures", key), 0)


def _generate(config: CalibrateConfig, folder: Path) -> None:
    protocol = config.protocol
    path = Path(config.out) if config.out else folder / f"{config.law}.csv"
    if path.exists():
        raise frame.UserError(f"out={path}: this file exists; remove it or choose another file")
    time, od, pump_rate, _ = simulated(config, 1)
    with frame.refusing(RecordingError), Recorder(path, COLUMNS, fsync=False) as recorder:
        for t, y, u in zip(time, od[0], pump_rate[0], strict=True):
            recorder.write({"time_min": round(float(t), 4), "od": round(float(y), 5), "pump_rate_ml_s": float(u)})
    files.write_json(
        folder / "summary.json", {"file": str(path), "rows": len(time), "mu": protocol.mu, "tau": protocol.tau}
    )
    print(f"{len(time)} rows ({config.law}; mu {protocol.mu:g}, tau {protocol.tau:g}) in {path}")


main = frame.EntryPoint("calibrate", CalibrateConfig(), body)


if __name__ == "__main__":
    main()
