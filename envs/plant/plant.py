"""The plant: N vials with pumps, heater, wall and sensor, for testing what was trained on the simple model.

It is not the training model. It shares the growth-law interface with it and nothing else, and reproduces it only when
everything real is switched off (the defaults of `PlantConfig`). Units: min, mL, mL/s, degC, 1/min; OD has none.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from conf.schema import check, part, require, setting
from envs.growth import REFERENCE_TEMPERATURE, Arrhenius, Cardinal, Exponential, GrowthLaw, Monod, Ratkowsky
from envs.integrators import INTEGRATORS
from envs.plant.noise import Streams, Tape, spread, streams
from envs.plant.pump import FeedPump, PumpConfig
from envs.plant.sensor import OdSensor, SensorConfig

__all__ = ["GrowthConfig", "Plant", "PlantConfig", "PumpConfig", "SensorConfig", "ThermalConfig", "VesselConfig"]

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

MIN_VOLUME_ML = 1.0  # mL, what no pump can take out of a vial; keeps concentrations finite
SETTLED_FRACTION = 0.08  # of the OD lost from the light path when the stirrer stands still (biology.md section 3)
SETTLING_MIN = 1.5  # min, so that it is lost within about three readings (biology.md section 3)
UNSTIRRED_GROWTH = 0.5  # relative growth without stirring (biology.md section 3)

TEMPERATURE_LAWS = ("none", "arrhenius", "ratkowsky", "cardinal")


@dataclass(frozen=True)
class GrowthConfig:
    """How cells grow; the defaults are the training model's. Every temperature law is 1 at 37 degC (envs/growth.py)."""

    mu: float = setting(0.03, "mean specific growth rate in fresh medium at 37 degC", "1/min", within=(0, 0.1))
    mu_cv: float = setting(0.0, "its relative spread between cultures", within=(0, 0.3))
    drift_sd_per_h: float = setting(0.0, "random walk of ln mu: sd after 1 h", "1/sqrt(h)", within=(0, 0.2))
    ramp_per_h: float = setting(0.0, "relative change of mu per hour (burden, pH, oxygen)", "1/h", within=(-0.5, 0.5))
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


@dataclass(frozen=True)
class VesselConfig:
    """The vial and its bottle."""

    volume_ml: float = setting(20.0, "mean culture up to the waste tube (Steel 2020)", "mL", within=(5, 50))
    volume_sd_ml: float = setting(0.0, "spread of the tube's height between vials", "mL", within=(0, 1.5))
    guard_above_ml: float = setting(
        2.0, "an overflow guard's tube ends so far above the waste tube", "mL", within=(0, 10)
    )
    capacity_ml: float = setting(
        30.0, "overflows above; 4.5 mL over volume_ml or more (30 mL vial)", "mL", at_most=200.0
    )
    evaporation_ml_day: float = setting(0.0, "water lost", "mL/day", within=(0, 50))
    media_ml: float = setting(math.inf, "fresh medium in the bottle; inf: never empty", "mL", within=(0, math.inf))

    def __post_init__(self) -> None:
        check(self, "plant.vessel")
        lowest = self.volume_ml + 4.5
        require(self.capacity_ml >= lowest, "plant.vessel.capacity_ml", f"{self.capacity_ml} mL", f"{lowest:g} to 200")


@dataclass(frozen=True)
class ThermalConfig:
    """Heater and surroundings: heating is active and fast, cooling passive and slow.

    Public Chi.Bio logs give ambient 21.4 and 25.7 degC, cooling 30 and 53 min, heating 2.3 to 2.5 degC/min at its peak.
    """

    ambient_c: float = setting(24.0, "temperature an unheated vial cools to", "degC", within=(0, 45))
    cooling_min: float = setting(39.0, "time constant of passive cooling", "min", within=(1, 600))
    heating_c_per_min: float = setting(2.0, "fastest rise of a heated vial", "degC/min", within=(0.1, 10))
    medium_c: float = setting(24.0, "temperature of fresh medium", "degC", within=(0, 45))
    ripple_c: float = setting(0.0, "sd of the temperature reading", "degC", within=(0, 2))

    def __post_init__(self) -> None:
        check(self, "plant.thermal")


