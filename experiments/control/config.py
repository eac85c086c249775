"""What the entry points can be told. Light to import: no torch, no matplotlib."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from typing import Any

from conf.schema import check, old_name, part, setting
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

    env: EnvConfig = part(EnvConfig, "the training model and its episodes")
    agent: DQNConfig = part(DQNConfig, "the agent's hyper-parameters")
    env_file: str | None = setting(None, "a calibrated.yaml; replaces env")
    seed: int = setting(0, "of the first agent", at_least=0)
    n_agents: int = setting(1, "with seeds seed, seed + 1, ... in one process", within=(1, 100_000))
    device: str = setting("cpu", "where networks are trained", choices=("cpu", "cuda"))
    threads: int | None = setting(
        None, "groups of 16 agents trained at the same time; null: one per core. No effect on results", at_least=1
    )
    eval_every: int = setting(
        250, "between evaluations of the greedy policy on the selection grid", "steps", at_least=1
    )
    checkpoint_every: int = setting(1000, "between checkpoints", "steps", at_least=1)
    resume: str | None = setting(None, "a run folder to continue")

    def __post_init__(self) -> None:
        check(self)


BACKENDS: dict[str, type[Any]] = {"sim": SimulatedConfig, "chibio": ChiBioConfig, "emulator": EmulatorConfig}


@dataclass(frozen=True)
class DeployConfig:
    """`python -m experiments.deploy`."""

    backend: Any = part(SimulatedConfig, "what is controlled")
    plant: PlantConfig = part(PlantConfig, "what the vials of a simulated backend are")
    safety: SafetyConfig = part(SafetyConfig, "limits of the interlock")
    scenario: Scenario = part(Scenario, "what the culture is asked to do")
    each: dict[str, Any] = setting(
        {}, "what differs for single reactors: each.M1.setpoints=[0.5] each.M1.minutes=[60] each.M1.role=control"
    )
    controller: Any = part(LearnedConfig, "what decides the pump rate")
    policy: str = setting(
        "latest", "of controller=dqn: a policy.npz, a run folder, or `latest`: of the newest training run under runs/"
    )
    env_file: str | None = setting(None, "a calibrated.yaml whose model the simulated plant takes")
    fsync: bool = setting(True, "every row on the disk before the next command")
    preflight_only: bool = setting(False, "check the device and stop")
    resume: str | None = setting(None, "a run folder to continue after a crash")

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
        raise ValueError(old_name(f"controller.kind={kind}") or f"controller.kind = {kind}: allowed {', '.join(known)}")
    return known[kind]


def deploy_schema(kind: str, controller: str = "dqn") -> DeployConfig:
    """The schema for the backend and controller of these kinds. Raises: ValueError naming the kinds there are."""
    if kind not in BACKENDS:
        raise ValueError(f"backend.kind = {kind}: allowed {', '.join(BACKENDS)}")
    return DeployConfig(backend=BACKENDS[kind](), controller=controller_config(controller))
