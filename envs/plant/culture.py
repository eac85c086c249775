"""The culture: suspended cells, their substrate, and what grows on the wall."""

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from conf.schema import check, require, setting
from envs.growth import Arrhenius, Cardinal, Exponential, GrowthLaw, Monod, relative_to_37
from envs.integrators import Integrator
from envs.plant.course import allowed, along, rises
from envs.plant.noise import Streams, spread

__all__ = ["Culture", "GrowthConfig"]

Array = NDArray[np.float64]

SETTLED_FRACTION = 0.08  # of the OD lost from the light path when the stirrer stands still (docs/biology.md, Stirring)
SETTLING_MIN = 1.5  # min, so that it is lost within about three readings (docs/biology.md, Stirring)
UNSTIRRED_GROWTH = 0.5  # relative growth without stirring (docs/biology.md, Stirring)

TEMPERATURE_LAWS = ("none", "arrhenius", "cardinal")


@dataclass(frozen=True)
class GrowthConfig:
    """How cells grow; the defaults are the training model's. Every temperature law is 1 at 37 degC (envs/growth.py)."""

    mu: float = setting(0.03, "mean specific growth rate in fresh medium at 37 degC", "1/min", within=(0, 0.1))
    mu_cv: float = setting(0.0, "its relative spread between cultures", within=(0, 0.3))
    drift_sd_per_h: float = setting(0.0, "random walk of ln mu: sd after 1 h", "1/sqrt(h)", within=(0, 0.2))
    ramp_per_h: float = setting(0.0, "relative change of mu per hour (burden, pH, oxygen)", "1/h", within=(-0.5, 0.5))
    knots_min: tuple[float, ...] = setting(
        (), "ages at which `knots_mu` gives mu; empty: mu is constant", "min", at_least=0.0
    )
    knots_mu: tuple[float, ...] = setting(
        (),
        "mu at those ages, straight between them, the last one from there on; in place of `mu`",
        "1/min",
        within=(0, 0.1),
    )
    temperature_law: str = setting("none", "how mu follows temperature", choices=TEMPERATURE_LAWS)
    activation_kj_mol: float = setting(
        56.0,
        "Ea of the Arrhenius law; 54 to 59 (Ingraham & Marr, BioNumbers 105003); mu(30)/mu(37) = 0.606",
        "kJ/mol",
        within=(0, 150),
    )
    adaptation_min: float = setting(
        0.0,
        "time constant with which growth follows temperature; at once within 21 to 37 degC (Ng et al. 1962)",
        "min",
        within=(0, 120),
    )
    yield_od: float = setting(
        math.inf, "OD grown from one fill of fresh medium; inf: substrate never runs out", "OD", within=(0.5, math.inf)
    )
    k_s: float = setting(
        0.1, "relative substrate at half rate (Monod), 0.02 to 0.2; used when yield_od is finite", within=(1e-4, 1)
    )
    wall_attach_per_min: float = setting(0.0, "biomass that settles on the wall", "1/min", within=(0, 1e-2))
    wall_growth_ratio: float = setting(0.0, "growth on the wall over growth in suspension", within=(0, 1))
    wall_detach_per_min: float = setting(0.0, "biomass that leaves the wall", "1/min", within=(0, 0.1))
    wall_capacity_od: float = setting(1.0, "OD-equivalent at which the wall is full", "OD", within=(1e-3, 10))

    def __post_init__(self) -> None:
        check(self, "plant.growth")
        fits = rises(self.knots_min) and len(self.knots_mu) == len(self.knots_min)
        require(fits, "plant.growth.knots_mu", self.knots_mu, allowed(self.knots_min))
        require(self.mu > 0.0 or not self.knots_mu, "plant.growth.mu", self.mu, "> 0 beside knots_mu, e.g. their mean")


def _response(config: GrowthConfig) -> Callable[[Array], Array]:
    """phi(T) / phi(37 degC) of the configured temperature law."""
    laws: dict[str, Callable[[Array], Array]] = {
        "none": np.ones_like,
        "arrhenius": Arrhenius(config.activation_kj_mol),
        "cardinal": Cardinal(),
    }
    return relative_to_37(laws[config.temperature_law])


