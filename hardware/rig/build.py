"""Python environments with the vendor's package, one for each version, and Debian's broker."""

import hashlib
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

from hardware.errors import DeviceStateError
from hardware.pioreactor.config import PUBLISHED
from hardware.pioreactor.versions import TESTED, number

CACHE = Path("~/.cache/turbidostat/pioreactor").expanduser()
PYTHONS = ("python3.13", "python3.14", "python3.12")


def _python() -> str | None:
    """Find a Python of 3.12 or newer, whose syntax the vendor's package uses."""
    beside = sorted(Path("~/.pyenv/versions").expanduser().glob("3.1[2-4]*/bin/python"), reverse=True)
    found = [path for name in PYTHONS if (path := shutil.which(name))]
    return next((p for p in [*map(str, beside), *found] if _runs(p)), None)


def _runs(python: str) -> bool:
    """Return whether a Python starts; the placeholder of a version manager may not."""
    return subprocess.run([python, "-c", "import ensurepip"], capture_output=True, check=False).returncode == 0


def broker() -> str | None:
    return shutil.which("mosquitto") or shutil.which("/usr/sbin/mosquitto")


def home(package: str = PUBLISHED, folder: str = "") -> Path:
    """Return the path of a package's environment, built or not; name and content of a wheel identify it.

    Args: package: version on the package index, or path of a wheel. folder: folder of all environments, "": the user's
      cache.
    """
    wheel, key = Path(package).expanduser(), package.removeprefix("pioreactor==")
    if wheel.is_file():
        key = f"{wheel.stem}-{hashlib.sha256(wheel.read_bytes()).hexdigest()[:8]}"
    return (Path(folder).expanduser() if folder else CACHE) / key


def version(env: Path) -> str:
    return next(env.glob("lib/python*/site-packages/pioreactor-*.dist-info")).stem.split("-")[1]


def missing(package: str = PUBLISHED, folder: str = "") -> str:
    """Return what this computer lacks to build or run the rig, with the remedy; "" if nothing."""
    if broker() is None:
        return "no MQTT broker: apt-get install mosquitto"
    if package.endswith(".whl") and not Path(package).expanduser().is_file():
        return f"no wheel {package}: give the path of one, or a version like {PUBLISHED}"
    if not (home(package, folder) / "done").exists() and _python() is None:
        return "no Python 3.12 or newer for the vendor's package (26.x: 3.13): pyenv install 3.13"
    return ""


def newer() -> str:
    """Return a line on a version on the package index that is newer than the tested ones; "" if none is found."""
    ask = [sys.executable, "-m", "pip", "index", "versions", "pioreactor", "--python-version", "3.13", "--retries", "0"]
    said = subprocess.run(ask, capture_output=True, text=True, check=False).stdout
    found = re.match(r"pioreactor \(([\d.]+)\)", said)
    if found is None or number(found[1]) <= number(TESTED[-1]):
        return ""
    return (
        f"the package index has version {found[1]} of the vendor's software; the newest tested version is {TESTED[-1]}"
    )


def environment(package: str = PUBLISHED, folder: str = "") -> Path:
    """Build the environment of a package unless it exists. Raises: DeviceStateError naming what is missing."""
    if lack := missing(package, folder):
        raise DeviceStateError(f"the rig cannot be built: {lack}")
    env = home(package, folder)
    if (env / "done").exists():
        return env
    python, wheel = _python(), Path(package).expanduser()
    assert python is not None
    ours = ("PYTHONPATH", "VIRTUAL_ENV", "PYTHONHOME")  # with these Python imports this project's packages
    shutil.rmtree(env, ignore_errors=True)
    env.parent.mkdir(parents=True, exist_ok=True)
    found = f"{wheel.resolve()}[leader-worker]" if wheel.is_file() else f"pioreactor[leader-worker]=={env.name}"
    needed = (found, "PyYAML")  # the package needs PyYAML without declaring it
    for command in (
        [python, "-m", "venv", str(env)],
        [str(env / "bin" / "pip"), "install", "-q", "--disable-pip-version-check", *needed],
    ):
        variables = {k: v for k, v in os.environ.items() if k not in ours}
        ran = subprocess.run(command, capture_output=True, text=True, check=False, env=variables)
        if ran.returncode:
            reason = (ran.stderr.strip() or ran.stdout.strip() or "no output").splitlines()[-1]
            raise DeviceStateError(f"the rig cannot be built: {reason}; try {' '.join(command)}")
    (env / "done").touch()
    return env
