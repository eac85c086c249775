"""Culture of a vial: suspended cells, substrate, and biomass on the wall."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from conf.schema import check, require, setting
from envs.integrators import Array, Integrator
from envs.plant.course import along, check_knots
from envs.plant.strains import TEMPERATURE_LAWS, Strain

SETTLED_FRACTION = 0.08  # fraction of the OD lost from the light path without stirring (docs/biology.md, Stirring)
SETTLING_MIN = 1.5  # min, for a loss within about three readings (docs/biology.md, Stirring)
SUBSTEP_MIN = 0.1  # longest integration step (paper)
UNSTIRRED_GROWTH = 0.5  # relative growth without stirring (docs/biology.md, Stirring)


@dataclass(frozen=True)
class GrowthConfig:
    """Growth of the culture; the defaults are those of the training model. Temperature responses are 1 at 37 degC."""

    mu: float = setting(0.03, "mean specific growth rate in fresh medium at 37 degC", "1/min", within=(0, 0.1))
    mu_cv: float = setting(0.0, "relative spread of mu between cultures", within=(0, 0.3))
    drift_sd_per_h: float = setting(0.0, "random walk of ln mu: sd after 1 h", "1/sqrt(h)", within=(0, 0.2))
    ramp_per_h: float = setting(0.0, "relative change of mu per hour (burden, pH, oxygen)", "1/h", within=(-0.5, 0.5))
    knots_min: tuple[float, ...] = setting(
        (), "culture ages at which `knots_mu` gives mu; empty: mu is constant", "min", at_least=0.0
    )
    knots_mu: tuple[float, ...] = setting(
        (),
        "mu at `knots_min`, linear between them, constant after the last; replaces `mu`",
        "1/min",
        within=(0, 0.1),
    )
    temperature_law: str = setting("none", "temperature dependence of mu", choices=TEMPERATURE_LAWS)
    activation_kj_mol: float = setting(
        56.0,
        "activation energy (Arrhenius); 54 to 59 (Ingraham & Marr, BioNumbers 105003); mu(30)/mu(37) = 0.606",
        "kJ/mol",
        within=(0, 150),
    )
    adaptation_min: float = setting(
        0.0,
        "time constant of growth after a change of temperature; 0 within 21 to 37 degC (Ng et al. 1962)",
        "min",
        within=(0, 120),
    )
    yield_od: float = setting(
        math.inf, "OD produced by one fill of fresh medium; inf: substrate never runs out", "OD", within=(0.5, math.inf)
    )
    k_s: float = setting(
        0.1, "relative substrate at half rate (Monod), 0.02 to 0.2; used if yield_od is finite", within=(1e-4, 1)
    )
    wall_attach_per_min: float = setting(0.0, "rate of attachment of biomass to the wall", "1/min", within=(0, 1e-2))
    wall_growth_ratio: float = setting(0.0, "growth rate on the wall relative to suspension", within=(0, 1))
    wall_detach_per_min: float = setting(0.0, "rate of detachment from the wall", "1/min", within=(0, 0.1))
    wall_capacity_od: float = setting(1.0, "OD-equivalent of a full wall", "OD", within=(1e-3, 10))

    def __post_init__(self) -> None:
        check(self, "plant.growth")
        check_knots("plant.growth.knots_mu", self.knots_min, self.knots_mu)
        require(self.mu > 0.0 or not self.knots_mu, "plant.growth.mu", self.mu, "> 0 with knots_mu, e.g. their mean")


class Culture:
    """N cultures of S strains: suspended biomass x (OD), substrate s (1: fresh medium), wall biomass w (OD).

      x_i' = (m_i - D) x_i - ka x_i + kd w_i        s' = D (1 - s) - sum_i m_i x_i / Y
      w_i' = ka x_i + r m_i w_i (1 - sum_i w_i / W) - kd w_i
      m_i  = mu_i(s) phi_i(T) times drift, stirring, `mu_factor` and `strain_factor`_i
      D    = fresh medium per minute / volume

    Args:
      config: growth; strains: the S strains; integrate: integrator.
    State: `biomass` (true, suspended), shape (N, S); `substrate`, shape (N,).
    Fault switches: `mu_factor` (N,), `strain_factor` (N, S), and `stir_factor` (N,): 1 with a working stirrer, also in
    the pause of each measuring cycle, 0 with a failed one.
    """

    def __init__(self, config: GrowthConfig, strains: Sequence[Strain], integrate: Integrator) -> None:
        self.config, self.strains, self._n = config, strains, strains[0].mu.size
        self._integrate = integrate
        self._mu = np.stack([strain.mu for strain in strains], axis=1)
        self.mu_factor, self.stir_factor = np.ones(self._n), np.ones(self._n)
        self.strain_factor = np.ones((self._n, len(strains)))

    def reset(self, od: Array, temperature: Array, share: Array | float | None = None) -> None:
        """Start a new culture; the substrate is reduced by what the biomass has used.

        Args: od: OD, temperature: degC, share: share of the second strain, None: as drawn; each scalar or (N,).
        """
        total = np.broadcast_to(od, (self._n,)).copy()
        others = [strain.share for strain in self.strains[1:]]
        if others and share is not None:
            others[0] = np.broadcast_to(share, (self._n,))
        parts = [total * (1.0 - sum(others)), *(total * r for r in others)] if others else [total]
        self.biomass: Array = np.stack(parts, axis=1)
        self.substrate: Array = np.maximum(1.0 - total / self.config.yield_od, 0.0)
        self._wall = np.zeros_like(self.biomass)
        self._adapted = self._phi(np.broadcast_to(temperature, (self._n,)))
        self._log_drift, self._settled = np.zeros(self._n), np.zeros(self._n)

    @property
    def od(self) -> Array:
        return np.asarray(self.biomass.sum(axis=1))

    @property
    def wall(self) -> Array:
        return np.asarray(self._wall.sum(axis=1))

    @property
    def share(self) -> Array:
        """Share of the second strain, shape (N,); nan without second strain or biomass."""
        if len(self.strains) == 1:
            return np.full(self._n, np.nan)
        od = self.od
        return np.asarray(np.divide(self.biomass[:, 1], od, out=np.full(self._n, np.nan), where=od > 0.0))

    def new_minute(self, z: Array) -> None:
        """Set the random draw of the new minute: standard normal, shape (N,)."""
        self._log_drift = self._log_drift + self.config.drift_sd_per_h / np.sqrt(60.0) * z

    def dilute(self, kept: Array) -> None:
        """Dilute: a fraction `kept`, shape (N,), of the vial's content remains, the rest is fresh medium."""
        self.biomass, self.substrate = self.biomass * kept[:, None], 1.0 - (1.0 - self.substrate) * kept

    def concentrate(self, factor: Array) -> None:
        """Multiply the concentrations by `factor`, shape (N,), after evaporation."""
        self.biomass, self.substrate = self.biomass * factor[:, None], self.substrate * factor

    def grow(self, minutes: float, dilution: Array, temperature: Array, age_min: Array) -> None:
        """Integrate x, s and w over an interval with constant temperature and dilution rate.

        Args:
          dilution: dilution rate, 1/min; temperature: degC; age_min: age of the culture, min; all of shape (N,).
        """
        g, d = self.config, dilution[:, None]
        follow = [
            1.0 if lag == 0.0 else -np.expm1(-minutes / lag) for lag in (strain.lag_min for strain in self.strains)
        ]
        self._adapted = self._adapted + (self._phi(temperature) - self._adapted) * np.array(follow)
        relative = self._relative_rate(age_min)
        n = len(follow)

        def derivative(y: Array) -> Array:
            x, s, w = y[:, :n], y[:, n : n + 1], y[:, n + 1 :]
            rate = self._rate(s) * relative
            exchange = g.wall_attach_per_min * x - g.wall_detach_per_min * w
            crowded = 1.0 - w.sum(axis=1, keepdims=True) / g.wall_capacity_od
            grown = g.wall_growth_ratio * rate * w * crowded
            dx = (rate - d) * x - exchange
            ds = d * (1.0 - s) - (rate * x).sum(axis=1, keepdims=True) / g.yield_od
            return np.concatenate([dx, ds, exchange + grown], axis=1)

        state = np.concatenate([self.biomass, self.substrate[:, None], self._wall], axis=1)
        state = np.maximum(self._integrate(derivative, state, minutes, self.substeps(minutes)), 0.0)
        self.biomass, self.substrate, self._wall = state[:, :n], state[:, n], state[:, n + 1 :]

    def substeps(self, minutes: float) -> int:
        """Return the number of integration steps in `minutes`."""
        return max(1, int(np.ceil(minutes / SUBSTEP_MIN - 1e-9)))

    def rates(self, age_min: Array) -> Array:
        """Return the current specific growth rate of each strain, 1/min, shape (N, S).

        Args: age_min: age of the culture, min, shape (N,).
        """
        return self._rate(self.substrate[:, None]) * self._relative_rate(age_min)

    def _rate(self, substrate: Array) -> Array:
        """Return the growth rates at 37 degC, (N, S), by Monod (1949): mu in fresh medium. Args: substrate: (N, 1)."""
        k_s = self.config.k_s
        if np.isinf(self.config.yield_od):
            return self._mu
        return np.asarray(self._mu * (1.0 + k_s) * substrate / (k_s + substrate))

    def _phi(self, temperature: Array) -> Array:
        """Return phi_i(T) of every strain, shape (N, S)."""
        return np.stack([strain.phi(temperature) for strain in self.strains], axis=1)

    def _relative_rate(self, age_min: Array) -> Array:
        """Return the factor of the growth rates by temperature, drift, stirring and fault switches, shape (N, S)."""
        g = self.config
        course = along(g.knots_min, g.knots_mu, g.mu, age_min)
        drift = np.exp(self._log_drift) * np.maximum(1.0 + g.ramp_per_h * age_min / 60.0, 0.0) * course
        stirred = UNSTIRRED_GROWTH + (1.0 - UNSTIRRED_GROWTH) * self.stir_factor
        factors = self.mu_factor[:, None] * self.strain_factor
        return np.asarray(self._adapted * drift[:, None] * stirred[:, None] * factors)

    def settle(self, minutes: float) -> None:
        """Let cells sink while the stirrer is stopped, and rise again while it turns."""
        sunk = SETTLED_FRACTION * (1.0 - self.stir_factor)
        self._settled += (sunk - self._settled) * -np.expm1(-minutes / SETTLING_MIN)

    @property
    def in_light_path(self) -> Array:
        """Suspended biomass in the light path of the sensor, OD, shape (N,)."""
        return self.od * (1.0 - self._settled)
