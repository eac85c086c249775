"""A second simulator of recordings, from the equations; it shares no code with the package.

The culture follows dx/dt = (m(t) - u(t) (1 + dose error) / tau) x with m(t) = mu (1 + wander(t)). The wander is a
stationary Ornstein-Uhlenbeck process. Both are advanced in sub-steps of a tenth of a minute, and all recordings run
side by side as arrays. A law chooses the pump's rate in every row, a minute, from the noisy readings alone; the pump
turns at full flow at the start of the minute.

Time is in minutes, a pump rate in mL/s, and tau is the dilution constant: the dilution per minute is the rate / tau.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

CAP = 0.02  # highest rate of a law, mL/s
PER_HOUR = 60
STEPS = 10  # of a minute
SOON = 1e-9  # minutes; makes comparisons of times safe from rounding


@dataclass(frozen=True)
class Conditions:
    """Everything that a recording is made from."""

    law: str = "pi"
    hours: float = 6.0
    mu: float = 0.03  # per minute
    tau: float = 1 / 3
    wander: float = 0.05  # sd of the growth rate's wander, relative
    wander_min: float = 30.0  # its time constant
    dose_spread: float = 0.1  # relative sd of a row's dose
    noise: float = 0.01  # relative sd of a reading
    noise_correlation: float = 0.12  # from one reading to the next
    late_share: float = 0.0  # of a dose that shows only at the reading after the next
    setpoint: float = 0.5
    start: float | None = None  # OD at time 0; None: the setpoint .5, .12 for open_loop

    def __post_init__(self) -> None:
        """Refuse names that do not exist."""
        if self.law not in LAWS:
            raise ValueError(f"law must be one of {', '.join(LAWS)}, not {self.law}")

    @property
    def rows(self) -> int:
        """Number of readings, the one at time 0 included."""
        return round(self.hours * PER_HOUR) + 1


@dataclass(frozen=True)
class Recordings:
    """What a lab would have, and the truth behind it."""

    time: Floats  # (T,) minutes
    od: Floats  # (n, T) readings
    pump_rate: Floats  # (n, T) mL/s asked for, held from its row to the next
    growth: Floats  # (n,) true mean of m over the recording, per minute
    tau: Floats  # (n,) true dilution constant


Law = Callable[[float, Floats], Floats]
"""Maps the minute of a row and its readings to the pump's rates."""


class DevicePi:
    """The regulator on board of the device: two integrators with resets, a volume of 20 mL."""

    def __init__(self, n: int, setpoint: Callable[[float], float]) -> None:
        self.setpoint, self.cycles = setpoint, 0
        self.seal, self.slow, self.before = np.zeros(n), np.zeros(n), np.zeros(n)

    def __call__(self, minute: float, y: Floats) -> Floats:
        """Decide as the device does after each measurement."""
        before, self.before = self.before, y
        self.cycles += 1
        if self.cycles < 3:
            return np.zeros_like(y)
        target = self.setpoint(minute)
        push = np.where(y > 0, np.log(np.maximum(y, 1e-9) / target) / (240.0 / 20.0), 0.0)
        error, jump = y - target, np.abs(y - before)
        grows = (jump < 0.05) & (error > 0.025)
        self.seal = np.where(error < 0.01, 0.0, self.seal + np.where(grows, 0.1 * error, 0.0))
        far = (np.abs(error) > 0.1) & (jump < 0.05)
        near = ~far & (jump < 0.1)
        self.slow = np.where(far, 0.0, self.slow + np.where(near, 0.01 * error, 0.0))
        push = np.where(near, 0.7 * push, push)
        return np.where(y - before > 0.04, 0.0, np.clip(push + self.seal + self.slow, 0.0, CAP))


class TunedPi:
    """A PI on the log of a filtered reading, critically damped with a time constant of 8 min.

    The log of the level obeys d ln x / dt = m - u / tau. Gains of 2 tau / settle and tau / settle^2 put both poles
    at -1 / settle. tau is the nominal 1/3: the law does not know the truth.
    """

    def __init__(self, conditions: Conditions, n: int) -> None:
        self.setpoint, settle = conditions.setpoint, 8.0
        self.gain, self.per_min = 2 / 3 / settle, 1 / 3 / settle**2
        self.weight = float(1 - np.exp(-1 / 1.5))
        self.level: Floats | None = None
        self.integral: Floats = np.zeros(n)

    def __call__(self, minute: float, y: Floats) -> Floats:
        """Filter, then add the two parts; the integrator stops where the pump is at a bound."""
        self.level = y if self.level is None else self.level + self.weight * (y - self.level)
        error = np.log(np.maximum(self.level, 1e-3) / self.setpoint)
        rate: Floats = self.gain * error + self.integral
        winds = ((rate > CAP) & (error > 0)) | ((rate < 0) & (error < 0))
        self.integral = self.integral + np.where(winds, 0.0, self.per_min * error)
        return np.clip(rate, 0.0, CAP)


