"""A learned policy as a law of the composition."""

from dataclasses import dataclass

import numpy as np

from conf.schema import require, setting
from dqn.policy import COCULTURE, COCULTURE_PREVIEW, Policy
from envs.coculture.task import logit
from experiments.laws.share.base import Array, Estimate, Wanted
from experiments.laws.share.laws import Index, LawConfig, Periodic

__all__ = ["LearnedLaw", "LearnedLawConfig", "PreviewLawConfig"]


@dataclass(frozen=True)
class LearnedLawConfig(LawConfig):
    """The policy that sees no change before it comes."""

    kind: str = setting("dqn", "which law of the composition")
    control_min: float = setting(
        10.0, "between decisions; the target is kept in between", "min", within=(1, 240), note="the policy's own counts"
    )


@dataclass(frozen=True)
class PreviewLawConfig(LearnedLawConfig):
    """The policy to which changes are announced."""

    kind: str = setting("dqn_preview", "which law of the composition")


class LearnedLaw(Periodic[LearnedLawConfig]):
    """T = actions[argmax_a Q(o, a)] with o = [logit r, T, m_p, logit s], and with preview [..., logit of the next
    setpoint, minutes until then].

    A change further ahead than the policy was trained for is not shown to it yet. It decides as often as in training.
    Args: policy: with one of these observations. preview: whether it must be the longer one.
    Raises: ValueError for a policy of another task.
    """

    def __init__(self, config: LearnedLawConfig, policy: Policy) -> None:
        preview = config.kind == "dqn_preview"
        task, expected = ("coculture_preview", COCULTURE_PREVIEW) if preview else ("coculture", COCULTURE)
        remedy = f"one with observation {list(expected)}, as env={task} trains"
        require(policy.observation == expected, "policy", list(policy.observation), remedy)
        self.policy, self._expected = policy, expected
        self.preview_min = float(policy.metadata["model"]["preview_min"])
        super().__init__(config)
        self.control_min = float(policy.metadata["control_min"])

    def _decide(self, estimate: Estimate, wanted: Wanted, minute: Array, idx: Index) -> Array:
        now = logit(wanted.setpoint)
        columns = [estimate.logit, estimate.temperature, estimate.rate, now]
        if self._expected == COCULTURE_PREVIEW:
            shown = wanted.minutes <= self.preview_min
            columns += [np.where(shown, logit(wanted.following), now), np.where(shown, wanted.minutes, 0.0)]
        return self.policy.chosen(np.stack(columns, axis=1))
