"""Settings that two species add to the core's configs, and functions that read the files named there."""

import logging
from dataclasses import replace
from pathlib import Path
from typing import Any, cast

import numpy as np
from omegaconf import DictConfig

from conf.schema import part, require, setting
from envs.coculture.pair import FILE, PairConfig, named_pair
from envs.coculture.second import of_plant
from envs.coculture.task import SCALES, CocultureConfig
from experiments.cli import files, frame
from experiments.coculture.base import SHARE
from experiments.coculture.program import composed
from experiments.coculture.signal import ShareWarnings
from experiments.comparison.config import BenchmarkConfig, StudyConfig
from experiments.control.config import DeployConfig
from experiments.laws import registry
from experiments.training.config import TrainConfig
from hardware.errors import RecordingError
from hardware.storage.journal import read_journal

log = logging.getLogger(__name__)

USUAL = "ecoli_pputida"


class OfDeploy:
    """Two-species options of `deploy`."""

    composition: Any = setting(
        None,
        "composition controller, a preset of `composition`; null: midpoint if the scenario has a composition",
        kinds=registry.config_at,
    )
    composition_policy: str = setting(
        "shipped",
        "policy of composition=dqn and dqn_preview: `shipped`, a policy.npz, or the run folder of a training or "
        "deployment",
    )
    share_warnings: ShareWarnings = part(ShareWarnings, "when to warn that the composition is out of control")
    pair: str = setting(
        USUAL, "the two species: a preset of conf/strains, a pair.yaml of calibrate_pair, or its run folder"
    )


class OfEmulator:
    """Two-species options of the emulator."""

    pair: str = setting(USUAL, "two species: a preset of conf/strains, or a pair.yaml")


class OfTrain:
    """Two-species options of `train`."""

    pair: str | None = setting(
        None,
        "two species: a preset of conf/strains, a pair.yaml of calibrate_pair, or its run folder; null: env.pair",
    )

    def __post_init__(self) -> None:
        of_two = isinstance(cast(TrainConfig, self).env, CocultureConfig)
        allowed = "null for a task of one species; to train with two species, add env=coculture_preview"
        require(self.pair is None or of_two, "pair", self.pair, allowed)


class OfStudy:
    """Two-species options of a study of `benchmark`."""

    compositions: tuple[str, ...] = setting(
        (), "names of composition controllers; each is combined with every controller of the density"
    )
    announced: bool = setting(True, "whether changes of the share's setpoint are announced as in the scenario")
    calibrated: bool = setting(False, "whether each reactor's light sensor is calibrated")


class OfBenchmark:
    """Two-species options of `benchmark`."""

    pair: str = setting(
        USUAL, "the two species: a preset of conf/strains, a pair.yaml of calibrate_pair, or its run folder"
    )
    compositions: dict[str, Any] = setting({}, "composition controllers by name", kinds=registry.config_at)
    composition_policies: dict[str, str] = setting(
        {}, "policies of learned composition controllers by name: `shipped`, a policy.npz or a run folder"
    )

    def __post_init__(self) -> None:
        config = cast(BenchmarkConfig, self)
        learned = [k for k, c in self.compositions.items() if registry.takes(c.kind, "policy", SHARE)]
        for name in self.composition_policies:
            require(
                name in learned, "composition_policies", name, ", ".join(learned) or "none: no controller needs one"
            )
        of_two = {name: study for name, study in config.studies.items() if of_study(study).compositions}
        same = len(of_two) in (0, len(config.studies))
        require(same, "studies", ", ".join(config.studies), "studies that all have compositions, or all have none")
        asks = [key for key, s in config.scenarios.items() if composed(s)]
        plants = [key for key, p in config.plants.items() if of_plant(p).second.present]
        for name, study in of_two.items():
            for key, given, having, known in (
                ("compositions", of_study(study).compositions, "", [*self.compositions]),
                ("scenarios", study.scenarios, "scenarios with ratios: ", asks),
                ("plants", study.plants, "plants with two species: ", plants),
            ):
                wrong = next((one for one in given if one not in known), None)
                require(wrong is None, f"studies.{name}.{key}", wrong, f"{having}{', '.join(known)}")


def of_study(study: StudyConfig) -> OfStudy:
    return cast(OfStudy, study)


def of_benchmark(config: BenchmarkConfig) -> OfBenchmark:
    return cast(OfBenchmark, config)


def of_deploy(config: DeployConfig) -> OfDeploy:
    return cast(OfDeploy, config)


def read_pair(name: str) -> PairConfig:
    """Read two species from a preset of conf/strains, or from a pair.yaml or the run folder of `calibrate_pair`.

    Raises: UserError with the known presets, or with the file and the reason.
    """
    with frame.refusing(ValueError):
        return named_pair(name)


def completed(config: TrainConfig) -> TrainConfig:
    """Return a training config whose task has the pair and the growth curves (`env_file`). Raises: UserError."""
    pair, env = cast(OfTrain, config).pair, config.env
    if config.env_file is not None:
        env = read_curves(config.env_file, env)
    if pair is not None and config.resume is None:  # env.pair of a resumed run already has the species
        with frame.refusing(ValueError):
            env = replace(env, pair=read_pair(pair))
    return config if env is config.env else replace(config, env=env, env_file=None)


def read_curves(run: str, env: CocultureConfig) -> CocultureConfig:
    """Return a task with the species of a deployment and the growth curves that it estimated last.

    Args: run: run folder of a deployment that controlled the share in one reactor, or, if in several reactors,
      RUN/recordings/NAME.csv of one reactor. Raises: UserError naming what is missing.
    """
    path, wanted = Path(run), None
    if path.suffix == ".csv":
        path, wanted = path.resolve().parents[1], path.stem
    remedy = "give the folder of a deployment with composition control, or RUN/recordings/NAME.csv of one reactor of it"
    try:
        rows, _ = read_journal(path / "journal.jsonl")
        stored = files.load_yaml(path / "config.yaml")
    except (RecordingError, OSError, ValueError) as error:
        raise frame.UserError(f"env_file={run}: {error}; {remedy}") from None
    newest = {
        row["reactor"]: row["why"]
        for row in rows
        if row["kind"] == "decision" and row.get("why", {}).get("bias_e") is not None
    }
    if wanted is None and len(newest) > 1:
        each = ", ".join(str(path / "recordings" / f"{name}.csv") for name in newest)
        raise frame.UserError(f"env_file={run}: several reactors with different growth curves; give one of {each}")
    if not newest or wanted not in (None, *newest):
        raise frame.UserError(f"env_file={run}: no estimated growth curves of two species; {remedy}")
    name, why = (wanted, newest[wanted]) if wanted else next(iter(newest.items()))
    scales = [float(np.clip(1.0 + why[key], *SCALES)) for key in ("bias_e", "bias_p")]
    known = [f"{scale:.3f} times" for scale in scales]
    log.info("growth estimated in %s, %s: %s and %s that of the pair", path, name, *known)
    own = stored.get("pair") if isinstance(stored, DictConfig) else None
    pair = read_pair(str(path) if (path / FILE).is_file() else str(own or USUAL))
    with frame.refusing(ValueError):
        return replace(env, pair=pair, scale_e=scales[0], scale_p=scales[1])
