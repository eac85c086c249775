"""Errors of reactors, as one tree of classes: catch `ReactorError` for all errors, or a subclass.

Every message names the thing, its value with unit, the allowed range and the remedy. A message class declares its
sentence (`conf.messages`); the base classes below also take a text.
"""

from conf.messages import Message


class ReactorError(Message, Exception):
    """Base of all errors of this package."""


class LinkError(ReactorError):
    """The device did not answer: refused, reset, timed out, cable pulled. Whether it acted is unknown."""


class ProtocolError(ReactorError):
    """The device's answer does not follow its protocol: malformed JSON, wrong status, bad frame."""


class DeviceStateError(ReactorError):
    """The device answered correctly but is not in the required state: pump still on, mode active, reactor absent."""


class IdentityError(DeviceStateError):
    """A reactor answered with another identity than the one pinned at the start."""


class SensorError(ReactorError):
    """A reading that no culture can cause: frozen, impossible, broken spectrometer."""


class RecordingError(ReactorError):
    """A recording cannot be read or written."""


class UnfitError(ReactorError):
    """A config requests something that this kind of reactor cannot do, or a calibration file is damaged."""
