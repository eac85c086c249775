"""Run a controller in closed loop and record everything: `python -m experiments.deploy`."""

import os
from datetime import datetime
from pathlib import Path

from experiments.cli import frame
from experiments.control.config import DeployConfig
from experiments.control.notify import hidden


def deploy(config: DeployConfig, folder: Path) -> None:
    """Run one closed loop over the scenario."""
    from experiments.control import run  # loads Matplotlib and SciPy, so only after the config is checked

    if config.dry_run:
        raise frame.UserError("dry_run=true: a sweep has no timetable; drop --multirun")
    run.deploy(config, folder)


class _Deploy(frame.EntryPoint[DeployConfig]):
    """Entry point of `deploy`: `dry_run=true` makes no run folder, and the hook's address is kept out of all files."""

    def _answer(self, given: list[str]) -> None:
        given = hidden(given, os.environ)
        plain = [a for a in given if not a.startswith("-")]
        if len(plain) < len(given) or not self.config(plain).dry_run:
            super()._answer(given)
            return
        from experiments.control.timetable import timetable

        named = [a.removeprefix("hydra.run.dir=") for a in plain if a.startswith("hydra.run.dir=")]
        place = named[-1] if named else "a new folder of runs/deploy/"
        print(timetable(self.config(plain), place, datetime.now()))


main = _Deploy("deploy", DeployConfig(), deploy, resumes="state.json")


if __name__ == "__main__":
    main()