@dataclass(frozen=True)
class PlantConfig:
    """Everything about a plant; the defaults are the preset `nominal`, the training model and nothing else."""

    growth: GrowthConfig = part(GrowthConfig, "how cells grow")
    pump: PumpConfig = part(PumpConfig, "how a pump turns on-time into volume")
    sensor: SensorConfig = part(SensorConfig, "what an averaged OD reading adds to the truth")
    vessel: VesselConfig = part(VesselConfig, "the vial and its bottle")
    thermal: ThermalConfig = part(ThermalConfig, "heater and surroundings")
    start_od: float = setting(
        0.5, "suspended biomass at reset unless the scenario says otherwise", "OD", within=(0, 10)
    )
    integrator: str = setting("euler", "scheme of the mass balances", choices=tuple(INTEGRATORS))
    substep_min: float = setting(0.1, "longest integration step (paper)", "min", within=(1e-3, 1))

    def __post_init__(self) -> None:
        check(self, "plant")


def _response(config: GrowthConfig) -> Callable[[Array], Array]:
    """phi(T) / phi(37 degC) of the configured temperature law."""
    laws: dict[str, Callable[[Array], Array]] = {
        "none": np.ones_like,
        "arrhenius": Arrhenius(config.activation_kj_mol),
        "ratkowsky": Ratkowsky(),
        "cardinal": Cardinal(),
    }
    phi = laws[config.temperature_law]
    reference = phi(np.asarray(REFERENCE_TEMPERATURE))
    return lambda temperature: phi(temperature) / reference


def _moved(on_s: Array, flow: Array) -> Array:
    """Volume a pump of `flow` mL/s could move, mL, shape (N,): nothing backwards, nothing if it is blocked."""
    able = np.zeros_like(flow)  # a blocked pump moves nothing, however long it runs (0 times infinity is 0 here)
    return np.multiply(np.maximum(on_s, 0.0), flow, out=able, where=flow > 0.0)


