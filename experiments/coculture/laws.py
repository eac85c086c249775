"""Laws of the composition: from estimated and wanted share to a thermostat target."""

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
    """What every composition controller has."""

    kind: str = setting("proportional", "composition controller")
    control_min: float = setting(1.0, "between decisions; the target is kept in between", "min", within=(1, 240))
    estimator: CompositionEstimatorConfig = part(CompositionEstimatorConfig, "what the filter believes")

    def __post_init__(self) -> None:
        check(self, "composition")


Config = TypeVar("Config", bound=LawConfig)


class Periodic(ABC, Generic[Config]):
    """A law that decides at whole multiples of its period since the program began, and keeps its target in between.

    Args: pair: the two species. What stands here as colder is warmer where warmth makes the second species gain.
    """

    remembers: tuple[str, ...] = ("target", "next")

    def __init__(self, config: Config, pair: PairConfig | None = None) -> None:
        self.config, self.control_min, self.pair = config, config.control_min, pair or PairConfig()
        self.model = CocultureConfig(control_min=self.control_min, pair=self.pair)
        self._even_c, self._colder = self.pair.even_c, 1.0 if self.pair.raising < self.pair.lowering else -1.0
        self.reset(1)

    def reset(self, n: int) -> None:
        """Forget everything; n cultures from here on."""
        self._target, self._next = np.full(n, self._even_c), np.zeros(n)

    def act(self, estimate: ShareEstimate, wanted: Wanted, minute: Array, rows: Mask) -> Array:
        """Return thermostat targets, degC, (N,); called once per control period of the density.

        Args: minute: since the program began, (N,). rows: True where the estimate is new and a setpoint is in force;
          only these rows' state advances.
        """
        idx = np.flatnonzero(rows & (minute >= self._next - 1e-6))
        if idx.size:
            now = estimate.of(idx)
            asked = Wanted(*(a[idx] for a in (wanted.setpoint, wanted.following, wanted.minutes)))
            shown = self._decide(now, asked, minute[idx], idx) - now.thermometer  # what the thermostat goes by
            self._target[idx] = np.clip(shown, *self.pair.temperatures)
            self._next[idx] = (np.floor(minute[idx] / self.control_min + 1e-6) + 1.0) * self.control_min
        return self._target.copy()

    @abstractmethod
    def _decide(self, estimate: ShareEstimate, wanted: Wanted, minute: Array, idx: Index) -> Array:
        """Decide true temperatures for the rows `idx`, whose estimates and wishes are given, degC; the caller clips."""


@dataclass(frozen=True)
class ProportionalConfig(LawConfig):
    """One gain, on the difference of logits."""

    gain: float = setting(20.0, "colder per logit that the share is too small", "degC", within=(0.1, 1000))


class Proportional(Periodic[ProportionalConfig]):
    """T = T_0 - gain (logit s - logit r): at equal rates, T_0, on the setpoint s, colder where the share is too small.

    T_0 is where the estimated growth curves cross: 33.2 degC, were they without error.
    """

    def _decide(self, estimate: ShareEstimate, wanted: Wanted, minute: Array, idx: Index) -> Array:
        error = logit(wanted.setpoint) - estimate.logit
        return np.asarray(self.pair.even(estimate.errors) - self._colder * self.config.gain * error)


@dataclass(frozen=True)
class PIConfig(LawConfig):
    """The vendor's gains."""

    kind: str = setting("pi", "composition controller")
    gain: float = setting(15.0, "colder per unit of the share that it is too small", "degC", within=(0, 1000))
    integral: float = setting(0.01, "per unit of the share and decision", "degC", within=(0, 10))


