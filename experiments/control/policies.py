"""Policy file of a run: find it, check it, decide whether it may run, and copy it into the run folder."""

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
TRAINED = ("train/**/policy.npz", "demo/*/2_train/policy.npz")  # in runs/; other folders contain only copies
POOR_REGRET_PCT = 10.0  # a higher regret gives a warning; the worst of 32 seeds of agent=paper has 11
FORCE = "to run it nevertheless, add force_policy=true"


class NoPolicyError(frame.UserError):
    """`policy=latest` is set, but there is no training run."""


@dataclass(frozen=True)
class WantedPolicy:
    """Policy that a run asks for, and the conditions of the run.

    name: as in `find_policy`. bench: control period and largest pump rate that the interlock allows. model: growth
    model of the run. estimator: changed settings of the policy's estimator. setpoints: of the scenario, OD.
    at_stake: whether the run has a real culture, so that a policy without a safety proof is refused. forced: whether
    the user permits such a policy.
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
    """Facts about the training of a policy, from its file; nan where missing.

    control_min: control period, min. regret_pct: regret, %. updates: number of gradient steps.
    setpoints: lowest and highest setpoint, OD. relative: whether it works with any control period and setpoint.
    """

    control_min: float
    regret_pct: float
    updates: float
    setpoints: tuple[float, float]
    relative: bool

    @classmethod
    def of(cls, policy: Policy) -> "Training":
        """Read the metadata of a policy. Raises: TypeError, ValueError, AttributeError, KeyError if damaged."""
        control, regret, updates = (
            float(policy.metadata.get(key, np.nan)) for key in ("control_min", "regret_pct", "updates")
        )
        setpoints = np.asarray(policy.metadata.get("model", {}).get("setpoints", [np.nan]), dtype=np.float64)
        limits = (float(setpoints.min()), float(setpoints.max()))
        return cls(control, regret, updates, limits, policy.observation == policies.RELATIVE)

    def doubts(self, setpoints: Sequence[float]) -> list[str]:
        """List reasons not to use the policy, each with its remedy. A value missing from the file gives no reason."""
        low, high = self.setpoints
        outside = sorted({s for s in setpoints if s < low - 1e-9 or s > high + 1e-9})
        reasons = {
            "it was exported before the first update (train for more steps than agent.learn_start)": self.updates == 0,
            f"its regret is {self.regret_pct:.0f} %, more than {POOR_REGRET_PCT:g} % "
            "(train longer or with another seed)": self.regret_pct > POOR_REGRET_PCT,
            f"it was trained for setpoints {low:g} to {high:g}, but the scenario has "
            f"{', '.join(f'{s:g}' for s in outside)} (train with env.setpoints that include them)": bool(outside),
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
    """Find a policy.npz. Args: name: path, run folder, `shipped` or `latest` (of train or demo). Raises: UserError."""
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
    """Turn errors of reading a policy file in this context into a UserError with the file and the reason."""
    try:
        yield
    except policies.PolicyError as error:
        raise frame.UserError(str(error)) from None
    except Exception as error:  # NumPy raises many kinds of error for a damaged file
        why = (str(error).splitlines() or [type(error).__name__])[0]
        raise messages.PolicyDamaged(path=path, why=why) from None


def load_policy(name: str, control_min: float, max_rate: float) -> Policy:
    """Load a policy, and check that it fits the control period and the interlock.

    Args: name: as in `find_policy`. control_min: control period, min. max_rate: largest allowed pump rate, mL/s.
    Raises: UserError with the file and, for a mismatch, both values.
    """
    path = find_policy(name)
    with readable(path):
        policy = policies.load(path)
        training = Training.of(policy)
        fastest = 0.0 if training.relative else float(policy.actions.max())
    if policy.observation not in (policies.ABSOLUTE, policies.RELATIVE):
        seen = ", ".join(policy.observation)
        raise frame.UserError(f"policy {path} has inputs {seen}; give a policy trained with env=sim or env=relative")
    if not (training.relative or abs(training.control_min - control_min) <= 1e-9):
        raise messages.OtherPeriod(path=path, own_min=training.control_min, asked_min=control_min)
    if not fastest <= max_rate + 1e-12:
        raise messages.PumpsTooMuch(path=path, own=fastest, most=max_rate)
    log.info("policy %s: %s", path, training)
    return policy


def admit(policy: Policy, file: Path, wanted: WantedPolicy, resumed: bool) -> None:
    """Refuse a policy that is not proven safe for this run; log every other reason against it as a warning.

    Args: file: file of the policy; its certificate is beside it. resumed: a resumed run keeps its policy.
    Raises: UserError for an unsafe policy if a culture is at stake, unless the policy is forced or the run resumed.
    """
    found = _judged(policy, file, wanted)
    if found.refused and not resumed and wanted.refuses:
        raise messages.PolicyRefused(why="; ".join(found.refused + found.short), help=FORCE)
    for reason in found.refused + found.short:
        log.warning(messages.PolicyDoubtful(why=reason))


def _judged(policy: Policy, file: Path, wanted: WantedPolicy) -> Opinion:
    """Return reasons against a policy: from its certificate if a culture is at stake, and from its training."""
    training = Training.of(policy).doubts(wanted.setpoints)
    if not wanted.at_stake:
        return Opinion(short=training)
    with frame.refusing(ValueError):
        own = settings(policy, wanted.estimator)
    run = wanted.setpoints, wanted.bench, wanted.model, wanted.name
    found = certificate.judged(policy, own, file, *run)
    return Opinion(found.refused, found.short + training)


def policy_check(wanted: WantedPolicy) -> Check:
    """Return the preflight's check of the policy. A policy that is safe but performs poorly passes, with a note.

    If no policy has been trained yet, this check fails but the preflight does not.
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
        safe = f"{said}, proven safe" if wanted.at_stake else said
        return Check("policy", True, f"{safe}; {told}" if told else safe)
    remedy = FORCE if wanted.refuses else "a device refuses it without force_policy=true"
    return Check("policy", False, told, remedy, wanted.refuses)


def run_policy(wanted: WantedPolicy, folder: Path, resumed: bool) -> tuple[Policy, EstimateBounds | None]:
    """Load the policy of a run and its bounds, and copy policy and certificate into the run folder.

    A resumed run loads this copy. It is written from the loaded policy, so a training that ends now has no effect.
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
    """Read the bounds in a policy's certificate. Args: changes: estimator settings that differ. Raises: UserError."""
    with frame.refusing(ValueError):
        own = settings(policy, changes)
    return certificate.bounds(policy, own, file, model)


def keep(policy: Policy, kept: Path, proof: Path | None = None) -> None:
    """Write a policy to the file `kept`, with a copy of its certificate `proof`, if it exists. Raises: UserError."""
    try:
        policies.save(kept, policy)
        if proof is not None and proof.is_file():
            atomic.write(certificate.beside(kept), proof.read_text(encoding="utf-8"), fsync=False)
    except OSError as error:
        raise frame.UserError(f"{kept}: copy of the policy not written ({error.strerror}); free disk space") from None
