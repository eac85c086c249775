"""Laws that ask nothing of a model, or one look ahead: from estimated and wanted share to a thermostat target."""

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Generic, TypeVar

import numpy as np
from numpy.typing import NDArray

from conf.schema import check, part, setting
from envs.coculture.optimum import best_action
from envs.coculture.rates import E_SLOPE, E_ZERO, EQUAL_RATES_C, T_MAX, T_MIN
from envs.coculture.task import CocultureConfig, advance, logit
from experiments.laws.share.base import Array, Estimate, Mask, Wanted
from experiments.laws.share.estimator import CompositionEstimatorConfig

__all__ = [
    "PI", "BangBang", "BangBangConfig", "InverseDynamics", "InverseDynamicsConfig", "LawConfig", "Midpoint",
    "MidpointConfig", "Myopic", "MyopicConfig", "PIConfig", "Periodic", "Proportional", "ProportionalConfig",
]  # fmt: skip

Index = NDArray[np.intp]


@dataclass(frozen=True)
class LawConfig:
    """What every law of the composition has."""

    kind: str = setting("proportional", "which law of the composition")
    control_min: float = setting(1.0, "between decisions; the target is kept in between", "min", within=(1, 240))
    estimator: CompositionEstimatorConfig = part(CompositionEstimatorConfig, "what the filter believes")

    def __post_init__(self) -> None:
        check(self, "composition")


Config = TypeVar("Config", bound=LawConfig)


class Periodic(ABC, Generic[Config]):
    """A law that decides at whole multiples of its period since the program began, and keeps its target in between."""

    remembers: tuple[str, ...] = ("target", "next")

    def __init__(self, config: Config) -> None:
        self.config, self.control_min = config, config.control_min
        self.reset(1)

    def reset(self, n: int) -> None:
        """See `Law.reset`."""
        self._target, self._next = np.full(n, EQUAL_RATES_C), np.zeros(n)

    def act(self, estimate: Estimate, wanted: Wanted, minute: Array, rows: Mask) -> Array:
        """See `Law.act`."""
        idx = np.flatnonzero(rows & (minute >= self._next - 1e-6))
        if idx.size:
            now = Estimate(*(a[idx] for a in (estimate.logit, estimate.sd, estimate.temperature, estimate.rate)))
            asked = Wanted(*(a[idx] for a in (wanted.setpoint, wanted.following, wanted.minutes)))
            self._target[idx] = np.clip(self._decide(now, asked, minute[idx], idx), T_MIN, T_MAX)
            self._next[idx] = (np.floor(minute[idx] / self.control_min + 1e-6) + 1.0) * self.control_min
        return self._target.copy()

    @abstractmethod
    def _decide(self, estimate: Estimate, wanted: Wanted, minute: Array, idx: Index) -> Array:
        """Targets of the rows `idx`, whose estimates and wishes are given, degC; clipped by the caller."""


@dataclass(frozen=True)
class ProportionalConfig(LawConfig):
    """One gain, on the difference of logits."""

    gain: float = setting(20.0, "colder per logit that the share is too small", "degC", within=(0.1, 1000))


class Proportional(Periodic[ProportionalConfig]):
    """T = 33.2 - gain (logit s - logit r): at equal rates on the setpoint s, colder where the share r is too small."""

    def _decide(self, estimate: Estimate, wanted: Wanted, minute: Array, idx: Index) -> Array:
        return np.asarray(EQUAL_RATES_C - self.config.gain * (logit(wanted.setpoint) - estimate.logit))


@dataclass(frozen=True)
class PIConfig(LawConfig):
    """The vendor's gains."""

    kind: str = setting("pi", "which law of the composition")
    gain: float = setting(15.0, "colder per unit of the share that it is too small", "degC", within=(0, 1000))
    integral: float = setting(0.01, "per unit of the share and decision", "degC", within=(0, 10))


class PI(Periodic[PIConfig]):
    """T = 33.2 - 15 (s - r) - I, I <- I + 0.01 (s - r) each minute; I rests while T is at the limit it pushes against.

    Source: program `CustomCompControl` of Janmorlock/ChiBio, the device's code for Lee et al. (2025).
    """

    remembers = ("target", "next", "integral")

    def reset(self, n: int) -> None:
        """See `Law.reset`."""
        super().reset(n)
        self._integral = np.zeros(n)

    def _decide(self, estimate: Estimate, wanted: Wanted, minute: Array, idx: Index) -> Array:
        error = wanted.setpoint - estimate.share
        further = self._integral[idx] + self.config.integral * error
        target = EQUAL_RATES_C - self.config.gain * error - further
        pushes = ((target > T_MAX) & (error < 0.0)) | ((target < T_MIN) & (error > 0.0))
        self._integral[idx] = np.where(pushes, self._integral[idx], further)
        return np.asarray(EQUAL_RATES_C - self.config.gain * error - self._integral[idx])


