"""Section of a run's page that compares the predictions of its model with the recordings."""

import json
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from omegaconf import DictConfig

from conf import guests
from conf.schema import build
from dqn import policy as policies
from envs.bench import Bench
from envs.identification.agreement import Agreement, Compared, agreement
from envs.identification.model import Parameter
from envs.identification.screening import Series
from envs.task import EnvConfig
from experiments.cli import files, frame
from experiments.cli.calibrated import read_env_file
from experiments.loop.signals import ESTIMATED, within_2sd
from experiments.recordings.reader import read_recording
from experiments.reporting.page import Page
from experiments.reporting.tables import Table, number, span
from hardware.errors import RecordingError

Array = NDArray[np.float64]

DECISION = '"kind":"decision"'
INCOMPARABLE: list[Callable[[Mapping[str, Any]], str]] = []
"""Functions of a run's config that return why the run has no model to compare with, or "". A guest adds its own."""
ESTIMATES = ("mu", "gain")  # estimates of culture and pump that a controller may report
COLUMNS = ("hours", "growth rate, 1/min", "pump gain, 1 = the model's", "net growth beyond the model's, 1/min")


@dataclass(frozen=True)
class Believed:
    """Model to compare a run with. source: origin of the model. planned: whether the run's controller used it."""

    mu: float
    tau: float
    source: str
    planned: bool = False


def believed(run: Path) -> Believed:
    """Return the model of a deployment: that of its policy, else that of its `env_file`, else the nominal one."""
    config = _config(run)
    nominal = EnvConfig(tau=_bench(config).tau)
    controller = config.get("controller")
    learned = isinstance(controller, Mapping) and controller.get("kind") == "dqn"
    if learned and (run / "policy.npz").is_file():
        try:
            model = policies.load(run / "policy.npz").metadata["model"]
            return Believed(float(model["mu"]), float(model["tau"]), "the policy's training model", True)
        except (policies.PolicyError, KeyError, TypeError, ValueError):
            pass  # the policy has no model or is damaged, so the run used another model, too
    if path := config.get("env_file"):
        try:
            env = read_env_file(str(path))
            return Believed(env.mu, env.tau, f"env_file {path}", not learned)
        except frame.UserError:
            return Believed(nominal.mu, nominal.tau, f"nominal, because env_file {path} can no longer be read")
    return Believed(nominal.mu, nominal.tau, "nominal")


def _bench(config: Mapping[str, Any]) -> Bench:
    with frame.refusing(ValueError):
        return build(Bench(), config.get("bench") or {}, "bench")


def _config(run: Path) -> Mapping[str, Any]:
    try:
        config = files.load_yaml(run / "config.yaml")
    except (OSError, ValueError):
        return {}
    return config if isinstance(config, DictConfig) else {}


def decisions(run: Path, reactor: str) -> dict[str, Array]:
    """Read the K decisions for a reactor from the journal: `minute`, `supervised` and the controller's estimates, (K,).

    The value of a decision without a key is nan. A key that no decision has is omitted.
    """
    rows = list(_decisions(run / "journal.jsonl", reactor))
    known = [key for name in ESTIMATED for key in (name, f"{name}_sd", f"true_{name}")]
    keys = [key for key in ("supervised", "alarm", *ESTIMATES, *known) if any(key in why for _, why in rows)]
    found = {key: np.array([_real(why.get(key)) for _, why in rows]) for key in keys}
    return {"minute": np.array([minute for minute, _ in rows]), **found}


def _decisions(path: Path, reactor: str) -> Iterator[tuple[float, Mapping[str, Any]]]:
    """Yield minute and explanation of every decision for a reactor; skip a line cut short by a power failure."""
    if not path.is_file():
        return
    with path.open(encoding="utf-8", errors="replace") as f:
        for line in f:
            if DECISION not in line[:120]:
                continue
            try:
                row = json.loads(line)
                if row["reactor"] == reactor:
                    yield float(row["row"]["time_min"]), row.get("why") or {}
            except (ValueError, KeyError, TypeError, AttributeError):
                continue


def _real(value: Any) -> float:
    return float(value) if isinstance(value, int | float) else float("nan")


def write(page: Page, run: Path, label: str = "") -> None:
    """Add the section of a deployment to a page, and write its figures to RUN/report. Other runs get no section.

    Args: label: name of the run, if the page shows several runs.
    """
    if not ((run / "recordings").is_dir() and (run / "config.yaml").is_file()):
        return
    model, bench = believed(run), _bench(_config(run))
    summary = json.loads((run / "summary.json").read_text(encoding="utf-8"))
    reactors = summary.get("reactors") if isinstance(summary, Mapping) else None
    page.section(f"{label}: predicted and measured" if label else "Predicted and measured")
    guests.load("experiments.record")
    for why in filter(None, (reason(_config(run)) for reason in INCOMPARABLE)):
        page.text(f"Not compared: {why}.")
        return
    own = {name: model.tau * ml / bench.volume_ml for name, ml in bench.volumes_ml.items()}
    told = "".join(f", {number(tau, 4)} of {name}" for name, tau in own.items())
    growth, tau = number(model.mu, 4), number(model.tau, 4)
    page.text(
        f"Model: growth {growth} 1/min, tau {tau}{told} ({model.source}). Growth and pump gain are estimated from each "
        "segment of about two hours alone. Net growth is the growth of each sample beyond the prediction from the "
        "sample before. Net growth also shows a change where growth and pump gain cannot be told apart. A value has "
        "changed if it differs by 10 % or more from the model's value and its interval excludes the model's value."
    )
    for path in sorted((run / "recordings").glob("*.csv")):
        known = reactors.get(path.stem) if isinstance(reactors, Mapping) else None
        mine = replace(model, tau=own.get(path.stem, model.tau))
        _reactor(page, run, path, mine, known if isinstance(known, Mapping) else {}, f"{run.name}_" if label else "")


