"""Config of `python -m experiments.benchmark`."""

from dataclasses import dataclass
from typing import Any, NamedTuple

from conf.schema import check, part, require, setting
from envs.plant.plant import PlantConfig
from envs.scenario import Scenario
from envs.task import EnvConfig
from experiments.laws import registry
from experiments.training.config import agent_schema

TWIN = "twin"  # name of the plant that plant_file describes


@dataclass(frozen=True)
class StudyConfig:
    """Study that runs every controller on every plant in every scenario; all are named by their keys in the config."""

    scenarios: tuple[str, ...] = setting(("setpoint_steps",), "names of scenarios")
    plants: tuple[str, ...] = setting(("nominal_noise",), "names of plants")
    controllers: tuple[str, ...] = setting(("dqn", "pi", "mpc"), "names of controllers")


@dataclass(frozen=True)
class BenchmarkConfig:
    """Config of a benchmark: the closed loops to compare. Raises: ValueError with key, value and allowed values."""

    replicates: int = setting(
        3, "vials per controller, plant and scenario (paper: 3), run as one batch", within=(1, 10_000)
    )
    seed: int = setting(
        0, "random seed of plants, noise, training and calibration; all controllers use the same seed", at_least=0
    )
    env: EnvConfig = part(EnvConfig, "culture model that model-based controllers and training use")
    agents: dict[str, Any] = setting({}, "learned controllers by name", kinds=agent_schema)
    train_seeds: int = setting(4, "seeds per agent; the best policy on the selection grid is used", within=(1, 1000))
    workers: int = setting(
        0, "processes for the closed loops; 0: one per core, 1: no extra process. No effect on results", within=(0, 256)
    )
    policies: dict[str, str] = setting(
        {},
        "trained policies by controller's name: a policy.npz, a run folder, `shipped`, or the folder policies/ of a "
        "training (one row per seed). A learned controller with neither policy nor agent uses `shipped`",
    )
    calibration: bool = setting(False, "simulate and fit the open-loop protocol (Fig. 2a)")
    training: bool = setting(False, "train all agents, also those that no study needs (Fig. 2b)")
    plants: dict[str, PlantConfig] = setting({}, "plants by name")
    plant_file: str | None = setting(
        None, "twin.yaml written by calibrate, used as plant `twin`; each vial starts at a random time of its recording"
    )
    scenarios: dict[str, Scenario] = setting({}, "scenarios by name")
    controllers: dict[str, Any] = setting({}, "controllers by name", kinds=registry.config_at)
    studies: dict[str, StudyConfig] = setting({}, "comparisons by name; the recipes of experiment/ define them")

    def __post_init__(self) -> None:
        check(self)
        for name, study in self.studies.items():
            for key in ("scenarios", "plants", "controllers"):
                known = [*getattr(self, key)]
                if key == "plants":
                    known += [TWIN if self.plant_file else f"{TWIN} (with plant_file=FILE)"]
                wrong = next((given for given in getattr(study, key) if given not in known), None)
                require(wrong is None, f"studies.{name}.{key}", wrong, ", ".join(known))
        for name, scenario in self.scenarios.items():
            given = *scenario.until, *scenario.outputs
            require(not any(given), f"scenarios.{name}", given, "no until and no outputs in a comparison")
        met = any(TWIN in study.plants for study in self.studies.values())
        wanted = f"null, or a study that uses it: studies.NAME.plants=[nominal,{TWIN}]"
        require(met or self.plant_file is None, "plant_file", self.plant_file, wanted)


SETTLING_MIN = 10.0
"""The paper's average settling time at a setpoint of 0.5, min. The paper does not define the band."""


class Published(NamedTuple):
    """ISE and ITAE of a controller in the paper (Brancato et al., L4DC 2024, Table 2): real reactors, 3 replicates.

    window: label of the setpoint or temperature. ise, itae: with T = 1 min, which the paper does not state.
    """

    scenario: str
    window: str
    setpoint: float
    controller: str
    ise: float
    itae: float


TABLE_2 = tuple(
    Published(scenario, window, setpoint, controller, ise, itae)
    for scenario, window, setpoint, *scores in (
        ("setpoint_steps", "0.8", 0.8, (0.039, 12.21), (0.046, 12.38), (0.035, 10.44)),
        ("setpoint_steps", "0.65", 0.65, (0.032, 11.90), (0.039, 10.50), (0.092, 9.38)),
        ("setpoint_steps", "0.5", 0.5, (0.051, 7.43), (0.111, 11.49), (0.117, 12.98)),
        ("temperature_switch", "37", 0.5, (0.045, 12.42), (0.033, 9.65), (0.032, 11.60)),
        ("temperature_switch", "30", 0.5, (0.031, 11.84), (0.025, 9.12), (0.042, 11.54)),
    )
    for controller, (ise, itae) in zip(("dqn", "pi", "mpc"), scores, strict=True)
)
