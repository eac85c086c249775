"""Learn a pump policy on the calibrated growth model: `python -m experiments.train`."""

from pathlib import Path

from omegaconf import DictConfig

from experiments.cli import frame
from experiments.training.config import TrainConfig, agent_schema, env_schema


def train(config: TrainConfig, folder: Path) -> float:
    """Train, export and report; returns the objective of a sweep, the merit of the worst seed."""
    from experiments.training import run  # torch, only once the config has been checked

    return run.train(config, folder)


def _schema(cfg: DictConfig) -> TrainConfig:
    """Use for environment and agent the config of its kind."""
    env, agent = cfg.env.get("kind", "density"), cfg.agent.get("kind", "dqn")
    return TrainConfig(env=env_schema(str(env)), agent=agent_schema(str(agent)))


main = frame.Command("train", TrainConfig(), train, _schema, resumes="checkpoint.pt", goes_on=True)


if __name__ == "__main__":
    main()
