"""Laws that ask nothing of a model, or one look ahead: from estimated and wanted share to a thermostat target."""

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Generic, TypeVar

import numpy as np
from numpy.typing import NDArray

from conf.schema import check, part, setting
from envs.coculture.optimum import best_action
from envs.coculture.pair import PairConfig
from envs.coculture.task import CocultureConfig, advance, logit
from experiments.coculture.base import Array, Mask, ShareEstimate, Wanted
from experiments.coculture.estimator import CompositionEstimatorConfig

__all__ = [
    "PI", "BangBang", "BangBangConfig", "InverseDynamics", "InverseDynamicsConfig", "LawConfig", "Midpoint",
    "MidpointConfig", "Myopic", "MyopicConfig", "PIConfig", "Periodic", "Proportional", "ProportionalConfig",
]  # fmt: skip

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
        """See `Law.reset`."""
        self._target, self._next = np.full(n, self._even_c), np.zeros(n)

    def act(self, estimate: ShareEstimate, wanted: Wanted, minute: Array, rows: Mask) -> Array:
        """See `Law.act`."""
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
        """See `Law.reset`."""
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
        """See `Law.reset`."""
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
