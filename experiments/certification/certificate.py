"""The file of a certificate: what it holds, where it lies, and whether it is that of a policy at hand."""

import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from conf.schema import build
from dqn.policy import Policy, fingerprint
from experiments.certification.bounds import EstimateBounds
from experiments.certification.config import CertifyConfig
from experiments.certification.judge import Certificate, recheck
from experiments.certification.network import Array
from experiments.certification.question import CertificationError
from experiments.certification.verdict import Proof

__all__ = ["FORMAT", "Stored", "beside", "bounds", "content", "doubts", "load"]

FORMAT = 1


def beside(policy: Path) -> Path:
    """Where the certificate of a policy file lies: certificate.json for policy.npz, else NAME.certificate.json."""
    return policy.with_name("certificate.json" if policy.stem == "policy" else f"{policy.stem}.certificate.json")


@dataclass(frozen=True)
class Stored:
    """A certificate as it was read: which policy it is of, what was asked, and what failed.

    setpoints: lowest and highest that it speaks of, OD. bounds: of an estimator's errors, and its growth shares.
    """

    fingerprint: str
    passed: bool
    failed: tuple[str, ...]
    config: CertifyConfig
    setpoints: tuple[float, float]
    bounds: EstimateBounds | None


def _outward(value: Array, digits: float = 1e6) -> Array:
    """Rounded away from zero: what is written down holds, too."""
    return np.asarray(np.sign(value) * np.ceil(np.abs(value) * digits) / digits)


def _case(proof: Proof) -> dict[str, Any]:
    """One case as columns over the strips."""
    return {
        **asdict(proof.case),
        "holdable": proof.holdable,
        "proven": proof.band.invariant,
        "band": np.stack([_outward(proof.band.low), _outward(proof.band.high)], axis=1),
        "half_width": _outward(proof.half_width),
        "law_half_width": np.round(proof.law_half_width, 6),
        "entry_periods": proof.band.periods,
        "entry_over_physics": np.round(proof.entry, 4),
    }


def content(policy: Policy, config: CertifyConfig, found: Certificate) -> dict[str, Any]:
    """A certificate as it is written.

    `band` is in ln(x / r) of a policy that sees the OD, else in e. `strips`: lowest and highest setpoint or growth
    share, and into how many equal strips it is cut; columns have an entry per strip.

    Args: config: with the nominal model in `env`, so that whoever reads it proves the same.
    """
    asked = found.question
    return {
        "format": FORMAT,
        "passed": found.passed,
        "fingerprint": fingerprint(policy),
        "observation": list(policy.observation),
        "checks": [{**asdict(check), "holds": check.holds} for check in found.checks],
        "setpoints": list(asked.setpoints),
        "strips": [float(asked.loop.low[0]), float(asked.loop.high[-1]), int(asked.loop.low.size)],
        "bounds": asdict(asked.bounds) if asked.bounds else None,
        "cannot_hold": found.cannot_hold(),
        "dose_below": dict(zip(map(str, found.levels), _outward(found.doses, 1e3), strict=True)),
        "not_monotone": [dict(zip(("first", "second", "from", "to"), drop, strict=True)) for drop in found.drops],
        "cases": [_case(proof) for proof in found.proofs],
        "config": asdict(replace(config, policy="", env_file=None)),
    }


def load(path: Path) -> Stored:
    """Read a certificate. Raises: OSError; ValueError for a damaged one."""
    try:
        given = json.loads(path.read_text(encoding="utf-8"))
        if given["format"] != FORMAT:
            raise ValueError(f"format {given['format']}, allowed {FORMAT}")
        low, high = given["setpoints"]
        return Stored(
            str(given["fingerprint"]),
            given["passed"] is True,
            tuple(str(check["name"]) for check in given["checks"] if not check["holds"]),
            build(CertifyConfig(), given["config"]),
            (float(low), float(high)),
            EstimateBounds.of(given["bounds"]) if given["bounds"] else None,
        )
    except (KeyError, TypeError, AttributeError, RecursionError) as error:
        raise ValueError(f"{type(error).__name__}: {error}") from None


def bounds(policy: Policy, file: Path) -> EstimateBounds | None:
    """Within which errors of its estimator a policy may act; None without a certificate that is this policy's.

    Args: file: of the policy, beside which its certificate lies.
    """
    try:
        stored = load(beside(file))
    except (OSError, ValueError):
        return None
    return stored.bounds if stored.passed and stored.fingerprint == fingerprint(policy) else None


def doubts(policy: Policy, file: Path, setpoints: Sequence[float], name: str) -> list[str]:
    """Reasons not to let a policy pump that its certificate gives, with the remedy; setpoints are proven anew.

    A policy that sees the growth share is proven anew along nine of those.

    Args: file: of the policy, beside which the certificate lies. setpoints: those of the run, OD. name: what the user
    calls the policy.
    """
    path, remedy = beside(file), f"python -m experiments.certify policy={name}"
    try:
        stored = load(path)
    except FileNotFoundError:
        return [f"it has no certificate ({remedy})"]
    except (OSError, ValueError) as error:
        why = getattr(error, "strerror", None) or error
        return [f"its certificate {path} is damaged ({why}; {remedy})"]
    if stored.fingerprint != fingerprint(policy):
        return [f"its certificate {path} is of another policy: one of them was changed ({remedy})"]
    if not stored.passed:
        failing = f"{len(stored.failed)} requirements, the first: {'; '.join(stored.failed[:1])}"
        return [f"its certificate fails {failing} (train with another seed, then {remedy})"]
    low, high = stored.setpoints
    outside = sorted({r for r in setpoints if not low - 1e-9 <= r <= high + 1e-9})
    if outside:
        asked = ", ".join(f"{r:g}" for r in outside)
        more = f"{remedy} 'setpoints=[LOW,HIGH]'"
        return [f"it is certified for setpoints {low:g} to {high:g}, the scenario asks for {asked} ({more})"]
    lines = np.linspace(*stored.bounds.proven, 9) if stored.bounds else np.unique(setpoints)
    try:
        failed = recheck(policy, stored.config, lines.tolist())
    except CertificationError as error:
        return [f"its certificate {path} asks for something else: {error} ({remedy})"]
    return [f"proven anew, it fails: {check} ({remedy})" for check in failed[:1]]
