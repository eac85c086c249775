"""Compare controllers on simulated reactors: `python -m experiments.benchmark`."""

from pathlib import Path

from experiments.cli import frame
from experiments.comparison.config import BenchmarkConfig


def benchmark(config: BenchmarkConfig, folder: Path) -> None:
    """Calibrate and train, run every closed loop, compare the results, draw and report them."""
    from experiments.comparison import run  # loads Matplotlib and SciPy, so only after the config is checked

    run.benchmark(config, folder)


main = frame.EntryPoint("benchmark", BenchmarkConfig(), benchmark)


if __name__ == "__main__":
    main()
