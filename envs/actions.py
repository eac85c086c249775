"""The discrete pump rates an agent chooses from (paper section 3: 17 values on [0, 0.02] mL/s)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

__all__ = ["MAX_PUMP_RATE", "pump_rates"]

MAX_PUMP_RATE = 0.02
"""mL/s. The Chi.Bio's own regulator never exceeds a duty of 0.02 of a 1 mL/s pump (docs/device.md, Regulation)."""


def pump_rates(n: int = 17, maximum: float = MAX_PUMP_RATE) -> NDArray[np.float64]:
    """n pump rates in mL/s, equally spaced from 0 to `maximum`, shape (n,).

    Raises: ValueError if n < 2 or `maximum` is not positive.
    """
    if n < 2:
        raise ValueError(f"number of pump rates = {n}: allowed >= 2 (the pump must be able to stop and to run)")
    if not maximum > 0.0:
        raise ValueError(f"maximum pump rate = {maximum} mL/s: allowed > 0")
    return np.linspace(0.0, maximum, n)