class PI(Periodic[PIConfig]):
    """T = 33.2 - 15 (s - r) - I, I <- I + 0.01 (s - r) each minute; I rests while T is at the limit it pushes against.

    T is the measured temperature: the vendor's law knows of no error of the thermometer.
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
    """All or nothing."""

    kind: str = setting("bang_bang", "composition controller")


class BangBang(Periodic[BangBangConfig]):
    """T = 29 while the share is too small, else 36."""

    def _decide(self, estimate: ShareEstimate, wanted: Wanted, minute: Array, idx: Index) -> Array:
        return np.where(logit(wanted.setpoint) > estimate.logit, self.pair.raising, self.pair.lowering)


@dataclass(frozen=True)
class InverseDynamicsConfig(LawConfig):
    """How soon the setpoint is to be reached."""

    kind: str = setting("inverse_dynamics", "composition controller")
    reach_min: float = setting(30.0, "time constant with which the error is to vanish", "min", within=(1, 1440))


class InverseDynamics(Periodic[InverseDynamicsConfig]):
    """Law of inverse dynamics: the error vanishes like exp(-t / reach).

    It takes the temperature at which the first species, which answers at once, grows by
    (1 + b_e) mu_e(T) = m_p - (logit s - logit r) / reach
    """

    def _decide(self, estimate: ShareEstimate, wanted: Wanted, minute: Array, idx: Index) -> Array:
        reach_h = self.config.reach_min / 60.0
        rate = estimate.rate - (logit(wanted.setpoint) - estimate.logit) / reach_h
        return self.pair.first_at(rate / (1.0 + estimate.error_e))


@dataclass(frozen=True)
class MyopicConfig(LawConfig):
    """One look ahead by the model."""

    kind: str = setting("myopic", "composition controller")
    control_min: float = setting(10.0, "between decisions; the target is kept in between", "min", within=(1, 240))


class Myopic(Periodic[MyopicConfig]):
    """The one of 17 temperatures after which, by the model, the share is nearest to the setpoint."""

    def _decide(self, estimate: ShareEstimate, wanted: Wanted, minute: Array, idx: Index) -> Array:
        state, errors = estimate.state, estimate.errors
        return self.model.targets()[best_action(self.model, None, None, state, wanted.setpoint, errors)]


@dataclass(frozen=True)
class MidpointConfig(InverseDynamicsConfig):
    """When to begin, and what holds until then."""

    kind: str = setting("midpoint", "composition controller")
    control_min: float = setting(5.0, "between decisions; the target is kept in between", "min", within=(1, 240))


class Midpoint(InverseDynamics):
    """Half-way, in logit, when an announced change comes: full authority from so early that the model is there then.

    The error is convex in the share, so being early by as much as late costs least. Before that, and where nothing is
    announced, as `InverseDynamics`. Once begun it goes on until the change comes.
    """

    remembers = ("target", "next", "towards")

    def reset(self, n: int) -> None:
        super().reset(n)
        self._towards = np.full(n, np.nan)  # setpoint that the share is on its way to before it is asked for

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
        """Logit after `minutes`, (N,), at targets (N,), by the estimated curves; to the nearest period."""
        state, steps = estimate.state, np.rint(minutes / self.control_min)
        reached = state[:, 0].copy()
        for k in range(int(steps.max(initial=0.0))):
            state = advance(self.model, state, target, self.control_min, estimate.errors)
            reached = np.where(steps == k + 1, state[:, 0], reached)
        return reached


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


@lru_cache(maxsize=64)
def _ahead(model: CocultureConfig, setpoints: tuple[float, ...]) -> Array:
    """Least cost of decisions with these setpoints in force, on the grid, (G,)."""
    return np.asarray(cost_to_go(transitions(model), np.array(setpoints)[:, None])[0, :, 0])


def _best(model: CocultureConfig, value: Array | None, estimate: ShareEstimate, setpoint: Array) -> Array:
    """Choose the best temperature now, by the estimated curves; what comes after it by the model's."""
    chosen = best_action(model, transitions(model), value, estimate.state, setpoint, estimate.errors)
    return np.asarray(model.targets()[chosen])


@dataclass(frozen=True)
class RecedingConfig(LawConfig):
    """How far it plans."""

    kind: str = setting("receding", "composition controller")
    control_min: float = setting(30.0, "between decisions; the target is kept in between", "min", within=(1, 240))
    horizon_min: float = setting(360.0, "how far ahead it plans", "min", within=(1, 1440))


class Receding(Periodic[RecedingConfig]):
    """The first action of the best plan for the next hours: least sum of (r - s)^2 after each decision, on the model.

    The setpoint is that in force until the announced change, then the next one. Programs are planned once and kept.
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
    """How often it decides."""

    kind: str = setting("optimum", "composition controller")
    control_min: float = setting(30.0, "between decisions; the target is kept in between", "min", within=(1, 240))


class Optimum(Periodic[OptimumConfig]):
    """Dynamic programming over the whole program, known from its beginning; what is announced does not matter to it.

    Where no share is asked for, the next one counts already. After the end the last decision's value holds.
    Args: program: what will be asked for.
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
