"""File of a certificate: its content and path, and the decision of a device whether to run the policy."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from conf.schema import build
from dqn.policy import RELATIVE, Policy, fingerprints
from envs.bench import Bench
from envs.task import EnvConfig
from experiments.certification.bounds import EstimateBounds
from experiments.certification.config import LIMITS, CertifyConfig
from experiments.certification.judge import KINDS, PERFORMANCE, SAFETY, Certificate, Requirement, recheck, worst
from experiments.certification.polygons import Array
from experiments.certification.question import CertificationError, full_pump, model_of
from experiments.certification.verdict import Proof

FORMAT = 4
BETTER = "train with another seed or n_agents=8, or use policy=shipped"


class FormatError(ValueError):
    """Error for a certificate that another version of this program wrote."""


def beside(policy: Path) -> Path:
    """Return the path of a policy's certificate: certificate.json for policy.npz, else NAME.certificate.json."""
    return policy.with_name("certificate.json" if policy.stem == "policy" else f"{policy.stem}.certificate.json")


@dataclass(frozen=True)
class Stored:
    """Certificate as read from its file.

    of: fingerprints of the policy's parts, and other settings that affect the loop, by name. safe: whether all safety
    requirements are met. passed: whether all requirements are met. failed: the requirements that are not met.
    config: settings of the proof. setpoints: lowest and highest certified setpoint, OD. bounds: on the estimator's
    errors. cannot_hold: cases and setpoints that are not judged, because no pump rate holds the culture.
    """

    of: Mapping[str, Any]
    safe: bool
    passed: bool
    failed: tuple[Requirement, ...]
    config: CertifyConfig
    setpoints: tuple[float, float]
    bounds: EstimateBounds | None
    cannot_hold: tuple[str, ...]

    def differs(self, policy: Policy, settings: Mapping[str, Any]) -> list[str]:
        """List the parts of the policy and the settings that differ from the certified ones."""
        parts, given = fingerprints(policy), {**fingerprints(policy), **settings}
        names = [name for name in sorted({*given, *self.of}) if given.get(name) != self.of.get(name)]
        shown = {name: f"{name} = {given.get(name)}, certified {self.of.get(name)}" for name in names}
        return [f"its {name}" if name in parts else shown[name] for name in names]


def _up(value: Array, digits: float = 1e6) -> Array:
    """Round up, so that the rounded number is still an upper bound."""
    return np.asarray(np.ceil(value * digits) / digits)


def _case(proof: Proof) -> dict[str, Any]:
    return {
        **asdict(proof.case),
        "holdable": proof.holdable,
        "proven": proof.band.invariant,
        "band": np.stack([-_up(-proof.band.low), _up(proof.band.high)], axis=1),
        "half_width": _up(proof.half_width),
        "law_half_width": np.round(proof.law_half_width, 6),
        "entry_periods": proof.band.periods,
        "entry_over_physics": np.round(proof.entry, 4),
    }


def content(policy: Policy, settings: Mapping[str, Any], config: CertifyConfig, found: Certificate) -> dict[str, Any]:
    """Return the content of a certificate's file.

    `band` is in ln(x / r) for a policy that sees the OD, else in e. `strips`: lowest and highest setpoint or growth
    share, and the number of equal strips; the lists below have an entry per strip. `cases`: only those in the figure;
    `checks` contain the worst value of every case.

    Args: settings: other settings that affect the loop. config: settings of the proof, with the nominal model in `env`,
    so that a reader can repeat the proof.
    """
    asked = found.question
    return {
        "format": FORMAT,
        "limits": asdict(asked.limits),
        "safe": found.safe,
        "passed": found.passed,
        "of": {**fingerprints(policy), **settings},
        "observation": list(policy.observation),
        "checks": [{**asdict(check), "holds": check.holds} for check in found.checks],
        "setpoints": list(asked.setpoints),
        "strips": [float(asked.loop.low[0]), float(asked.loop.high[-1]), int(asked.loop.low.size)],
        "bounds": asdict(asked.bounds) if asked.bounds else None,
        "cannot_hold": found.cannot_hold(),
        "dose_below": dict(zip(map(str, found.levels), _up(found.doses, 1e3), strict=True)),
        "not_monotone": [dict(zip(("first", "second", "from", "to"), drop, strict=True)) for drop in found.drops],
        "cases": [_case(proof) for proof in found.proofs if proof.case.name in asked.drawn],
        "config": asdict(replace(config, policy="", to=None, env_file=None)),
    }


