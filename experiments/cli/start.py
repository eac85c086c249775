"""First steps of a command, before its imports: check the origin of the packages, and handle Ctrl-C."""

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
    """Refuse Windows, and packages of other projects. Raises: SystemExit in a command, ImportError in a library."""
    first = Path(sys.argv[0] if sys.argv else "").name
    command = first in ("-m", "turbidostat")  # "-m" while the interpreter is still looking for the command
    if line := WINDOWS if sys.platform == "win32" else _other_package():
        raise SystemExit(f"error: {line}") if command else ImportError(line)
    if command:
        sys.excepthook = _shown


def _other_package() -> str | None:
    """Return an error if a user's folder, e.g. `envs/`, or an installed package hides a package of this project."""
    for name in PACKAGES:
        spec = find_spec(name)
        places = list(spec.submodule_search_locations or [str(spec.origin)]) if spec is not None else []
        if not places:
            return f"package {name} is missing in {HOME / name}; install the project again"
        if Path(places[0]).resolve() != (HOME / name).resolve():
            remedy = "rename the first one, or start the command from another folder"
            return f"package {name} is taken from {places[0]}, not from {HOME / name}; {remedy}"
    return None


def version() -> str:
    """Return name and version of this program, from pyproject.toml if the program is not installed."""
    try:
        return f"turbidostat-dqn {metadata.version('turbidostat-dqn')}"
    except metadata.PackageNotFoundError:
        found = re.search(r'^version = "([^"]+)"', (HOME / "pyproject.toml").read_text(encoding="utf-8"), re.MULTILINE)
        return f"turbidostat-dqn {found[1] if found else 'unknown'}"


def stopped() -> str:
    """Return the message of a stop before the start; a run to be resumed may have left a pump on."""
    words = sys.orig_argv
    deploys = any(Path(word).name in ("deploy", "deploy.py", "experiments.deploy") for word in words)
    resumed = deploys and any(word.lstrip("+").startswith("resume=") for word in words)
    return "stopped before the command started" + "; pumps not verified off: resume the run" * resumed


def _shown(kind: type[BaseException], error: BaseException, trace: TracebackType | None) -> None:
    """Print one line instead of a traceback if Ctrl-C stops the import of a command."""
    if issubclass(kind, KeyboardInterrupt):
        print(stopped(), file=sys.stderr)
    else:
        sys.__excepthook__(kind, error, trace)
