"""A second simulator of recordings, from the equations; it shares no code with the package.

The culture follows dx/dt = (m(t) - u(t) (1 + dose error) / tau) x with m(t) = mu (1 + wander(t)). The wander is a
stationary Ornstein-Uhlenbeck process. Both are advanced in sub-steps of a tenth of a minute, and all recordings run
side by side as arrays. A law chooses the pump's rate in every row from the noisy readings alone.

Time is in minutes, a pump rate in mL/s, and tau is the dilution constant: the dilution per minute is the rate / tau.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

CAP = 0.02  # highest rate of a law, mL/s
FULL_FLOW = 1.0  # flow of the pump while it turns, mL/s
PER_HOUR = 60.0
SOON = 1e-9  # minutes; makes comparisons of times safe from rounding


@dataclass(frozen=True)
class Conditions:
    """Everything that a recording is made from."""

    law: str = "pi"
    hours: float = 6.0
    period_min: float = 1.0  # length of a row
    mu: float = 0.03  # per minute
    tau: float = 1 / 3
    wander: float = 0.05  # sd of the growth rate's wander, relative
    wander_min: float = 30.0  # its time constant
    dose_spread: float = 0.1  # relative sd of a row's dose
    dose_law: str = "normal"  # or gamma
    pulse: bool = True  # the pump turns at full flow at the start of each minute; False spreads the dose over the row
    noise: float = 0.01  # relative sd of a reading
    noise_correlation: float = 0.12  # from one reading to the next
    outlier_share: float = 0.0  # of readings that are off by 10 to 50 %, up or down
    late_share: float = 0.0  # of a dose that shows only at the reading after the next
    blank: float = 0.0  # offset added to each reading
    stirring_min: float = 0.0  # lag with which the sensor's zone follows the culture
    setpoint: float = 0.5
    hysteresis: float = 0.02  # the relay switches at the setpoint plus and minus this
    start: float | None = None  # OD at time 0; None: the setpoint .5, .12 for open_loop
    start_rate: float | None = None  # integrator of tuned_pi and smooth_pi at time 0; None: 0, half the cap
    rest_min: float = 0.0  # the pump stands still for the last rest_min of each hour
    step_min: float = 0.1  # longest sub-step

    def __post_init__(self) -> None:
        """Refuse names that do not exist."""
        if self.law not in LAWS:
            raise ValueError(f"law must be one of {', '.join(LAWS)}, not {self.law}")
        if self.dose_law not in ("normal", "gamma"):
            raise ValueError(f"dose_law must be normal or gamma, not {self.dose_law}")

    @property
    def rows(self) -> int:
        """Number of readings, the one at time 0 included."""
        return round(self.hours * PER_HOUR / self.period_min) + 1

    @property
    def duration(self) -> float:
        """Minutes from the first reading to the last."""
        return (self.rows - 1) * self.period_min


@dataclass(frozen=True)
class Recordings:
    """What a lab would have, and the truth behind it."""

    time: Floats  # (T,) minutes
    od: Floats  # (n, T) readings
    pump_rate: Floats  # (n, T) mL/s asked for, held from its row to the next
    growth: Floats  # (n,) true mean of m over the recording, per minute
    tau: Floats  # (n,) true dilution constant


class Law(Protocol):
    """A law maps the reading of a row to the pump's rate."""

    def __call__(self, minute: float, y: Floats, resting: bool) -> Floats:
        """Return the rate of each recording; while resting the pump is stopped and integrators stand still."""