def load(path: Path) -> Stored:
    """Read a certificate. Raises: OSError; FormatError for another version's file; ValueError for a damaged file."""
    try:
        given = json.loads(path.read_text(encoding="utf-8"))
        if given["format"] != FORMAT:
            raise FormatError(f"has format {given['format']}, this version reads format {FORMAT}")
        if given["limits"] != asdict(LIMITS):
            raise FormatError("has other limits than this version")
        low, high = given["setpoints"]
        failed = tuple(_check(check) for check in given["checks"] if check["holds"] is not True)
        return Stored(
            dict(given["of"]),
            given["safe"] is True and not any(check.kind == SAFETY for check in failed),
            given["passed"] is True and given["safe"] is True and not failed,
            failed,
            build(CertifyConfig(), given["config"]),
            (float(low), float(high)),
            EstimateBounds.of(given["bounds"]) if given["bounds"] else None,
            tuple(map(str, given["cannot_hold"])),
        )
    except (KeyError, TypeError, AttributeError, RecursionError) as error:
        raise ValueError(f"{type(error).__name__}: {error}") from None


def _check(given: Mapping[str, Any]) -> Requirement:
    """Read a requirement; the file has null for a value that was not finite. Raises: ValueError, KeyError."""
    name, where, kind = (str(given[key]) for key in ("name", "where", "kind"))
    if kind not in KINDS:
        raise ValueError(f"kind {kind} of a requirement: allowed {', '.join(KINDS)}")
    return Requirement(
        name, np.nan if given["value"] is None else float(given["value"]), float(given["limit"]), where, kind
    )


def bounds(policy: Policy, settings: Mapping[str, Any], file: Path, model: EnvConfig) -> EstimateBounds | None:
    """Return the bounds on the estimator's errors within which a policy may act; None if it is not certified as safe.

    Args: settings: other settings that affect the loop. file: the policy file; its certificate is beside it. model:
    tau, control period and largest pump rate of the run.
    """
    try:
        stored = load(beside(file))
    except (OSError, ValueError):
        return None
    if stored.bounds is None or not stored.safe or stored.config.quick or stored.differs(policy, settings):
        return None
    return replace(stored.bounds, full_pump=full_pump(model))


@dataclass(frozen=True)
class Opinion:
    """Decision of a device from a certificate.

    refused: reasons to refuse the policy, each with its remedy. short: warnings about performance requirements that
    fail, with values, limits and remedy; they are no reason to refuse.
    """

    refused: list[str] = field(default_factory=list)
    short: list[str] = field(default_factory=list)


def judged(
    policy: Policy,
    settings: Mapping[str, Any],
    file: Path,
    setpoints: Sequence[float],
    bench: Bench,
    model: EnvConfig,
    name: str,
) -> Opinion:
    """Judge a policy by its certificate: refuse an unsafe policy, report missing performance.

    The policy is proven again for the run's setpoints and bench, so a different bench alone is no reason to refuse it.

    Args: settings: other settings that affect the loop. file: the policy file; its certificate is beside it. setpoints:
    of the run, OD. model: tau, control period and largest pump rate of the run. name: value of `policy=`.
    """
    path, remedy = beside(file), f"python -m experiments.certify policy={name}"
    if name == "shipped":
        remedy = "copy dqn/shipped/policy.npz and certify the copy: python -m experiments.certify policy=COPY"
    try:
        stored = load(path)
    except FileNotFoundError:
        return Opinion([f"it has no certificate; create one first: {remedy}"])
    except FormatError as error:
        return Opinion([f"its certificate {path} {error}; create a new one: {remedy}"])
    except (OSError, ValueError) as error:
        why = getattr(error, "strerror", None) or error
        return Opinion([f"its certificate {path} is damaged ({why}; {remedy})"])
    if reason := _unfit(stored, policy, settings, path, setpoints, remedy):
        return Opinion([reason], _short(stored.failed, stored))
    if reason := _other_model(policy, stored.config, bench, model):
        return Opinion([reason], _short(stored.failed, stored))
    try:
        again = recheck(policy, on_bench(policy, stored.config, bench, model), sorted(set(setpoints)))
    except CertificationError as error:
        return Opinion([f"its certificate {path} cannot be repeated for this run: {error} ({remedy})"])
    told = _short((*again, *stored.failed), stored)
    if unsafe := [check for check in again if check.kind == SAFETY]:
        what = _listed(unsafe)
        other = "choose another bench or scenario, or train a policy for this one"
        return Opinion([f"a proof for this bench and scenario shows that it is not safe: {what} ({other})"], told)
    return Opinion([], told)


