"""Fixed-step integrators of y' = f(y), all with the same signature, for any leading batch shape."""

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Derivative = Callable[[Array], Array]
Integrator = Callable[[Derivative, Array, float, int], Array]


def euler(f: Derivative, y: Array, duration: float, substeps: int) -> Array:
    """Integrate by explicit Euler, y <- y + h f(y), first order; the paper uses h = 0.1 min.

    Args:
      f: derivative, maps y to y' of the same shape. y: start value, any shape.
      duration: time to advance, in the time unit of f.
      substeps: number of equal steps, >= 1; h = duration / substeps.
    Returns: y at the end, a new array. Raises: nothing.
    """
    h = duration / substeps
    for _ in range(substeps):
        y = y + h * f(y)
    return y


def rk4(f: Derivative, y: Array, duration: float, substeps: int) -> Array:
    """Integrate by classical Runge-Kutta, fourth order. Args: as in `euler`."""
    h = duration / substeps
    for _ in range(substeps):
        k1 = f(y)
        k2 = f(y + 0.5 * h * k1)
        k3 = f(y + 0.5 * h * k2)
        k4 = f(y + h * k3)
        y = y + (h / 6.0) * (k1 + 2.0 * k2 + 2.0 * k3 + k4)
    return y


INTEGRATORS: dict[str, Integrator] = {"euler": euler, "rk4": rk4}