class Culture:
    """N cultures: suspended biomass x, relative substrate s and wall biomass w (OD or relative to fresh medium).

      x' = (m - D) x - ka x + kd w        s' = D (1 - s) - m x / Y        w' = ka x + r m w (1 - w/W) - kd w
      m  = mu(s) phi(T), times drift, stirring and `mu_factor`; D = fresh medium per minute / volume

    Args:
      config: how cells grow; rngs: one stream per vial, for its growth rate.
      integrate, substep_min: integrator and longest integration step, min.
    State, shape (N,): `od` (true suspended biomass), `substrate`, `wall`. Fault switches, shape (N,): `mu_factor`, and
    `stir_factor` (1 turning, 0 stopped; for a stirrer that fails, not for the still phase of each cycle).
    """

    def __init__(self, config: GrowthConfig, rngs: Streams, integrate: Integrator, substep_min: float) -> None:
        self.config, self._n = config, len(rngs)
        self._integrate, self._substep_min = integrate, substep_min
        mu = spread(rngs, config.mu, config.mu_cv)
        self.draws: dict[str, Array] = {"mu": mu}
        # Quoted for fresh medium: Monod's rate at s = 1 is mu_max / (1 + k_s).
        endless = np.isinf(config.yield_od)
        self._law: GrowthLaw = Exponential(mu) if endless else Monod(mu * (1.0 + config.k_s), config.k_s)
        self._phi = _response(config)
        self.mu_factor, self.stir_factor = np.ones(self._n), np.ones(self._n)

    def reset(self, od: Array, temperature: Array) -> None:
        """A new culture in balance with the medium it grew from. Args: OD and degC, scalar or shape (N,)."""
        self.od: Array = np.broadcast_to(od, (self._n,)).copy()
        self.substrate: Array = np.maximum(1.0 - self.od / self.config.yield_od, 0.0)
        self.wall: Array = np.zeros(self._n)
        self._adapted = self._phi(temperature)
        self._log_drift, self._settled = np.zeros(self._n), np.zeros(self._n)

    def new_minute(self, z: Array) -> None:
        """Take this minute's draw: standard normal, shape (N,)."""
        self._log_drift = self._log_drift + self.config.drift_sd_per_h / np.sqrt(60.0) * z

    def dilute(self, kept: Array) -> None:
        """Fresh medium left the share `kept`, shape (N,), of what was in the vial."""
        self.od, self.substrate = self.od * kept, 1.0 - (1.0 - self.substrate) * kept

    def concentrate(self, factor: Array) -> None:
        """Water evaporated: concentrations rise by `factor`, shape (N,)."""
        self.od, self.substrate = self.od * factor, self.substrate * factor

    def grow(self, minutes: float, dilution: Array, temperature: Array, age_min: Array) -> None:
        """Integrate x, s, w over an interval in which temperature and dilution rate are constant.

        Args:
          dilution: 1/min; temperature: degC; age_min: of the culture, min; all of shape (N,).
        """
        g = self.config
        response = self._phi(temperature)
        follow = 1.0 if g.adaptation_min == 0.0 else -np.expm1(-minutes / g.adaptation_min)
        self._adapted = self._adapted + (response - self._adapted) * follow
        relative = self._relative_rate(age_min)

        def derivative(y: Array) -> Array:
            x, s, w = y
            rate = self._law.specific_rate(s) * relative
            exchange = g.wall_attach_per_min * x - g.wall_detach_per_min * w
            grown = g.wall_growth_ratio * rate * w * (1.0 - w / g.wall_capacity_od)
            dx, ds = (rate - dilution) * x - exchange, dilution * (1.0 - s) - rate * x / g.yield_od
            return np.stack([dx, ds, exchange + grown])

        state = np.stack([self.od, self.substrate, self.wall])
        state = self._integrate(derivative, state, minutes, self.substeps(minutes))
        self.od, self.substrate, self.wall = np.maximum(state, 0.0)

    def substeps(self, minutes: float) -> int:
        """Integration steps in an interval of `minutes`."""
        return max(1, int(np.ceil(minutes / self._substep_min - 1e-9)))

    def specific_rate(self, age_min: Array) -> Array:
        """Specific growth rate at this moment, 1/min, of a culture of `age_min` min; both shape (N,)."""
        return self._law.specific_rate(self.substrate) * self._relative_rate(age_min)

    def _relative_rate(self, age_min: Array) -> Array:
        """What temperature, drift, stirring and `mu_factor` now make of the growth law's rate, shape (N,)."""
        g = self.config
        course = along(g.knots_min, g.knots_mu, g.mu, age_min)
        drift = np.exp(self._log_drift) * np.maximum(1.0 + g.ramp_per_h * age_min / 60.0, 0.0) * course
        stirred = UNSTIRRED_GROWTH + (1.0 - UNSTIRRED_GROWTH) * self.stir_factor
        return np.asarray(self._adapted * drift * stirred * self.mu_factor)

    def settle(self, minutes: float) -> None:
        """Cells sink where the stirrer stands still, and rise again where it turns."""
        sunk = SETTLED_FRACTION * (1.0 - self.stir_factor)
        self._settled += (sunk - self._settled) * -np.expm1(-minutes / SETTLING_MIN)

    @property
    def in_light_path(self) -> Array:
        """Suspended biomass that the sensor's light meets, OD, shape (N,)."""
        return self.od * (1.0 - self._settled)