class DevicePi:
    """The regulator on board of the device: two integrators with resets, a volume of 20 mL.

    Its bounds on the change of the reading are meant for cycles of a minute. In longer rows they hold per minute,
    since growth alone would pass them.
    """

    def __init__(self, conditions: Conditions, n: int, setpoint: Callable[[float], float]) -> None:
        self.period, self.setpoint = conditions.period_min, setpoint
        self.cycles = 0
        self.seal, self.slow, self.before = np.zeros(n), np.zeros(n), np.zeros(n)

    def __call__(self, minute: float, y: Floats, resting: bool) -> Floats:
        """Decide as the device does after each measurement."""
        before, self.before = self.before, y
        self.cycles += 1
        if self.cycles < 3 or resting:
            return np.zeros_like(y)
        target = self.setpoint(minute)
        gain = 240.0 / 20.0
        push = np.where(y > 0, np.log(np.maximum(y, 1e-9) / target) / self.period / gain, 0.0)
        rise = (y - before) / max(1.0, self.period)
        error, jump = y - target, np.abs(rise)
        grows = (jump < 0.05) & (error > 0.025)
        self.seal = np.where(error < 0.01, 0.0, self.seal + np.where(grows, 0.1 * error, 0.0))
        far = (np.abs(error) > 0.1) & (jump < 0.05)
        near = ~far & (jump < 0.1)
        self.slow = np.where(far, 0.0, self.slow + np.where(near, 0.01 * error, 0.0))
        push = np.where(near, 0.7 * push, push)
        return np.where(rise > 0.04, 0.0, np.clip(push + self.seal + self.slow, 0.0, CAP))


class FilteredPi:
    """A PI on the log of a filtered reading, critically damped with time constant settle_min.

    The log of the level obeys d ln x / dt = m - u / tau. Gains of 2 tau / settle and tau / settle^2 put both poles
    at -1 / settle. tau is the nominal 1/3: the law does not know the truth.
    """

    def __init__(self, conditions: Conditions, n: int, settle_min: float, filter_min: float, start: float) -> None:
        self.period, self.setpoint = conditions.period_min, conditions.setpoint
        settle = max(settle_min, 4 * self.period)
        self.gain, self.per_min = 2 / 3 / settle, 1 / 3 / settle**2
        self.weight = float(1 - np.exp(-self.period / filter_min))
        self.level: Floats | None = None
        self.integral: Floats = np.full(n, start if conditions.start_rate is None else conditions.start_rate)

    def __call__(self, minute: float, y: Floats, resting: bool) -> Floats:
        """Filter, then add the two parts; the integrator stops where the pump is at a bound."""
        self.level = y if self.level is None else self.level + self.weight * (y - self.level)
        error = np.log(np.maximum(self.level, 1e-3) / self.setpoint)
        rate: Floats = self.gain * error + self.integral
        if not resting:
            winds = ((rate > CAP) & (error > 0)) | ((rate < 0) & (error < 0))
            self.integral = self.integral + np.where(winds, 0.0, self.per_min * self.period * error)
        return np.clip(rate, 0.0, CAP)


class Threshold:
    """Full rate above the setpoint, none below."""

    def __init__(self, conditions: Conditions) -> None:
        self.setpoint = conditions.setpoint

    def __call__(self, minute: float, y: Floats, resting: bool) -> Floats:
        """Switch."""
        return np.where(y > self.setpoint, CAP, 0.0)


class Relay:
    """Full rate from the upper bound down to the lower one."""

    def __init__(self, lower: float, upper: float, n: int) -> None:
        self.lower, self.upper, self.on = lower, upper, np.zeros(n, dtype=np.bool_)

    def __call__(self, minute: float, y: Floats, resting: bool) -> Floats:
        """Keep the state between the bounds."""
        self.on = (y > self.upper) | (self.on & (y > self.lower))
        return np.where(self.on, CAP, 0.0)


class Proportional:
    """Half the cap at the setpoint, and a gain."""

    def __init__(self, conditions: Conditions, gain: float) -> None:
        self.setpoint, self.gain = conditions.setpoint, gain

    def __call__(self, minute: float, y: Floats, resting: bool) -> Floats:
        """Answer the last reading only."""
        return np.clip(CAP / 2 + self.gain * (y - self.setpoint), 0.0, CAP)


