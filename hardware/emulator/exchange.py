"""A request to the device and its answer."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

__all__ = ["Answer", "Exchange"]

Answer = tuple[int, bytes, dict[str, str]]  # status, body, headers


@dataclass(eq=False)
class Exchange:
    """One request and what became of it.

    `answer` is (status, body, headers). `fate` says how it ended without one: "refused" (nobody listens), "reset"
    (connection broken) or "lost" (silence until the client's time-out), else "". `cut` is how many body bytes to leave
    out.
    """

    method: str
    path: str
    headers: Mapping[str, str]
    answer: Answer | None = None
    fate: str = ""
    cut: int = 0

    @property
    def done(self) -> bool:
        """Answered or given up?"""
        return self.answer is not None or self.fate != ""
