"""The plant: N simulated vials with pumps, heater, wall and sensor, to test policies trained on the simple model.

The plant does not use the training model. Both agree only if all real effects are off (the defaults of `PlantConfig`).
Units: min, mL, mL/s, degC, 1/min; OD has none.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from conf.messages import NotAllowed
from conf.schema import check, part, setting
from envs.bench import Bench
from envs.integrators import INTEGRATORS, Array
from envs.plant.culture import Culture, GrowthConfig
from envs.plant.disturbance import named
from envs.plant.noise import Streams, Tape, spread, streams, uniform
from envs.plant.pump import FeedPump, PumpConfig
from envs.plant.sensor import OdSensor, SensorConfig
from envs.plant.strains import Strain, response
from envs.plant.thermal import Thermal, ThermalConfig
from envs.plant.vessel import Vessel, VesselConfig


@dataclass(frozen=True)
class PlantConfig:
    """Settings of a plant; the defaults are the preset `nominal`, which equals the training model."""

    growth: GrowthConfig = part(GrowthConfig, "growth of the culture")
    pump: PumpConfig = part(PumpConfig, "flow of the pumps")
    sensor: SensorConfig = part(SensorConfig, "errors of an OD reading")
    vessel: VesselConfig = part(VesselConfig, "the vial and its bottle")
    thermal: ThermalConfig = part(ThermalConfig, "heater and surroundings")
    start_od: float = setting(0.5, "OD at reset unless the scenario sets it", "OD", within=(0, 10))
    start_temperature: float = setting(
        37.0, "temperature of vial and thermostat at reset unless the scenario sets it", "degC", within=(0, 60)
    )
    start_min: float = setting(0.0, "age of culture and pump at reset, for drifts and knots", "min", at_least=0.0)
    start_spread_min: float = setting(
        0.0,
        "extra age of each vial, drawn uniformly from 0 to this",
        "min",
        at_least=0.0,
    )
    disturbances: tuple[str, ...] = setting((), "names of your functions that change the vials every minute")
    integrator: str = setting("euler", "integration scheme of the mass balances", choices=tuple(INTEGRATORS))

    def __post_init__(self) -> None:
        check(self, "plant")
        for name in self.disturbances:
            named(name)


def with_options(config: PlantConfig, values: Mapping[str, str]) -> PlantConfig:
    """Return the config with the options in `values`, by keys of `OPTIONS`, applied. Raises: ValueError."""
    for key, (usual, _, change) in OPTIONS.items():
        config = change(config, values.get(key, usual))
    return config


class LightSensor(Protocol):
    """Interface of N sensors of one strain's light. draws: constants drawn once, by name; strain: its index."""

    draws: dict[str, Array]
    strain: int

    def reset(self, producers: Array, growth: Array, temperature: Array) -> None:
        """Start a new culture. Args: producers: OD of the strain; growth: its rate, 1/min; temperature: degC."""

    def new_minute(self, temperature: Array) -> None:
        """Begin a new minute at a temperature, degC."""

    def advance(self, minutes: float, producers: Array, kept: Array, dilution: Array, concentrated: Array) -> None:
        """Advance by an interval, min.

        Args: producers: mean OD of the strain. kept: fraction left by a dose at the start; dilution: dilution rate,
          1/min; concentrated: factor of the concentrations by evaporation, applied at the end.
        """

    def read(self, od: Array, minutes: float) -> Array:
        """Take one reading, counts. Args: od: total OD of all cells; minutes: time since reset."""


STRAINS: list[Callable[[PlantConfig, Streams], tuple[Sequence[Strain], dict[str, Array]]]] = []
"""Functions (config, a stream per vial) -> further strains and their random constants by name. Guests add entries."""
OPTIONS: dict[str, tuple[str, str, Callable[[PlantConfig, str], PlantConfig]]] = {}
"""Options of simulated vials: key -> default, meaning, function (config, value) -> config. Guests add entries."""
LIGHTS: list[Callable[[PlantConfig, Streams], LightSensor | None]] = []
"""Functions (config, a stream per vial) -> sensor of a strain's light, or None. Guests add entries."""


