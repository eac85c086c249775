"""Control task on which an agent is trained: model, control period, action grid, reward, episode (paper, section 3)."""

from dataclasses import dataclass
from typing import Any, TypeVar

import numpy as np

from conf.schema import check, setting
from envs.integrators import INTEGRATORS, Array

T = TypeVar("T", bound=Any)

MAX_PUMP_RATE = 0.02
"""mL/s. The Chi.Bio's regulator never exceeds a duty of 0.02 with a 1 mL/s pump (docs/device.md, Regulation)."""

MAX_OD = 1000.0
"""Limit of the simulated OD: without it, 100 steps of 1 min at mu = 0.1/min from OD 4 would reach 1e5."""

SCORED_OD = (0.1, 1.1)
"""Range of the initial OD in scored episodes, independent of `start_od`."""


@dataclass(frozen=True)
class EnvConfig:
    """Training model x' = (mu - u/tau) x, equation (5) of the paper, and its episode.

    The paper reports neither mu nor tau. The nominal mu is that of E. coli with a plasmid in rich medium at 37 degC
    (0.020 to 0.031 1/min in the literature); the nominal tau is that of a 20 mL vial and a 1 mL/s pump (tau = V/60).
    Raises: ValueError with key, value and allowed range.
    """

    mu: float = setting(
        0.03, "specific growth rate", "1/min", above=0.0, at_most=0.1, note="E. coli at 37 degC: 0.01 to 0.032"
    )
    tau: float = setting(
        1.0 / 3.0,
        "u/tau is the dilution rate in 1/min for a pump rate u in mL/s",
        at_least=0.01,
        at_most=100.0,
        note="20 mL and a 1 mL/s pump: 0.333",
    )
    control_min: float = setting(1.0, "control period (paper)", "min", above=0.0, at_most=60.0)
    integrator: str = setting("euler", "integration scheme (not stated in the paper)", choices=tuple(INTEGRATORS))
    substeps: int = setting(10, "integration steps per control period (paper: 0.1 min)", within=(1, 10_000))
    n_actions: int = setting(17, "number of pump rates, equally spaced on [0, max_pump_rate] (paper)", within=(2, 1001))
    max_pump_rate: float = setting(MAX_PUMP_RATE, "largest pump rate (paper)", "mL/s", above=0.0, at_most=0.05)
    episode_steps: int = setting(100, "control steps per episode, ended by truncation (paper)", at_least=1)
    setpoints: tuple[float, ...] = setting(
        (0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 1.0),
        "setpoints, one drawn per episode (paper)",
        "OD",
        above=0.0,
        at_most=1.5,
        some=True,
    )
    start_od: tuple[float, float] = setting(
        (0.1, 1.1),
        "range of the initial OD, slightly wider than the setpoints (not in the paper)",
        "OD",
        above=0.0,
        at_most=4.0,
        interval=True,
    )
    final_reward_weight: float = setting(
        1.0,
        "factor on the last reward of an episode (final term of equation 4; not stated in the paper)",
        at_least=0.0,
    )

    def __post_init__(self) -> None:
        check(self, "env")

    def pump_rates(self) -> Array:
        """Return the action grid in mL/s, shape (A,)."""
        return np.linspace(0.0, self.max_pump_rate, self.n_actions)


def step_factors(config: EnvConfig, rates: Array | None = None) -> Array:
    """Compute f with x(t + control period) = f x(t) for a constant pump rate, shape of `rates`.

    The model is linear in x, so one run of the configured integrator from x = 1 gives f exactly. For Euler with step h,
    f = (1 + h (mu - u/tau))^substeps. Environment, optimum and MPC all use this factor.

    Args: config: the task. rates: pump rates u, mL/s, any shape; None: the action grid, (A,).
    """
    u = config.pump_rates() if rates is None else np.asarray(rates, dtype=np.float64)
    advance = INTEGRATORS[config.integrator]
    return advance(lambda x: (config.mu - u / config.tau) * x, np.ones(u.shape), config.control_min, config.substeps)


def tracking_reward(od: T, setpoint: T) -> T:
    """Compute the reward -(x - setpoint)^2 (paper, equation 4) from the OD x after the step.

    Args: od: x, any shape, a NumPy array or tensor. setpoint: same type, broadcastable shape.
    """
    error: T = od - setpoint
    reward: T = -error * error
    return reward
