"""Growth rates of E. coli (e) and P. putida (p) against temperature, the actuator of their composition.

Source: Lee, Morlock, Allan, Steel, Cell Reports Methods 5:101009 (2025); its public model Janmorlock/CompEst3000 (MIT).
"""

import numpy as np
from numpy.typing import NDArray

__all__ = ["EQUAL_RATES_C", "LAG_E_MIN", "LAG_P_MIN", "T_MAX", "T_MIN", "e_coli_rate", "p_putida_rate"]

Array = NDArray[np.float64]

T_MIN, T_MAX = 29.0, 36.0  # degC, range of the fits; beyond it the nearest end's rate
EQUAL_RATES_C = 33.2  # degC at which both grow alike (to 0.001 1/h), 0.895 1/h
LAG_E_MIN, LAG_P_MIN = 2.0, 60.0  # min, time constants with which the rates follow temperature


def e_coli_rate(temperature: Array | float) -> Array:
    """mu_e = 0.07727 T - 1.66954, 1/h, with T cut to [29, 36] degC; shape of `temperature`."""
    t = np.clip(temperature, T_MIN, T_MAX)
    return np.asarray(0.07727 * t - 1.66954)


def p_putida_rate(temperature: Array | float) -> Array:
    """mu_p = -0.02208 T^2 + 1.3796 T - 20.56996, 1/h, with T cut to [29, 36] degC; shape of `temperature`."""
    t = np.clip(temperature, T_MIN, T_MAX)
    return np.asarray(-0.02208 * t * t + 1.3796 * t - 20.56996)
