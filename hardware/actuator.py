"""What acts on a culture, declared: its name, the unit of a command, its limits, and which pump it is, if any."""

import math
from dataclasses import dataclass


@dataclass(frozen=True)
class Actuator:
    """One thing that a signal of the control loop commands; a reactor family lists those that it has.

    A fluid's command is a mean rate: what it comes to is given in doses, in the feed's place, and each of them passes
    the interlock and its ledger. A temperature stands in place of the schedule's. Any other command reaches the
    reactors as `Command.targets[name]`.

    low, high: limits in its unit, to which the interlock cuts a command; those of a fluid are 0 and the bench's largest
    rate, those of the thermostat are settings of the interlock. pump: its number, 0 for what is no fluid.
    """

    name: str
    unit: str
    low: float = -math.inf
    high: float = math.inf
    pump: int = 0


FEED, THERMOSTAT = Actuator("feed pump", "mL/s", pump=1), Actuator("thermostat", "degC")
SPARE = {number: Actuator(f"pump {number}", "mL/s", pump=number) for number in (3, 4)}
