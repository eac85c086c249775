"""The control task an agent is trained on: model, control period, action grid, reward, episode (paper, section 3)."""

from dataclasses import dataclass
from typing import Any, TypeVar

import numpy as np

from conf.schema import check, setting
from envs.integrators import INTEGRATORS, Array

T = TypeVar("T", bound=Any)

MAX_PUMP_RATE = 0.02
"""mL/s. The Chi.Bio's own regulator never exceeds a duty of 0.02 of a 1 mL/s pump (docs/device.md, Regulation)."""

MAX_OD = 1000.0
"""Limit of the OD: 100 steps at mu = 0.1/min from OD 4 would reach 1e5."""

SCORED_OD = (0.1, 1.1)
"""Range of the scored starts, independent of `start_od`."""


@dataclass(frozen=True)
class EnvConfig:
    """Training model x' = (mu - u/tau) x, equation (5) of the paper, and its episode.

    The paper reports neither mu nor tau. The nominal values are E. coli in rich medium at 37 degC with a plasmid (0.020
    to 0.031 1/min in the literature), and a vial of 20 mL with a pump of 1 mL/s (tau = V/60). Raises: ValueError with
    key, value and allowed range.
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
        "weight of the final reward of equation (4); the paper gives no form, 1 counts the last state as every other",
        at_least=0.0,
    )

    def __post_init__(self) -> None:
        check(self, "env")

    def pump_rates(self) -> Array:
        """Return the action grid in mL/s, shape (A,)."""
        return np.linspace(0.0, self.max_pump_rate, self.n_actions)


def step_factors(config: EnvConfig, rates: Array | None = None) -> Array:
    """Compute f with x(t + control period) = f x(t) for a constant pump rate, shape of `rates`.

    The model is linear in x, so the configured integrator, run once from x = 1 with all sub-steps, gives f exactly: for
    Euler f = (1 + h (mu - u/tau))^substeps. Environment, optimum and MPC all step by this factor.

    Args: config: the task. rates: pump rates u, mL/s, any shape; None means the action grid, shape (A,).
    """
    u = config.pump_rates() if rates is None else np.asarray(rates, dtype=np.float64)
    advance = INTEGRATORS[config.integrator]
    return advance(lambda x: (config.mu - u / config.tau) * x, np.ones(u.shape), config.control_min, config.substeps)


def tracking_reward(od: T, setpoint: T) -> T:
    """Compute r = -(x - setpoint)^2 (paper, equation 4) of the OD after the step.

    Args: od: x, shape (N,) or any; a NumPy array or a tensor. setpoint: same type, same or broadcastable shape.
    Returns: shape of the broadcast. Raises: nothing.
    """
    error: T = od - setpoint
    reward: T = -error * error
    return reward
