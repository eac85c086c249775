"""The policy file of a run: finding it, checking it, judging whether it may run, and keeping a copy with the run."""

import logging
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np

from dqn import policy as policies
from dqn.policy import Policy
from envs.bench import Bench
from envs.task import EnvConfig
from experiments.certification import certificate
from experiments.certification.bounds import EstimateBounds
from experiments.certification.certificate import Opinion
from experiments.cli import frame
from experiments.cli.latest import ROOT, newest
from experiments.control import messages
from experiments.laws.density.learned import settings
from hardware.family import Check
from hardware.storage import atomic

log = logging.getLogger(__name__)

SHIPPED = Path(str(resources.files("dqn"))) / "shipped" / "policy.npz"
TRAINED = ("train/**/policy.npz", "demo/*/2_train/policy.npz")  # below runs/; other commands keep copies of policies
POOR_REGRET_PCT = 10.0  # above which a run warns; the worst of 32 seeds of agent=paper has 11
FORCE = "force_policy=true runs it all the same"


class NoPolicyError(frame.UserError):
    """`policy=latest` without a training run."""


@dataclass(frozen=True)
class WantedPolicy:
    """The policy that a run is to have, and what that run asks of it.

    name: as of `find_policy`. bench: with the control period and the largest pump rate that the interlock allows.
    model: tau, control period and largest pump rate that laws are given. estimator: settings of the policy's estimator
    that are changed. setpoints: OD. at_stake: a culture is: a policy whose certificate does not say that it is safe
    is refused. forced: it is not refused.
    """

    name: str
    bench: Bench
    model: EnvConfig
    estimator: Mapping[str, Any]
    setpoints: tuple[float, ...]
    at_stake: bool
    forced: bool

    @property
    def refuses(self) -> bool:
        """Whether a policy without a safety proof is refused."""
        return self.at_stake and not self.forced


@dataclass(frozen=True)
class Training:
    """Training data of a policy file; nan where missing.

    control_min: min. regret_pct: per cent. updates: gradient steps before it was exported.
    setpoints: lowest and highest one, OD. relative: it serves any control period and setpoint.
    """

    control_min: float
    regret_pct: float
    updates: float
    setpoints: tuple[float, float]
    relative: bool

    @classmethod
    def of(cls, policy: Policy) -> "Training":
        """Read from the metadata. Raises: TypeError, ValueError, AttributeError, KeyError for damaged ones."""
        control, regret, updates = (
            float(policy.metadata.get(key, np.nan)) for key in ("control_min", "regret_pct", "updates")
        )
        setpoints = np.asarray(policy.metadata.get("model", {}).get("setpoints", [np.nan]), dtype=np.float64)
        limits = (float(setpoints.min()), float(setpoints.max()))
        return cls(control, regret, updates, limits, policy.observation == policies.RELATIVE)

    def doubts(self, setpoints: Sequence[float]) -> list[str]:
        """List reasons against this training, each with its remedy; a value missing from the file gives no reason."""
        low, high = self.setpoints
        outside = sorted({s for s in setpoints if s < low - 1e-9 or s > high + 1e-9})
        reasons = {
            "it was exported before the first update (train for more steps than agent.learn_start)": self.updates == 0,
            f"its regret is {self.regret_pct:.0f} %, more than {POOR_REGRET_PCT:g} % "
            "(train longer or with another seed)": self.regret_pct > POOR_REGRET_PCT,
            f"it was trained for setpoints {low:g} to {high:g}, the scenario asks for "
            f"{', '.join(f'{s:g}' for s in outside)} (train with env.setpoints that reach there)": bool(outside),
        }
        return [reason for reason, holds in reasons.items() if holds]

    def __str__(self) -> str:
        low, high = self.setpoints
        where = (
            "any growth rate, pump, control period and setpoint" if self.relative else f"setpoints {low:g} to {high:g}"
        )
        regret = f"{self.regret_pct:.2g} % against the optimum of its model"
        return f"regret {'not known' if np.isnan(self.regret_pct) else regret}, {where}"


def find_policy(name: str) -> Path:
    """Find a policy.npz by path, run folder, `shipped`, or `latest`: what `train` or `demo` wrote last.

    Raises: UserError saying what to give instead.
    """
    if not name.strip():
        raise messages.NoPolicyNamed()
    if name == "shipped":
        return SHIPPED
    if name == "latest":
        found = newest(TRAINED)
        if found is None:
            raise NoPolicyError(f"policy=latest: no training run under {ROOT}/; train one first or give policy=PATH")
        return found
    path = Path(name)
    return path / "policy.npz" if path.is_dir() else path


@contextmanager
def readable(path: Path) -> Iterator[None]:
    """Read a policy in this context. Raises: UserError naming the file and what is wrong with it."""
    try:
        yield
    except policies.PolicyError as error:
        raise frame.UserError(str(error)) from None
    except Exception as error:  # whatever a damaged file makes NumPy say
        why = (str(error).splitlines() or [type(error).__name__])[0]
        raise messages.PolicyDamaged(path=path, why=why) from None


