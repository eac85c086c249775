"""What the paper reports, cell by cell (Brancato et al., L4DC 2024, Table 2): real reactors, three replicates."""

from typing import NamedTuple

__all__ = ["SETTLING_MIN", "TABLE_2", "Published"]

SETTLING_MIN = 10.0
"""Average settling time at a setpoint of 0.5, min; the paper does not define its band."""


class Published(NamedTuple):
    """One cell pair: scenario, window (setpoint or temperature), controller, ISE and ITAE (T read as 1 min)."""

    scenario: str
    window: str
    setpoint: float
    controller: str
    ise: float
    itae: float


TABLE_2 = (
    Published("setpoint_steps", "0.8", 0.8, "dqn", 0.039, 12.21),
    Published("setpoint_steps", "0.8", 0.8, "pi", 0.046, 12.38),
    Published("setpoint_steps", "0.8", 0.8, "mpc", 0.035, 10.44),
    Published("setpoint_steps", "0.65", 0.65, "dqn", 0.032, 11.90),
    Published("setpoint_steps", "0.65", 0.65, "pi", 0.039, 10.50),
    Published("setpoint_steps", "0.65", 0.65, "mpc", 0.092, 9.38),
    Published("setpoint_steps", "0.5", 0.5, "dqn", 0.051, 7.43),
    Published("setpoint_steps", "0.5", 0.5, "pi", 0.111, 11.49),
    Published("setpoint_steps", "0.5", 0.5, "mpc", 0.117, 12.98),
    Published("temperature_switch", "37", 0.5, "dqn", 0.045, 12.42),
    Published("temperature_switch", "37", 0.5, "pi", 0.033, 9.65),
    Published("temperature_switch", "37", 0.5, "mpc", 0.032, 11.60),
    Published("temperature_switch", "30", 0.5, "dqn", 0.031, 11.84),
    Published("temperature_switch", "30", 0.5, "pi", 0.025, 9.12),
    Published("temperature_switch", "30", 0.5, "mpc", 0.042, 11.54),
)
