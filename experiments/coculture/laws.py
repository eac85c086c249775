"""Composition controllers: from estimated share and its setpoint to a thermostat target."""

from abc import ABC, abstractmethod
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Generic, TypeVar

import numpy as np
from numpy.typing import NDArray

from conf.schema import build, check, part, require, setting
from dqn.policy import Policy
from envs.coculture.optimum import best_action, cost_to_go, transitions
from envs.coculture.pair import PairConfig
from envs.coculture.task import CocultureConfig, advance, logit
from experiments.coculture.base import SEEN, SEEN_AHEAD, Array, Mask, ShareEstimate, Wanted
from experiments.coculture.estimator import CompositionEstimatorConfig
from experiments.coculture.program import Program

Index = NDArray[np.intp]


@dataclass(frozen=True)
class LawConfig:
    """Settings of every composition controller."""

    kind: str = setting("proportional", "composition controller")
    control_min: float = setting(1.0, "time between decisions, with a constant target", "min", within=(1, 240))
    estimator: CompositionEstimatorConfig = part(CompositionEstimatorConfig, "settings of the estimator")

    def __post_init__(self) -> None:
        check(self, "composition")


Config = TypeVar("Config", bound=LawConfig)


class Periodic(ABC, Generic[Config]):
    """Base class of controllers that decide at multiples of a period since the program began and then keep the target.

    Args: pair: the two species. "Colder" in the settings means warmer if the second species gains by warmth.
    """

    remembers: tuple[str, ...] = ("target", "next")

    def __init__(self, config: Config, pair: PairConfig | None = None) -> None:
        self.config, self.control_min, self.pair = config, config.control_min, pair or PairConfig()
        self.model = CocultureConfig(control_min=self.control_min, pair=self.pair)
        self._even_c, self._colder = self.pair.even_c, 1.0 if self.pair.raising < self.pair.lowering else -1.0
        self.reset(1)

    def reset(self, n: int) -> None:
        """Reset the state for n cultures."""
        self._target, self._next = np.full(n, self._even_c), np.zeros(n)

    def act(self, estimate: ShareEstimate, wanted: Wanted, minute: Array, rows: Mask) -> Array:
        """Return thermostat targets, degC, (N,). The loop calls this once per control period of the density.

        Args: minute: since the program began, (N,). rows: True where the estimate is new and the share has a setpoint;
          only the state of these rows changes.
        """
        idx = np.flatnonzero(rows & (minute >= self._next - 1e-6))
        if idx.size:
            now = estimate.of(idx)
            asked = Wanted(*(a[idx] for a in (wanted.setpoint, wanted.following, wanted.minutes)))
            shown = self._decide(now, asked, minute[idx], idx) - now.thermometer  # as the thermometer shows it
            self._target[idx] = np.clip(shown, *self.pair.temperatures)
            self._next[idx] = (np.floor(minute[idx] / self.control_min + 1e-6) + 1.0) * self.control_min
        return self._target.copy()

    @abstractmethod
    def _decide(self, estimate: ShareEstimate, wanted: Wanted, minute: Array, idx: Index) -> Array:
        """Return true temperatures for the rows `idx`, degC. All arguments have only these rows; the caller clips."""


@dataclass(frozen=True)
class ProportionalConfig(LawConfig):
    """Settings of the proportional controller."""

    gain: float = setting(20.0, "degrees colder per logit by which the share is too small", "degC", within=(0.1, 1000))


class Proportional(Periodic[ProportionalConfig]):
    """Controller T = T_0 - gain (logit s - logit r), with share r and setpoint s.

    T_0 is the temperature at which the estimated growth curves cross: 33.2 degC if the curves have no error.
    """

    def _decide(self, estimate: ShareEstimate, wanted: Wanted, minute: Array, idx: Index) -> Array:
        error = logit(wanted.setpoint) - estimate.logit
        return np.asarray(self.pair.even(estimate.errors) - self._colder * self.config.gain * error)


