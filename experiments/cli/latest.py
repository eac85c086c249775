"""`latest`: the newest output of a command below runs/, as a value without a folder's name."""

from collections.abc import Sequence
from pathlib import Path

ROOT = Path("runs")
WRITTEN = {
    "env_file": (("calibrate/**/calibrated.yaml", "demo/*/1_calibrate/calibrated.yaml"), "calibrate"),
    "plant_file": (("calibrate/**/twin.yaml", "demo/*/1_calibrate/twin.yaml"), "calibrate"),
    "runs": (("*/*/sweep.json",), "train -m 'seed=range(0,4)'"),
    "run": (("deploy/*/recordings", "demo/*/4_deploy/recordings"), "deploy"),
}
"""Key -> where its files are below runs/, and the command that writes them."""
FOLDERS = ("resume", "runs", "run")  # keys that get the folder of the found file


def newest(patterns: Sequence[str]) -> Path | None:
    """Find the newest file that matches below `ROOT`, None if there is none."""
    found = [path for pattern in patterns for path in ROOT.glob(pattern)]
    return max(found, key=lambda path: path.stat().st_mtime, default=None)


def resolved(arg: str, command: str) -> str:
    """Replace `latest` of these keys and of `resume` by the path; return other arguments unchanged.

    Args: command: of the resumed run. Raises: ValueError without a file, with the command that writes it.
    """
    key, _, value = arg.partition("=")
    name = key.lstrip("+")
    if value != "latest" or name not in (*WRITTEN, "resume") or (name == "run" and command != "mark"):
        return arg  # report itself finds the newest run of any command
    runs = tuple(f"{command}/*/{name}" for name in ("checkpoint.pt", "state.json", "sweep.json"))
    patterns, writer = WRITTEN.get(name, (runs, command))
    path = newest(patterns)
    if path is None:
        what = "no sweep" if name == "runs" else "nothing of the kind"
        raise ValueError(f"{arg}: {what} under {ROOT}/; run python -m experiments.{writer} first, or give a path")
    return f"{key}={path.parent if name in FOLDERS else path}"
