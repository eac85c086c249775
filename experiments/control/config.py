"""What a closed loop is told: reactors, controller, scenario and safety."""

from __future__ import annotations

from dataclasses import dataclass, field, fields, replace
from typing import Any

from envs.plant.plant import PlantConfig
from envs.scenario import Scenario
from experiments.controllers import registry
from experiments.controllers.learned import LearnedConfig
from hardware.chibio.config import ChiBioConfig, EmulatorConfig
from hardware.safety.config import SafetyConfig
from hardware.simulated import SimulatedConfig

__all__ = ["BACKENDS", "DeployConfig", "deploy_schema"]


BACKENDS: dict[str, type[Any]] = {"sim": SimulatedConfig, "chibio": ChiBioConfig, "emulator": EmulatorConfig}


@dataclass(frozen=True)
class DeployConfig:
    """`python -m experiments.deploy`."""

    backend: Any = field(default_factory=SimulatedConfig)  # one of BACKENDS
    plant: PlantConfig = field(default_factory=PlantConfig)  # of a simulated backend
    safety: SafetyConfig = field(default_factory=SafetyConfig)
    scenario: Scenario = field(default_factory=Scenario)
    each: dict[str, Any] = field(default_factory=dict)  # reactor -> what differs from `scenario`, and its `role`
    controller: Any = field(default_factory=LearnedConfig)  # of a kind of `controllers.registry`
    policy: str = "latest"  # of controller=dqn: a policy.npz, a run folder, or `latest`
    env_file: str | None = None  # a calibrated.yaml; its model becomes the simulated plant's
    fsync: bool = True  # every row on the disk before the next command
    preflight_only: bool = False  # check the device and stop
    resume: str | None = None  # a run folder to continue

    def schedules(self) -> list[Scenario]:
        """One schedule per reactor. Raises: ValueError naming reactor, key and what is allowed."""
        unknown = [name for name in self.each if name not in self.backend.reactors]
        if unknown:
            raise ValueError(f"each.{unknown[0]}: no such reactor; allowed {', '.join(self.backend.reactors)}")
        schedules = []
        for name in self.backend.reactors:
            given = self.each.get(name, {})
            if not isinstance(given, dict):
                raise ValueError(f"each.{name} = {given}: allowed keys and values, as each.{name}.minutes=[90]")
            own = {k: v for k, v in given.items() if k != "role"}
            wrong = set(own) - {f.name for f in fields(Scenario)}
            if wrong:
                allowed = ", ".join([f.name for f in fields(Scenario)] + ["role"])
                raise ValueError(f"each.{name}.{sorted(wrong)[0]}: no such key; allowed {allowed}")
            try:
                schedules.append(replace(self.scenario, **own) if own else self.scenario)
            except (TypeError, ValueError) as error:
                raise ValueError(f"each.{name}: {error}") from None
        return schedules

    def role(self, reactor: str) -> str:
        """What a reactor is for, in words of the user."""
        return str(self.each.get(reactor, {}).get("role", "replicate"))


def deploy_schema(kind: str, controller: str = "dqn") -> DeployConfig:
    """The schema for the backend and controller of these kinds. Raises: ValueError naming the kinds there are."""
    if kind not in BACKENDS:
        raise ValueError(f"backend.kind = {kind}: allowed {', '.join(BACKENDS)}")
    return DeployConfig(backend=BACKENDS[kind](), controller=registry.config(controller))