@dataclass(frozen=True)
class PIConfig(LawConfig):
    """Settings of the PI controller; the defaults are the vendor's gains."""

    kind: str = setting("pi", "composition controller")
    gain: float = setting(15.0, "degrees colder per unit by which the share is too small", "degC", within=(0, 1000))
    integral: float = setting(0.01, "integral gain per decision, for the same error", "degC", within=(0, 10))


class PI(Periodic[PIConfig]):
    """The vendor's PI controller: T = 33.2 - 15 (s - r) - I, and I <- I + 0.01 (s - r) each minute.

    While T is at a limit, I does not grow further. T is the measured temperature, not the estimated true one.
    Source: program `CustomCompControl` of Janmorlock/ChiBio, the device's code for Lee et al. (2025).
    """

    remembers = ("target", "next", "integral")

    def reset(self, n: int) -> None:
        super().reset(n)
        self._integral = np.zeros(n)

    def _decide(self, estimate: ShareEstimate, wanted: Wanted, minute: Array, idx: Index) -> Array:
        error = wanted.setpoint - estimate.share
        further = self._integral[idx] + self.config.integral * error
        target, (low, high) = self._law(error, further), self.pair.temperatures
        pushes = ((target > high) & (self._colder * error < 0.0)) | ((target < low) & (self._colder * error > 0.0))
        self._integral[idx] = np.where(pushes, self._integral[idx], further)
        measured = self._law(error, self._integral[idx])
        return np.asarray(measured + estimate.thermometer)

    def _law(self, error: Array, integral: Array) -> Array:
        return np.asarray(self._even_c - self._colder * (self.config.gain * error + integral))


@dataclass(frozen=True)
class BangBangConfig(LawConfig):
    """Settings of the bang-bang controller."""

    kind: str = setting("bang_bang", "composition controller")


class BangBang(Periodic[BangBangConfig]):
    """Controller T = 29 degC while the share is too small, else 36 degC, for *E. coli* and *P. putida*."""

    def _decide(self, estimate: ShareEstimate, wanted: Wanted, minute: Array, idx: Index) -> Array:
        return np.where(logit(wanted.setpoint) > estimate.logit, self.pair.raising, self.pair.lowering)


@dataclass(frozen=True)
class InverseDynamicsConfig(LawConfig):
    """Settings of inverse dynamics."""

    kind: str = setting("inverse_dynamics", "composition controller")
    reach_min: float = setting(30.0, "time constant with which the error decays", "min", within=(1, 1440))


class InverseDynamics(Periodic[InverseDynamicsConfig]):
    """Inverse dynamics: the error of the logit decays like exp(-t / reach).

    The controller chooses T so that the first species, which follows the temperature at once, grows at the rate
    (1 + b_e) mu_e(T) = m_p - (logit s - logit r) / reach
    """

    def _decide(self, estimate: ShareEstimate, wanted: Wanted, minute: Array, idx: Index) -> Array:
        reach_h = self.config.reach_min / 60.0
        rate = estimate.rate - (logit(wanted.setpoint) - estimate.logit) / reach_h
        return self.pair.first_at(rate / (1.0 + estimate.error_e))


@dataclass(frozen=True)
class MyopicConfig(LawConfig):
    """Settings of the one-step controller."""

    kind: str = setting("myopic", "composition controller")
    control_min: float = setting(10.0, "time between decisions, with a constant target", "min", within=(1, 240))


class Myopic(Periodic[MyopicConfig]):
    """One-step controller: of 17 temperatures it chooses the one whose predicted share is nearest to the setpoint."""

    def _decide(self, estimate: ShareEstimate, wanted: Wanted, minute: Array, idx: Index) -> Array:
        state, errors = estimate.state, estimate.errors
        return self.model.targets()[best_action(self.model, None, None, state, wanted.setpoint, errors)]


@dataclass(frozen=True)
class MidpointConfig(InverseDynamicsConfig):
    """Settings of `midpoint`; reach_min applies while it acts as `inverse_dynamics`."""

    kind: str = setting("midpoint", "composition controller")
    control_min: float = setting(5.0, "time between decisions, with a constant target", "min", within=(1, 240))


