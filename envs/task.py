"""The control task an agent is trained on: model, control period, action grid, episode (paper, section 3)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from envs.actions import MAX_PUMP_RATE, pump_rates
from envs.growth import DilutedCulture, Exponential
from envs.integrators import INTEGRATORS

__all__ = ["EnvConfig", "step_factors"]

Array = NDArray[np.float64]


@dataclass(frozen=True)
class EnvConfig:
    """Training model x' = (mu - u/tau) x and the episode built on it; values and their sources in conf/env/sim.yaml.

    Raises: ValueError naming key, value and allowed range.
    """

    mu: float = 0.03  # specific growth rate, 1/min
    tau: float = 1.0 / 3.0  # u/tau is the dilution rate, 1/min for u in mL/s
    control_min: float = 1.0  # control period, min
    integrator: str = "euler"
    substeps: int = 10  # integration steps per control period
    n_actions: int = 17
    max_pump_rate: float = MAX_PUMP_RATE  # mL/s
    episode_steps: int = 100
    setpoints: tuple[float, ...] = (0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 1.0)
    start_od: tuple[float, float] = (0.1, 1.1)
    final_reward_weight: float = 1.0  # weight of the last step's reward (final reward of equation 4)

    def __post_init__(self) -> None:
        """Check every range once, where the value enters."""
        checks = (
            ("mu", self.mu, 0.0 < self.mu <= 0.1, "0 < mu <= 0.1 1/min (E. coli at 37 degC: 0.01 to 0.032)"),
            ("tau", self.tau, 0.01 <= self.tau <= 100.0, "0.01 to 100 (20 mL and a 1 mL/s pump: 0.333)"),
            ("control_min", self.control_min, 0.0 < self.control_min <= 60.0, "0 < control_min <= 60 min"),
            ("integrator", self.integrator, self.integrator in INTEGRATORS, " or ".join(INTEGRATORS)),
            ("substeps", self.substeps, 1 <= self.substeps <= 10_000, "1 to 10000"),
            ("n_actions", self.n_actions, 2 <= self.n_actions <= 1001, "2 to 1001 pump rates"),
            ("max_pump_rate", self.max_pump_rate, 0.0 < self.max_pump_rate <= 0.05, "0 < rate <= 0.05 mL/s"),
            ("episode_steps", self.episode_steps, self.episode_steps >= 1, "at least 1"),
            (
                "setpoints",
                self.setpoints,
                len(self.setpoints) > 0 and all(0.0 < s <= 1.5 for s in self.setpoints),
                "one or more OD values, each 0 < setpoint <= 1.5",
            ),
            (
                "start_od",
                self.start_od,
                len(self.start_od) == 2 and 0.0 < self.start_od[0] <= self.start_od[1] <= 4.0,
                "[low, high] with 0 < low <= high <= 4 OD",
            ),
            ("final_reward_weight", self.final_reward_weight, self.final_reward_weight >= 0.0, ">= 0"),
        )
        for key, value, ok, allowed in checks:
            if not ok:
                raise ValueError(f"env.{key} = {value}: allowed {allowed}")

    def pump_rates(self) -> Array:
        """The action grid in mL/s, shape (A,)."""
        return pump_rates(self.n_actions, self.max_pump_rate)


def step_factors(config: EnvConfig, rates: Array | None = None) -> Array:
    """f with x(t + control period) = f x(t) for a pump rate held over the period, shape of `rates`.

    The model is linear in x, so the configured integrator, run once from x = 1 with all its sub-steps, gives f
    exactly: for Euler f = (1 + h (mu - u/tau))^substeps. Environment, optimum and MPC all step by this factor.

    Args:
      config: the task.
      rates: pump rates u, mL/s, any shape; None means the action grid, shape (A,).
    """
    u = config.pump_rates() if rates is None else np.asarray(rates, dtype=np.float64)
    flat = u.reshape(-1)
    culture = DilutedCulture(Exponential(config.mu), config.tau)
    unit = np.ones((flat.size, 2))
    advance = INTEGRATORS[config.integrator]
    end = advance(lambda y: culture.derivative(y, flat), unit, config.control_min, config.substeps)
    return end[:, 0].reshape(u.shape)
