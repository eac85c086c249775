"""`latest`: what a command wrote last below runs/, so that a line can be typed without a folder's name."""

from collections.abc import Sequence
from pathlib import Path

__all__ = ["ROOT", "newest", "resolved"]

ROOT = Path("runs")
WRITTEN = {
    "env_file": (("calibrate/**/calibrated.yaml", "demo/*/1_calibrate/calibrated.yaml"), "calibrate"),
    "plant_file": (("calibrate/**/twin.yaml", "demo/*/1_calibrate/twin.yaml"), "calibrate"),
    "runs": (("*/*/sweep.json",), "train -m 'seed=range(0,4)'"),
    "run": (("deploy/*/recordings", "demo/*/4_deploy/recordings"), "deploy"),
}
"""Key -> where its files are below runs/, and the command that writes them."""
FOLDERS = ("resume", "runs", "run")  # keys that are given the folder of the file that is found


def newest(patterns: Sequence[str]) -> Path | None:
    """Find the newest file that matches below `ROOT`, None if there is none."""
    found = [path for pattern in patterns for path in ROOT.glob(pattern)]
    return max(found, key=lambda path: path.stat().st_mtime, default=None)


def resolved(arg: str, command: str) -> str:
    """`latest` of these keys and of `resume` with the path in its place, any other word as it is.

    Args: command: whose run is resumed.
    Raises: ValueError where nothing was written yet, saying what writes it.
    """
    key, _, value = arg.partition("=")
    name = key.lstrip("+")
    if value != "latest" or name not in (*WRITTEN, "resume") or (name == "run" and command != "mark"):
        return arg  # report finds the newest run of any command by itself
    runs = tuple(f"{command}/*/{name}" for name in ("checkpoint.pt", "state.json", "sweep.json"))
    patterns, writer = WRITTEN.get(name, (runs, command))
    path = newest(patterns)
    if path is None:
        what = "no sweep" if name == "runs" else "nothing of the kind"
        raise ValueError(f"{arg}: {what} under {ROOT}/; run python -m experiments.{writer} first, or give a path")
    return f"{key}={path.parent if name in FOLDERS else path}"