class Midpoint(InverseDynamics):
    """Controller that is half-way to the next setpoint, in logit, at the time of an announced change.

    It switches to the hottest or coldest temperature when the model predicts that the share then is half-way just at
    the change, and keeps this temperature until the change. Otherwise it acts as `InverseDynamics`. The cost is convex
    in the error, so the smallest total cost has equal errors before and after the change.
    """

    remembers = ("target", "next", "towards")

    def reset(self, n: int) -> None:
        super().reset(n)
        self._towards = np.full(n, np.nan)  # next setpoint, once the controller moves towards it

    def _decide(self, estimate: ShareEstimate, wanted: Wanted, minute: Array, idx: Index) -> Array:
        now, following = logit(wanted.setpoint), logit(wanted.following)
        change = np.sign(following - now)
        known = (wanted.minutes > 0.0) & (change != 0.0)
        full = np.where(change > 0.0, self.pair.raising, self.pair.lowering)
        late = change * (self._reached(estimate, full, wanted.minutes) - 0.5 * (now + following)) <= 0.0
        begun = self._towards[idx] == wanted.following
        moving = known & (late | begun)
        self._towards[idx] = np.where(moving, wanted.following, np.nan)
        return np.where(moving, full, super()._decide(estimate, wanted, minute, idx))

    def _reached(self, estimate: ShareEstimate, target: Array, minutes: Array) -> Array:
        """Predict the logit after `minutes` at constant targets, (N,), with the estimated curves, in whole periods."""
        state, steps = estimate.state, np.rint(minutes / self.control_min)
        reached = state[:, 0].copy()
        for k in range(int(steps.max(initial=0.0))):
            state = advance(self.model, state, target, self.control_min, estimate.errors)
            reached = np.where(steps == k + 1, state[:, 0], reached)
        return reached


@dataclass(frozen=True)
class LearnedLawConfig(LawConfig):
    """Settings of a learned controller that does not observe announced changes."""

    kind: str = setting("dqn", "composition controller")
    control_min: float = setting(10.0, "time between decisions, with a constant target", "min", within=(1, 240))


@dataclass(frozen=True)
class PreviewLawConfig(LearnedLawConfig):
    """Settings of a learned controller that observes announced changes."""

    kind: str = setting("dqn_preview", "composition controller")
    control_min: float = setting(5.0, "time between decisions, with a constant target", "min", within=(1, 240))


def _unnamed(pair: PairConfig) -> PairConfig:
    """Return a copy of a pair whose species are named 1 and 2, to compare pairs without their names."""
    return replace(pair, first=replace(pair.first, name="1"), second=replace(pair.second, name="2"))


class LearnedLaw(Periodic[LearnedLawConfig]):
    """Learned controller T = actions[argmax_a Q(o, a)].

    The observation is o = [logit r, T, m_p, logit s], and with preview [..., logit of the next setpoint, minutes until
    then]. The value given for m_p is m_p - (b_e - b) mu_e(33.2), with the estimated error b_e of the first species'
    curve and the error b of the training: this difference changes the share as much as an equal change of m_p.
    A change that is further ahead than in training is not yet given to the policy. The controller may decide more
    often than in training; the Q values still assume that an action lasts for a period of the training.
    Args: policy: policy with one of these observations, used for all cultures.
    Raises: ValueError for a policy of another task or pair.
    """

    def __init__(self, config: LearnedLawConfig, policy: Policy, pair: PairConfig | None = None) -> None:
        super().__init__(config, pair)
        self._check(policy)
        self.policy = policy
        self.preview_min = float(policy.metadata["model"]["preview_min"])

    def _check(self, policy: Policy) -> None:
        preview = self.config.kind == "dqn_preview"
        task, expected = ("coculture_preview", SEEN_AHEAD) if preview else ("coculture", SEEN)
        remedy = f"a policy with observation {list(expected)}, trained with env={task}"
        require(policy.observation == expected, "policy", list(policy.observation), remedy)
        known = build(PairConfig(), policy.metadata["model"].get("pair", {}), "pair")
        here, there = (f"{p.first.name} and {p.second.name}" for p in (self.pair, known))
        off = np.abs(known.rates(grid := np.linspace(*self.pair.temperatures, 71)) - self.pair.rates(grid)).max()
        said = f"of {there}, for a run with {here}; growth differs by up to {off:.2g} 1/h"
        allowed = "that of the run: train a policy with pair=... of the run, or use a controller without a policy"
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


