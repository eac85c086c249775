"""A learned policy as a law of the composition."""

from dataclasses import dataclass, replace

import numpy as np

from conf.schema import build, require, setting
from dqn.policy import COCULTURE, COCULTURE_PREVIEW, Policy
from envs.coculture.pair import PairConfig
from envs.coculture.task import logit
from experiments.laws.share.base import Array, Estimate, Wanted
from experiments.laws.share.laws import Index, LawConfig, Midpoint, MidpointConfig, Periodic

__all__ = ["ONE_LINE", "LearnedLaw", "LearnedLawConfig", "PreviewLawConfig", "one_line"]

ONE_LINE = "midpoint"  # the best law without a policy


@dataclass(frozen=True)
class LearnedLawConfig(LawConfig):
    """The policy that sees no change before it comes."""

    kind: str = setting("dqn", "which law of the composition")
    control_min: float = setting(10.0, "between decisions; the target is kept in between", "min", within=(1, 240))


@dataclass(frozen=True)
class PreviewLawConfig(LearnedLawConfig):
    """The policy to which changes are announced."""

    kind: str = setting("dqn_preview", "which law of the composition")
    control_min: float = setting(5.0, "between decisions; the target is kept in between", "min", within=(1, 240))


def one_line(policy: Policy) -> bool:
    """Whether a run found `ONE_LINE` better than this policy, so that it decides where the policy would."""
    return bool(policy.metadata.get("learned", {}).get("law") == ONE_LINE)


def _unnamed(pair: PairConfig) -> PairConfig:
    """A pair whose species are called by numbers."""
    return replace(pair, first=replace(pair.first, name="1"), second=replace(pair.second, name="2"))


class LearnedLaw(Periodic[LearnedLawConfig]):
    """T = actions[argmax_a Q(o, a)] with o = [logit r, T, m_p, logit s], and with preview [..., logit of the next
    setpoint, minutes until then].

    Shown in place of m_p is m_p - (b_e - b) mu_e(33.2): an error b_e of the other curve, beyond the b that it was
    trained with, moves the share as much as that of m_p does. A change further ahead than the policy was trained for is
    not shown to it yet. It may decide more often than in training, as a receding horizon does: an action is worth what
    it is worth for a whole period, and is thought over before.
    Args: policy: with one of these observations, which all cultures follow until `follow` gives one another.
    Where the policy that a culture follows was beaten by `ONE_LINE` (`one_line`), that law decides in its place.
    Attributes: number, of the policy that each culture follows, 0 for that, (N,).
    Raises: ValueError for a policy of another task.
    """

    remembers = ("target", "next", "one_line")
    added = ("one_line",)

    def __init__(self, config: LearnedLawConfig, policy: Policy, pair: PairConfig | None = None) -> None:
        self._policies: dict[int, Policy] = {}
        self._one_line = Midpoint(MidpointConfig(control_min=config.control_min), pair)
        super().__init__(config, pair)
        self._check(policy)
        self.policy = self._policies[0] = policy
        self.preview_min = float(policy.metadata["model"]["preview_min"])

    def _check(self, policy: Policy) -> None:
        preview = self.config.kind == "dqn_preview"
        task, expected = ("coculture_preview", COCULTURE_PREVIEW) if preview else ("coculture", COCULTURE)
        remedy = f"one with observation {list(expected)}, as env={task} trains"
        require(policy.observation == expected, "policy", list(policy.observation), remedy)
        known = build(PairConfig(), policy.metadata["model"].get("pair", {}), "pair")
        here, there = (f"{p.first.name} and {p.second.name}" for p in (self.pair, known))
        off = np.abs(known.rates(grid := np.linspace(*self.pair.temperatures, 71)) - self.pair.rates(grid)).max()
        said = f"of {there}, for a run with {here}; growth differs by up to {off:.2g} 1/h"
        allowed = "the run's own: train one with pair=... of the run, or give a law without a policy"
        require(_unnamed(known) == _unnamed(self.pair), "policy's pair", said, allowed)

    def reset(self, n: int) -> None:
        """See `Law.reset`; every culture follows the first policy."""
        super().reset(n)
        self._one_line.reset(n)
        self.number = np.zeros(n, dtype=np.int64)

    def follow(self, n: int, number: int, policy: Policy) -> None:
        """From now on culture n follows a policy of its own, of a number > 0, like the first one in task and timing.

        Raises: ValueError for a policy that is not.
        """
        self._check(policy)
        for key in ("control_min", "preview_min"):
            found, mine = (float(p.metadata["model"][key]) for p in (policy, self.policy))
            require(found == mine, f"policy's {key}", found, f"{mine:g}, as of the policy before it")
        self._policies[number], self.number[n] = policy, number

    def _decide(self, estimate: Estimate, wanted: Wanted, minute: Array, idx: Index) -> Array:
        now = logit(wanted.setpoint)
        following = self.number[idx]
        known = np.array([self._policies[k].metadata["model"].get("scale_e", 1.0) for k in following])
        rate = estimate.rate - (1.0 + estimate.error_e - known) * self.pair.rates(self._even_c)[0]
        columns = [estimate.logit, estimate.temperature, rate, now]
        if self.policy.observation == COCULTURE_PREVIEW:
            shown = wanted.minutes <= self.preview_min
            columns += [np.where(shown, logit(wanted.following), now), np.where(shown, wanted.minutes, 0.0)]
        observation, chosen = np.stack(columns, axis=1), np.empty(idx.size)
        for k in np.unique(following):
            rows, policy = following == k, self._policies[int(k)]
            if one_line(policy):
                asked = Wanted(wanted.setpoint[rows], wanted.following[rows], wanted.minutes[rows])
                chosen[rows] = self._one_line._decide(estimate.of(np.flatnonzero(rows)), asked, minute[rows], idx[rows])
            else:
                chosen[rows] = policy.chosen(observation[rows])
        return chosen
