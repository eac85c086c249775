"""The paper's open-loop calibration experiment, simulated: growth, dilution at full rate, then random pump rates."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from envs.actions import MAX_PUMP_RATE, pump_rates
from envs.growth import DilutedCulture, Exponential
from envs.integrators import rk4

__all__ = ["OpenLoop", "open_loop"]

Array = NDArray[np.float64]


@dataclass(frozen=True)
class OpenLoop:
    """Protocol, culture and sensor of a simulated open-loop recording.

    The paper (section 4): 60 min of growth, dilution at the maximum until OD < 0.3, then a random pump rate every
    30 min. Rates are drawn from the agent's 17. What the paper does not say: outside `keep_od` a new rate is drawn at
    once, from the half of the rates that leads back, as an experimenter would, so that no draw washes the culture out.

    mu: 1/min. tau: u/tau is the dilution rate in 1/min for u in mL/s. start_od: OD.
    hours: length; one row per `control_min`.
    noise: sd of a reading relative to the OD. noise_correlation: of the noise from one row to the next; 0.12 is the
      median of public Chi.Bio logs (docs/biology.md, Sensor).
    """

    mu: float = 0.028
    tau: float = 0.31
    start_od: float = 0.12
    hours: float = 6.0
    control_min: float = 1.0
    growth_min: float = 60.0
    dilute_to: float = 0.3
    hold_min: float = 30.0
    keep_od: tuple[float, float] = (0.08, 1.2)
    noise: float = 0.01
    noise_correlation: float = 0.12
    seed: int = 1

    def __post_init__(self) -> None:
        low, high = self.keep_od
        for key, value, allowed, holds in (
            ("mu", self.mu, "> 0 to 0.1 1/min", 0.0 < self.mu <= 0.1),
            ("tau", self.tau, "> 0 and below 0.02/mu, so that the pump can outrun growth", self.tau < self.fastest),
            ("tau", self.tau, "> 0", self.tau > 0.0),
            ("start_od", self.start_od, "> 0 to 2", 0.0 < self.start_od <= 2.0),
            ("hours", self.hours, "2 to 100", 2.0 <= self.hours <= 100.0),
            ("control_min", self.control_min, "0.1 to 10 min", 0.1 <= self.control_min <= 10.0),
            ("growth_min", self.growth_min, ">= 0 min", self.growth_min >= 0.0),
            ("dilute_to", self.dilute_to, "> 0", self.dilute_to > 0.0),
            ("hold_min", self.hold_min, f">= {self.control_min} min", self.hold_min >= self.control_min),
            ("keep_od", self.keep_od, "0 < low < high", 0.0 < low < high),
            ("noise", self.noise, "0 to 0.2", 0.0 <= self.noise <= 0.2),
            ("noise_correlation", self.noise_correlation, "0 to 0.95", 0.0 <= self.noise_correlation <= 0.95),
            ("seed", self.seed, ">= 0", self.seed >= 0),
        ):
            if not holds:
                raise ValueError(f"protocol.{key} = {value}: allowed {allowed}")

    @property
    def fastest(self) -> float:
        """The tau at which the pump at its maximum only balances growth."""
        return MAX_PUMP_RATE / self.mu if self.mu > 0.0 else np.inf


def open_loop(config: OpenLoop, rng: np.random.Generator, n: int = 1) -> tuple[Array, Array, Array]:
    """N recordings of the same experiment with their own noise and their own random pump rates.

    The culture is `DilutedCulture(Exponential(mu), tau)` of envs.growth, integrated by RK4 in steps of 0.1 min (error
    below 1e-10, so that the truth is mu and tau and not an integrator's); decisions are taken on the noisy readings.

    Args:
      config: protocol, culture and sensor.
      rng: source of rates and noise.
      n: number of recordings N.
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