@dataclass(frozen=True)
class BangBangConfig(LawConfig):
    """All or nothing."""

    kind: str = setting("bang_bang", "which law of the composition")


class BangBang(Periodic[BangBangConfig]):
    """T = 29 while the share is too small, else 36."""

    def _decide(self, estimate: Estimate, wanted: Wanted, minute: Array, idx: Index) -> Array:
        return np.where(logit(wanted.setpoint) > estimate.logit, T_MIN, T_MAX)


@dataclass(frozen=True)
class InverseDynamicsConfig(LawConfig):
    """How soon the setpoint is to be reached."""

    kind: str = setting("inverse_dynamics", "which law of the composition")
    reach_min: float = setting(30.0, "time constant with which the error is to vanish", "min", within=(1, 1440))


class InverseDynamics(Periodic[InverseDynamicsConfig]):
    """The temperature at which E. coli, which answers at once, makes the error vanish like exp(-t / reach):

    mu_e(T) = m_p - (logit s - logit r) / reach
    """

    def _decide(self, estimate: Estimate, wanted: Wanted, minute: Array, idx: Index) -> Array:
        reach_h = self.config.reach_min / 60.0
        rate = estimate.rate - (logit(wanted.setpoint) - estimate.logit) / reach_h
        return np.asarray((rate + E_ZERO) / E_SLOPE)


@dataclass(frozen=True)
class MyopicConfig(LawConfig):
    """One look ahead by the model."""

    kind: str = setting("myopic", "which law of the composition")
    control_min: float = setting(10.0, "between decisions; the target is kept in between", "min", within=(1, 240))


class Myopic(Periodic[MyopicConfig]):
    """The one of 17 temperatures after which, by the model, the share is nearest to the setpoint."""

    def __init__(self, config: MyopicConfig) -> None:
        self.model = CocultureConfig(control_min=config.control_min)
        super().__init__(config)

    def _decide(self, estimate: Estimate, wanted: Wanted, minute: Array, idx: Index) -> Array:
        return self.model.targets()[best_action(self.model, None, None, estimate.state, wanted.setpoint)]


@dataclass(frozen=True)
class MidpointConfig(LawConfig):
    """When to begin, and the gain until then."""

    kind: str = setting("midpoint", "which law of the composition")
    control_min: float = setting(10.0, "between decisions; the target is kept in between", "min", within=(1, 240))
    gain: float = setting(20.0, "colder per logit that the share is too small", "degC", within=(0.1, 1000))


class Midpoint(Periodic[MidpointConfig]):
    """Half-way, in logit, when an announced change comes: full authority from so early that the model is there then.

    The error is convex in the share, so being early by as much as late costs least. Before that, and where nothing is
    announced, as `Proportional`. Once begun it goes on until the change comes.
    """

    remembers = ("target", "next", "towards")

    def __init__(self, config: MidpointConfig) -> None:
        self.model = CocultureConfig(control_min=config.control_min)
        super().__init__(config)

    def reset(self, n: int) -> None:
        """See `Law.reset`."""
        super().reset(n)
        self._towards = np.full(n, np.nan)  # setpoint that the share is on its way to before it is asked for

    def _decide(self, estimate: Estimate, wanted: Wanted, minute: Array, idx: Index) -> Array:
        now, following = logit(wanted.setpoint), logit(wanted.following)
        change = np.sign(following - now)
        known = (wanted.minutes > 0.0) & (change != 0.0)
        full = np.where(change > 0.0, T_MIN, T_MAX)
        late = change * (self._reached(estimate.state, full, wanted.minutes) - 0.5 * (now + following)) <= 0.0
        begun = self._towards[idx] == wanted.following
        moving = known & (late | begun)
        self._towards[idx] = np.where(moving, wanted.following, np.nan)
        return np.where(moving, full, EQUAL_RATES_C - self.config.gain * (now - estimate.logit))

    def _reached(self, state: Array, target: Array, minutes: Array) -> Array:
        """Logit after `minutes`, (N,), at targets (N,), from states (N, 3); to the nearest period."""
        steps, reached = np.rint(minutes / self.control_min), state[:, 0].copy()
        for k in range(int(steps.max(initial=0.0))):
            state = advance(self.model, state, target, self.control_min)
            reached = np.where(steps == k + 1, state[:, 0], reached)
        return reached
