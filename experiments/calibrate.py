"""A recording in, one trustworthy pair (mu, tau) out, as a model file for `train`: `python -m experiments.calibrate`.

Also the generator of the paper's open-loop protocol (generate=true) and the coverage study (coverage=N).
"""

import re
from dataclasses import dataclass
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np

from conf.schema import check, entries, part, require, setting
from envs.identification.fit import Parameter
from envs.identification.open_loop import OpenLoop, open_loop
from envs.identification.screening import Series, row_spans
from envs.identification.window import Calibration, Drift, IdentifyConfig, calibrate
from envs.task import EnvConfig
from experiments.cli import files, frame
from hardware.errors import RecordingError
from hardware.storage.recorder import Recorder
from hardware.storage.recording_reader import Recording, read_recording

__all__ = ["CalibrateConfig", "body", "environment_yaml", "main", "summary"]

COLUMNS = ("time_min", "od", "pump_rate_ml_s")
PMSE_FORMULA = "100 * sum (od - model)^2 / sum od^2 over the fitted readings, model run freely from one fitted start"


@dataclass(frozen=True)
class CalibrateConfig:
    """A recording and how it is fitted; or the generator of recordings; or the study of the intervals' coverage."""

    data: str | None = setting(None, "recording (CSV); null: the synthetic one that the project ships")
    rows: str | None = setting(None, "FIRST:END, data rows counted from 0, END excluded; null: all")
    run: int | None = setting(None, "which of several concatenated runs, from 0; null: the longest")
    reactor: str | None = setting(None, "which reactor of a file with a column `reactor`; null: the first")
    pump_ml_s: float = setting(
        1.0,
        "flow of the Chi.Bio's feed pump at full power (its own CSV holds duties, not flows)",
        "mL/s",
        above=0.0,
        at_most=10.0,
    )
    name: str = setting("calibrated", "the environment file is RUN/<name>.yaml")
    identify: IdentifyConfig = part(IdentifyConfig, "how the window is chosen and what is reported")
    generate: bool = setting(False, "simulate the paper's open-loop protocol and write it as a recording")
    out: str | None = setting(None, "where to; null: RUN/open_loop.csv")
    coverage: int = setting(
        0,
        "simulate so many recordings and count how often the 95 % intervals hold the truth; 0: no study",
        within=(0, 10000),
    )
    protocol: OpenLoop = part(OpenLoop, "protocol, culture and sensor of a simulated recording")

    def __post_init__(self) -> None:
        check(self)
        named = re.fullmatch(r"[\w-]+", self.name)
        require(bool(named), "name", self.name, "letters, digits, _ and - (it names a file)")
        spans = self.rows is None or re.fullmatch(r"\d*:\d*", self.rows)
        require(bool(spans), "rows", self.rows, "FIRST:END, e.g. 0:700 (data rows from 0, END excluded)")


def body(config: CalibrateConfig, folder: Path) -> float | None:
    """Calibrate, generate a recording, or study the coverage, as the config says.

    Returns: PMSE in % of a calibration. Raises: frame.UserError.
    """
    if config.generate:
        _generate(config, folder)
        return None
    if config.coverage:
        return _coverage(config, folder)
    return _calibrate(config, folder)


def _calibrate(config: CalibrateConfig, folder: Path) -> float:
    source = config.data or str(resources.files("experiments") / "data" / "open_loop.csv")
    print(f"reading {config.data or 'the shipped recording'}", flush=True)
    try:
        recording = read_recording(source, pump_ml_s=config.pump_ml_s, run=config.run, reactor=config.reactor)
    except RecordingError as error:
        raise frame.UserError(str(error)) from None
    raw = _series(recording, config.rows, source)
    hours = (raw.time[-1] - raw.time[0]) / 60
    print(f"{recording.source}: rows {raw.row[0]}-{raw.row[-1]}, {hours:.1f} h; fitting", flush=True)
    try:
        result = calibrate(raw, config.identify)
    except ValueError as error:
        raise frame.UserError(f"{source}: {error}") from None
    name = Path(source).name
    environment = folder / f"{config.name}.yaml"
    environment.write_text(environment_yaml(result, name), encoding="utf-8")
    content = summary(result, recording, raw)
    files.write_json(folder / "summary.json", {**content, "data": source, "env_file": str(environment)})
    _draw(folder, raw, result, name, config.identify.segment_min)
    print(report(result, recording, content))
    print(f"\n  files       {environment}\n              {folder}/{{summary.json, figures/}}")
    return result.fit.pmse_pct


def _series(recording: Recording, rows: str | None, source: str) -> Series:
    """The asked-for rows of a recording. Raises: frame.UserError if there are fewer than ten."""
    first, end = 0, int(recording.row[-1]) + 1
    if rows is not None:
        low, high = rows.split(":")
        first, end = int(low or 0), int(high or end)
    keep = (recording.row >= first) & (recording.row < end)
    if np.isfinite(recording.od[keep]).sum() < 10:
        raise frame.UserError(
            f"rows = {rows}: {int(keep.sum())} rows of {source} lie there; the recording has rows "
            f"{recording.row[0]}:{recording.row[-1] + 1}; at least 10 readings are needed"
        )
    return Series(recording.time_min[keep], recording.od[keep], recording.pump_rate[keep], recording.row[keep])


