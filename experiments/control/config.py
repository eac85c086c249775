"""What each entry point can be told: the typed schema behind conf/*.yaml. Light to import: no torch, no matplotlib."""

from __future__ import annotations

from dataclasses import dataclass, field, fields, replace
from typing import Any

from dqn.config import DQNConfig
from envs.plant.plant import PlantConfig
from envs.scenario import Scenario
from envs.task import EnvConfig
from experiments.controllers.learned import LearnedConfig
from hardware.chibio.config import ChiBioConfig, EmulatorConfig
from hardware.safety.config import SafetyConfig
from hardware.simulated import SimulatedConfig

__all__ = ["BACKENDS", "DeployConfig", "TrainConfig", "controller_config", "deploy_schema"]


@dataclass(frozen=True)
class TrainConfig:
    """`python -m experiments.train`. Raises: ValueError naming key, value and allowed range."""

    env: EnvConfig = field(default_factory=EnvConfig)
    agent: DQNConfig = field(default_factory=DQNConfig)
    env_file: str | None = None  # a calibrated.yaml; replaces `env`
    seed: int = 0  # of the first agent
    n_agents: int = 1  # agents with seeds seed, seed + 1, ... trained in one process
    device: str = "cpu"  # cpu | cuda
    threads: int | None = None  # groups of 16 agents trained at the same time; None: one per core; no effect on results
    eval_every: int = 250  # steps between evaluations of the greedy policy
    checkpoint_every: int = 1000  # steps between checkpoints
    resume: str | None = None  # a run folder to continue

    def __post_init__(self) -> None:
        """Check every range once, where the value enters."""
        checks = (
            ("seed", self.seed, self.seed >= 0, "at least 0"),
            ("n_agents", self.n_agents, 1 <= self.n_agents <= 100_000, "1 to 100000"),
            ("device", self.device, self.device in ("cpu", "cuda"), "cpu or cuda"),
            (
                "threads",
                self.threads,
                self.threads is None or self.threads >= 1,
                "at least 1, or null",
            ),
            ("eval_every", self.eval_every, self.eval_every >= 1, "at least 1 step"),
            ("checkpoint_every", self.checkpoint_every, self.checkpoint_every >= 1, "at least 1 step"),
        )
        for key, value, ok, allowed in checks:
            if not ok:
                raise ValueError(f"{key} = {value}: allowed {allowed}")


BACKENDS: dict[str, type[Any]] = {"sim": SimulatedConfig, "chibio": ChiBioConfig, "emulator": EmulatorConfig}


@dataclass(frozen=True)
class DeployConfig:
    """`python -m experiments.deploy`."""

    backend: Any = field(default_factory=SimulatedConfig)  # one of BACKENDS
    plant: PlantConfig = field(default_factory=PlantConfig)  # of a simulated backend
    safety: SafetyConfig = field(default_factory=SafetyConfig)
    scenario: Scenario = field(default_factory=Scenario)
    each: dict[str, Any] = field(default_factory=dict)  # reactor -> what differs from `scenario`, and its `role`
    controller: Any = field(default_factory=LearnedConfig)  # one of `controller_config`
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
                schedules.append(replace(self.scenario, **own))
            except (TypeError, ValueError) as error:
                raise ValueError(f"each.{name}: {error}") from None
        return schedules

    def role(self, reactor: str) -> str:
        """What a reactor is for, in words of the user."""
        return str(self.each.get(reactor, {}).get("role", "replicate"))


def controller_config(kind: str) -> Any:
    """The default config of the controller of this kind. Raises: ValueError naming the kinds there are."""
    from experiments.controllers.baselines import HoldConfig, ThresholdConfig
    from experiments.controllers.inverse import InverseConfig
    from experiments.controllers.mpc import MpcConfig
    from experiments.controllers.oracle import OracleConfig
    from experiments.controllers.pi import ChiBioPIConfig, TunedPIConfig

    kinds = (
        LearnedConfig(), ChiBioPIConfig(), TunedPIConfig(), MpcConfig(), InverseConfig(), ThresholdConfig(),
        HoldConfig(), OracleConfig(),
    )  # fmt: skip
    known = {config.kind: config for config in kinds}
    if kind not in known:
        raise ValueError(f"controller.kind = {kind}: allowed {', '.join(known)}")
    return known[kind]


def deploy_schema(kind: str, controller: str = "dqn") -> DeployConfig:
    """The schema for the backend and controller of these kinds. Raises: ValueError naming the kinds there are."""
    if kind not in BACKENDS:
        raise ValueError(f"backend.kind = {kind}: allowed {', '.join(BACKENDS)}")
    return DeployConfig(backend=BACKENDS[kind](), controller=controller_config(controller))