class Drawn:
    """A new random rate at equal times; beyond the bounds at once one from the half that leads back.

    With warm_min the pump first stands still for so long and then washes at the cap until the OD is below washed.
    """

    def __init__(
        self,
        rng: np.random.Generator,
        n: int,
        *,
        every: float,
        top: float,
        bounds: tuple[float, float],
        warm_min: float = 0.0,
        washed: float = np.inf,
        levels: int = 0,
    ) -> None:
        self.rng, self.every, self.top, self.bounds = rng, every, top, bounds
        self.warm_min, self.washed, self.levels = warm_min, washed, levels
        self.rate, self.drawn = np.zeros(n), np.full(n, -np.inf)
        self.washing = np.ones(n, dtype=np.bool_)

    def __call__(self, minute: float, y: Floats, resting: bool) -> Floats:
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


class Sine:
    """A sine about the balance, with a random phase; beyond the bounds the pump leads back to the setpoint."""

    def __init__(self, conditions: Conditions, rng: np.random.Generator, n: int) -> None:
        self.setpoint, self.balance = conditions.setpoint, conditions.mu * conditions.tau
        self.phase = rng.uniform(0, 2 * np.pi, n)
        self.back = np.zeros(n)  # 1: the pump runs at the cap, -1: it stands still

    def __call__(self, minute: float, y: Floats, resting: bool) -> Floats:
        """One swing takes an hour and reaches four fifths of the balance."""
        there = (self.back > 0) & (y <= self.setpoint) | (self.back < 0) & (y >= self.setpoint)
        self.back = np.where(there, 0.0, self.back)
        self.back = np.where(y > 2 * self.setpoint, 1.0, np.where(y < self.setpoint / 2, -1.0, self.back))
        swing = self.balance * (1 + 0.8 * np.sin(2 * np.pi * minute / PER_HOUR + self.phase))
        return np.where(self.back > 0, CAP, np.where(self.back < 0, 0.0, np.clip(swing, 0.0, CAP)))


def _steps(conditions: Conditions) -> Callable[[float], float]:
    """Return the setpoint at a minute: three levels, each for a third of the recording."""
    levels = (0.8, 0.65, 0.5)
    return lambda minute: levels[min(int(3 * minute / conditions.duration + SOON), 2)]


LAWS: dict[str, Callable[[Conditions, int, np.random.Generator], Law]] = {
    "pi": lambda c, n, rng: DevicePi(c, n, lambda minute: c.setpoint),
    "tuned_pi": lambda c, n, rng: FilteredPi(c, n, settle_min=8.0, filter_min=1.5, start=0.0),
    "smooth_pi": lambda c, n, rng: FilteredPi(c, n, settle_min=30.0, filter_min=6.0, start=CAP / 2),
    "threshold": lambda c, n, rng: Threshold(c),
    "relay": lambda c, n, rng: Relay(c.setpoint - c.hysteresis, c.setpoint + c.hysteresis, n),
    "proportional": lambda c, n, rng: Proportional(c, 0.1),
    "proportional_weak": lambda c, n, rng: Proportional(c, 0.03),
    "setpoint_steps": lambda c, n, rng: DevicePi(c, n, _steps(c)),
    "open_loop": lambda c, n, rng: Drawn(
        rng, n, every=30.0, top=CAP, bounds=(0.08, 1.2), warm_min=60.0, washed=0.3, levels=17
    ),
    "random": lambda c, n, rng: Drawn(
        rng, n, every=10.0, top=min(CAP, 2 * c.mu * c.tau), bounds=(c.setpoint / 2, 2 * c.setpoint)
    ),
    "sine": lambda c, n, rng: Sine(c, rng, n),
}


def _dose_factors(conditions: Conditions, n: int, rng: np.random.Generator) -> Floats:
    """Return what is really delivered of each row's dose, 1 on average; never backward."""
    shape, spread = (conditions.rows, n), conditions.dose_spread
    if spread <= 0:
        return np.ones(shape)
    if conditions.dose_law == "gamma":
        return rng.gamma(spread**-2, spread**2, shape)
    return np.maximum(0.0, 1 + spread * rng.standard_normal(shape))