@lru_cache(maxsize=64)
def _ahead(model: CocultureConfig, setpoints: tuple[float, ...]) -> Array:
    """Return the smallest cost of a sequence of decisions with these setpoints, on the grid, (G,)."""
    return np.asarray(cost_to_go(transitions(model), np.array(setpoints)[:, None])[0, :, 0])


def _best(model: CocultureConfig, value: Array | None, estimate: ShareEstimate, setpoint: Array) -> Array:
    """Return the best temperatures, with the estimated curves for the next step, and later costs by the model."""
    chosen = best_action(model, transitions(model), value, estimate.state, setpoint, estimate.errors)
    return np.asarray(model.targets()[chosen])


@dataclass(frozen=True)
class RecedingConfig(LawConfig):
    """Settings of the receding-horizon controller."""

    kind: str = setting("receding", "composition controller")
    control_min: float = setting(30.0, "time between decisions, with a constant target", "min", within=(1, 240))
    horizon_min: float = setting(360.0, "length of the plan", "min", within=(1, 1440))


class Receding(Periodic[RecedingConfig]):
    """Receding horizon: it applies the first action of the plan with the smallest predicted sum of (r - s)^2.

    The plan assumes the current setpoint until an announced change, then the next one. Plans are cached by setpoints.
    """

    def __init__(self, config: RecedingConfig, pair: PairConfig | None = None) -> None:
        self.steps = max(round(config.horizon_min / config.control_min), 1)
        super().__init__(config, pair)

    def _decide(self, estimate: ShareEstimate, wanted: Wanted, minute: Array, idx: Index) -> Array:
        until = np.where(wanted.minutes > 0.0, np.ceil(wanted.minutes / self.control_min - 1e-6), self.steps)
        kinds = np.stack([wanted.setpoint, wanted.following, np.minimum(until, self.steps)], axis=1).round(6)
        target = np.empty(idx.size)
        for now, following, left in np.unique(kinds, axis=0):
            row = np.flatnonzero((kinds == (now, following, left)).all(axis=1))
            later = tuple(now if k < left else following for k in range(1, self.steps))
            value = _ahead(self.model, later) if later else None
            target[row] = _best(self.model, value, estimate.of(row), wanted.setpoint[row])
        return target


@dataclass(frozen=True)
class OptimumConfig(LawConfig):
    """Settings of `optimum`."""

    kind: str = setting("optimum", "composition controller")
    control_min: float = setting(30.0, "time between decisions, with a constant target", "min", within=(1, 240))


class Optimum(Periodic[OptimumConfig]):
    """Dynamic programming over the whole program, which the controller knows from the start, announced or not.

    In phases without a setpoint it plans with the next one. After the end it decides as in the last period.
    Args: program: setpoints of the share.
    """

    def __init__(self, config: OptimumConfig, program: Program, pair: PairConfig | None = None) -> None:
        steps = max(int(np.ceil(program.total_min / config.control_min)), 1)
        asked = program.setpoint(config.control_min * (np.arange(steps, dtype=np.float64) + 0.5))
        known = np.flatnonzero(np.isfinite(asked))
        following = known[np.minimum(np.searchsorted(known, np.arange(steps)), known.size - 1)]
        self._asked = asked[following]
        self._value: Array | None = None
        super().__init__(config, pair)

    def _decide(self, estimate: ShareEstimate, wanted: Wanted, minute: Array, idx: Index) -> Array:
        if self._value is None:
            self._value = cost_to_go(transitions(self.model), self._asked[:, None])[:, :, 0]
        step = np.clip(np.floor(minute / self.control_min + 1e-6), 0, len(self._asked) - 1).astype(np.intp)
        target = np.empty(idx.size)
        for k in np.unique(step):
            row = np.flatnonzero(step == k)
            target[row] = _best(self.model, self._value[k + 1], estimate.of(row), wanted.setpoint[row])
        return target
