"""Learn a pump policy on the calibrated growth model: `python -m experiments.train`."""

from pathlib import Path

from experiments.cli import frame
from experiments.training.config import TrainConfig


def train(config: TrainConfig, folder: Path) -> float:
    """Train, export and report; returns the median regret, the objective of a sweep."""
    from experiments.training import run  # torch, only once the config has been checked

    return run.train(config, folder)


main = frame.Command("train", TrainConfig(), train, resumes="checkpoint.pt")


if __name__ == "__main__":
    main()
