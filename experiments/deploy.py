"""Run a controller in closed loop and record everything: `python -m experiments.deploy`."""

from pathlib import Path

from omegaconf import DictConfig

from experiments.cli import frame
from experiments.control.config import DeployConfig, deploy_schema


def deploy(config: DeployConfig, folder: Path) -> None:
    """One closed loop over the scenario."""
    from experiments.control import run  # matplotlib and SciPy, only once the config has been checked

    run.deploy(config, folder)


def _schema(cfg: DictConfig) -> DeployConfig:
    composition = cfg.get("composition")
    return deploy_schema(
        str(cfg.backend.kind), str(cfg.controller.kind), None if composition is None else str(composition.kind)
    )


main = frame.Command("deploy", DeployConfig(), deploy, _schema, resumes="state.json")


if __name__ == "__main__":
    main()
