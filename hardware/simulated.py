"""Reactors in this process: N vials of a `Plant`, sampled and dosed once per control period, in virtual time."""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass

import numpy as np

from conf.schema import check, require, setting
from envs.plant.plant import Plant, PlantConfig
from hardware.family import Can, Family, Opening
from hardware.reactor import Array, Command, Mask, Measurement, Reactor, Receipt


@dataclass(frozen=True)
class SimulatedConfig:
    """`backend=sim`: simulated vials in this process, in virtual time. Raises: ValueError naming key and range."""

    kind: str = setting("sim", "backend")
    reactors: tuple[str, ...] = setting(("M0",), "names of the simulated vials", some=True)
    pump_ml_s: float = setting(1.0, "calibrated flow of the feed pump at full power", "mL/s", above=0.0, at_most=10.0)
    seed: int = setting(0, "random seed of the plant", at_least=0)

    def __post_init__(self) -> None:
        check(self, "backend")
        unique = len(set(self.reactors)) == len(self.reactors)
        require(unique, "backend.reactors", self.reactors, "one or more unique names")


class SimulatedReactors(Reactor):
    """`Reactor` of a simulated plant: a cycle is sample, decide, dose, grow for the rest of the control period.

    Args: plant: N vials, reset to the state at the start of the run. control_min: control period, min.
    """

    def __init__(self, plant: Plant, config: SimulatedConfig, control_min: float = 1.0) -> None:
        if plant.n != len(config.reactors):
            raise ValueError(f"plant has {plant.n} vials: allowed {len(config.reactors)}, one per reactor")
        self.plant = plant
        self.config, self.control_min = config, control_min
        self._minutes, self._sampled = 0.0, False
        self._feed_s = np.zeros(plant.n)
        self._target = np.full(plant.n, np.nan)

    @property
    def names(self) -> tuple[str, ...]:
        return self.config.reactors

    def measure(self) -> Measurement:
        """Let the control period pass (with the dose of the last command) and read every sensor. Raises: nothing."""
        if self._sampled:
            self.plant.advance(self.control_min, self._feed_s, temperature_target=self._target)
            self._minutes += self.control_min
            self._feed_s = np.zeros(self.plant.n)
        self._sampled = True
        return Measurement(
            time_s=np.full(self.plant.n, self.elapsed()),
            od=self.plant.read_od(),
            temperature=self.plant.thermal.read(),
            fresh=np.ones(self.plant.n, dtype=np.bool_),
            fluorescence=None if self.plant.fluorescence is None else self.plant.read_fluorescence(),
        )

    def actuate(self, command: Command) -> Receipt:
        volume = np.where(command.rows, command.pump_rate, 0.0) * 60.0 * self.control_min
        self._feed_s = volume / self.config.pump_ml_s
        asked = command.rows & ~np.isnan(command.temperature)
        self._target = np.where(asked, command.temperature, self._target)
        return Receipt(volume_ml=volume)

    def elapsed(self) -> float:
        return 60.0 * self._minutes

    def pumps_off(self, rows: Mask) -> list[str]:
        """Cancel the pending doses of `rows`; this never fails."""
        self._feed_s = np.where(rows, 0.0, self._feed_s)
        return []

    def heat_off(self, rows: Mask) -> list[str]:
        """Switch the heater of `rows` off until a temperature is commanded; this never fails."""
        self._target = np.where(rows, 0.0, self._target)
        return []

    def regulate(self, rows: Mask, setpoint: Array) -> list[str]:
        self.pumps_off(rows)
        return [
            f"{name}: no on-board regulation in simulation, pumps off"
            for name, r in zip(self.names, rows, strict=True)
            if r
        ]

    def stop(self) -> None:
        self._feed_s = np.zeros(self.plant.n)


class SimulatedFamily(Family):
    """Vials in this process."""

    config = SimulatedConfig
    can = Can(fluorescence=True, spare_pumps=(3, 4), thermostat=True)
    called = "simulated vials"
    at_stake = False
    simulated = True

    @contextmanager
    def open(self, opening: Opening) -> Iterator[Reactor]:
        backend, bench = opening.backend, opening.bench
        volumes_ml = bench.volumes(backend.reactors)
        vials = Plant(opening.plant, len(backend.reactors), np.random.default_rng(backend.seed), volumes_ml)
        yield SimulatedReactors(vials, backend, bench.control_min)

    def vials(self, backend: SimulatedConfig, plant: PlantConfig) -> tuple[str, PlantConfig]:
        return "plant", plant

    def truth(self, reactors: Reactor) -> tuple[Plant | None, float]:
        if not isinstance(reactors, SimulatedReactors):
            return None, 1.0
        return reactors.plant, reactors.config.pump_ml_s

    def address(self, backend: SimulatedConfig) -> str:
        return "in this computer"

    def start_od(self, backend: SimulatedConfig, plant: PlantConfig) -> float:
        return plant.start_od


FAMILY = SimulatedFamily()
