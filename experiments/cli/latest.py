"""Value `latest` of an argument: the newest output of a command below runs/."""

from collections.abc import Sequence
from pathlib import Path

ROOT = Path("runs")
WRITTEN = {
    "env_file": (("calibrate/**/calibrated.yaml", "demo/*/1_calibrate/calibrated.yaml"), "calibrate"),
    "plant_file": (("calibrate/**/twin.yaml", "demo/*/1_calibrate/twin.yaml"), "calibrate"),
    "runs": (("*/*/sweep.json",), "train -m 'seed=range(0,4)'"),
    "run": (("deploy/*/recordings", "demo/*/4_deploy/recordings"), "deploy"),
}
"""Key of an argument -> patterns of its files below runs/, and the command that writes them."""
FOLDERS = ("resume", "runs", "run")  # keys whose value is the folder of the file found


def newest(patterns: Sequence[str]) -> Path | None:
    """Return the newest file below `ROOT` that matches a pattern, None without one."""
    found = [path for pattern in patterns for path in ROOT.glob(pattern)]
    return max(found, key=lambda path: path.stat().st_mtime, default=None)


def resolved(arg: str, command: str) -> str:
    """Replace the value `latest` of `resume` and of the keys in `WRITTEN` by a path; return other arguments unchanged.

    Args: command: name of the command. Raises: ValueError if there is no such file, with the command that writes it.
    """
    key, _, value = arg.partition("=")
    name = key.lstrip("+")
    if value != "latest" or name not in (*WRITTEN, "resume") or (name == "run" and command != "mark"):
        return arg  # report itself finds the newest run of any command
    runs = tuple(f"{command}/*/{name}" for name in ("checkpoint.pt", "state.json", "sweep.json"))
    patterns, writer = WRITTEN.get(name, (runs, command))
    path = newest(patterns)
    if path is None:
        what = "no sweep" if name == "runs" else "no such output"
        raise ValueError(f"{arg}: {what} under {ROOT}/; run python -m experiments.{writer} first, or give a path")
    return f"{key}={path.parent if name in FOLDERS else path}"
