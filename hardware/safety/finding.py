"""What a check of the interlock hands to it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from hardware.reactor import Mask

__all__ = ["Finding"]


@dataclass(frozen=True)
class Finding:
    """Something is wrong with some reactors.

    kind: the reason, a field of `Responses`.
    rows: the reactors concerned, shape (N,).
    text: what was seen, for a reactor's index.
    cool: reactors that get no dose for a while after this, unless the reason is only reported; None for none.
    """

    kind: str
    rows: Mask
    text: Callable[[int], str]
    cool: Mask | None = None
