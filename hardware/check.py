"""One line of a preflight, for every family."""

import logging
from collections.abc import Sequence
from dataclasses import dataclass

from hardware.errors import DeviceStateError

__all__ = ["Check", "report"]

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Check:
    """One line: what was checked, whether it passed, what was seen, what to do. `required` ones stop a run."""

    name: str
    ok: bool
    detail: str
    remedy: str = ""
    required: bool = True

    def __str__(self) -> str:
        mark = "pass" if self.ok else ("FAIL" if self.required else "note")
        return f"{mark}  {self.name}: {self.detail}" + ("" if self.ok else f" -> {self.remedy}")


def report(checks: Sequence[Check]) -> None:
    """Log the lines of a preflight. Raises: DeviceStateError if a required check failed."""
    for one in checks:
        log.log(logging.INFO if one.ok else logging.WARNING, "%s", one)
    failed = [one for one in checks if one.required and not one.ok]
    if failed:
        raise DeviceStateError(f"preflight: {len(failed)} of {len(checks)} checks failed, the first: {failed[0]}")
