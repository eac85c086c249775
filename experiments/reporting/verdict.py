"""Verdict at the top of a run's page: what was run, the main results, and how good they are."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from envs.bench import Bench
from experiments.reporting.curves import BAND, CALLED, ERROR_UNITS, signals_in
from experiments.reporting.tables import count, number

Summary = Mapping[str, Any]
REGRET, STEADY = 0.5, 0.003
"""Limits of regret, %, and steady error, OD, for `env=sim` (experiments/training/density.py). A regret of 0.5 % is
invisible in a recording; 0.003 OD is the noise of the sensor."""

REMEDY = (
    "use policy=shipped, which is certified for every growth rate and pump and needs no training; or repeat the "
    "training with another seed (seed=1), since seeds differ at the ends of the range, and certify the new policy"
)
"""Remedies for a failed requirement of a certificate."""
SHOWN = 3  # number of failed requirements on the page


@dataclass(frozen=True)
class Headline:
    """Verdict on a run. claim: what was run. items: results with units. remark: how good the results are."""

    claim: str
    items: list[str] = field(default_factory=list)
    remark: str = ""


def verdict(summary: Summary, config: Mapping[str, Any]) -> Headline | None:
    """Return the verdict on a training, deployment, calibration, certificate or replay; None for any other run."""
    for key, of in KINDS.items():
        if key in summary:
            try:
                return of(summary, config)
            except (LookupError, TypeError, ValueError, AttributeError):
                return None
    return None


def _training(summary: Summary, config: Mapping[str, Any]) -> Headline:
    regret, steady, env = np.array(summary["regret_pct"]), np.array(summary["steady_abs_error"]), config["env"]
    agents = f"{regret.size} agents" if regret.size > 1 else f"one agent, seed {summary['seeds'][0]},"
    kind = env.get("kind", "density")
    model = f"mu {number(env['mu'])} 1/min, tau {number(env['tau'])}" if "tau" in env else f"the task env={kind}"
    steps, seconds = summary["env_steps"], summary["train_seconds"]
    claim = f"Training: {agents} trained on {model} for {steps} steps in {seconds:.0f} s."
    unit = ERROR_UNITS.get(kind, ERROR_UNITS["relative"])
    law = summary["myopic_regret_pct"]
    best = [*summary["seeds"]].index(summary["policy_seed"])
    own, error = float(regret[best]), float(steady[best])
    who = f" (policy.npz: seed {summary['policy_seed']}, the best agent)" if regret.size > 1 else ""
    worst = f"; worst agent {number(regret.max())} %" if regret.size > 1 else ""
    items = [
        f"regret {number(own)} %{who}: cost of the policy above that of the exact optimum{worst}",
        f"steady error at the worst setpoint {number(error)} {unit}",
        f"for comparison, the one-line controller (one period ahead): regret {number(round(law, 4))} %, steady error "
        f"{number(summary['myopic_steady_abs_error'])} {unit}",
    ]
    if kind != "density":
        return Headline(claim, items)
    if own > REGRET:
        word = f"Not good yet: the regret is above {REGRET:g} %. Train longer, or with n_agents=8, which keeps the best"
    elif error > STEADY:
        word = f"Nearly optimal, but the steady error is above {STEADY:g} OD. The best of n_agents=8 may be better"
    else:
        word = f"Good: the regret is at most {REGRET:g} % and the steady error at most {STEADY:g} OD"
    return Headline(claim, items, f"{word}.")


def _deployment(summary: Summary, config: Mapping[str, Any]) -> Headline:
    from hardware.family import family, known  # slow: imports the simulated plant, too

    windows: Sequence[Summary] = summary["windows"]
    backend = config["backend"]["kind"]
    where = family(backend).called if backend in known() else f"the reactors of {backend}"
    hours, did = summary["minutes"] / 60.0, "only watched" if config.get("watch") else "held"
    claim = (
        f"Deployment: {config['controller']['kind']} {did} {', '.join(summary['reactors'])} on {where} for "
        f"{hours:.1f} h; {summary['outcome']}."
    )
    steady = [w["steady_abs_error"] / w["setpoint"] for w in windows if w["steady_abs_error"] is not None]
    items = [f"fresh medium {number(summary['volume_ml'])} mL"]
    items += [f"interlock alarms in {count(sum(r['interlock'] for r in summary['reactors'].values()), 'sample')}"]
    for signal in signals_in(windows):
        errors = [w[key] for w in windows if w.get(key := f"{signal}_abs_error_mean") is not None]
        if errors:
            said = number(float(np.mean(errors)))
            items.append(f"mean error of the estimated {CALLED.get(signal, signal)} {said}")
    if not steady:
        return Headline(claim, items, "No window was long enough to judge how well its setpoint was held.")
    worst = max(w["steady_abs_error"] for w in windows if w["steady_abs_error"] is not None)
    items.insert(0, f"largest steady error {number(worst)} OD (mean error in the last 10 min of a window)")
    held = sum(error <= BAND for error in steady)
    word = "Good" if held == len(windows) else "Not good"
    return Headline(claim, items, f"{word}: {held} of {len(windows)} windows ended within 5 % of their setpoint.")


def _calibration(summary: Summary, config: Mapping[str, Any]) -> Headline:
    data = Path(config["data"]).name if config.get("data") else "the shipped recording"
    said = summary["verdict"]
    claim = f"Calibration of {data}: " + "; ".join(filter(None, (f"{said['word']}: {said['why']}", said["then"]))) + "."
    if summary["mu"] is None:
        alone = ((name, summary[name]) for name in ("mu_alone", "net_growth"))
        told = [
            f"{name.replace('_', ' ')} {number(p['value'])} 1/min, 95 % interval {number(p['ci95'][0])} to "
            f"{number(p['ci95'][1])}, rows {p['rows'][0]} to {p['rows'][1] - 1}"
            for name, p in alone
            if p is not None
        ]
        return Headline(claim, told, "; ".join(summary["notes"]))
    mu, tau = ((p["value"], *p["ci95"]) for p in (summary["mu"], summary["tau"]))
    items = [
        f"mu {number(mu[0])} 1/min, 95 % interval {number(mu[1])} to {number(mu[2])}; doubling time "
        f"{number(summary['doubling_min'])} min",
        f"tau {number(tau[0])}, 95 % interval {number(tau[1])} to {number(tau[2])}; in {Bench.volume_ml:g} mL the "
        f"pump then delivers {number(Bench.volume_ml / 60.0 / tau[0])} times the stated flow (recording, pump_ml_s)",
        f"PMSE {number(summary['pmse_pct'])} % (squared residual / squared OD); {summary['n_used']} readings used, "
        f"{summary['n_rejected']} rejected",
    ]
    items += [
        f"the first half's fit predicts the second half {a['minutes']:.0f} min ahead with rms error "
        f"{number(a['model_pct'], 2)} % (if OD stayed constant: {number(a['od_stays_pct'], 2)} %; if its slope did: "
        f"{number(a['same_slope_pct'], 2)} %)"
        for a in summary.get("validation", {}).get("ahead", ())
    ]
    against = "; ".join(summary["warnings"])
    return Headline(claim, items, f"Warnings: {against}." if against else "Good: no warnings.")


def _certificate(summary: Summary, config: Mapping[str, Any]) -> Headline:
    checks: Sequence[Any] = summary["checks"]
    claim = f"Certificate of a policy for {', '.join(summary['observation'])}."
    unsafe = not all(check["holds"] for check in checks if check["kind"] == "safety")
    failed = [check["name"] for check in sorted(checks, key=lambda c: c["kind"] != "safety") if not check["holds"]]
    items = [f"{len(checks)} requirements were checked, listed below", *(f"failed: {name}" for name in failed[:SHOWN])]
    items += [f"{len(failed) - SHOWN} more failed"] * (len(failed) > SHOWN)
    if not failed:
        return Headline(claim, items, "Good: the policy is safe and meets every performance requirement.")
    said = "Not safe: devices refuse this policy" if unsafe else "Safe: devices accept it, but it performs poorly"
    return Headline(claim, items, f"{said}. Remedy: {REMEDY}.")


def _replay(summary: Summary, config: Mapping[str, Any]) -> Headline:
    inside, doses, twin = summary["inside_pct"], summary["doses_pct"], summary["twin"]
    data = Path(config["data"]).name if config.get("data") else "the shipped recording"
    claim = f"Replay of {data}: {number(inside['one'])} % of the readings lay in the 95 % band predicted one reading "
    claim += f"ahead, and {number(inside['ten'])} % in that predicted {summary['ahead']} readings ahead."
    items = [f"{name} {number(low)} to {number(high)}" for name, (low, high) in _spreads(summary)]
    items += [
        f"doses at setpoint OD {number(summary['setpoint'])}, % of readings: both {doses['both']:.0f}, neither "
        f"{doses['neither']:.0f}, only device {doses['device']:.0f}, only controller {doses['controller']:.0f}",
        f"rejected {number(summary['not_believed_pct'])} %; filter alarm acts: {number(summary['filter_alarm_pct'])} %",
        "alarms and notes (readings): " + (", ".join(f"{k} {n}" for k, n in summary["interlock"].items()) or "none"),
    ]
    if "none" in twin:
        return Headline(claim, items, f"No closed loop on a twin: {twin['none']}.")
    error = f"holds OD {number(summary['setpoint'])} with a mean error of {number(twin['mean_abs_error'])} OD"
    return Headline(claim, items, f"On the recording's twin the controller {error} for {twin['hours']:.0f} h.")


def _spreads(summary: Summary) -> list[tuple[str, tuple[float, float]]]:
    """Return label and range of the estimates: growth rate; effect of the pump, % of the model's; only known ones."""
    scales = {"mu": ("growth rate, 1/min,", 1.0), "gain": ("effect of the pump, % of the model's (env_file),", 100.0)}
    known = [(name, scale, summary[key]) for key, (name, scale) in scales.items() if summary[key] is not None]
    return [(name, (scale * low, scale * high)) for name, scale, (low, high) in known]


KINDS = {
    "doses_pct": _replay,
    "train_seconds": _training,
    "windows": _deployment,
    "net_growth": _calibration,
    "pmse_pct": _calibration,
    "cannot_hold": _certificate,
}