def summary(result: Calibration, recording: Recording, raw: Series) -> dict[str, Any]:
    """What summary.json holds; rows are [first, end), counted from 0; n_rejected counts readings within `rows`."""
    row = result.screened.series.row
    v = result.validation
    return {
        "mu": _interval(result.fit.mu),
        "tau": _interval(result.tau),
        "pmse_pct": result.fit.pmse_pct,
        "pmse_formula": PMSE_FORMULA,
        "rows_used": list(result.window_rows),
        "n_used": result.fit.n_used,
        "n_rejected": len(raw.od) - int(np.isfinite(result.screened.series.od).sum()),
        "warnings": list(result.warnings),
        "notes": list(recording.notes),
        "rejected": [
            {"rows": row_spans(r.rows), "first": int(r.rows[0]), "last": int(r.rows[-1])}
            | {"n": len(r.rows), "reason": r.reason}
            for r in result.screened.rejections
        ],
        "window": result.window_reason,
        "rows": [int(raw.row[0]), int(raw.row[-1]) + 1],
        "source": recording.source,
        "rms_od": result.fit.rms,
        "residual_autocorrelation": result.fit.autocorrelation,
        "start_od": float(result.fit.start_od[0]),
        "doubling_min": float(np.log(2.0) / result.fit.mu.value),
        "validation": {
            "holdout_pmse_pct": v.holdout_pct,
            "holdout_n": v.holdout_n,
            "outside_pmse_pct": v.outside_pct,
            "outside_n": v.outside_n,
        },
        "drift": {"mu": _drift(result.drift_mu), "tau": _drift(result.drift_tau)},
        "segments": [
            {
                "rows": [int(row[s.first]), int(row[s.end - 1]) + 1],
                "middle_min": s.middle_min,
                "mu": None if s.mu is None else _interval(s.mu),
                "tau": None if s.tau is None else _interval(s.tau),
                "pmse_pct": s.pmse_pct,
            }
            for s in result.segments
        ],
    }


def _interval(p: Parameter) -> dict[str, Any]:
    return {"value": p.value, "ci95": [p.low, p.high]}


def _drift(d: Drift | None) -> dict[str, Any] | None:
    if d is None:
        return None
    line = {"first": d.first, "last": d.last, "change_pct": d.change_pct, "per_hour": _interval(d.slope_per_h)}
    return {**line, "significant": d.significant, "segments": d.segments}


def environment_yaml(result: Calibration, source: str) -> str:
    """The environment with the fitted mu and tau, every value with its meaning, and where the two come from."""
    mu, tau = result.fit.mu, result.tau
    first, end = result.window_rows
    lines = [
        "# Training model x' = (mu - u/tau) x, equation (5) of the paper, fitted to a recording by calibrate.",
        f"# Recording {source}, rows {first}:{end}, {result.fit.n_used} readings, PMSE {result.fit.pmse_pct:.3g} %.",
        f"# 95 % intervals: mu {mu.low:.6g} to {mu.high:.6g} 1/min, tau {tau.low:.6g} to {tau.high:.6g}.",
        *(f"# Warning: {w}." for w in result.warnings),
    ]
    for entry in entries(EnvConfig(mu=mu.value, tau=tau.value)):
        comment, given = ", ".join(filter(None, (entry.said.what, entry.said.unit))), entry.value
        lines.append(f"{entry.name}: {list(given) if isinstance(given, tuple) else given} # {comment}")
    return "\n".join(lines) + "\n"


def _draw(folder: Path, raw: Series, result: Calibration, name: str, segment_min: float) -> None:
    """Figures, as files and for TensorBoard, and its scalars."""
    from experiments.reporting.calibration_charts import drift_figure, fit_figure
    from experiments.reporting.charts import save
    from experiments.reporting.tensorboard import Events

    figures = {
        "fit": fit_figure(raw, result, f"{name}: measured and free-running model"),
        "drift": drift_figure(result, f"{name}: segments of about {segment_min:g} min, fitted alone"),
    }
    events = Events(folder)
    for tag, value in (
        ("mu_per_min", result.fit.mu.value),
        ("tau", result.tau.value),
        ("pmse_pct", result.fit.pmse_pct),
    ):
        events.scalar(f"calibration/{tag}", value, 0)
    for i, segment in enumerate(result.segments):
        for name, parameter in (("mu_per_min", segment.mu), ("tau", segment.tau)):
            if parameter is not None:
                events.scalar(f"drift/{name}", parameter.value, i)
    for key, figure in figures.items():
        save(figure, folder / "figures", key)
        events.figure(f"calibration/{key}", figure, 0)
    events.close()


