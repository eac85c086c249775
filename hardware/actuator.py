"""Actuators: the name, the unit and limits of a command, and the pump number."""

import math
from dataclasses import dataclass


@dataclass(frozen=True)
class Actuator:
    """A pump, thermostat or other device that a signal of the control loop commands; a reactor family lists its own.

    A pump's command is a mean rate. It is given as doses that replace feed doses, and each dose passes the interlock
    and its ledger. A temperature command replaces the temperature of the schedule. Any other command reaches the
    reactors as `Command.targets[name]`.

    low, high: limits to which the interlock cuts a command, except for pumps (0 to the bench's largest rate) and the
    thermostat (settings of the interlock). pump: number of the pump, 0 if it is none.
    """

    name: str
    unit: str
    low: float = -math.inf
    high: float = math.inf
    pump: int = 0


FEED, THERMOSTAT = Actuator("feed pump", "mL/s", pump=1), Actuator("thermostat", "degC")
SPARE = {number: Actuator(f"pump {number}", "mL/s", pump=number) for number in (3, 4)}
