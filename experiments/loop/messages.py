"""Messages of the closed loop, and errors of signals that do not fit the reactors of a run."""

from conf.messages import Message
from hardware.messages import Fault

# fmt: off

class FilterAlarm(Fault, response="report", says="readings do not fit the estimate", remedy="{then}"):
    """Causes: a jump of the OD, bubbles, chance, or wrong settings. In rows and summary, not on the screen."""
class SignalError(Message, ValueError):
    """A signal does not fit the run. Raised at its start."""
class NoSuchSignal(SignalError, says="signals.{name}: no such signal", remedy="use one of {known}"): ...
class WrongShape(SignalError, says="{what} has shape {shape}",
    remedy="it must be ({n},), one value for each reactor"): ...
class PartMissing(SignalError, says="signal {name} has no {parts}", remedy="define it (docs/extending.md)"): ...
class NoActuator(SignalError, says="{name} needs the {actuator}: these reactors lack it", remedy="use {known}"): ...
class ActuatorTaken(SignalError, says="{one} and {other} both use the {actuator}", remedy="remove one of them"): ...
