"""Train a pump policy on the calibrated growth model: `python -m experiments.train`."""

from pathlib import Path

from experiments.cli import frame
from experiments.training.config import TrainConfig


def train(config: TrainConfig, folder: Path) -> float:
    """Train, export and report; return the merit of the worst seed, which is the objective of a sweep."""
    from experiments.training import run  # loads torch, so only after the config is checked

    return run.train(config, folder)


main = frame.EntryPoint("train", TrainConfig(), train, resumes="checkpoint.pt", goes_on=True)


if __name__ == "__main__":
    main()
