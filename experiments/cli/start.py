"""Checks before a command imports anything: origin of the packages, and Ctrl-C during the start."""

import re
import sys
from importlib import metadata
from importlib.util import find_spec
from pathlib import Path
from types import TracebackType

PACKAGES = ("conf", "dqn", "envs", "hardware")
HOME = Path(__file__).parents[2]  # folder of all packages of this project
WINDOWS = "this program needs Linux or macOS; on Windows run it inside WSL (wsl --install)"


def begin() -> None:
    """Refuse packages of other projects. Raises: SystemExit with one line for a command, ImportError for a library."""
    first = Path(sys.argv[0] if sys.argv else "").name
    command = first in ("-m", "turbidostat")  # the interpreter still searches the command, or the script imports it
    if line := WINDOWS if sys.platform == "win32" else _other_package():
        raise SystemExit(f"error: {line}") if command else ImportError(line)
    if command:
        sys.excepthook = _shown


def _other_package() -> str | None:
    """Find a user's folder `envs/`, or another installed package of that name, that shadows this project's."""
    for name in PACKAGES:
        spec = find_spec(name)
        places = list(spec.submodule_search_locations or [str(spec.origin)]) if spec is not None else []
        if not places:
            return f"package {name} is missing, it belongs to {HOME / name}; install the project again"
        if Path(places[0]).resolve() != (HOME / name).resolve():
            remedy = "rename that one, or start the command from another folder"
            return f"package {name} is taken from {places[0]}, not from {HOME / name}; {remedy}"
    return None


def version() -> str:
    """Write name and version of this program; from pyproject.toml if it is not installed."""
    try:
        return f"turbidostat-dqn {metadata.version('turbidostat-dqn')}"
    except metadata.PackageNotFoundError:
        found = re.search(r'^version = "([^"]+)"', (HOME / "pyproject.toml").read_text(encoding="utf-8"), re.MULTILINE)
        return f"turbidostat-dqn {found[1] if found else 'unknown'}"


def stopped() -> str:
    """Write the message of a stop before the start; the run to resume may have left a pump on."""
    words = sys.orig_argv
    deploys = any(Path(word).name in ("deploy", "deploy.py", "experiments.deploy") for word in words)
    resumed = deploys and any(word.lstrip("+").startswith("resume=") for word in words)
    return "stopped before anything began" + "; pumps not verified off: resume the run" * resumed


def _shown(kind: type[BaseException], error: BaseException, trace: TracebackType | None) -> None:
    """Handle Ctrl-C during the import of a command without a useless traceback."""
    if issubclass(kind, KeyboardInterrupt):
        print(stopped(), file=sys.stderr)
    else:
        sys.__excepthook__(kind, error, trace)