def load_policy(name: str, control_min: float, max_rate: float) -> Policy:
    """Load the policy that `find_policy` finds, checked against control period and interlock.

    Args: control_min: of the backend, min. max_rate: largest pump rate that the interlock allows, mL/s.
    Raises: UserError naming the file and, for a mismatch, both values.
    """
    path = find_policy(name)
    with readable(path):
        policy = policies.load(path)
        training = Training.of(policy)
        fastest = 0.0 if training.relative else float(policy.actions.max())
    if policy.observation not in (policies.ABSOLUTE, policies.RELATIVE):
        seen = ", ".join(policy.observation)
        raise frame.UserError(f"policy {path} observes {seen}; give a policy of env=sim or env=relative")
    if not (training.relative or abs(training.control_min - control_min) <= 1e-9):
        raise messages.OtherPeriod(path=path, own_min=training.control_min, asked_min=control_min)
    if not fastest <= max_rate + 1e-12:
        raise messages.PumpsTooMuch(path=path, own=fastest, most=max_rate)
    log.info("policy %s: %s", path, training)
    return policy


def admit(policy: Policy, file: Path, wanted: WantedPolicy, resumed: bool) -> None:
    """Refuse a policy that is not proven to be safe for this run, and warn of all else that speaks against it.

    Args: file: of the policy, beside which its certificate lies.
    Raises: UserError where a culture is at stake, unless it is forced or the resumed run began with it.
    """
    found = _judged(policy, file, wanted)
    if found.refused and not resumed and wanted.refuses:
        raise messages.PolicyRefused(why="; ".join(found.refused + found.short), help=FORCE)
    for reason in found.refused + found.short:
        log.warning(messages.PolicyDoubtful(why=reason))


def _judged(policy: Policy, file: Path, wanted: WantedPolicy) -> Opinion:
    """Judge a policy by its certificate where a culture is at stake; a weak training gives a warning only."""
    training = Training.of(policy).doubts(wanted.setpoints)
    if not wanted.at_stake:
        return Opinion(short=training)
    with frame.refusing(ValueError):
        own = settings(policy, wanted.estimator)
    run = wanted.setpoints, wanted.bench, wanted.model, wanted.name
    found = certificate.judged(policy, own, file, *run)
    return Opinion(found.refused, found.short + training)


def policy_check(wanted: WantedPolicy) -> Check:
    """Return the policy's line of a preflight. A policy that falls short only in performance passes, with its numbers.

    That no policy has been trained yet does not stop a look at the device.
    """
    try:
        path = find_policy(wanted.name)
        policy = load_policy(str(path), wanted.bench.control_min, wanted.bench.max_rate)
    except NoPolicyError as error:
        return Check("policy", False, str(error), "python -m experiments.train", required=False)
    except frame.UserError as error:
        return Check("policy", False, str(error), "give another policy=PATH")
    found = _judged(policy, path, wanted)
    told = "; ".join(found.refused + found.short)
    if not found.refused:
        said = str(Training.of(policy))
        safe = f"{said}, proven to be safe" if wanted.at_stake else said
        return Check("policy", True, f"{safe}; {told}" if told else safe)
    remedy = FORCE if wanted.refuses else "a device refuses it without force_policy=true"
    return Check("policy", False, told, remedy, wanted.refuses)


def run_policy(wanted: WantedPolicy, folder: Path, resumed: bool) -> tuple[Policy, EstimateBounds | None]:
    """Load the policy of a run and its bounds; the run folder keeps a copy with its certificate, for a resumed run.

    The copy is written from the policy as it was read: whatever has been trained meanwhile, both are the same.
    Raises: UserError as `load_policy` and `admit`, and if the copy cannot be written.
    """
    kept = folder / "policy.npz"
    again = resumed and kept.is_file()
    source = kept if again else find_policy(wanted.name)
    policy = load_policy(str(source), wanted.bench.control_min, wanted.bench.max_rate)
    if not again:
        keep(policy, kept, certificate.beside(source))
    admit(policy, kept, wanted, resumed)
    return policy, bounds_of(policy, wanted.estimator, kept, wanted.model)


def bounds_of(policy: Policy, changes: Mapping[str, Any], file: Path, model: EnvConfig) -> EstimateBounds | None:
    """Read the bounds of a policy's certificate. Args: changes: of its estimator. Raises: UserError for a wrong one."""
    with frame.refusing(ValueError):
        own = settings(policy, changes)
    return certificate.bounds(policy, own, file, model)


def keep(policy: Policy, kept: Path, proof: Path | None = None) -> None:
    """Write the copy of a policy, and of its certificate `proof` where there is one. Raises: UserError."""
    try:
        policies.save(kept, policy)
        if proof is not None and proof.is_file():
            atomic.write(certificate.beside(kept), proof.read_text(encoding="utf-8"), fsync=False)
    except OSError as error:
        raise frame.UserError(f"{kept}: copy of the policy not written ({error.strerror}); free the disk") from None
