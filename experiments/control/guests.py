"""What a guest may do to a run that is put together: complete its config, hold signals, and tell of both."""

from pathlib import Path

from envs.plant.plant import PlantConfig
from envs.scenario import Scenario
from experiments.control.config import DeployConfig
from experiments.loop.signals import Signal


class Guest:
    """One that adds nothing; every part may be left as it is."""

    def completed(self, config: DeployConfig, folder: Path | None) -> DeployConfig:
        """Fill in what the config leaves open. Args: folder: of the run, which may keep files; None for a dry run.

        Raises: ValueError, ReactorError or UserError for what does not fit.
        """
        return config

    def signals(
        self, config: DeployConfig, plant: PlantConfig, folder: Path, scenarios: list[Scenario]
    ) -> list[Signal]:
        """Build signals that are held beside the density. Args: scenarios: one per reactor. Raises: as `completed`."""
        return []

    def vials(self, config: DeployConfig) -> str:
        """Name the preset that it put in the place of the usual vials; "" for none."""
        return ""

    def deciders(self, config: DeployConfig) -> list[tuple[str, str]]:
        """List what decides beside the controller: of what, and its name."""
        return []

    def asked(self, scenario: Scenario, phase: int) -> str:
        """Tell what a phase asks for beside density and temperature, for the timetable; "" for nothing."""
        return ""


GUESTS: list[Guest] = []


def add(guest: Guest) -> None:
    """Let a guest take part in every run."""
    GUESTS.append(guest)
