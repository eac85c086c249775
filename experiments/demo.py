"""The whole way in one command, `python -m experiments.demo`: calibrate, train, deploy, report.

Each step is the command a user would type, shown before it runs.
"""

import argparse
import os
import subprocess
import sys
import time
from contextlib import suppress
from pathlib import Path

from experiments.cli import stop

__all__ = ["main"]


def commands(folder: Path) -> list[list[str]]:
    """The steps, each writing into its own folder below `folder`."""
    calibrated = folder / "1_calibrate" / "calibrated.yaml"
    policy = folder / "2_train" / "policy.npz"
    steps = [
        ["calibrate", f"hydra.run.dir={folder / '1_calibrate'}"],
        ["train", f"env_file={calibrated}", "stop_within=1", f"hydra.run.dir={folder / '2_train'}"],
        ["deploy", f"policy={policy}", f"env_file={calibrated}", f"hydra.run.dir={folder / '3_deploy'}"],
        ["report", f"run={folder}", f"hydra.run.dir={folder / '4_report'}"],
    ]
    return [["-m", f"experiments.{name}", *overrides] for name, *overrides in steps]


def step(arguments: list[str], signals: list[int]) -> int:
    """Run one command to its end; returns its status, or that of a stopped command.

    It has a session of its own, so that a signal reaches it once, from here, however it was sent.
    Args: signals: come in here; each is passed on.
    """
    process, stopped = subprocess.Popen([sys.executable, *arguments], start_new_session=True), False
    while process.poll() is None:
        while signals:
            process.send_signal(signals.pop(0))
            stopped = True
        with suppress(subprocess.TimeoutExpired):
            process.wait(0.2)
    return stop.STATUS if stopped else process.returncode


def main() -> None:
    """Entry point; exits with the status of the first step that fails."""
    parser = argparse.ArgumentParser(prog="python -m experiments.demo", description=__doc__)
    _, others = parser.parse_known_args()
    if others:
        text = f"error: {others[0]}: the demo takes nothing but --help; values go to calibrate, train and deploy"
        print(text, file=sys.stderr)
        sys.exit(1)
    folder = Path("runs") / "demo" / f"{time.strftime('%Y-%m-%d_%H-%M-%S')}_{os.getpid()}"  # two demos never meet
    signals: list[int] = []
    with stop.handled(lambda number, _: signals.append(number), *stop.SIGNALS):
        for arguments in commands(folder):
            print("\n$ python", " ".join(arguments), flush=True)
            if status := step(arguments, signals):
                sys.exit(status)
    print(
        f"\npolicy    {folder / '2_train' / 'policy.npz'}"
        f"\nfigures   {folder / '2_train' / 'figures'}, {folder / '3_deploy' / 'figures'}"
        f"\nreport    {folder / 'report.html'}"
        f"\ncurves    tensorboard --logdir {folder}"
    )


if __name__ == "__main__":
    main()