def report(result: Calibration, recording: Recording, content: dict[str, Any]) -> str:
    """The result for a human, a dozen lines."""
    mu, tau, v = result.fit.mu, result.tau, result.validation
    first, end = result.window_rows
    lines = [
        "",
        f"  mu          {mu.value:.5f} 1/min   95 % {mu.low:.5f} to {mu.high:.5f}   "
        f"(doubling time {content['doubling_min']:.1f} min)",
        f"  tau         {tau.value:.4f}          95 % {tau.low:.4f} to {tau.high:.4f}   "
        f"(dilution {0.02 / tau.value:.4f} 1/min at 0.02 mL/s)",
        f"  PMSE        {result.fit.pmse_pct:.3g} %   (100 sum e^2 / sum OD^2; rms error {result.fit.rms:.4f} OD)",
        f"  window      rows {first}:{end} - {result.window_reason}",
    ]
    if v.holdout_pct is not None:
        lines.append(f"  held out    PMSE {v.holdout_pct:.3g} % over the window's last 30 %, fitted to the first 70 %")
    if v.outside_pct is not None:
        lines.append(
            f"              PMSE {v.outside_pct:.3g} % on {v.outside_n} readings outside the window, started afresh"
        )
    for name, drift in (("mu", result.drift_mu), ("tau", result.drift_tau)):
        if drift is not None:
            sure = "" if drift.significant else ", within its uncertainty"
            lines.append(
                f"  drift       {name} {drift.first:.3g} to {drift.last:.3g} along the recording "
                f"({drift.change_pct:+.0f} %{sure})"
            )
    lines += [f"  rejected    rows {row_spans(r.rows)} ({len(r.rows)}): {r.reason}" for r in result.screened.rejections]
    lines += [f"  note        {note}" for note in recording.notes]
    lines += [f"  warning     {warning}" for warning in result.warnings]
    return "\n".join(lines)


def _generate(config: CalibrateConfig, folder: Path) -> None:
    protocol = config.protocol
    path = Path(config.out) if config.out else folder / "open_loop.csv"
    if path.exists():
        raise frame.UserError(f"out={path}: exists; remove it or choose another file")
    time, od, pump_rate = open_loop(protocol, np.random.default_rng(protocol.seed))
    try:
        with Recorder(path, COLUMNS, fsync=False) as recorder:
            for t, y, u in zip(time, od[0], pump_rate[0], strict=True):
                recorder.write({"time_min": round(float(t), 4), "od": round(float(y), 5), "pump_rate_ml_s": float(u)})
    except RecordingError as error:
        raise frame.UserError(str(error)) from None
    files.write_json(
        folder / "summary.json", {"file": str(path), "rows": len(time), "mu": protocol.mu, "tau": protocol.tau}
    )
    print(f"{len(time)} rows of the open-loop protocol (mu {protocol.mu:g}, tau {protocol.tau:g}) in {path}")


def _coverage(config: CalibrateConfig, folder: Path) -> float:
    """Share of simulated recordings whose 95 % intervals hold the truth; returns the smaller of the two, in %."""
    protocol, n = config.protocol, config.coverage
    print(f"simulating {n} recordings of {protocol.hours:g} h with {100 * protocol.noise:g} % noise", flush=True)
    time, od, pump_rate = open_loop(protocol, np.random.default_rng(protocol.seed), n)
    rows = np.arange(len(time))
    found = []
    for i in range(n):
        try:
            found.append(calibrate(Series(time, od[i], pump_rate[i], rows), config.identify))
        except ValueError as error:
            raise frame.UserError(f"simulated recording {i}: {error}") from None
    pairs = [(c.fit.mu, c.tau) for c in found]
    mu, tau = (np.array([(p.value, p.low, p.high) for p in column]) for column in zip(*pairs, strict=True))
    truth, shares, widths = (protocol.mu, protocol.tau), {}, {}
    for name, values, true in zip(("mu", "tau"), (mu, tau), truth, strict=True):
        shares[name] = 100.0 * float(np.mean((values[:, 1] <= true) & (true <= values[:, 2])))
        widths[name] = 50.0 * float(np.median((values[:, 2] - values[:, 1]) / values[:, 0]))
    title = f"{n} simulated recordings of {protocol.hours:g} h, {100 * protocol.noise:g} % noise (seed {protocol.seed})"
    from experiments.reporting.calibration_charts import coverage_figure
    from experiments.reporting.charts import save

    save(coverage_figure(mu, tau, truth, title), folder / "figures", "coverage")
    numbers = {"recordings": n, "coverage_pct": shares, "noise": protocol.noise, "relative_half_width_pct": widths}
    files.write_json(folder / "summary.json", numbers)
    print(f"95 % intervals hold the truth: mu {shares['mu']:.1f} %, tau {shares['tau']:.1f} % of {n}")
    print(f"figure and summary in {folder}")
    return min(shares.values())


main = frame.Command("calibrate", CalibrateConfig(), body)


if __name__ == "__main__":
    main()
