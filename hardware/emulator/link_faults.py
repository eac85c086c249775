"""What is wrong with network, server or board of the emulated device."""

from __future__ import annotations

from dataclasses import dataclass

__all__ = ["LinkFaults"]


@dataclass
class LinkFaults:
    """Fault switches of network, server and board; counters go down with every use, -1 = until set to 0.

    slow_s: added to the way of every request. hang_s: the next request takes so long. lost_request: swallowed before
    the server (half-open connection). lost_reply: acted on, then silence. reset_before, reset_after: connection reset
    without or after acting. malformed, truncated: getSysdata answers broken JSON, or half its bytes under the full
    length. lying: POST routes answer 204 and do nothing. bus_stuck: the bus lock is never released.
    bus_stuck_when_pumping: it gets stuck as soon as a feed pump runs. disk_full: when a cycle writes its row.
    foreign_selects: probability that somebody else's page selects another reactor before a request.
    require_requested_with, terminal_as_list, terminal_named, extra_fields: variants seen in forks and newer apps
    (docs/device.md, Variants).
    """

    slow_s: float = 0.0
    hang_s: float = 0.0
    lost_request: int = 0
    lost_reply: int = 0
    reset_before: int = 0
    reset_after: int = 0
    malformed: int = 0
    truncated: int = 0
    lying: int = 0
    bus_stuck: bool = False
    bus_stuck_when_pumping: bool = False
    disk_full: bool = False
    foreign_selects: float = 0.0
    require_requested_with: bool = False
    terminal_as_list: bool = False
    terminal_named: bool = False
    extra_fields: bool = False

    def take(self, name: str) -> bool:
        """Is this counted fault due? Counts it down."""
        left: int = getattr(self, name)
        if left > 0:
            setattr(self, name, left - 1)
        return left != 0
