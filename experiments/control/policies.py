"""The policy file of a run: finding it, checking it, and keeping a copy with the run."""

import logging
from pathlib import Path

from dqn import policy as policies
from dqn.policy import Policy
from experiments.cli import frame

__all__ = ["find_policy", "load_policy", "run_policy"]

log = logging.getLogger(__name__)

POOR_REGRET_PCT = 25.0


def find_policy(name: str, root: Path = Path("runs/train")) -> Path:
    """A policy.npz from a path, a run folder or `latest`. Raises: UserError saying what to give instead."""
    if name == "latest":
        found = sorted(root.glob("**/policy.npz"), key=lambda p: p.stat().st_mtime)
        if not found:
            raise frame.UserError(f"policy=latest: no policy.npz under {root}; train one first or give policy=PATH")
        return found[-1]
    path = Path(name)
    return path / "policy.npz" if path.is_dir() else path


def load_policy(name: str, control_min: float, max_rate: float) -> Policy:
    """The policy that `find_policy` finds, checked against control period and interlock.

    Args: control_min: of the backend, min. max_rate: largest pump rate that the interlock allows, mL/s.
    Raises: UserError naming the file and, for a mismatch, both values.
    """
    path = find_policy(name)
    try:
        policy = policies.load(path)
        trained = float(policy.metadata.get("control_min", float("nan")))
        regret = float(policy.metadata.get("regret_pct", float("nan")))
        fastest = float(policy.pump_rates.max())
    except policies.PolicyError as error:
        raise frame.UserError(str(error)) from None
    except Exception as error:  # whatever a damaged file makes NumPy say
        why = (str(error).splitlines() or [type(error).__name__])[0]
        raise frame.UserError(f"policy {path}: damaged ({why}); give the policy.npz of a training run") from None
    if not abs(trained - control_min) <= 1e-9:
        raise frame.UserError(
            f"policy {path} was trained for a control period of {trained} min, the backend has {control_min} min; "
            f"train with env.control_min={control_min}"
        )
    if not fastest <= max_rate + 1e-12:
        raise frame.UserError(
            f"policy {path} pumps up to {fastest} mL/s, the interlock allows {max_rate} mL/s; "
            "train with a smaller env.max_pump_rate or raise safety.max_rate"
        )
    log.info("policy %s: regret %.2f %% against the optimum of its model", path, regret)
    if not regret <= POOR_REGRET_PCT:
        log.warning("this policy is far from optimal (regret %.0f %%): train longer or with another seed", regret)
    return policy


def run_policy(name: str, folder: Path, resumed: bool, control_min: float, max_rate: float) -> Policy:
    """The policy of a run, of which the run folder keeps a copy; a resumed run goes on with that copy.

    The copy is written from the policy as it was read: whatever has been trained meanwhile, both are the same.
    Raises: UserError as `load_policy`, and if the copy cannot be written.
    """
    kept = folder / "policy.npz"
    if resumed and kept.is_file():
        return load_policy(str(kept), control_min, max_rate)
    policy = load_policy(name, control_min, max_rate)
    try:
        policies.save(kept, policy)
    except OSError as error:
        raise frame.UserError(f"{kept}: copy of the policy not written ({error.strerror}); free the disk") from None
    return policy
