"""A learned policy as a composition controller."""

from dataclasses import dataclass, replace

import numpy as np

from conf.schema import build, require, setting
from dqn.policy import Policy
from envs.coculture.pair import PairConfig
from envs.coculture.task import logit
from experiments.coculture.base import SEEN, SEEN_AHEAD, Array, ShareEstimate, Wanted
from experiments.coculture.laws import Index, LawConfig, Periodic

__all__ = ["LearnedLaw", "LearnedLawConfig", "PreviewLawConfig"]


@dataclass(frozen=True)
class LearnedLawConfig(LawConfig):
    """The policy that sees no change before it comes."""

    kind: str = setting("dqn", "composition controller")
    control_min: float = setting(10.0, "between decisions; the target is kept in between", "min", within=(1, 240))


@dataclass(frozen=True)
class PreviewLawConfig(LearnedLawConfig):
    """The policy to which changes are announced."""

    kind: str = setting("dqn_preview", "composition controller")
    control_min: float = setting(5.0, "between decisions; the target is kept in between", "min", within=(1, 240))


def _unnamed(pair: PairConfig) -> PairConfig:
    """Return a pair whose species are called by numbers."""
    return replace(pair, first=replace(pair.first, name="1"), second=replace(pair.second, name="2"))


class LearnedLaw(Periodic[LearnedLawConfig]):
    """Law of a learned policy, T = actions[argmax_a Q(o, a)].

    The observation is o = [logit r, T, m_p, logit s], and with preview [..., logit of the next
    setpoint, minutes until then].

    Shown in place of m_p is m_p - (b_e - b) mu_e(33.2): an error b_e of the other curve, beyond the b that it was
    trained with, moves the share as much as that of m_p does. A change further ahead than the policy was trained for is
    not shown to it yet. It may decide more often than in training, as a receding horizon does: an action is worth what
    it is worth for a whole period, and is thought over before.
    Args: policy: with one of these observations, which all cultures follow.
    Raises: ValueError for a policy of another task.
    """

    def __init__(self, config: LearnedLawConfig, policy: Policy, pair: PairConfig | None = None) -> None:
        super().__init__(config, pair)
        self._check(policy)
        self.policy = policy
        self.preview_min = float(policy.metadata["model"]["preview_min"])

    def _check(self, policy: Policy) -> None:
        preview = self.config.kind == "dqn_preview"
        task, expected = ("coculture_preview", SEEN_AHEAD) if preview else ("coculture", SEEN)
        remedy = f"one with observation {list(expected)}, as env={task} trains"
        require(policy.observation == expected, "policy", list(policy.observation), remedy)
        known = build(PairConfig(), policy.metadata["model"].get("pair", {}), "pair")
        here, there = (f"{p.first.name} and {p.second.name}" for p in (self.pair, known))
        off = np.abs(known.rates(grid := np.linspace(*self.pair.temperatures, 71)) - self.pair.rates(grid)).max()
        said = f"of {there}, for a run with {here}; growth differs by up to {off:.2g} 1/h"
        allowed = "the run's own: train one with pair=... of the run, or give a law without a policy"
        require(_unnamed(known) == _unnamed(self.pair), "policy's pair", said, allowed)

    def _decide(self, estimate: ShareEstimate, wanted: Wanted, minute: Array, idx: Index) -> Array:
        now = logit(wanted.setpoint)
        known = self.policy.metadata["model"].get("scale_e", 1.0)
        rate = estimate.rate - (1.0 + estimate.error_e - known) * self.pair.rates(self._even_c)[0]
        columns = [estimate.logit, estimate.temperature, rate, now]
        if self.policy.observation == SEEN_AHEAD:
            shown = wanted.minutes <= self.preview_min
            columns += [np.where(shown, logit(wanted.following), now), np.where(shown, wanted.minutes, 0.0)]
        return self.policy.chosen(np.stack(columns, axis=1))