def _reactor(page: Page, run: Path, path: Path, model: Believed, summary: Mapping[str, Any], prefix: str) -> None:
    name = path.stem
    page.add("subheading", text=name)
    why = decisions(run, name)
    supervised = why["minute"][why["supervised"] > 0.0] if "supervised" in why else np.empty(0)
    try:
        recording = read_recording(path)
        series = Series(recording.time_min, recording.od, recording.pump_rate, recording.row)
        found = agreement(series, model.mu, model.tau)
    except (RecordingError, ValueError) as error:
        page.text(f"Not compared: {error}")
    else:
        page.add(
            "verdict", claim=found.verdict(model.planned), items=_facts(found) + _sure(why), remark=_acted(summary, why)
        )
        page.table(_segments(found, f"{prefix}after_{name}", name))
        estimates = {key: values for key, values in why.items() if key in ("minute", *ESTIMATES)}
        from experiments.reporting.calibration_charts import agreement_figure  # Matplotlib, only where one is drawn
        from experiments.reporting.charts import save

        figure = agreement_figure(found, estimates, supervised, f"{name}: growth and pump along the run")
        page.figure(save(figure, run / "report", name).with_suffix(".svg"), f"{name}, predicted and measured")


def _facts(found: Agreement) -> list[str]:
    """List how long each value of the model was right, and how well the model predicted the next sample."""
    facts = [f"{c.name}: {_fact(c)}" for c in (found.growth, found.gain, found.net)]
    best = f"{found.attainable:.4f} OD without the error of net growth"
    return [*facts, f"rms error of the predicted next sample: {found.rms:.4f} OD; {best}"]


def _fact(c: Compared) -> str:
    """Compare the last estimate with the model's value, and describe the drift of the estimates."""
    if c.latest is None:
        return "not identifiable"
    last = f"last estimate {_shown(c.latest)}, model {number(c.expected)}"
    if c.left_min is not None:
        last += f", wrong since hour {c.left_min / 60:.1f}"
    elif not c.latest.low <= c.expected <= c.latest.high:
        last += "; the interval excludes the model's value, but in too few segments or by less than 10 %"
    if c.line is not None and c.line.significant and c.expected > 0.0:
        last += f"; trend over all segments {c.line.change_pct:+.0f} %"
    return last


def _sure(why: Mapping[str, Array]) -> list[str]:
    """List how often each estimate was within two of its standard deviations of the truth, in a simulation."""
    names = {"error": "error e", "growth_share": "growth share s"}
    found = {key: values[np.isfinite(values)] for key, values in within_2sd(why).items()}
    within = "within two standard deviations of the truth in"
    return [
        f"{names[key]}: {within} {100.0 * values.mean():.0f} % of {values.size} decisions"
        for key, values in found.items()
        if values.size
    ]


def _acted(summary: Mapping[str, Any], why: Mapping[str, Array]) -> str:
    supervised = why["minute"][why["supervised"] > 0.0] if "supervised" in why else np.empty(0)
    reasons = summary.get("reasons")
    kinds = "; ".join(
        f"{kind} in {t['rows']} rows, {span(t['first_min'], t['last_min'])}"
        for kind, t in (reasons.items() if isinstance(reasons, Mapping) else ())
        if isinstance(t, Mapping) and {"rows", "first_min", "last_min"} <= t.keys()
    )
    interlock = f"The interlock had alarms in {summary.get('interlock', 0)} of {summary.get('rows', 0)} rows"
    acted = f"A supervisor acted on {len(supervised)} rows"
    if len(supervised):
        acted += f", {span(supervised[0], supervised[-1])}"
        if (alarmed := int((why.get("alarm", np.zeros(1)) > 0.0).sum())) > 0:
            acted += f", on {alarmed} of them because readings did not fit the estimate"
    return f"{interlock}{': ' if kinds else ''}{kinds}. {acted}."


def _segments(found: Agreement, name: str, reactor: str) -> Table:
    spans = sorted({s for c in (found.growth, found.net) for s in zip(c.first_min, c.end_min, strict=True)})
    estimates = [dict(zip(c.first_min, c.found, strict=True)) for c in (found.growth, found.gain, found.net)]
    rows = [(f"{a / 60:.1f} to {b / 60:.1f}", *(_shown(each.get(a)) for each in estimates)) for a, b in spans]
    return Table(name, f"{reactor}: estimates along the run with their 95 % intervals", COLUMNS, tuple(rows))


def _shown(p: Parameter | None) -> str:
    return "–" if p is None else f"{number(p.value)} ({number(p.low)} to {number(p.high)})"
