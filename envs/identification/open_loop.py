"""The paper's open-loop calibration experiment, simulated: growth, dilution at full rate, then random pump rates."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from conf.schema import check, require, setting
from envs.growth import DilutedCulture, Exponential
from envs.integrators import rk4
from envs.task import MAX_PUMP_RATE, pump_rates

__all__ = ["OpenLoop", "open_loop"]

Array = NDArray[np.float64]


@dataclass(frozen=True)
class OpenLoop:
    """Protocol, culture and sensor of a simulated open-loop recording.

    The paper (section 4): 60 min of growth, dilution at the maximum until OD < 0.3, then a random pump rate every
    30 min. Rates are drawn from the agent's 17. What the paper does not say: outside `keep_od` a new rate is drawn at
    once, from the half of the rates that leads back, as an experimenter would, so that no draw washes the culture out.
    """

    mu: float = setting(0.028, "specific growth rate", "1/min", above=0.0, at_most=0.1)
    tau: float = setting(
        0.31, "u/tau is the dilution rate in 1/min; below 0.02/mu, so that the pump outruns growth", above=0.0
    )
    start_od: float = setting(0.12, "at the start", "OD", above=0.0, at_most=2.0)
    hours: float = setting(6.0, "length of the recording", "h", within=(2, 100))
    control_min: float = setting(1.0, "between rows", "min", within=(0.1, 10))
    growth_min: float = setting(60.0, "growth without feed (paper)", "min", at_least=0.0)
    dilute_to: float = setting(0.3, "then the pump at its maximum until the OD is below (paper)", "OD", above=0.0)
    hold_min: float = setting(
        30.0, "then a random pump rate for so long, again and again (paper); control_min or more", "min"
    )
    keep_od: tuple[float, float] = setting(
        (0.08, 1.2),
        "outside, a new rate is drawn at once from the half that leads back (not in the paper)",
        "OD",
        above=0.0,
        interval=True,
    )
    noise: float = setting(0.01, "sd of a reading relative to the OD", within=(0, 0.2))
    noise_correlation: float = setting(0.12, "from row to row; median of public Chi.Bio logs", within=(0, 0.95))
    seed: int = setting(1, "of rates and noise", at_least=0)

    def __post_init__(self) -> None:
        check(self, "protocol")
        outrun = "> 0 and below 0.02/mu, so that the pump can outrun growth"
        require(self.tau < self.fastest, "protocol.tau", self.tau, outrun)
        require(self.hold_min >= self.control_min, "protocol.hold_min", self.hold_min, f">= {self.control_min} min")
        require(self.keep_od[0] < self.keep_od[1], "protocol.keep_od", self.keep_od, "0 < low < high")

    @property
    def fastest(self) -> float:
        """The tau at which the pump at its maximum only balances growth."""
        return MAX_PUMP_RATE / self.mu if self.mu > 0.0 else np.inf


def open_loop(config: OpenLoop, rng: np.random.Generator, n: int = 1) -> tuple[Array, Array, Array]:
    """N recordings of the same experiment with their own noise and their own random pump rates.

    The culture is `DilutedCulture(Exponential(mu), tau)` of envs.growth, integrated by RK4 in steps of 0.1 min (error
    below 1e-10, so that the truth is mu and tau and not an integrator's); decisions are taken on the noisy readings.

    Args: config: protocol, culture and sensor. rng: source of rates and noise. n: number of recordings N.
    Returns: time in min, shape (T,); measured OD, shape (N, T); pump rate in mL/s held to the next row, shape (N, T).
    Raises: nothing.
    """
    rows = round(60.0 * config.hours / config.control_min) + 1
    time = config.control_min * np.arange(rows, dtype=np.float64)
    culture = DilutedCulture(Exponential(config.mu), config.tau)
    state = np.stack([np.full(n, config.start_od), np.ones(n)], axis=1)
    substeps = max(1, round(config.control_min / 0.1))
    measured, applied = np.empty((n, rows)), np.empty((n, rows))
    error = rng.standard_normal(n)
    protocol = _Protocol(config, n)
    for i, t in enumerate(time):
        fresh = rng.standard_normal(n)
        error = config.noise_correlation * error + np.sqrt(1.0 - config.noise_correlation**2) * fresh
        measured[:, i] = state[:, 0] * (1.0 + config.noise * error)
        rate = applied[:, i] = protocol.decide(float(t), measured[:, i], rng)

        def derivative(y: Array, u: Array = rate) -> Array:
            return culture.derivative(y, u)

        state = rk4(derivative, state, config.control_min, substeps)
    return time, measured, applied


class _Protocol:
    """Which rate each of N experiments applies next: grow, dilute, then random steps."""

    def __init__(self, config: OpenLoop, n: int) -> None:
        self.config = config
        self.rates = pump_rates()
        self.diluted = np.zeros(n, dtype=np.bool_)
        self.rate = np.zeros(n)
        self.until = np.zeros(n)

    def decide(self, t: float, od: Array, rng: np.random.Generator) -> Array:
        """Pump rates from `t` min on, mL/s, shape (N,)."""
        c = self.config
        pick = rng.random(len(od))
        grown = t >= c.growth_min
        self.diluted |= grown & (od < c.dilute_to)
        low, high = od < c.keep_od[0], od > c.keep_od[1]
        lost = (low & (self.rate / c.tau > c.mu)) | (high & (self.rate / c.tau < c.mu))
        due = self.diluted & ((t >= self.until) | lost)
        first = np.where(high, len(self.rates) // 2 + 1, 0)
        count = np.where(low, len(self.rates) // 2, len(self.rates)) - first
        drawn = self.rates[first + np.floor(pick * count).astype(np.int64)]
        self.rate = np.where(due, drawn, np.where(self.diluted, self.rate, MAX_PUMP_RATE if grown else 0.0))
        self.until = np.where(due, t + c.hold_min, self.until)
        return self.rate
