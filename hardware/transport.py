"""How requests travel to a device: `Transport` is all a driver knows of HTTP, serial line or emulator."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

__all__ = ["Reply", "Transport"]


@dataclass(frozen=True)
class Reply:
    """An answer as it came: HTTP status and body."""

    status: int
    body: bytes


class Transport(Protocol):
    """Carries one request at a time; a driver never retries blindly what is not idempotent."""

    def get(self, path: str) -> Reply:
        """Raises: LinkError when no answer came."""
        ...

    def post(self, path: str) -> Reply:
        """POST without a body. Raises: LinkError when no answer came; the device may have acted all the same."""
        ...

    def close(self) -> None:
        """Release the line. Idempotent."""
        ...
