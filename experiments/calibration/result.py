"""Output of a calibration: summary.json, environment file, report on the console."""

from dataclasses import asdict
from typing import Any

import numpy as np

from conf.schema import entries
from envs.identification.calibration import Calibration
from envs.identification.drift import Drift
from envs.identification.model import NotIdentifiable, Parameter
from envs.identification.refusal import GrowthAlone
from envs.identification.screening import Series, row_spans
from envs.identification.verdict import Verdict
from envs.task import EnvConfig
from experiments.calibration.twin_file import yaml_line
from experiments.recordings.reader import Recording

__all__ = ["environment_yaml", "refusal", "report", "summary"]

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

    A fault of the recording comes first, e.g. a wrong pump.
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
    """Write the environment with the fitted mu and tau, the meaning of every value, and the source of the two.

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
        *(f"# Against it: {w}." for w in result.warnings),
    ]
    lines += map(yaml_line, entries(model))
    return "\n".join(lines) + "\n"


def report(result: Calibration, recording: Recording, content: dict[str, Any]) -> str:
    """Describe the result for a person in a dozen lines, the verdict first."""
    mu, tau, v = result.mu, result.tau, result.validation
    first, end = result.window_rows
    lines = [
        "",
        result.verdict.line(),
        "",
        f"  mu          {mu.value:.5f} 1/min   95 % {mu.low:.5f} to {mu.high:.5f}   "
        f"(doubling time {content['doubling_min']:.1f} min)",
        f"  tau         {tau.value:.4f}          95 % {tau.low:.4f} to {tau.high:.4f}   "
        f"(dilution {0.02 / tau.value:.4f} 1/min at 0.02 mL/s)",
        f"  window      rows {first}:{end}, {result.window_reason}",
        *_disturbances(result),
        *_beside(result),
        f"  PMSE        {result.pmse_pct:.3g} %   (100 sum e^2 / sum OD^2 of the free-running least-squares fit, as in "
        f"the paper; {result.pair_pmse_pct:.3g} % with the returned pair)",
    ]
    if v.holdout_pct is not None and v.early_pct is not None:
        lines.append(
            f"  held out    PMSE {v.holdout_pct:.3g} % over the window's last 30 % with the pair of the first 70 %, "
            f"{v.early_pct:.3g} % over its own rows; an hour ahead each"
        )
    lines += [
        f"  {a.minutes:.0f} min ahead {a.model_pct:.2g} % rms, the first half predicts the second; the OD stays: "
        f"{a.od_stays_pct:.2g} %; the slope of 20 min goes on: {a.same_slope_pct:.2g} %"
        for a in v.ahead
    ]
    if v.outside_pct is not None:
        lines.append(
            f"              PMSE {v.outside_pct:.3g} % on {v.outside_n} readings outside the window, from a new start"
        )
    for name, drift in (("mu", result.drift_mu), ("tau", result.drift_tau)):
        if drift is not None and drift.significant:
            lines.append(
                f"  drift       {name} {drift.first:.3g} to {drift.last:.3g} along the recording "
                f"({drift.change_pct:+.0f} %)"
            )
    lines += [f"  rejected    rows {row_spans(r.rows)} ({len(r.rows)}): {r.reason}" for r in result.screened.rejections]
    lines += [f"  note        {note}" for note in recording.notes]
    lines += [f"  against     {warning}" for warning in result.warnings]
    return "\n".join(lines)


def _disturbances(result: Calibration) -> list[str]:
    """Describe the estimated disturbances of the bench."""
    if not result.sound:
        return []
    q = result.estimate.quality
    doses, growth, late = (
        f"{100 * p.value:.0f} % ({100 * p.low:.0f} to {100 * p.high:.0f})"
        for p in (q.dose_spread, q.growth_spread, q.late_share)
    )
    return [
        f"  bench       doses spread by {doses}; {late} of a dose shows one reading late; "
        f"readings by {100 * q.noise:.1f} %",
        f"  culture     growth rate fluctuates by {growth} from hour to hour",
    ]


def _beside(result: Calibration) -> list[str]:
    """Describe the pair of the other method."""
    free, found = result.free_run, result.estimate
    if result.method == "free_run":
        other = None if not result.sound or found.tau is None else (found.mu, found.tau, "prediction_error")
    else:
        other = None if free is None or free.tau is None else (free.mu, free.tau, "free_run")
    if other is None:
        return []
    mu, tau, name = other
    return [
        f"  beside      {name}: mu {mu.value:.5f} ({mu.low:.5f} to {mu.high:.5f}), "
        f"tau {tau.value:.4f} ({tau.low:.4f} to {tau.high:.4f})"
    ]
