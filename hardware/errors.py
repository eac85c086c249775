"""Everything that can go wrong with a reactor, as one tree; catch `ReactorError` widely or a leaf narrowly.

Every message names the thing, its value with unit, the allowed range and the remedy. A leaf declares its sentence
(`conf.messages`); the classes below also take a text.
"""

from conf.messages import Message


class ReactorError(Message, Exception):
    """Base of all errors of this package."""


class LinkError(ReactorError):
    """The device did not answer: refused, reset, timed out, cable pulled. Whether it acted is unknown."""


class ProtocolError(ReactorError):
    """The device answered something that is not its protocol: malformed JSON, wrong status, bad frame."""


class DeviceStateError(ReactorError):
    """The device answered well, but is not in the state it must be in: pump still on, mode active, absent."""


class IdentityError(DeviceStateError):
    """A reactor answered with another identity than the one pinned at the start."""


class SensorError(ReactorError):
    """A reading that no culture can cause: frozen, impossible, broken spectrometer."""


class RecordingError(ReactorError):
    """A recording cannot be read or written."""


class UnfitError(ReactorError):
    """What a config asks for does not fit this kind of reactor, or a file of its calibration is damaged."""
