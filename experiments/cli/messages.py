"""Messages of a command while a reactor runs."""

from conf.messages import Message

# fmt: off

class PumpsBeingEnded(Message, says="the pumps are being switched off and verified; this takes up to a minute",
    remedy="wait"):
    """A second Ctrl-C."""
