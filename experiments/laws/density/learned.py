"""DQN policies as controllers: from OD and setpoint, or from the estimated error and growth share with a supervisor."""

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from types import MappingProxyType
from typing import Any

import numpy as np

from conf.schema import build, setting
from dqn.policy import RELATIVE, Policy
from envs.task import EnvConfig
from experiments.certification.bounds import EstimateBounds
from experiments.laws.base import Array, Controller, ControllerConfig, Mask, usable
from experiments.laws.density import estimators
from experiments.laws.density.estimator import EstimatorConfig

WATCHED = 2.0  # this many sd count as the error of an estimate
LOUDER = 1.5  # alarm only if the loudness of the policy's filter is this many times that of the second filter
NOTED = 36.0  # a larger loudness of the policy's filter is noted, whatever the second filter's


@dataclass(frozen=True)
class LearnedConfig(ControllerConfig):
    """Settings of a learned controller. The policy's file has all other settings, also those of the estimator."""

    kind: str = setting("dqn", "controller")
    estimator: dict[str, Any] = setting(
        {}, "changed settings of the estimator of a policy in relative coordinates, e.g. estimator.noise_memory=0"
    )


def learned(config: LearnedConfig, policy: Policy, model: EnvConfig, bounds: EstimateBounds | None) -> Controller:
    """Build the controller for a policy: absolute (OD, setpoint) or relative (error, growth share).

    Args: bounds: from the policy's certificate, or None. Raises: ValueError for unknown or invalid settings.
    """
    if policy.observation != RELATIVE:
        return LearnedController(policy)
    return RelativeController(policy, _estimator(policy, config.estimator), model, bounds)


def _estimator(policy: Policy, changes: Mapping[str, Any]) -> Any:
    """Return the estimator's config: from the policy's file (or defaults, for another kind), with changes applied."""
    filed = policy.metadata.get("estimator", {})
    kind = str(filed.get("kind", ""))
    if (asked := str(changes.get("kind", kind))) != kind:
        filed = {}
    own = build(estimators.config_at(asked), filed, "policy.estimator")
    return build(own, dict(changes), "controller.estimator")


def settings(policy: Policy, changes: Mapping[str, Any] = MappingProxyType({})) -> dict[str, Any]:
    """Return all settings, other than the network, that affect a policy's decisions; a certificate contains them.

    Args: changes: changed settings of its estimator. Raises: ValueError for unknown or invalid settings.
    """
    if policy.observation != RELATIVE:
        return {}
    second = {f"fallback.estimator.{key}": value for key, value in asdict(EstimatorConfig()).items()}
    law = {"fallback.law": "clip(e + s, 0, 1)", "fallback.watched_sd": WATCHED, "fallback.louder": LOUDER}
    return estimators.settings(_estimator(policy, changes)) | second | law


class LearnedController:
    """Controller u = actions[argmax_a Q([od, setpoint], a)] (paper, section 3) of a policy with this observation."""

    def __init__(self, policy: Policy) -> None:
        self.policy = policy
        self._q = np.zeros((0, policy.actions.size), dtype=np.float32)

    def reset(self, n: int) -> None:
        """Reset the explanation; there is no other state."""
        self._q = np.full((n, self.policy.actions.size), np.nan, dtype=np.float32)

    def act(self, od: Array, setpoint: Array, minute: Array, rows: Mask) -> Array:
        """Return the greedy pump rate, mL/s, shape (N,); 0 without a reading."""
        seen = rows & np.isfinite(od)
        observation = np.stack([np.where(seen, od, 0.0), setpoint], axis=1)
        q = self.policy.q_values(observation)
        self._q[rows] = q[rows]
        return np.where(seen, self.policy.actions[q.argmax(axis=1)], 0.0)

    def explain(self) -> dict[str, Array]:
        """Return the Q value of the chosen pump rate and its lead over the second best, each (N,)."""
        return lead(self._q)


def lead(q: np.ndarray) -> dict[str, Array]:
    """Return the best Q value, and its lead over the second best, (N,) each. Args: q: (N, A)."""
    ranked = np.sort(q.astype(np.float64), axis=1)
    return {"q_best": ranked[:, -1], "q_lead": ranked[:, -1] - ranked[:, -2]}