class Plant:
    """N vials, advanced together.

    Suspended biomass x, relative substrate s and wall biomass w (both in OD or relative to fresh medium):

      x' = (m - D) x - ka x + kd w        s' = D (1 - s) - m x / Y        w' = ka x + r m w (1 - w/W) - kd w
      m  = mu(s) phi(T) (times drift, stirring and `mu_factor`),          D = fresh medium per minute / V

    With `dosing = pulse` the dose enters at the start of an interval: x <- x F, s <- 1 - (1 - s) F, and D = 0 after it;
    F = exp(-v/V) for what feed and waste pump exchange at constant volume, V/(V + v) for what stays in the vial.
    Volume: the waste pump lowers V to its tube, never below; what it does not take raises V up to the rim, where
    `overflowed` is set. An overflow guard is a second such outlet a little higher. Source of the terms and numbers:
    biology.md sections 2 to 7.

    What is drawn once (growth rate, pump flow, optics, tube height) is drawn here, recorded in `draws`, and stays over
    `reset`: a reset is a new culture in the same reactor. Process noise is drawn per minute of plant time and sensor
    noise per reading, from one stream per vial, so neither depends on what the pumps are told, and vial i is the same
    whatever N is.

    Args:
      config: what is real about it.
      n: number of vials.
      rng: a generator, from which one stream per vial is spawned, or a sequence of n generators.
    Raises: ValueError for n < 1 or a sequence of another length.

    State, shape (N,): `od` (true suspended biomass), `substrate`, `wall`, `volume_ml`, `temperature`,
    `temperature_target`, `media_ml` (fresh medium delivered since reset), `overflowed`; `minutes` since reset.
    Fault switches, shape (N,), may be set at any time and stay until set again: `mu_factor`, `stir_factor` (1 turning,
    0 stopped; for a stirrer that fails, not for the still phase of each cycle), `waste_gain_factor`,
    `guard_gain_factor`, and through the parts `pump_gain_factor`, `back_leak_ml`, `media_left_ml`, `sensor_frozen`,
    `sensor_offset`.
    """

    def __init__(self, config: PlantConfig, n: int, rng: np.random.Generator | Streams) -> None:
        if n < 1:
            raise ValueError(f"number of vials = {n}: allowed >= 1")
        self.config, self.n = config, n
        parts = [r.spawn(3) for r in streams(rng, n)]
        once, process, reading = ([p[k] for p in parts] for k in range(3))
        mu = spread(once, config.growth.mu, config.growth.mu_cv)
        self._tube_ml = spread(once, config.vessel.volume_ml, config.vessel.volume_sd_ml / config.vessel.volume_ml)
        self.feed = FeedPump(config.pump, once)
        self.sensor = OdSensor(config.sensor, once, reading)
        self.feed.media_left_ml = np.full(n, config.vessel.media_ml)
        self.draws: dict[str, Array] = {
            "mu": mu,
            "volume_ml": self._tube_ml,
            **self.feed.draws,
            **self.sensor.draws,
        }
        g = config.growth
        # Quoted for fresh medium: Monod's rate at s = 1 is mu_max / (1 + k_s).
        self._law: GrowthLaw = Exponential(mu) if np.isinf(g.yield_od) else Monod(mu * (1.0 + g.k_s), g.k_s)
        self._phi = _response(g)
        self._integrate = INTEGRATORS[config.integrator]
        self._tape = Tape(process, normals=3, uniforms=2)
        self.mu_factor, self.stir_factor = np.ones(n), np.ones(n)
        self.waste_gain_factor, self.guard_gain_factor = np.ones(n), np.ones(n)
        self.reset()

    def reset(self, od: Array | float | None = None, temperature: float = 37.0) -> None:
        """A new culture at the waste tube's level, in balance with the medium it grew from.

        Args:
          od: suspended biomass, OD, scalar or shape (N,), >= 0; None = `start_od` of the config.
          temperature: of vial and thermostat, degC.
        Fault switches, what the bottle holds and the drawn parameters stay. Raises: ValueError for an OD below 0.
        """
        start = np.asarray(self.config.start_od if od is None else od, dtype=np.float64)
        if not np.all(start >= 0.0):
            raise ValueError(f"start OD = {start}: allowed >= 0")
        n = self.n
        self.od: Array = np.broadcast_to(start, (n,)).copy()
        self.substrate: Array = np.maximum(1.0 - self.od / self.config.growth.yield_od, 0.0)
        self.wall: Array = np.zeros(n)
        self.volume_ml: Array = self._tube_ml.copy()
        self.temperature: Array = np.full(n, float(temperature))
        self.temperature_target: Array = np.full(n, float(temperature))
        self.media_ml: Array = np.zeros(n)
        self.overflowed: Mask = np.zeros(n, dtype=bool)
        self.minutes = 0.0
        self._adapted = self._phi(self.temperature)
        self._log_drift, self._settled, self._ripple = np.zeros(n), np.zeros(n), np.zeros(n)
        self._minute = -1
        self.feed.reset()
        self.sensor.reset()

    def advance(
        self,
        minutes: float,
        feed_s: Array,
        waste_s: Array | None = None,
        temperature_target: Array | float | None = None,
        guard_s: Array | float = 0.0,
    ) -> None:
        """Run pumps, growth and heater for an interval of any length; long ones are cut into minutes.

        Args:
          minutes: length of the interval, min, > 0.
          feed_s: on-time of the feed pump at full power, s, shape (N,) or scalar. Negative runs it backwards: culture
            is drawn out. An on-time that fills the interval leaves the pulse open for the next call.
          waste_s: on-time of the waste pump, s, same shape, beside the feed; None = as much as is needed.
            Negative blows air and changes nothing.
          temperature_target: thermostat, degC, scalar or shape (N,); None or nan leaves it, 0 is off.
          guard_s: on-time of the overflow guard's pump, s, as `waste_s`; 0 = there is none.
        Raises: ValueError for an interval not positive or an on-time not finite.
        """
        if not (minutes > 0.0 and np.isfinite(minutes)):
            raise ValueError(f"interval = {minutes} min: allowed > 0")
        feed = np.broadcast_to(np.asarray(feed_s, dtype=np.float64), (self.n,))
        waste = np.full(self.n, np.inf) if waste_s is None else np.broadcast_to(waste_s, (self.n,))
        guard = np.broadcast_to(np.asarray(guard_s, dtype=np.float64), (self.n,))
        if not np.all(np.isfinite(feed)) or np.any(np.isnan(waste + guard)):
            raise ValueError(f"pump on-time = feed {feed} s, waste {waste} s, guard {guard} s: allowed finite numbers")
        if temperature_target is not None:
            target = np.broadcast_to(np.asarray(temperature_target, dtype=np.float64), (self.n,))
            self.temperature_target = np.where(np.isnan(target), self.temperature_target, target)
        pieces = max(1, int(np.ceil(minutes - 1e-9)))
        continuous = self.config.pump.dosing == "continuous"
        for k in range(pieces):
            share = 1.0 / pieces if continuous else float(k == 0)
            outlets = (waste * share, guard * share) if share else (np.zeros(self.n), np.zeros(self.n))
            self._advance_piece(minutes / pieces, feed * share, *outlets)

    def _advance_piece(self, minutes: float, feed_s: Array, waste_s: Array, guard_s: Array) -> None:
        """At most one minute: this minute's draws, doses, heat, growth, evaporation."""
        self._catch_up()
        fresh = self.feed.deliver(np.maximum(feed_s, 0.0), minutes, self.minutes)
        self.media_ml = self.media_ml + fresh
        volume = self.volume_ml
        kept = self._exchange(fresh, waste_s, guard_s)
        drawn = self.draws["pump_gain_ml_s"] * self.feed.gain_factor * np.maximum(-feed_s, 0.0)
        self.volume_ml = np.maximum(self.volume_ml - drawn, MIN_VOLUME_ML)
        if self.config.pump.dosing == "pulse":
            self.od, self.substrate = self.od * kept, 1.0 - (1.0 - self.substrate) * kept
            dilution = np.zeros(self.n)
        else:
            dilution = fresh / volume / minutes
        self._heat(minutes, kept)
        self._grow(minutes, dilution)
        lost = self.config.vessel.evaporation_ml_day * minutes / 1440.0
        left = np.maximum(self.volume_ml - lost, MIN_VOLUME_ML)
        concentrated = self.volume_ml / left
        self.od, self.substrate, self.volume_ml = self.od * concentrated, self.substrate * concentrated, left
        self._settled += (SETTLED_FRACTION * (1.0 - self.stir_factor) - self._settled) * -np.expm1(
            -minutes / SETTLING_MIN
        )
        self.minutes += minutes

    def _catch_up(self) -> None:
        """Take the draws of every minute begun since the last call."""
        per_minute = self.config.growth.drift_sd_per_h / np.sqrt(60.0)
        while self._minute < int(np.floor(self.minutes + 1e-6)):
            (z_pump, z_mu, z_ripple), (u_timing, u_prime) = self._tape.next()
            self.feed.new_minute(z_pump, u_timing, u_prime)
            self._log_drift = self._log_drift + per_minute * z_mu
            self._ripple = z_ripple
            self._minute += 1

    def _exchange(self, fresh: Array, waste_s: Array, guard_s: Array) -> Array:
        """Move liquid; returns F, the share of what was in the vial that its concentrations keep, shape (N,).

        Fresh medium fills the vial up to an outlet's tube, is exchanged there for what its pump takes, and rises on.
        """
        pump = self.config.pump
        guard_ml = self._tube_ml + self.config.vessel.guard_above_ml
        outlets = [  # from below: level of the tube, mL the pump is able to move
            [self._tube_ml, _moved(waste_s, pump.waste_ml_s * self.waste_gain_factor)],
            [guard_ml, _moved(guard_s, pump.guard_ml_s * self.guard_gain_factor)],
        ]
        level, left, kept = self.volume_ml, fresh, np.ones(self.n)
        for outlet in outlets:
            tube, able = outlet
            fill = np.minimum(left, np.maximum(tube - level, 0.0))
            swapped = np.minimum(left - fill, able)
            kept = kept * (level / (level + fill)) * np.exp(-swapped / (level + fill))
            level, left, outlet[1] = level + fill, left - fill - swapped, able - swapped
        kept = kept * (level / (level + left))
        level = level + left
        self.overflowed = self.overflowed | (level > self.config.vessel.capacity_ml)
        for tube, able in outlets:
            level = np.maximum(level - able, np.minimum(tube, level))
        self.volume_ml = np.minimum(level, self.config.vessel.capacity_ml)
        return np.asarray(kept)

    def _heat(self, minutes: float, kept: Array) -> None:
        """Mix in the medium's temperature, cool passively, heat towards the target without overshoot."""
        t = self.config.thermal
        mixed = t.medium_c + (self.temperature - t.medium_c) * kept
        cooled = t.ambient_c + (mixed - t.ambient_c) * np.exp(-minutes / t.cooling_min)
        heated = np.minimum(self.temperature_target, cooled + t.heating_c_per_min * minutes)
        self.temperature = np.maximum(cooled, heated)
        # The interval's mean: a vial that is warm again early spends only a share of it on the way.
        rise = self.temperature - mixed
        share = np.where(rise > 0.0, np.minimum(rise / (t.heating_c_per_min * minutes), 1.0), 1.0)
        self._mean_temperature = self.temperature - 0.5 * rise * share

    def _grow(self, minutes: float, dilution: Array) -> None:
        """Integrate x, s, w over an interval in which temperature and dilution rate are constant."""
        g = self.config.growth
        response = self._phi(self._mean_temperature)
        follow = 1.0 if g.adaptation_min == 0.0 else -np.expm1(-minutes / g.adaptation_min)
        self._adapted = self._adapted + (response - self._adapted) * follow
        relative = self._relative_growth()

        def derivative(y: Array) -> Array:
            x, s, w = y
            rate = self._law.specific_rate(s, self._mean_temperature) * relative
            exchange = g.wall_attach_per_min * x - g.wall_detach_per_min * w
            return np.stack(
                [
                    (rate - dilution) * x - exchange,
                    dilution * (1.0 - s) - rate * x / g.yield_od,
                    exchange + g.wall_growth_ratio * rate * w * (1.0 - w / g.wall_capacity_od),
                ]
            )

        substeps = max(1, int(np.ceil(minutes / self.config.substep_min - 1e-9)))
        state = self._integrate(derivative, np.stack([self.od, self.substrate, self.wall]), minutes, substeps)
        self.od, self.substrate, self.wall = np.maximum(state, 0.0)

    def _relative_growth(self) -> Array:
        """What temperature, drift, stirring and `mu_factor` now make of the growth law's rate, shape (N,)."""
        drift = np.exp(self._log_drift) * max(1.0 + self.config.growth.ramp_per_h * self.minutes / 60.0, 0.0)
        stirred = UNSTIRRED_GROWTH + (1.0 - UNSTIRRED_GROWTH) * self.stir_factor
        return np.asarray(self._adapted * drift * stirred * self.mu_factor)

    def expected_od(self, minutes: float, feed_s: Array) -> Array:
        """Suspended biomass after an interval without surprises, OD, (A, N); changes nothing.

        x grows at the rate of this moment (substrate, temperature, drift and stirring as they are) and is diluted by
        the mean dose of a primed pump. What is drawn during the interval, priming and the wall are left out.

        Args:
          minutes: length of the interval, min, at most 1.
          feed_s: on-times of the feed pump to compare, s, shape (A, N).
        """
        rate = self._law.specific_rate(self.substrate, self.temperature) * self._relative_growth()
        dose = self.feed.expected(feed_s, self.minutes) / self.volume_ml
        steps = max(1, int(np.ceil(minutes / self.config.substep_min - 1e-9)))
        continuous = self.config.pump.dosing == "continuous"
        change = (rate * minutes - (dose if continuous else 0.0)) / steps
        grown = (1.0 + change) ** steps if self.config.integrator == "euler" else np.exp(steps * change)
        return np.asarray(self.od * grown * (1.0 if continuous else np.exp(-dose)))

    def read_od(self) -> Array:
        """One averaged reading of every sensor, with all that is configured or switched on, OD, shape (N,)."""
        return self.sensor.read(self._in_light_path(), self.wall, self.minutes)

    def read_temperature(self) -> Array:
        """The thermometer's value, degC, shape (N,); its ripple changes every minute."""
        return self.temperature + self.config.thermal.ripple_c * self._ripple

    @property
    def apparent_od(self) -> Array:
        """What a noise-free sensor would show now, OD, shape (N,)."""
        return self.sensor.apparent(self._in_light_path(), self.wall, self.minutes)

    def _in_light_path(self) -> Array:
        return self.od * (1.0 - self._settled)

    @property
    def pump_gain_factor(self) -> Array:
        """Fault switch of the feed pump: 0 blocked, 0.5 weak, 1 sound, 1.5 strong; shape (N,)."""
        return self.feed.gain_factor

    @pump_gain_factor.setter
    def pump_gain_factor(self, value: Array) -> None:
        self.feed.gain_factor[:] = value

    @property
    def back_leak_ml(self) -> Array:
        """Volume that siphons back after each pulse, mL, shape (N,)."""
        return self.feed.back_leak_ml

    @back_leak_ml.setter
    def back_leak_ml(self, value: Array) -> None:
        self.feed.back_leak_ml[:] = value

    @property
    def media_left_ml(self) -> Array:
        """Fresh medium left in the bottle, mL, shape (N,)."""
        return self.feed.media_left_ml

    @media_left_ml.setter
    def media_left_ml(self, value: Array) -> None:
        self.feed.media_left_ml[:] = value

    @property
    def sensor_frozen(self) -> Mask:
        """True where the sensor repeats its last value, shape (N,)."""
        return self.sensor.frozen

    @sensor_frozen.setter
    def sensor_frozen(self, value: Mask) -> None:
        self.sensor.frozen[:] = value

    @property
    def sensor_offset(self) -> Array:
        """OD added to every reading, shape (N,)."""
        return self.sensor.extra_offset

    @sensor_offset.setter
    def sensor_offset(self, value: Array) -> None:
        self.sensor.extra_offset[:] = value