def _unfit(
    stored: Stored, policy: Policy, settings: Mapping[str, Any], path: Path, setpoints: Sequence[float], remedy: str
) -> str:
    """Return why a certificate does not allow this policy at these setpoints, with the remedy; "" if it does."""
    if different := stored.differs(policy, settings):
        return f"its certificate {path} is for another policy: {'; '.join(different)} (restore it, or {remedy})"
    if not stored.safe:
        what = _listed([check for check in stored.failed if check.kind == SAFETY]) or "no reason given"
        return f"according to its certificate it is not safe: {what} ({BETTER}, then {remedy})"
    if laxer := stored.config.laxer():
        return f"its certificate is less strict than required: {'; '.join(laxer)} ({remedy})"
    if stored.config.quick and stored.bounds is not None:
        return f"its certificate was made with quick=true, without errors of the gain ({remedy})"
    low, high = stored.setpoints
    outside = sorted({r for r in setpoints if not low - 1e-9 <= r <= high + 1e-9})
    if outside:
        asked = ", ".join(f"{r:g}" for r in outside)
        more = f"{remedy} 'setpoints=[LOW,HIGH]'"
        return f"it is certified for setpoints {low:g} to {high:g}, but the scenario has {asked} ({more})"
    return ""


def _other_model(policy: Policy, config: CertifyConfig, bench: Bench, model: EnvConfig) -> str:
    """Return why a policy of the OD does not suit the culture or the pump of a run, with the remedy; "" if it does.

    The tau of the run must be within `uncertainty` of the proven tau, and the proven mu within `uncertainty` of the
    trained mu, so that no proof is for an easier culture. A policy in relative coordinates suits every tau and mu."""
    if policy.observation == RELATIVE:
        return ""
    proven, share = model_of(policy, config), 100.0 * config.uncertainty
    mu = float(policy.metadata.get("model", {}).get("mu", proven.mu))
    if not abs(proven.mu / mu - 1.0) <= config.uncertainty:
        remedy = "train for this culture, or certify without env.mu"
        return f"it is proven for mu = {proven.mu:.3g}, but trained for {mu:.3g} +- {share:.0f} % ({remedy})"
    if model.mu != EnvConfig().mu and not abs(model.mu / proven.mu - 1.0) <= config.uncertainty:
        remedy = "train for this culture with this env_file, or use policy=shipped"
        return (
            f"it is proven for mu = {proven.mu:.3g} +- {share:.0f} %, this run's env_file has {model.mu:.3g} ({remedy})"
        )
    tau = proven.tau * bench.tau / config.bench.tau
    if abs(model.tau / tau - 1.0) <= config.uncertainty:
        return ""
    remedy = "set env_file=CALIBRATED.yaml to the calibration used for its training, or train for this pump"
    return f"it is proven for tau = {tau:.3g} +- {share:.0f} %, but this run has tau = {model.tau:.3g} ({remedy})"


def _listed(checks: Sequence[Requirement]) -> str:
    """Return the worst case of each requirement, and the number of all cases, as text."""
    told = "; ".join(map(str, worst(checks)))
    return told if len(checks) < 2 else f"{told} ({len(checks)} in all)"


def _short(failed: Sequence[Requirement], stored: Stored) -> list[str]:
    """Return warnings: failed performance requirements, cases that are not proven."""
    found = worst(check for check in failed if check.kind == PERFORMANCE)
    lines = [f"performance falls short: {'; '.join(map(str, found))} ({BETTER})"] if found else []
    if stored.bounds is None:  # docs/certificate.md has the growth shares that the pump holds for other policies
        lines += [f"not proven: {case}; use a faster pump or less volume" for case in stored.cannot_hold]
    return lines


def on_bench(policy: Policy, config: CertifyConfig, bench: Bench, model: EnvConfig) -> CertifyConfig:
    """Return the settings of a proof for the bench of a run.

    For a policy of (error, growth share), B changes; for a policy of the OD, the volume of the nominal model changes.
    """
    if policy.observation == RELATIVE:
        return replace(config, bench=bench, env=model, full_pumps=())
    env = model_of(policy, config)
    return replace(config, bench=bench, env=replace(env, tau=env.tau * bench.tau / config.bench.tau))
