"""Message of a command while it stops its reactors."""

from conf.messages import Message

# fmt: off

class PumpsBeingEnded(Message, says="the pumps are being switched off and verified; this takes up to a minute",
    remedy="wait"):
    """Reply to a second Ctrl-C."""
