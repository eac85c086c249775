"""The exported DQN policy as a controller: of (OD, setpoint), without memory, or of (error, growth share) estimated."""

from dataclasses import dataclass
from typing import Any

import numpy as np

from conf.schema import build, setting
from dqn.policy import RELATIVE, Policy
from envs.task import EnvConfig
from experiments.certification.bounds import EstimateBounds
from experiments.laws.base import Array, Controller, ControllerConfig, Mask, usable
from experiments.laws.density.estimator import LOWEST_OD, Estimator, EstimatorConfig

__all__ = ["LearnedConfig", "LearnedController", "RelativeController", "learned"]

WATCHED = 2.0  # sd of an estimate that count as its error


@dataclass(frozen=True)
class LearnedConfig(ControllerConfig):
    """Everything about a policy is in its file, the estimator's settings too."""

    kind: str = setting("dqn", "which controller")
    estimator: dict[str, Any] = setting(
        {}, "of a policy in relative coordinates: what replaces the settings in its file, estimator.noise_memory=0"
    )


def learned(config: LearnedConfig, policy: Policy, model: EnvConfig, bounds: EstimateBounds | None) -> Controller:
    """The controller that fits a policy's observation.

    Args: bounds: of the policy's certificate, within which it may act; None where it has none.
    Raises: ValueError for settings that do not exist or fit.
    """
    if policy.observation != RELATIVE:
        return LearnedController(policy)
    own = build(EstimatorConfig(), policy.metadata.get("estimator", {}), "policy.estimator")
    return RelativeController(policy, build(own, config.estimator, "controller.estimator"), model, bounds)


class LearnedController:
    """u = actions[argmax_a Q([od, setpoint], a)] (paper, section 3).

    Args: policy: as read by `dqn.policy.load`.
    """

    def __init__(self, policy: Policy) -> None:
        self.policy = policy
        self._q = np.zeros((0, policy.actions.size), dtype=np.float32)

    def reset(self, n: int) -> None:
        """There is nothing to forget but the last explanation."""
        self._q = np.full((n, self.policy.actions.size), np.nan, dtype=np.float32)

    def act(self, od: Array, setpoint: Array, minute: Array, rows: Mask) -> Array:
        """Greedy pump rate, mL/s, shape (N,); 0 where the reading is no number."""
        seen = rows & np.isfinite(od)
        observation = np.stack([np.where(seen, od, 0.0), setpoint], axis=1)
        q = self.policy.q_values(observation)
        self._q[rows] = q[rows]
        return np.where(seen, self.policy.actions[q.argmax(axis=1)], 0.0)

    def explain(self) -> dict[str, Array]:
        """Q value of the chosen pump rate and its lead over the second best, each (N,)."""
        return lead(self._q)


def lead(q: np.ndarray) -> dict[str, Array]:
    """Best Q value and its lead over the second best, each (N,); q: (N, A)."""
    ranked = np.sort(q.astype(np.float64), axis=1)
    return {"q_best": ranked[:, -1], "q_lead": ranked[:, -1] - ranked[:, -2]}


class RelativeController:
    """u = u_max v with v = actions[argmax_a Q([e, s], a)], error e and growth share s as `Estimator` knows them.

    A supervisor stands over it: where twice the estimator's own sd of e or s leaves the bounds of the certificate, the
    one-line law on the nominal model acts instead, u = tau (mu + ln(x/r)/h) of the reading, clipped to the pump's
    range (docs/certificate.md, What is assumed). The error of s is how far the s that the policy is shown may lie from
    the true one, which is between 0 and the highest that was proven: above it no pump rate holds the culture.

    Args: policy: with observation (error, growth_share). estimator: its settings. model: mu, tau, control period and
      largest pump rate; mu and tau are where the estimator begins. bounds: of the certificate; None: nobody supervises.
    """

    remembers = ("estimator", "rate", "q", "seen", "supervised")

    def __init__(
        self, policy: Policy, estimator: EstimatorConfig, model: EnvConfig, bounds: EstimateBounds | None = None
    ) -> None:
        self.policy, self.model, self.bounds = policy, model, bounds
        self.estimator = Estimator(estimator, model)
        self.reset(1)

    def reset(self, n: int) -> None:
        """See `Controller.reset`."""
        self.estimator.reset(n)
        self._rate, self._q = np.zeros(n), np.full((n, self.policy.actions.size), np.nan)
        self._seen, self._supervised = np.full((n, 2), np.nan), np.zeros(n, dtype=np.bool_)

    def watch(self, od: Array, temperature: Array, minute: Array, rows: Mask) -> None:
        """See `Watches.watch`."""
        self.estimator.watch(od, temperature, minute, rows)

    def act(self, od: Array, setpoint: Array, minute: Array, rows: Mask) -> Array:
        """See `Controller.act`."""
        self.estimator.see(od, minute, rows)
        now = usable(od, rows)
        observation = np.stack(self.estimator.relative(setpoint), axis=1)
        q = self.policy.q_values(observation)
        outside = self._outside(setpoint, observation)
        rate = np.where(outside, self._nominal(od, setpoint), self.policy.actions[q.argmax(axis=1)])
        rate = self.model.max_pump_rate * rate
        self._supervised = np.where(now, outside, self._supervised)
        self._q[now], self._seen[now] = q[now], observation[now]
        self._rate = np.where(now, rate, self._rate)
        self.estimator.decided(self._rate)
        return self._rate.copy()

    def _outside(self, setpoint: Array, observation: np.ndarray) -> Mask:
        """Where the policy may not act, (N,)."""
        if self.bounds is None:
            return np.zeros(setpoint.size, dtype=np.bool_)
        error, doubt = (WATCHED * sd for sd in self.estimator.doubt(setpoint))
        estimate, (low, high) = observation[:, 1], self.bounds.proven
        shown = np.clip(estimate, low, high)
        largest, least = np.minimum(estimate + doubt, high), np.maximum(estimate - doubt, 0.0)
        return ~self.bounds.hold(setpoint, error, shown, np.maximum(largest - shown, shown - least))

    def _nominal(self, od: Array, setpoint: Array) -> Array:
        """Share of the largest pump rate by the one-line law on the nominal model, (N,)."""
        m = self.model
        error = np.log(np.maximum(np.nan_to_num(od), LOWEST_OD) / np.maximum(setpoint, LOWEST_OD))
        return np.clip(m.tau / m.max_pump_rate * (m.mu + error / m.control_min), 0.0, 1.0)

    def dosed(self, volume_ml: Array) -> None:
        """See `Accounts.dosed`."""
        self.estimator.dosed(volume_ml)

    def explain(self) -> dict[str, Array]:
        """What the policy saw, how sure it was, and the estimates behind it, each (N,)."""
        seen = {"error": self._seen[:, 0].copy(), "growth_share": self._seen[:, 1].copy()}
        supervised = {"supervised": self._supervised.astype(np.float64)}
        return {**supervised, **seen, **lead(self._q), **self.estimator.explain()}
