"""Growth of E. coli and P. putida against temperature (docs/coculture.md, Growth).

Lee, Morlock, Allan, Steel, Cell Reports Methods 5:101009 (2025) and its public model, Janmorlock/CompEst3000: fits to
batch growth between 29 and 36 degC; beyond that range the rate of the nearer end is taken.
"""

from typing import Any

import numpy as np
from numpy.typing import NDArray

__all__ = [
    "EQUAL_RATES_C", "E_SLOPE", "E_ZERO", "LAG_E_MIN", "LAG_P_MIN", "T_MAX", "T_MIN", "e_coli_rate", "p_putida_rate",
]  # fmt: skip

Array = NDArray[np.float64]

T_MIN, T_MAX = 29.0, 36.0  # degC, range of the fits
EQUAL_RATES_C = 33.2  # degC at which both grow alike
E_SLOPE, E_ZERO = 0.07727, 1.66954  # mu_e(T) = E_SLOPE T - E_ZERO, 1/h
LAG_E_MIN, LAG_P_MIN = 2.0, 60.0  # min, first-order lag of the rate behind the temperature


def e_coli_rate(temperature: Any) -> Array:
    """mu_e(T) = 0.07727 T - 1.66954, 1/h, of a temperature in degC, any shape."""
    return np.asarray(E_SLOPE * np.clip(temperature, T_MIN, T_MAX) - E_ZERO)


def p_putida_rate(temperature: Any) -> Array:
    """mu_p(T) = -0.02208 T^2 + 1.3796 T - 20.56996, 1/h, of a temperature in degC, any shape."""
    t = np.clip(temperature, T_MIN, T_MAX)
    return np.asarray((-0.02208 * t + 1.3796) * t - 20.56996)
