"""Learn a pump policy on the calibrated growth model: `python -m experiments.train`."""

from pathlib import Path

from experiments.cli import frame
from experiments.training.config import TrainConfig


def train(config: TrainConfig, folder: Path) -> float:
    """Train, export and report; return the objective of a sweep, the merit of the worst seed."""
    from experiments.training import run  # torch, only after the check of the config

    return run.train(config, folder)


main = frame.EntryPoint("train", TrainConfig(), train, resumes="checkpoint.pt", goes_on=True)


if __name__ == "__main__":
    main()
