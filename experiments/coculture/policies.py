"""Policy of a learned composition controller: find it, copy it, and check its range of shares."""

import logging
from pathlib import Path

from dqn import policy as policies
from dqn.policy import Policy
from experiments.cli import frame
from experiments.coculture.base import SHARE
from experiments.coculture.program import Program
from experiments.control.policies import SHIPPED, find_policy, keep, readable
from experiments.laws import registry

log = logging.getLogger(__name__)

SHIPPED_COMPOSITION = {
    "dqn": SHIPPED.with_name("coculture.npz"),
    "dqn_preview": SHIPPED.with_name("coculture_preview.npz"),
}
"""Kind of a learned controller -> the policy shipped with the program."""
KEPT = "composition_policy.npz"  # name of the copy in a run folder


def _found(name: str) -> Path:
    """Return the path of a policy as `find_policy`; for a deployment's folder, the path of its composition policy."""
    run = Path(name)
    return run / KEPT if (run / "journal.jsonl").is_file() else find_policy(name)


def composition_policy(kind: str, name: str, folder: Path, resumed: bool) -> Policy | None:
    """Load the policy of a composition controller and copy it into the run folder; None if the controller needs none.

    Args: kind: kind of the controller. name: `shipped`, a policy.npz or a run folder. resumed: use the copy.
    Raises: UserError with the file and the reason.
    """
    if not registry.takes(kind, "policy", SHARE):
        return None
    kept = folder / KEPT
    again = resumed and kept.is_file()
    path = SHIPPED_COMPOSITION.get(kind, Path("shipped")) if name == "shipped" or again else _found(name)
    if not again and name == "shipped" and not path.is_file():
        remedy = "give composition_policy=RUN/policy.npz of a training with env=coculture or env=coculture_preview"
        raise frame.UserError(f"composition={kind}: this version ships no policy for it; {remedy}")
    with readable(path):
        policy = policies.load(kept if again else path)
    if not again:
        keep(policy, kept)
    return policy


def check_shares(policy: Policy, kind: str, programs: list[Program], forced: bool) -> None:
    """Check that a policy was trained for the requested shares. Raises: UserError; if `forced`, it logs a warning."""
    low, high = policy.metadata["model"]["setpoints"]
    outside = sorted({s for p in programs for s in p.extremes if not low - 1e-9 <= s <= high + 1e-9})
    if not outside:
        return
    what = f"composition={kind}: its policy was trained for shares {low:g} to {high:g}, but the scenario has "
    what += ", ".join(f"{s:g}" for s in outside)
    if not forced:
        remedy = "use composition=midpoint, a policy trained with env.setpoints that include it, or force_policy=true"
        raise frame.UserError(f"{what}; {remedy}")
    log.warning("%s; the run continues because of force_policy=true", what)
