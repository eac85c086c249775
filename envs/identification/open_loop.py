"""Simulated recordings: the paper's open-loop experiment (growth, dilution, random pump rates) or any controller."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from conf.schema import check, require, setting
from envs.task import MAX_PUMP_RATE, EnvConfig

Array = NDArray[np.float64]
Decide = Callable[[float, Array], Array]
"""Controller: (minute, readings of shape (N,)) -> pump rates in mL/s, shape (N,), constant to the next row."""

GROWTH_MIN, DILUTE_TO, HOLD_MIN = 60.0, 0.3, 30.0  # min without feed; OD at which dilution ends; min per random rate


@dataclass(frozen=True)
class OpenLoop:
    """Protocol, culture and sensor of a simulated open-loop recording.

    The paper (section 4): 60 min of growth, dilution at the maximum until OD < 0.3, then a random pump rate every
    30 min, one of the agent's 17. Not in the paper: outside `keep_od` a new rate is drawn at once, from the half of the
    rates that leads back into this range. So no draw washes the culture out.
    """

    mu: float = setting(0.028, "specific growth rate", "1/min", above=0.0, at_most=0.1)
    tau: float = setting(0.31, "u/tau is the dilution rate in 1/min; must be below 0.02/mu", above=0.0)
    start_od: float = setting(0.12, "OD at the start", "OD", above=0.0, at_most=2.0)
    hours: float = setting(6.0, "length of the recording", "h", within=(1, 100))
    control_min: float = setting(1.0, "time between rows", "min", within=(0.1, 10))
    keep_od: tuple[float, float] = setting(
        (0.08, 1.2),
        "OD range; outside it a new pump rate that leads back is drawn at once (not in the paper)",
        "OD",
        above=0.0,
        interval=True,
    )
    noise: float = setting(0.01, "sd of a reading relative to the OD", within=(0, 0.2))
    noise_correlation: float = setting(
        0.12, "correlation of this noise from row to row; median of public Chi.Bio logs", within=(0, 0.95)
    )
    outlier_share: float = setting(0.0, "fraction of readings that are off by 10 to 50 %", within=(0, 0.2))
    dose_cv: float = setting(0.0, "sd of a dose relative to its volume", within=(0, 0.5))
    growth_cv: float = setting(0.0, "sd of the fluctuating growth rate relative to mu", within=(0, 0.5))
    growth_memory_min: float = setting(30.0, "correlation time of the growth fluctuations", "min", within=(1, 1000))
    late_share: float = setting(0.0, "fraction of a dose that readings show one row late", within=(0, 1))
    seed: int = setting(1, "random seed of pump rates, noise and disturbances", at_least=0)

    def __post_init__(self) -> None:
        check(self, "protocol")
        outrun = "> 0 and below 0.02/mu, so that the pump can dilute faster than the culture grows"
        require(self.tau < self.fastest, "protocol.tau", self.tau, outrun)
        require(self.keep_od[0] < self.keep_od[1], "protocol.keep_od", self.keep_od, "0 < low < high")

    @property
    def fastest(self) -> float:
        """Upper limit of tau, at which the pump at its maximum rate just balances growth."""
        return MAX_PUMP_RATE / self.mu if self.mu > 0.0 else np.inf


def open_loop(config: OpenLoop, rng: np.random.Generator, n: int = 1) -> tuple[Array, Array, Array]:
    """Simulate N recordings of the open-loop experiment; noise and random pump rates differ. See `recordings`.

    Returns: time in min, shape (T,); measured OD, shape (N, T); pump rate in mL/s held to the next row, shape (N, T).
    """
    protocol = OpenLoopLaw(config, n, rng)
    time, measured, applied, _ = recordings(config, protocol.decide, rng, n)
    return time, measured, applied


def recordings(
    config: OpenLoop, decide: Decide, rng: np.random.Generator, n: int = 1
) -> tuple[Array, Array, Array, Array]:
    """Simulate N recordings of the same culture; the controller `decide` sees the noisy readings.

    From row to row x <- x exp((m - (1 + e) u/tau) dt) with m = mu (1 + w), exact for constant rates between rows. e is
    the random error of a dose, w a first-order random process. A reading is x without the effect of the last dose's
    late share, times 1 + noise.

    Args: config: culture and sensor. decide: see `Decide`. rng: source of the noise and, by a spawned stream, of e, w.
    Returns: time in min, shape (T,); measured OD, shape (N, T); pump rate in mL/s held to the next row, shape (N, T);
      mean growth rate over the rows, 1/min, shape (N,).
    """
    rows = round(60.0 * config.hours / config.control_min) + 1
    dt = config.control_min
    time = dt * np.arange(rows, dtype=np.float64)
    (disturbance,) = rng.spawn(1)
    od, last_dose = np.full(n, config.start_od), np.zeros(n)
    measured, applied, growth = np.empty((n, rows)), np.empty((n, rows)), np.empty((n, rows))
    error, wander = rng.standard_normal(n), disturbance.standard_normal(n)
    memory = np.exp(-dt / config.growth_memory_min)
    for i, t in enumerate(time):
        error = config.noise_correlation * error + np.sqrt(1.0 - config.noise_correlation**2) * rng.standard_normal(n)
        reading = od * np.exp(config.late_share * last_dose) * (1.0 + config.noise * error)
        wrong = disturbance.random(n) < config.outlier_share
        off = disturbance.choice((-1.0, 1.0), n) * disturbance.uniform(0.1, 0.5, n)
        measured[:, i] = np.where(wrong, reading * (1.0 + off), reading)
        rate = applied[:, i] = decide(float(t), measured[:, i])
        growth[:, i] = config.mu * (1.0 + config.growth_cv * wander)
        last_dose = dt * rate / config.tau * (1.0 + config.dose_cv * disturbance.standard_normal(n))
        od = od * np.exp(dt * growth[:, i] - last_dose)
        wander = memory * wander + np.sqrt(1.0 - memory**2) * disturbance.standard_normal(n)
    return time, measured, applied, growth[:, :-1].mean(axis=1)


class OpenLoopLaw:
    """Controller of N open-loop experiments: growth, dilution, then random steps of the pump rate."""

    def __init__(self, config: OpenLoop, n: int, rng: np.random.Generator) -> None:
        self.config, self.rng = config, rng
        self.rates = EnvConfig().pump_rates()
        self.diluted = np.zeros(n, dtype=np.bool_)
        self.rate = np.zeros(n)
        self.until = np.zeros(n)

    def decide(self, t: float, od: Array) -> Array:
        """Return the pump rates from minute `t` on, mL/s, shape (N,)."""
        c = self.config
        pick = self.rng.random(len(od))
        grown = t >= GROWTH_MIN
        self.diluted |= grown & (od < DILUTE_TO)
        low, high = od < c.keep_od[0], od > c.keep_od[1]
        lost = (low & (self.rate / c.tau > c.mu)) | (high & (self.rate / c.tau < c.mu))
        due = self.diluted & ((t >= self.until) | lost)
        first = np.where(high, len(self.rates) // 2 + 1, 0)
        count = np.where(low, len(self.rates) // 2, len(self.rates)) - first
        drawn = self.rates[first + np.floor(pick * count).astype(np.int64)]
        self.rate = np.where(due, drawn, np.where(self.diluted, self.rate, MAX_PUMP_RATE if grown else 0.0))
        self.until = np.where(due, t + HOLD_MIN, self.until)
        return self.rate
