"""Result of a calibration: the pair with its intervals, all other findings, and the verdict."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from envs.identification.drift import Drift, Segment
from envs.identification.free_run import Fit
from envs.identification.model import Parameter
from envs.identification.prediction_error import Estimate
from envs.identification.screening import Screened, Series
from envs.identification.validation import Validation

__all__ = ["Calibration", "Verdict"]

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Verdict:
    """word: use, use with care, record again or read again. why: one clause. then: what to do next, "" for training."""

    word: str
    why: str
    then: str

    def line(self) -> str:
        """Line on the screen."""
        return f"{self.word}: {self.why}" + (f"; {self.then}" if self.then else "")


@dataclass(frozen=True, eq=False)
class Calibration:
    """Result of `calibrate`. Positions refer to `screened.series`; window is [first, end).

    mu, tau: the returned pair, by `method`. estimate, free_run: of the window by either method, None without such a
    fit; sound: whether the estimate identifies tau. model: free run of the returned pair over the window from the start
    that fits best, OD, shape (n,). pair_pmse_pct: its PMSE. pmse_pct: of the free-run fit, the paper's figure; of the
    pair where there is no such fit.
    warnings: reasons against the pair, the most serious first.
    """

    screened: Screened
    window: tuple[int, int]
    window_reason: str
    method: str
    mu: Parameter
    tau: Parameter
    estimate: Estimate
    sound: bool
    free_run: Fit | None
    model: Array
    pair_pmse_pct: float
    pmse_pct: float
    validation: Validation
    segments: tuple[Segment, ...]
    drift_mu: Drift | None
    drift_tau: Drift | None
    verdict: Verdict
    warnings: tuple[str, ...]

    @property
    def inside(self) -> Series:
        """Rows of the window."""
        return self.screened.series.part(*self.window)

    @property
    def window_rows(self) -> tuple[int, int]:
        """Row numbers [first, end) of the window."""
        row = self.screened.series.row
        return int(row[self.window[0]]), int(row[self.window[1] - 1]) + 1

    @property
    def n_used(self) -> int:
        """Readings in the window."""
        return int(np.isfinite(self.inside.od).sum())
