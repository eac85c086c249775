"""The file of a certificate: what it holds, where it lies, and whether it is that of a policy at hand."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from conf.schema import build
from dqn.policy import RELATIVE, Policy, fingerprints
from envs.bench import Bench
from envs.task import EnvConfig
from experiments.certification.bounds import EstimateBounds
from experiments.certification.config import CertifyConfig
from experiments.certification.judge import Certificate, recheck
from experiments.certification.network import Array
from experiments.certification.question import CertificationError, full_pump, model_of
from experiments.certification.verdict import Proof

__all__ = ["FORMAT", "Stored", "beside", "bounds", "content", "doubts", "load"]

FORMAT = 2


def beside(policy: Path) -> Path:
    """Where the certificate of a policy file lies: certificate.json for policy.npz, else NAME.certificate.json."""
    return policy.with_name("certificate.json" if policy.stem == "policy" else f"{policy.stem}.certificate.json")


@dataclass(frozen=True)
class Stored:
    """A certificate as it was read: what it is of, what was asked, and what failed.

    of: what decides, by name: fingerprints of the parts of a policy, and the settings that act beside it.
    setpoints: lowest and highest that it speaks of, OD. bounds: of an estimator's errors, and its growth shares.
    """

    of: Mapping[str, Any]
    passed: bool
    failed: tuple[str, ...]
    config: CertifyConfig
    setpoints: tuple[float, float]
    bounds: EstimateBounds | None

    def differs(self, policy: Policy, settings: Mapping[str, Any]) -> list[str]:
        """Every part of a policy, and every setting, that is another than the one it was made for."""
        parts, given = fingerprints(policy), {**fingerprints(policy), **settings}
        names = [name for name in sorted({*given, *self.of}) if given.get(name) != self.of.get(name)]
        shown = {name: f"{name} = {given.get(name)}, certified {self.of.get(name)}" for name in names}
        return [f"its {name}" if name in parts else shown[name] for name in names]


def _up(value: Array, digits: float = 1e6) -> Array:
    """Rounded up: what is written down holds, too."""
    return np.asarray(np.ceil(value * digits) / digits)


def _case(proof: Proof) -> dict[str, Any]:
    """One case as columns over the strips."""
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
    """A certificate as it is written.

    `band` is in ln(x / r) of a policy that sees the OD, else in e. `strips`: lowest and highest setpoint or growth
    share, and into how many equal strips it is cut; columns have an entry per strip.
    `cases`: those that are drawn; of all others `checks` have the worst.

    Args: settings: that decide beside the policy. config: with the nominal model in `env`, so that whoever reads it
      proves the same.
    """
    asked = found.question
    return {
        "format": FORMAT,
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
    """Read a certificate. Raises: OSError; ValueError for a damaged one."""
    try:
        given = json.loads(path.read_text(encoding="utf-8"))
        if given["format"] != FORMAT:
            raise ValueError(f"of format {given['format']}, this version reads {FORMAT}")
        low, high = given["setpoints"]
        return Stored(
            dict(given["of"]),
            given["passed"] is True and all(check["holds"] is True for check in given["checks"]),
            tuple(str(check["name"]) for check in given["checks"] if not check["holds"]),
            build(CertifyConfig(), given["config"]),
            (float(low), float(high)),
            EstimateBounds.of(given["bounds"]) if given["bounds"] else None,
        )
    except (KeyError, TypeError, AttributeError, RecursionError) as error:
        raise ValueError(f"{type(error).__name__}: {error}") from None


def bounds(policy: Policy, settings: Mapping[str, Any], file: Path, model: EnvConfig) -> EstimateBounds | None:
    """Within which errors of its estimator a policy may act; None without a certificate that is of these.

    Args: settings: that decide beside the policy. file: of the policy, beside which its certificate lies. model: tau,
    control period and largest pump rate of the run.
    """
    try:
        stored = load(beside(file))
    except (OSError, ValueError):
        return None
    if stored.bounds is None or not stored.passed or stored.config.quick or stored.differs(policy, settings):
        return None
    return replace(stored.bounds, full_pump=full_pump(model))


def doubts(
    policy: Policy,
    settings: Mapping[str, Any],
    file: Path,
    setpoints: Sequence[float],
    bench: Bench,
    model: EnvConfig,
    name: str,
) -> list[str]:
    """Reasons not to let a policy pump that its certificate gives, with the remedy.

    It is proven anew for the setpoints and the bench of the run: another bench is no reason by itself.

    Args: settings: that decide beside the policy. file: of the policy, beside which the certificate lies. setpoints:
    those of the run, OD. model: tau, control period and largest pump rate of the run. name: what the user calls the
    policy.
    """
    path, remedy = beside(file), f"python -m experiments.certify policy={name}"
    if name == "shipped":
        remedy = "copy dqn/shipped/policy.npz and run that: python -m experiments.certify policy=COPY"
    try:
        stored = load(path)
    except FileNotFoundError:
        return [f"it has no certificate ({remedy})"]
    except (OSError, ValueError) as error:
        why = getattr(error, "strerror", None) or error
        return [f"its certificate {path} is damaged ({why}; {remedy})"]
    if different := stored.differs(policy, settings):
        return [f"its certificate {path} is of another: {'; '.join(different)} (put it back, or {remedy})"]
    if not stored.passed:
        failing = f"{len(stored.failed)} of its requirements, the first: {'; '.join(stored.failed[:1]) or 'not said'}"
        return [f"its certificate fails {failing} (train with another seed, then {remedy})"]
    if laxer := stored.config.laxer():
        return [f"its certificate asks for less than it should: {'; '.join(laxer)} ({remedy})"]
    if stored.config.quick and stored.bounds is not None:
        return [f"its certificate is a quick one, without errors of the gain ({remedy})"]
    low, high = stored.setpoints
    outside = sorted({r for r in setpoints if not low - 1e-9 <= r <= high + 1e-9})
    if outside:
        asked = ", ".join(f"{r:g}" for r in outside)
        more = f"{remedy} 'setpoints=[LOW,HIGH]'"
        return [f"it is certified for setpoints {low:g} to {high:g}, the scenario asks for {asked} ({more})"]
    try:
        failed = recheck(policy, on_bench(policy, stored.config, bench, model), sorted(set(setpoints)))
    except CertificationError as error:
        return [f"its certificate {path} asks for something else: {error} ({remedy})"]
    other = "choose another bench or scenario, or train for this one"
    return [f"proven anew for this bench and scenario, it fails: {check} ({other})" for check in failed[:1]]


def on_bench(policy: Policy, config: CertifyConfig, bench: Bench, model: EnvConfig) -> CertifyConfig:
    """What a certificate asks, of the bench of a run.

    A policy of (error, growth share) meets another B; the nominal model of one of the OD has another volume.
    """
    if policy.observation == RELATIVE:
        return replace(config, bench=bench, env=model, full_pumps=())
    env = model_of(policy, config)
    return replace(config, bench=bench, env=replace(env, tau=env.tau * bench.tau / config.bench.tau))
