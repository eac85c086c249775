"""The vendor's published package in an environment of its own, and Debian's broker."""

import os
import shutil
import subprocess
from pathlib import Path

from hardware.errors import DeviceStateError

__all__ = ["CACHE", "VERSION", "broker", "environment", "missing"]

VERSION = "25.11.19"
CACHE = Path("~/.cache/turbidostat/pioreactor").expanduser()
PACKAGES = (f"pioreactor[leader-worker]=={VERSION}", "PyYAML")  # the second is needed and not declared
PYTHONS = ("python3.13", "python3.14", "python3.12")
BROKERS = ("mosquitto", "/usr/sbin/mosquitto")


def _python() -> str | None:
    """A Python of 3.12 or newer: the vendor's package is written in its syntax."""
    beside = sorted(Path("~/.pyenv/versions").expanduser().glob("3.1[2-4]*/bin/python"), reverse=True)
    found = [path for name in PYTHONS if (path := shutil.which(name))]
    return next((p for p in [*map(str, beside), *found] if _runs(p)), None)


def _runs(python: str) -> bool:
    """Whether it starts at all: a version manager's stand-in may not."""
    return subprocess.run([python, "-c", "import ensurepip"], capture_output=True, check=False).returncode == 0


def broker() -> str | None:
    """The path of the MQTT broker, None if there is none."""
    return next((path for name in BROKERS if (path := shutil.which(name))), None)


def missing() -> str:
    """What this computer lacks for the rig, with the remedy; "" if nothing but the environment itself."""
    if broker() is None:
        return "no MQTT broker: apt-get install mosquitto"
    if not (CACHE / "env" / "done").exists() and _python() is None:
        return "no Python 3.12 or newer for the vendor's package: pyenv install 3.13"
    return ""


def environment(folder: Path = CACHE) -> Path:
    """The environment with the vendor's package in `folder`, built if it is not there; returns its folder of programs.

    Raises: DeviceStateError with what is missing, or pip's last line.
    """
    env = folder / "env"
    done = env / "done"
    if done.exists() and done.read_text(encoding="utf-8") == VERSION:
        return env / "bin"
    if lack := missing():
        raise DeviceStateError(f"the rig cannot be built: {lack}")
    python = _python()
    assert python is not None
    shutil.rmtree(env, ignore_errors=True)
    folder.mkdir(parents=True, exist_ok=True)
    for command in (
        [python, "-m", "venv", str(env)],
        [str(env / "bin" / "pip"), "install", "-q", "--disable-pip-version-check", *PACKAGES],
    ):
        ran = subprocess.run(command, capture_output=True, text=True, check=False, env=_clean())
        if ran.returncode:
            said = (ran.stderr.strip() or ran.stdout.strip() or "no word").splitlines()[-1]
            raise DeviceStateError(f"the rig cannot be built: {said}; try {' '.join(command)}")
    done.write_text(VERSION, encoding="utf-8")
    return env / "bin"


def _clean() -> dict[str, str]:
    """Our variables without those that point Python at our own packages."""
    return {k: v for k, v in os.environ.items() if k not in ("PYTHONPATH", "VIRTUAL_ENV", "PYTHONHOME")}
