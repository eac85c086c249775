"""Oracle: dynamic programming with exact knowledge of the simulated plant, as a reference for other controllers."""

from dataclasses import dataclass
from functools import cache

import numpy as np

from conf.schema import setting
from envs.optimum import OptimalPolicy, solve
from envs.plant.plant import Plant
from envs.task import EnvConfig
from experiments.laws.base import Array, ControllerConfig, Mask

SECONDS = 60.0  # per min
SPAN = (0.05, 4.0)  # range of OD / setpoint that the value function covers
GRID = 3001
DRAWN = ("mu", "volume_ml", "pump_gain_ml_s")


@dataclass(frozen=True)
class OracleConfig(ControllerConfig):
    """Settings of the oracle. 129 levels include the learned policy's 17; more levels have no measurable effect."""

    kind: str = setting("oracle", "controller")
    levels: int = setting(129, "number of pump rates on [0, max_pump_rate]", within=(2, 1001))
    gamma: float = setting(0.99, "discount per control period, as the agent's", at_least=0.0, below=1.0)


@cache
def _value(
    mu: float, tau: float, control_min: float, max_rate: float, levels: int, gamma: float, grid: int
) -> OptimalPolicy:
    """Solve one vial for setpoint 1. The model is linear in x, so V_r(x) = r^2 V_1(x/r) for any setpoint r."""
    model = EnvConfig(mu, tau, control_min=control_min, n_actions=levels, max_pump_rate=max_rate, start_od=SPAN)
    return solve(model, gamma, np.array([1.0]), grid)


class Oracle:
    """Controller u = argmin_u (y(u) - r)^2 + gamma r^2 V(y(u)/r), with y(u) the next reading of a noise-free sensor.

    It knows for each vial: the current growth rate (drawn mu, substrate, temperature, drift), flow, dead time and
    shortest pulse of the pump head, the volume, and the noise-free reading, which replaces the noisy one. V belongs to
    the vial's drawn mu and tau = volume/(60 flow). It does not know the spread of the next dose, the noise of the next
    reading, the drift within the next minute, priming and wall growth. So it bounds all controllers on `nominal`; on
    other plants it shows the benefit of knowing the present state.

    Args:
      config: action grid and discount. plant: the controlled vials, in the order of the rows. model: control period
      and largest pump rate. flow_ml_s: flow with which the backend converts a rate to an on-time, mL/s.
    """

    def __init__(self, config: OracleConfig, plant: Plant, model: EnvConfig, flow_ml_s: float = 1.0) -> None:
        self.config, self.plant, self.model = config, plant, model
        self.rates = np.linspace(0.0, model.max_pump_rate, config.levels)
        self._on_s = (self.rates * SECONDS * model.control_min / flow_ml_s)[:, None]
        mu, volume, gain = (plant.draws[key] for key in DRAWN)
        tau = volume / (SECONDS * gain)
        fixed = (model.control_min, model.max_pump_rate, config.levels, config.gamma, GRID)
        solved = [_value(float(m), float(t), *fixed) for m, t in zip(mu, tau, strict=True)]
        self._log_ratio = solved[0].log_od
        self._values = np.stack([s.value[0] for s in solved])

    def reset(self, n: int) -> None:
        """Check that the plant has n vials; there is no state to reset. Raises: ValueError."""
        if n != self.plant.n:
            raise ValueError(f"oracle: the plant has {self.plant.n} vials, so it needs as many reactors, not {n}")

    def act(self, od: Array, setpoint: Array, minute: Array, rows: Mask) -> Array:
        """Return pump rates as `Controller.act`; the argument `od` is not used."""
        plant = self.plant
        after = plant.expected_od(self.model.control_min, self._on_s + np.zeros(plant.n))
        seen = plant.sensor.apparent(after, plant.culture.wall, plant.minutes)
        ratio = np.log(np.maximum(seen, 1e-6) / setpoint)
        spacing = self._log_ratio[1] - self._log_ratio[0]
        place = np.clip((ratio - self._log_ratio[0]) / spacing, 0.0, self._log_ratio.size - 1.000001)
        left = place.astype(np.intp)
        vial = np.arange(plant.n)
        low, high = self._values[vial, left], self._values[vial, left + 1]
        ahead = low + (place - left) * (high - low)
        cost = (seen - setpoint) ** 2 + self.config.gamma * setpoint**2 * ahead
        return np.asarray(self.rates[np.argmin(cost, axis=0)])
