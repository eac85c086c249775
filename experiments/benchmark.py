"""Controllers side by side on simulated reactors, `python -m experiments.benchmark`: the paper and beyond it."""

from pathlib import Path

from experiments.cli import frame
from experiments.comparison.config import BenchmarkConfig


def benchmark(config: BenchmarkConfig, folder: Path) -> None:
    """Calibrate, train, run every closed loop, compare, draw, report."""
    from experiments.comparison import run  # Matplotlib and SciPy, only once the config has been checked

    run.benchmark(config, folder)


main = frame.EntryPoint("benchmark", BenchmarkConfig(), benchmark)


if __name__ == "__main__":
    main()
