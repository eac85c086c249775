"""Conditions that end a step of a schedule early."""

import re
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

__all__ = ["Condition", "Conditions"]

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

WORDS = "'od >= 0.8', 'od <= 0.3', settled, or null: its minutes"
COMPARED = re.compile(r"od\s*(>=|<=)\s*(\d*\.?\d+)")


@dataclass(frozen=True)
class Condition:
    """Condition that ends a step: "od >= LEVEL", "od <= LEVEL", "settled"; None: only its time.

    Raises: ValueError for any other text, with the allowed forms.
    """

    text: str | None = None
    LARGEST: ClassVar[float] = 2.0  # OD

    def __post_init__(self) -> None:
        if self.text is None or self.text == "settled":
            return
        found = COMPARED.fullmatch(self.text)
        if found is None:
            raise ValueError(f"{self.text!r}: allowed {WORDS}")
        if not 0.0 < float(found[2]) <= self.LARGEST:
            raise ValueError(f"{self.text!r}: allowed a level with 0 < OD <= {self.LARGEST:g}")

    @property
    def bounds(self) -> tuple[float, float]:
        """Limits: an OD of at least the first or at most the second ends the step; inf and -inf for none."""
        found = COMPARED.fullmatch(self.text or "")
        level = float(found[2]) if found else np.nan
        return (level if found and found[1] == ">=" else np.inf, level if found and found[1] == "<=" else -np.inf)


class Conditions:
    """The conditions of N reactors' steps, (N, P); rows shorter than P are padded with None.

    Attributes: given, (N, P), whether there is a condition; any, whether there is one at all; texts, as written.
    """

    def __init__(self, texts: list[list[str | None]]) -> None:
        self.texts = texts
        bounds = np.array([[Condition(text).bounds for text in row] for row in texts], dtype=np.float64)
        self._least, self._most = bounds[..., 0], bounds[..., 1]
        self._settled = np.array([[text == "settled" for text in row] for row in texts])
        self.given = np.array([[text is not None for text in row] for row in texts])
        self.any = bool(self.given.any())

    def met(self, phase: NDArray[np.intp], od: Array, settled: Mask) -> Mask:
        """Return whether each reactor's step ends, (N,): OD at its level, or settled if required.

        Args: phase: of each reactor, >= 0. od: nan meets no condition. settled: determined by the caller.
        """
        row = np.arange(phase.size)
        reached = (od >= self._least[row, phase]) | (od <= self._most[row, phase])
        return np.asarray(reached | (settled & self._settled[row, phase]))