def _reading_factors(conditions: Conditions, n: int, rng: np.random.Generator) -> Floats:
    """Return reading / level of each row: correlated noise, and outliers."""
    shape, phi = (conditions.rows, n), conditions.noise_correlation
    noise = rng.standard_normal(shape)
    for row in range(1, conditions.rows):
        noise[row] = phi * noise[row - 1] + np.sqrt(1 - phi**2) * noise[row]
    factors = 1 + conditions.noise * noise
    outlier = rng.random(shape) < conditions.outlier_share
    off = rng.uniform(0.1, 0.5, shape) * np.where(rng.random(shape) < 0.5, -1.0, 1.0)
    return np.where(outlier, factors * (1 + off), factors)


class _Culture:
    """The true state: log of the level, the sensor's zone, the wander and the integral of m."""

    def __init__(self, conditions: Conditions, n: int, start: float, rng: np.random.Generator) -> None:
        self.c, self.rng = conditions, rng
        period = conditions.period_min
        self.pulses = max(1, round(period)) if conditions.pulse else 1
        self.spacing = period / self.pulses
        self.steps = int(np.ceil(self.spacing / conditions.step_min - SOON))
        self.step = self.spacing / self.steps
        self.log = np.full(n, np.log(start))
        self.zone = np.full(n, start / (1 + conditions.mu * conditions.stirring_min))  # as after long growth
        self.wander = conditions.wander * rng.standard_normal(n)
        self.grown = np.zeros(n)

    def row(self, rate: Floats, factor: Floats) -> None:
        """Advance by one row; in a pulse the pump turns at full flow, and its minutes are those of the volume."""
        c, step = self.c, self.step
        keep = np.exp(-step / c.wander_min)
        kick = c.wander * np.sqrt(1 - keep**2)
        mix = np.exp(-step / c.stirring_min) if c.stirring_min > 0 else 0.0
        on = rate * self.spacing / FULL_FLOW
        noise = self.rng.standard_normal((self.pulses, self.steps, len(rate)))
        for pulse in range(self.pulses):
            for k in range(self.steps):
                flow = FULL_FLOW * np.clip(on - k * step, 0.0, step) / step if c.pulse else rate
                wander = keep * self.wander + kick * noise[pulse, k]
                grown = step * c.mu * (1 + (self.wander + wander) / 2)
                change = grown - step * flow * factor / c.tau
                if c.stirring_min > 0:
                    middle = np.exp(self.log + change / 2)
                    self.zone = middle + (self.zone - middle) * mix
                self.wander, self.log, self.grown = wander, self.log + change, self.grown + grown

    def seen(self) -> Floats:
        """Return the level before the sensor."""
        return self.zone if self.c.stirring_min > 0 else np.exp(self.log)


def simulate(conditions: Conditions, n: int, seed: int) -> Recordings:
    """Simulate n recordings; the same n and seed give the same ones, and laws share their luck."""
    doses, readings, growth, law_rng = np.random.default_rng(seed).spawn(4)
    c = conditions
    start = c.start if c.start is not None else (0.12 if c.law == "open_loop" else 0.5)
    time: Floats = c.period_min * np.arange(c.rows, dtype=np.float64)
    dose, reading = _dose_factors(c, n, doses), _reading_factors(c, n, readings)
    culture, law = _Culture(c, n, start, growth), LAWS[c.law](c, n, law_rng)
    od, rates = np.empty((c.rows, n)), np.empty((c.rows, n))
    hidden = np.zeros(n)
    for row, minute in enumerate(time):
        od[row] = culture.seen() * np.exp(hidden) * reading[row] + c.blank
        resting = minute % PER_HOUR >= PER_HOUR - c.rest_min - SOON if c.rest_min > 0 else False
        rate = law(float(minute), od[row], bool(resting))
        rates[row] = 0.0 if resting else rate
        if row < c.rows - 1:
            culture.row(rates[row], dose[row])
            hidden = c.late_share * rates[row] * dose[row] * c.period_min / c.tau
    return Recordings(
        time=time,
        od=np.ascontiguousarray(od.T),
        pump_rate=np.ascontiguousarray(rates.T),
        growth=culture.grown / c.duration,
        tau=np.full(n, c.tau),
    )