class RelativeController:
    """Controller u = u_max actions[argmax_a Q([e, s], a)] with the estimated error e and growth share s, supervised.

    The supervisor (docs/certificate.md, The supervisor) replaces the policy by the one-line controller
    u = u_max clip(e + s, 0, 1), with e and s of a second filter with fixed settings, in two cases. 1: twice the sd of e
    or s exceeds the bounds of the certificate. 2: the innovations of the policy's filter are far too large, or far too
    small for a long time, and those of the second filter are not. Case 1 compares the largest distance of the true s
    from the s that the policy observes; the true s is between 0 and the highest proven s, above which no pump rate
    holds a culture.

    Args: policy: policy that observes (error, growth_share). estimator: config of its estimator. model: control period,
      largest pump rate, and the initial mu and tau of both filters. bounds: from the certificate; None: only case 2.
    """

    remembers = ("estimator", "second", "rate", "q", "seen", "sure", "supervised", "alarm", "noted")

    def __init__(self, policy: Policy, estimator: Any, model: EnvConfig, bounds: EstimateBounds | None = None) -> None:
        self.policy, self.model, self.bounds = policy, model, bounds
        self.estimator, self.second = (estimators.build(one, model) for one in (estimator, EstimatorConfig()))
        self.reset(1)

    def reset(self, n: int) -> None:
        self.estimator.reset(n)
        self.second.reset(n)
        self._rate, self._q = np.zeros(n), np.full((n, self.policy.actions.size), np.nan)
        self._seen, self._sure = np.full((n, 2), np.nan), np.full((n, 2), np.nan)
        self._supervised, self._alarm, self._noted = np.zeros((3, n), dtype=np.bool_)

    def watch(self, od: Array, temperature: Array, minute: Array, rows: Mask) -> None:
        for each in (self.estimator, self.second):
            each.watch(od, temperature, minute, rows)

    def act(self, od: Array, setpoint: Array, minute: Array, rows: Mask) -> Array:
        for each in (self.estimator, self.second):
            each.see(od, minute, rows)
        now = usable(od, rows)
        observation, sure = (np.stack(pair(setpoint), axis=1) for pair in (self.estimator.relative, self.estimator.sd))
        q = self.policy.q_values(observation)
        loudness = self.estimator.loudness
        loud = self.estimator.loud & (loudness > LOUDER * self.second.loudness)
        alarm = loud | (self.estimator.quiet & ~self.second.quiet)
        supervised = alarm | self._outside(setpoint, observation)
        error, share = self.second.relative(setpoint)
        rate = np.where(supervised, np.clip(error + share, 0.0, 1.0), self.policy.actions[q.argmax(axis=1)])
        self._supervised[now], self._alarm[now], self._noted[now] = supervised[now], alarm[now], (loudness > NOTED)[now]
        self._q[now], self._seen[now], self._sure[now] = q[now], observation[now], sure[now]
        self._rate[now] = self.model.max_pump_rate * rate[now]
        for each in (self.estimator, self.second):
            each.decided(self._rate)
        return self._rate.copy()

    def _outside(self, setpoint: Array, observation: Array) -> Mask:
        """Return where the errors of e or s may exceed the certificate's bounds, (N,)."""
        if self.bounds is None:
            return np.zeros(setpoint.size, dtype=np.bool_)
        error, doubt = (WATCHED * sd for sd in self.estimator.doubt(setpoint))
        estimate, (low, high) = observation[:, 1], self.bounds.proven
        shown = np.clip(estimate, low, high)
        largest, least = np.minimum(estimate + doubt, high), np.maximum(estimate - doubt, 0.0)
        od = setpoint * np.exp(observation[:, 0] * self.estimator.full_pump)
        return ~self.bounds.hold(od, error, shown, np.maximum(largest - shown, shown - least))

    def dosed(self, volume_ml: Array) -> None:
        for each in (self.estimator, self.second):
            each.dosed(volume_ml)

    def explain(self) -> dict[str, Array]:
        """Return the supervisor's flags, the policy's inputs with their sd, its Q values, and the estimates."""
        flags = {"supervised": self._supervised, "alarm": self._alarm, "noted": self._noted}
        said = {name: flag.astype(np.float64) for name, flag in flags.items()}
        (error, share), (error_sd, share_sd) = self._seen.T.copy(), self._sure.T.copy()
        seen = {"error": error, "growth_share": share, "error_sd": error_sd, "growth_share_sd": share_sd}
        return {**said, **seen, **lead(self._q), **self.estimator.explain()}