class Drawn:
    """A new random rate at equal times; beyond the bounds at once one from the half that leads back.

    With warm_min the pump first stands still for so long and then washes at the cap until the OD is below washed.
    """

    def __init__(
        self,
        rng: np.random.Generator, n: int, *, every: float, top: float, bounds: tuple[float, float],
        warm_min: float = 0.0, washed: float = np.inf, levels: int = 0,
    ) -> None:  # fmt: skip
        self.rng, self.every, self.top, self.bounds = rng, every, top, bounds
        self.warm_min, self.washed, self.levels = warm_min, washed, levels
        self.rate, self.drawn = np.zeros(n), np.full(n, -np.inf)
        self.washing = np.ones(n, dtype=np.bool_)

    def __call__(self, minute: float, y: Floats) -> Floats:
        """Grow, wash, then draw."""
        share = self.rng.random(len(y))
        if minute < self.warm_min - SOON:
            return np.zeros_like(y)
        self.washing &= y >= self.washed
        low, high = y < self.bounds[0], y > self.bounds[1]
        middle = self.top / 2
        away = (low & (self.rate >= middle)) | (high & (self.rate <= middle))
        due = ~self.washing & (away | (minute - self.drawn >= self.every - SOON))
        share = np.where(high, (9 + 8 * share) / 17, np.where(low, 8 * share / 17, share))
        if self.levels:
            share = np.floor(share * self.levels) / (self.levels - 1)
        self.rate = np.where(due, self.top * share, self.rate)
        self.drawn = np.where(due, minute, self.drawn)
        return np.where(self.washing, CAP, self.rate)


def _steps(conditions: Conditions) -> Callable[[float], float]:
    """Return the setpoint at a minute: three levels, each for a third of the recording."""
    levels = (0.8, 0.65, 0.5)
    return lambda minute: levels[min(int(3 * minute / (conditions.rows - 1) + SOON), 2)]


LAWS: dict[str, Callable[[Conditions, int, np.random.Generator], Law]] = {
    "pi": lambda c, n, rng: DevicePi(n, lambda minute: c.setpoint),
    "tuned_pi": lambda c, n, rng: TunedPi(c, n),
    "threshold": lambda c, n, rng: lambda minute, y: np.where(y > c.setpoint, CAP, 0.0),
    "proportional": lambda c, n, rng: lambda minute, y: np.clip(CAP / 2 + 0.1 * (y - c.setpoint), 0.0, CAP),
    "setpoint_steps": lambda c, n, rng: DevicePi(n, _steps(c)),
    "open_loop": lambda c, n, rng: Drawn(
        rng, n, every=30.0, top=CAP, bounds=(0.08, 1.2), warm_min=60.0, washed=0.3, levels=17
    ),
    "random": lambda c, n, rng: Drawn(
        rng, n, every=10.0, top=min(CAP, 2 * c.mu * c.tau), bounds=(c.setpoint / 2, 2 * c.setpoint)
    ),
}


def _reading_factors(conditions: Conditions, n: int, rng: np.random.Generator) -> Floats:
    """Return reading / level of each row: correlated noise."""
    phi = conditions.noise_correlation
    noise = rng.standard_normal((conditions.rows, n))
    for row in range(1, conditions.rows):
        noise[row] = phi * noise[row - 1] + np.sqrt(1 - phi**2) * noise[row]
    return 1 + conditions.noise * noise


class _Culture:
    """The true state: log of the level, the wander and the integral of m."""

    def __init__(self, conditions: Conditions, n: int, start: float, rng: np.random.Generator) -> None:
        self.c, self.rng = conditions, rng
        self.log = np.full(n, np.log(start))
        self.wander = conditions.wander * rng.standard_normal(n)
        self.grown = np.zeros(n)

    def row(self, rate: Floats, factor: Floats) -> None:
        """Advance by a minute; the pump turns at 1 mL/s for its first seconds, as minutes of the row's volume."""
        c, step = self.c, 1.0 / STEPS
        keep = np.exp(-step / c.wander_min)
        kick = c.wander * np.sqrt(1 - keep**2)
        noise = self.rng.standard_normal((STEPS, len(rate)))
        for k in range(STEPS):
            flow = np.clip(rate - k * step, 0.0, step) / step
            wander = keep * self.wander + kick * noise[k]
            grown = step * c.mu * (1 + (self.wander + wander) / 2)
            self.wander, self.grown = wander, self.grown + grown
            self.log = self.log + (grown - step * flow * factor / c.tau)


def simulate(conditions: Conditions, n: int, seed: int) -> Recordings:
    """Simulate n recordings; the same n and seed give the same ones, and laws share their luck."""
    doses, readings, growth, law_rng = np.random.default_rng(seed).spawn(4)
    c = conditions
    start = c.start if c.start is not None else (0.12 if c.law == "open_loop" else 0.5)
    time: Floats = np.arange(c.rows, dtype=np.float64)
    dose = np.maximum(0.0, 1 + c.dose_spread * doses.standard_normal((c.rows, n)))  # never backward
    reading = _reading_factors(c, n, readings)
    culture, law = _Culture(c, n, start, growth), LAWS[c.law](c, n, law_rng)
    od, rates = np.empty((c.rows, n)), np.empty((c.rows, n))
    hidden = np.zeros(n)
    for row, minute in enumerate(time):
        od[row] = np.exp(culture.log) * np.exp(hidden) * reading[row]
        rates[row] = law(float(minute), od[row])
        if row < c.rows - 1:
            culture.row(rates[row], dose[row])
            hidden = c.late_share * rates[row] * dose[row] / c.tau
    growth_rate = culture.grown / (c.rows - 1)
    return Recordings(time, np.ascontiguousarray(od.T), np.ascontiguousarray(rates.T), growth_rate, np.full(n, c.tau))
