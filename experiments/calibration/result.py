"""Output files of a calibration: summary.json, the environment, and twin.yaml, a plant fitted to the recording."""

from dataclasses import asdict, replace
from textwrap import wrap
from typing import Any

import numpy as np
from numpy.typing import NDArray

from conf.schema import Entry, entries
from envs.bench import Bench
from envs.identification.drift import Drift
from envs.identification.model import NotIdentifiable, Parameter
from envs.identification.screening import Series, row_spans
from envs.identification.twin import Course, Twin
from envs.identification.verdict import Calibration, GrowthAlone, Verdict
from envs.plant.culture import GrowthConfig
from envs.plant.plant import PlantConfig
from envs.plant.pump import PumpConfig
from envs.plant.sensor import SensorConfig
from envs.plant.vessel import VesselConfig
from envs.task import EnvConfig
from experiments.recordings.reader import Recording

Array = NDArray[np.float64]

DIGITS, WIDTH = 5, 120
LEFT = (
    "One recording cannot show these values, which keep their defaults: dead time, shortest pulse and priming of the "
    "pump (its flow holds for pulses as long as the recorded ones), spread between vials, slope and blank of the "
    "sensor, substrate, temperature, wall."
)
PMSE_FORMULA = "100 * sum (od - model)^2 / sum od^2 over the window, least-squares fit run freely from its start"


def summary(result: Calibration, recording: Recording, raw: Series) -> dict[str, Any]:
    """Build summary.json; rows are [first, end), counted from 0; n_rejected counts readings within `rows`."""
    row = result.screened.series.row
    return {
        "verdict": asdict(result.verdict),
        "mu": _interval(result.mu),
        "tau": _interval(result.tau),
        "method": result.method,
        "pmse_pct": result.pmse_pct,
        "pmse_formula": PMSE_FORMULA,
        "pair_pmse_pct": result.pair_pmse_pct,
        "rows_used": list(result.window_rows),
        "n_used": result.n_used,
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
        "doubling_min": float(np.log(2.0) / result.mu.value),
        "prediction_error": _prediction_error(result),
        "free_run": _free_run(result),
        "validation": asdict(result.validation),
        "drift": {"mu": _drift(result.drift_mu), "tau": _drift(result.drift_tau)},
        "segments": [
            {
                "rows": [int(row[s.first]), int(row[s.end - 1]) + 1],
                "middle_min": s.middle_min,
                "mu": None if s.mu is None else _interval(s.mu),
                "tau": None if s.tau is None else _interval(s.tau),
            }
            for s in result.segments
        ],
    }


def refusal(error: NotIdentifiable, alone: GrowthAlone | None, recording: Recording) -> tuple[str, dict[str, Any]]:
    """Build the message and the summary.json of a refused calibration.

    The message names a fault of the recording, e.g. a wrong pump, before any other reason.
    """
    what, then = recording.doubts[0] if recording.doubts else ("", error.remedy)
    verdict = Verdict("record again" if not what else "read again", "; ".join(filter(None, (what, error.why))), then)
    known = [] if alone is None else [alone.words()]
    content: dict[str, Any] = {
        "verdict": asdict(verdict),
        "mu": None,
        "tau": None,
        "mu_alone": None,
        "net_growth": None,
    }
    if alone is not None:
        content["net_growth"] = {**_interval(alone.net), "rows": list(alone.net_rows)}
        if alone.mu is not None and alone.mu_rows is not None:
            content["mu_alone"] = {**_interval(alone.mu), "rows": list(alone.mu_rows)}
    content |= {"notes": list(recording.notes), "source": recording.source}
    return "; ".join([verdict.line(), *known, *recording.notes]), content


def _prediction_error(result: Calibration) -> dict[str, Any] | None:
    found = result.estimate
    if not result.sound or found.tau is None:
        return None
    q = found.quality
    spreads = {name: _interval(getattr(q, name)) for name in ("dose_spread", "growth_spread", "late_share")}
    return {"mu": _interval(found.mu), "tau": _interval(found.tau), "innovations": asdict(q) | spreads}


def _free_run(result: Calibration) -> dict[str, Any] | None:
    found = result.free_run
    if found is None or found.tau is None:
        return None
    fit = {"pmse_pct": found.pmse_pct, "rms_od": found.rms, "residual_autocorrelation": found.autocorrelation}
    return {"mu": _interval(found.mu), "tau": _interval(found.tau), **fit, "start_od": found.start_od}


def _interval(p: Parameter) -> dict[str, Any]:
    return {"value": p.value, "ci95": [p.low, p.high]}


def _drift(d: Drift | None) -> dict[str, Any] | None:
    if d is None:
        return None
    line = {"first": d.first, "last": d.last, "change_pct": d.change_pct, "per_hour": _interval(d.slope_per_h)}
    return {**line, "significant": d.significant, "segments": d.segments}