class Plant:
    """N vials, advanced together. Parts: `culture`, `vessel`, `thermal`, `feed` (the pump), `sensor`, `fluorescence`.

    With `dosing = pulse` the dose enters at the start of an interval: x <- x F, s <- 1 - (1 - s) F. The dilution rate
    is 0 after the dose. F = exp(-v/V) for a volume v exchanged at constant volume V; F = V/(V + v) for a volume v that
    stays in the vial. Source of the terms and numbers: docs/biology.md.

    Constants of a reactor (growth rate, pump flow, optics, tube height) are drawn once and recorded in `draws`. They
    survive `reset`, which starts a new culture in the same reactor. Process noise is drawn per minute of plant time and
    sensor noise per reading, from one stream per vial. Neither depends on the pump commands, and vial i is the same for
    every N.

    Args:
      config: settings of the plant.
      n: number of vials.
      rng: a generator, from which one stream per vial is spawned, or a sequence of n generators.
      volume_ml: culture volume of the bench, mL, (N,) or one for all; the config may override it.
    Raises: ValueError for n < 1 or a sequence whose length is not n.

    State and fault switches are arrays of shape (N,) in the parts. A switch may be set at any time and keeps its value
    until it is set again. `minutes` is the time since reset.
    """

    def __init__(
        self,
        config: PlantConfig,
        n: int,
        rng: np.random.Generator | Streams,
        volume_ml: Array | float = Bench.volume_ml,
    ) -> None:
        if n < 1:
            raise NotAllowed(key="number of vials", given=n, allowed=">= 1")
        self.config, self.n = config, n
        parts = [r.spawn(7) for r in streams(rng, n)]
        once, process, reading, start, second, light, thermometer = ([p[k] for p in parts] for k in range(7))
        # The parts draw from the same streams: their order affects the draws of a seed.
        integrate = INTEGRATORS[config.integrator]
        mu, draws = spread(once, config.growth.mu, config.growth.mu_cv), dict[str, Array]()
        own = response(config.growth.temperature_law, config, config.growth.activation_kj_mol, 0)
        strains = [Strain(mu, own, config.growth.adaptation_min, np.ones(n))]
        for make in STRAINS:
            more, drawn = make(config, second)
            strains, draws = [*strains, *more], draws | drawn
        self.culture = Culture(config.growth, strains, integrate)
        self.vessel = Vessel(config.vessel, config.pump, once, np.full(n, volume_ml, dtype=np.float64))
        self.feed = FeedPump(config.pump, once)
        self.sensor = OdSensor(config.sensor, once, reading)
        self.thermal = Thermal(config.thermal, thermometer)
        self.feed.media_left_ml[:] = config.vessel.media_ml
        self.draws = {"mu": mu} | draws | self.vessel.draws | self.feed.draws | self.sensor.draws | self.thermal.draws
        lights = [sensor for make_light in LIGHTS if (sensor := make_light(config, light)) is not None]
        self.fluorescence = lights[0] if lights else None
        if self.fluorescence is not None:
            self.draws |= self.fluorescence.draws
        self.draws["start_min"] = uniform(start, config.start_min, config.start_min + config.start_spread_min)
        self._disturbances = [named(name) for name in config.disturbances]
        self._tape = Tape(process, normals=3, uniforms=2)
        self.reset()

    def reset(
        self,
        od: Array | float | None = None,
        temperature: Array | float | None = None,
        share: Array | float | None = None,
    ) -> None:
        """Start a new culture, filled up to the waste tube. Fault switches, bottle content and `draws` are kept.

        Args:
          od: suspended biomass, OD, scalar or shape (N,), >= 0; None: `start_od` of the config.
          temperature: temperature of vial and thermostat, degC, scalar or (N,); None: `start_temperature`.
          share: share of the second strain, if there is one, scalar or shape (N,), 0 to 1; None: as drawn.
        Raises: ValueError for an OD below 0 or a share outside 0 to 1.
        """
        start = np.asarray(self.config.start_od if od is None else od, dtype=np.float64)
        if not np.all(start >= 0.0):
            raise NotAllowed(key="start OD", given=start, allowed=">= 0")
        if share is not None and not (np.all(np.asarray(share) >= 0.0) and np.all(np.asarray(share) <= 1.0)):
            raise NotAllowed(key="start share", given=share, allowed="0 to 1")
        self.thermal.reset(self.config.start_temperature if temperature is None else temperature)
        self.culture.reset(start, self.thermal.temperature, share)
        self.vessel.reset()
        self.feed.reset()
        self.sensor.reset()
        self.minutes = 0.0
        self._minute = -1
        if self.fluorescence is not None:
            which = self.fluorescence.strain
            growth = self.culture.rates(self.age_min)[:, which]
            self.fluorescence.reset(self.culture.biomass[:, which], growth, self.thermal.temperature)

    def advance(
        self,
        minutes: float,
        feed_s: Array,
        waste_s: Array | None = None,
        temperature_target: Array | float | None = None,
        overflow_s: Array | float = 0.0,
        supply_ml: Array | float = 0.0,
    ) -> None:
        """Run pumps, growth and heater for an interval of any length, which is cut into minutes.

        Args:
          minutes: length of the interval, min, > 0.
          feed_s: on-time of the feed pump at full power, s, shape (N,) or scalar. Negative: the pump runs backwards and
          removes culture. If the on-time fills the interval, the pulse continues in the next call.
          waste_s: on-time of the waste pump during the feed, s, same shape; None: as long as needed. Negative: no
          effect, because the pump blows air.
          temperature_target: target of the thermostat, degC, scalar or shape (N,); None or nan: unchanged, 0: off.
          overflow_s: on-time of the overflow pump, s, as `waste_s`; 0: none.
          supply_ml: volume of a fluid without cells that a spare pump adds with the feed, mL, shape (N,) or scalar.
        Raises: ValueError if the interval is not positive or an on-time is not finite.
        """
        if not (minutes > 0.0 and np.isfinite(minutes)):
            raise ValueError(f"interval = {minutes} min: allowed > 0")
        feed = np.broadcast_to(np.asarray(feed_s, dtype=np.float64), (self.n,))
        waste = np.full(self.n, np.inf) if waste_s is None else np.broadcast_to(waste_s, (self.n,))
        above = np.broadcast_to(np.asarray(overflow_s, dtype=np.float64), (self.n,))
        if not np.all(np.isfinite(feed)) or np.any(np.isnan(waste + above)):
            given = f"feed {feed} s, waste {waste} s, overflow {above} s"
            raise NotAllowed(key="pump on-time", given=given, allowed="finite numbers")
        if temperature_target is not None:
            self.thermal.set_target(temperature_target)
        pieces = max(1, int(np.ceil(minutes - 1e-9)))
        continuous = self.config.pump.dosing == "continuous"
        for k in range(pieces):
            share = 1.0 / pieces if continuous else float(k == 0)
            outlets = (waste * share, above * share) if share else (np.zeros(self.n), np.zeros(self.n))
            supply = np.broadcast_to(np.asarray(supply_ml, dtype=np.float64), (self.n,)) * share
            self._advance_piece(minutes / pieces, feed * share, *outlets, supply)

    def _advance_piece(
        self, minutes: float, feed_s: Array, waste_s: Array, overflow_s: Array, supply_ml: Array
    ) -> None:
        """Advance by at most one minute: random draws, doses, heat, growth, evaporation."""
        self._draw_minutes()
        volume = self.vessel.volume_ml
        fresh = self.feed.deliver(np.maximum(feed_s, 0.0), minutes, self.age_min) + supply_ml
        kept = self.vessel.exchange(fresh, waste_s, overflow_s)
        self.vessel.draw_out(self.feed.drawn_back(np.maximum(-feed_s, 0.0)))
        if self.config.pump.dosing == "pulse":
            self.culture.dilute(kept)
            dilution = np.zeros(self.n)
        else:
            dilution = fresh / volume / minutes
        self.thermal.advance(minutes, kept)
        before = self.culture.biomass
        self.culture.grow(minutes, dilution, self.thermal.mean, self.age_min)
        concentrated = self.vessel.evaporate(minutes)
        if self.fluorescence is not None:
            washed_out = kept if self.config.pump.dosing == "pulse" else np.ones(self.n)
            producers = 0.5 * (before + self.culture.biomass)[:, self.fluorescence.strain]
            self.fluorescence.advance(minutes, producers, washed_out, dilution, concentrated)
        self.culture.concentrate(concentrated)
        self.culture.settle(minutes)
        self.minutes += minutes

    def _draw_minutes(self) -> None:
        """Take the random draws of every minute that began since the last call; apply the disturbances."""
        while self._minute < int(np.floor(self.minutes + 1e-6)):
            (z_pump, z_mu, z_ripple), (u_timing, u_prime) = self._tape.next()
            self.feed.new_minute(z_pump, u_timing, u_prime)
            self.culture.new_minute(z_mu)
            self.thermal.new_minute(z_ripple)
            if self.fluorescence is not None:
                self.fluorescence.new_minute(self.thermal.temperature)
            for disturb in self._disturbances:
                disturb(self)
            self._minute += 1

    def expected_od(self, minutes: float, feed_s: Array) -> Array:
        """Return the expected suspended biomass after an interval, OD, (A, N); no side effects.

        Each strain grows at its present rate (present substrate, temperature, drift and stirring) and is diluted by the
        mean dose of a primed pump. Random draws of the interval, priming and wall growth are neglected.

        Args:
          minutes: length of the interval, min, at most 1.
          feed_s: on-times of the feed pump to compare, s, shape (A, N).
        """
        rate = self.culture.rates(self.age_min)
        dose = (self.feed.expected(feed_s, self.age_min) / self.vessel.volume_ml)[..., None]
        steps = self.culture.substeps(minutes)
        continuous = self.config.pump.dosing == "continuous"
        change = (rate * minutes - (dose if continuous else 0.0)) / steps
        grown = (1.0 + change) ** steps if self.config.integrator == "euler" else np.exp(steps * change)
        return np.asarray((self.culture.biomass * grown * (1.0 if continuous else np.exp(-dose))).sum(axis=-1))

    def at_rest(self, minutes: float, feed_s: Array | float) -> tuple[Array, Array]:
        """Compute the decrease of ln x by one mean dose of `feed_s` s, and the growth share, each (N,).

        Args: minutes: time between two doses, min. Assumptions as in `expected_od`.
        """
        rate, biomass = self.culture.rates(self.age_min), self.culture.biomass
        taken = self.feed.expected(np.broadcast_to(feed_s, (self.n,)), self.age_min) / self.vessel.volume_ml
        grown = minutes * (rate * biomass).sum(axis=-1) / biomass.sum(axis=-1)
        return taken, np.divide(grown, taken, out=np.full(self.n, np.nan), where=taken > 0.0)

    @property
    def age_min(self) -> Array:
        """Age of culture and pump: `start_min` plus the time since reset, min, shape (N,)."""
        return self.draws["start_min"] + self.minutes

    def read_od(self) -> Array:
        """Take one averaged reading of every sensor, with all errors and faults, OD, shape (N,)."""
        return self.sensor.read(self.culture.in_light_path, self.culture.wall, self.minutes)

    @property
    def apparent_od(self) -> Array:
        """Reading of a noise-free sensor, OD, shape (N,)."""
        return self.sensor.apparent(self.culture.in_light_path, self.culture.wall, self.minutes)

    def read_fluorescence(self) -> Array:
        """Take one reading of every fluorescence sensor, counts, shape (N,); nan if no strain emits light."""
        if self.fluorescence is None:
            return np.full(self.n, np.nan)
        return np.asarray(self.fluorescence.read(self.culture.od, self.minutes))
