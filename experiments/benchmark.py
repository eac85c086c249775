"""Compare controllers on simulated reactors: `python -m experiments.benchmark`."""

from pathlib import Path

from experiments.cli import frame
from experiments.comparison.config import BenchmarkConfig


def benchmark(config: BenchmarkConfig, folder: Path) -> None:
    """Calibrate, train, run every closed loop, compare, draw, report."""
    from experiments.comparison import run  # Matplotlib and SciPy, only after the check of the config

    run.benchmark(config, folder)


main = frame.EntryPoint("benchmark", BenchmarkConfig(), benchmark)


if __name__ == "__main__":
    main()
