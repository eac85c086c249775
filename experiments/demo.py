"""The whole way in one command, `python -m experiments.demo`: calibrate, train, deploy, report.

Each step is the command a user would type, shown before it runs.
"""

import subprocess
import sys
import time
from pathlib import Path

__all__ = ["main"]


def commands(folder: Path) -> list[list[str]]:
    """The steps, each writing into its own folder below `folder`."""
    calibrated = folder / "1_calibrate" / "calibrated.yaml"
    policy = folder / "2_train" / "policy.npz"
    steps = [
        ["calibrate", f"hydra.run.dir={folder / '1_calibrate'}"],
        ["train", f"env_file={calibrated}", f"hydra.run.dir={folder / '2_train'}"],
        ["deploy", f"policy={policy}", f"env_file={calibrated}", f"hydra.run.dir={folder / '3_deploy'}"],
        ["report", f"run={folder}", f"hydra.run.dir={folder / '4_report'}"],
    ]
    return [["-m", f"experiments.{name}", *overrides] for name, *overrides in steps]


def main() -> None:
    """Entry point; exits with the status of the first step that fails."""
    folder = Path("runs") / "demo" / time.strftime("%Y-%m-%d_%H-%M-%S")
    for arguments in commands(folder):
        print("\n$ python", " ".join(arguments), flush=True)
        status = subprocess.run([sys.executable, *arguments], check=False).returncode
        if status:
            sys.exit(status)
    print(
        f"\npolicy    {folder / '2_train' / 'policy.npz'}"
        f"\nfigures   {folder / '2_train' / 'figures'}, {folder / '3_deploy' / 'figures'}"
        f"\nreport    {folder / 'report.html'}"
        f"\ncurves    tensorboard --logdir {folder}"
    )


if __name__ == "__main__":
    main()