def environment_yaml(result: Calibration, source: str) -> str:
    """Return the environment file's text: fitted mu and tau with their source, and all values with their meaning.

    Raises: ValueError with the value that is out of range for an environment.
    """
    model = EnvConfig(mu=result.mu.value, tau=result.tau.value)
    mu, tau = result.mu, result.tau
    first, end = result.window_rows
    lines = [
        "# Training model x' = (mu - u/tau) x, equation (5) of the paper, fitted to a recording by calibrate.",
        f"# Recording {source}, rows {first}:{end}, {result.n_used} readings, method {result.method}, "
        f"PMSE {result.pmse_pct:.3g} %.",
        f"# 95 % intervals: mu {mu.low:.6g} to {mu.high:.6g} 1/min, tau {tau.low:.6g} to {tau.high:.6g}.",
        f"# {result.verdict.line()}.",
        *(f"# Warning: {w}." for w in result.warnings),
    ]
    lines += map(yaml_line, entries(model))
    return "\n".join(lines) + "\n"


def plant_of(found: Twin) -> PlantConfig:
    """Convert the twin to a plant. Raises: ValueError with the value that is out of range for a plant."""
    if (negative := found.knot_min[found.mu.value < 0.0]).size:
        raise ValueError(f"the growth rate is negative {negative[0] / 60.0:.1f} h after the first row used")
    volume = Bench.volume_ml  # a recording determines only flow over volume: the file has both
    flow, knots = volume / (60.0 * found.tau.value), _numbers(found.knot_min)
    growth = GrowthConfig(mu=_mean(found.mu.value), knots_min=knots, knots_mu=_numbers(found.mu.value))
    pump = PumpConfig(dosing="pulse", gain_ml_s=_mean(flow), pulse_cv=_rounded(found.noise.dose_cv))
    if found.drifts:
        pump = replace(pump, knots_min=knots, knots_ml_s=_numbers(flow))
    noise = found.noise
    sensor = SensorConfig(
        noise_floor=_rounded(noise.floor),
        noise_relative=_rounded(noise.relative),
        lag1=_rounded(noise.lag1),
        outlier_rate=_rounded(noise.outlier_rate),
    )
    return PlantConfig(growth, pump, sensor, VesselConfig(volume), start_od=_rounded(found.start_od), integrator="rk4")


def twin_yaml(found: Twin, source: str) -> str:
    """Return the plant file's text: all values that differ from a plant's defaults, with meaning and unit.

    Raises: ValueError with the value that is out of range for a plant.
    """
    plant, (first, end) = plant_of(found), found.rows
    hours = found.knot_min[-1] / 60.0
    tau = "at the knots" if found.drifts else "constant, since the recording does not show its drift"
    said = (
        "Plant fitted to a recording by calibrate, for deploy plant_file=FILE and benchmark plant_file=FILE.",
        f"Recording {source}, rows {first}:{end}, {hours:.1f} h, a reading every {found.row_min:.3g} min. Age 0 is the "
        "first of these rows; start_min begins later.",
        f"mu at the knots, 95 %: {_band(found.mu)} 1/min.",
        f"tau {tau}, 95 %: {_band(found.tau if found.drifts else _first(found.tau))}; flow = volume / (60 tau).",
        LEFT,
    )
    lines = [line for text in said for line in wrap(text, WIDTH, initial_indent="# ", subsequent_indent="# ")]
    nominal = PlantConfig()
    for own, usual in zip(entries(plant), entries(nominal), strict=True):
        if own.value == usual.value:
            continue
        if own.name in ("growth", "pump", "sensor", "vessel"):
            lines.append(f"{own.name}:")
            changed = zip(entries(own.value), entries(usual.value), strict=True)
            lines += [f"  {yaml_line(e)}" for e, was in changed if e.value != was.value]
        else:
            lines.append(yaml_line(own))
    return "\n".join(lines) + "\n"


def yaml_line(entry: Entry) -> str:
    """Return a line of YAML: the value, then its meaning and unit as a comment."""
    value = entry.value
    if isinstance(value, tuple):
        text = "[" + ", ".join(_plain(v) for v in value) + "]"
    else:
        text = _plain(value) if isinstance(value, float) else str(value)
    return f"{entry.name}: {text} # " + ", ".join(filter(None, (entry.said.what, entry.said.unit)))


def _plain(value: float) -> str:
    """Write a number so that YAML reads it back: 5e-05 would be a string there."""
    return np.format_float_positional(value, trim="0")


def _rounded(value: float) -> float:
    return float(f"{value:.{DIGITS}g}")


def _numbers(values: Array) -> tuple[float, ...]:
    return tuple(_rounded(float(v)) for v in values)


def _mean(values: Array) -> float:
    """Return the mean over time of the values at evenly spaced knots."""
    return _rounded(float(np.trapezoid(values) / (len(values) - 1)))


def _first(course: Course) -> Course:
    return Course(course.value[:1], course.low[:1], course.high[:1])


def _band(course: Course) -> str:
    return ", ".join(f"{low:.3g} to {high:.3g}" for low, high in zip(course.low, course.high, strict=True))
