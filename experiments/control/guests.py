"""Interface by which a guest package takes part in a run: complete the config, add signals, describe both."""

from pathlib import Path

from envs.plant.plant import PlantConfig
from envs.scenario import Scenario
from experiments.control.config import DeployConfig
from experiments.loop.signals import Signal


class Guest:
    """Base class of guests. It adds nothing to a run; a guest overrides the methods that it needs."""

    def completed(self, config: DeployConfig, folder: Path | None) -> DeployConfig:
        """Return the config with missing parts filled in. Args: folder: run folder for files; None for a dry run.

        Raises: ValueError, ReactorError or UserError if parts of the config do not fit together.
        """
        return config

    def signals(
        self, config: DeployConfig, plant: PlantConfig, folder: Path, scenarios: list[Scenario]
    ) -> list[Signal]:
        """Build the guest's signals. Args: scenarios: one per reactor. Raises: as `completed`."""
        return []

    def vials(self, config: DeployConfig) -> str:
        """Return the plant preset that `completed` uses instead of the usual vials; "" for none."""
        return ""

    def deciders(self, config: DeployConfig) -> list[tuple[str, str]]:
        """List the guest's controllers: (controlled quantity, kind of its controller)."""
        return []

    def asked(self, scenario: Scenario, phase: int) -> str:
        """Return the guest's setpoints in a phase as text for the timetable; "" for none."""
        return ""


GUESTS: list[Guest] = []


def add(guest: Guest) -> None:
    """Register a guest; it then takes part in every run."""
    GUESTS.append(guest)
