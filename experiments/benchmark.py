"""Controllers side by side on simulated reactors, `python -m experiments.benchmark`: the paper and beyond it."""

from pathlib import Path

from omegaconf import DictConfig

from experiments.cli import frame
from experiments.comparison.config import BenchmarkConfig
from experiments.laws import registry
from experiments.training.config import agent_schema


def benchmark(config: BenchmarkConfig, folder: Path) -> None:
    """Calibrate, train, run every closed loop, compare, draw, report."""
    from experiments.comparison import run  # Matplotlib and SciPy, only once the config has been checked

    run.benchmark(config, folder)


def _schema(cfg: DictConfig) -> BenchmarkConfig:
    """Use for each agent, controller and composition the config of its kind."""
    return BenchmarkConfig(
        agents={str(name): agent_schema(str(c.get("kind", "dqn"))) for name, c in cfg.agents.items()},
        controllers={str(name): registry.config(str(c.kind)) for name, c in cfg.controllers.items()},
        compositions={str(name): registry.config(str(c.kind), registry.SHARE) for name, c in cfg.compositions.items()},
    )


main = frame.Command("benchmark", BenchmarkConfig(), benchmark, _schema)


if __name__ == "__main__":
    main()
