"""Messages of the closed loop, and errors of a signal that does not fit the reactors of a run."""

from conf.messages import Message
from hardware.messages import Fault

# fmt: off

class FilterAlarm(Fault, response="report", says="readings do not fit the estimate", remedy="{then}"):
    """A jump of the OD, bubbles, chance, or wrong settings; in rows and summary, not on the screen."""
class SignalError(Message, ValueError):
    """A signal of the run does not fit; raised at the start."""
class NoSuchSignal(SignalError, says="signals.{name}: no such signal", remedy="allowed {known}"): ...
class WrongShape(SignalError, says="{what} has the shape {shape}",
    remedy="allowed ({n},), one value for each reactor"): ...
class PartMissing(SignalError, says="signal {name} has no {parts}", remedy="define it (docs/extending.md)"): ...
class NoActuator(SignalError, says="{name} acts by the {actuator}", remedy="these reactors have {known}"): ...
class ActuatorTaken(SignalError, says="{one} and {other} act by the same {actuator}", remedy="allowed one"): ...
