"""The rig: broker, and for every unit the vendor's web server and task queue, around our vials; all end with it."""

from __future__ import annotations

import contextlib
import ctypes
import getpass
import os
import shutil
import signal
import socket
import subprocess
import tempfile
import time
import urllib.error
import urllib.request
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from conf.schema import check, setting
from hardware.errors import DeviceStateError
from hardware.pioreactor.rig.build import broker, environment
from hardware.pioreactor.rig.files import layout, wrapper
from hardware.pioreactor.rig.vials import VialServer, vial_preset

__all__ = ["Rig", "RigConfig"]

WEB = (
    "import os, pioreactor.web.app as web\n"
    "web.client._client_id = ('rig-web-' + os.environ['HOSTNAME']).encode()\n"  # else each throws out the other
    "web.create_app().run(host=os.environ['RIG_HOST'], port=int(os.environ['RIG_WEB_PORT']), threaded=True)\n"
)
BOOT_S = 40.0
UNIT = ("web", "tasks", "monitor")  # what boots with a unit; without any job the list of jobs is an error
CONSUMER = ("-n", "-b", "1.001", "-w", "4", "-f", "-C", "-d", "0.05")  # of the task queue, as on a unit


@dataclass(frozen=True)
class RigConfig:
    """What the rig's vials are.

    Raises: ValueError naming key, value and allowed range.
    """

    folder: str = setting("", "of the environment and of the units' files; empty: in the user's cache")
    growth_x: float = setting(10.0, "how much faster than real time the cultures grow", within=(1.0, 60.0))
    od: float = setting(0.7, "of the cultures at the start", "OD", within=(0.0, 4.0))
    plant: str = setting("nominal", "preset of the cultures")
    volume_ml: float = setting(20.0, "culture up to the waste tube", "mL", within=(5.0, 30.0))
    seed: int = setting(0, "of the vials", at_least=0)

    def __post_init__(self) -> None:
        check(self, "backend.rig")


class Rig:
    """Everything that stands on a bench, as processes of this computer; use as a context manager.

    Args: units: names; unit k is at 127.0.0.k. config: of their vials. truth: folder of truth.jsonl, where
      another than the rig's own, which is removed with it.
    Attributes: web, address of each unit's web server; broker, port of MQTT; vials; folder; processes by name.
    Raises: DeviceStateError with what is missing or did not start.
    """

    def __init__(self, units: Sequence[str], config: RigConfig | None = None, truth: Path | None = None) -> None:
        self.config = config or RigConfig()
        self.units = tuple(units)
        home = Path(self.config.folder).expanduser() if self.config.folder else None
        self._bin = environment(home) if home else environment()
        self.folder = Path(tempfile.mkdtemp(prefix="pioreactor-rig-"))
        self.broker, self.port = _free_port("127.0.0.1"), _free_port("127.0.0.1")
        self.web = {unit: f"http://127.0.0.{k}:{self.port}" for k, unit in enumerate(self.units, 1)}
        self.processes: dict[str, subprocess.Popen[bytes]] = {}
        plant = vial_preset(self.config.plant, self.config.volume_ml, self.config.od)
        self.vials = VialServer(self.units, plant, self.config.growth_x, truth or self.folder, self.config.seed)
        try:
            self._start()
        except BaseException:
            self.close()
            raise

    def _start(self) -> None:
        conf = self.folder / "mosquitto.conf"
        conf.write_text(
            f"listener {self.broker} 127.0.0.1\nallow_anonymous true\nuser {getpass.getuser()}\n", encoding="utf-8"
        )
        self.start("broker")
        _wait(lambda: _listens("127.0.0.1", self.broker), "the broker")
        for unit in self.units:
            layout(self.folder / unit, unit, self.units, self.port, self.broker, self.config.volume_ml)
            for name in ("pio", "pios"):
                script = self.folder / unit / name
                script.write_text(wrapper(self._bin / name, self._variables(unit)), encoding="utf-8")
                script.chmod(0o755)
            stand_in = self.folder / unit / "sudo"  # what a unit would shut down, reboot or restart is this computer
            stand_in.write_text("#!/bin/sh\nexit 1\n", encoding="utf-8")
            stand_in.chmod(0o755)
            shutil.copy(Path(__file__).with_name("plugin.py"), self.folder / unit / "plugins" / "rig_plugin.py")
            for name in UNIT:
                self.start(f"{unit} {name}")
        for unit, url in self.web.items():
            _wait(lambda url=url: _answers(f"{url}/unit_api/health"), f"the web server of {unit}")
            for pump in ("media_pump", "waste_pump"):
                request = urllib.request.Request(
                    f"{url}/unit_api/active_calibrations/{pump}/rig-{pump}", method="PATCH"
                )
                urllib.request.urlopen(request, timeout=10.0).close()

    def start(self, name: str) -> None:
        """Start, or start again, one process: "broker", "UNIT web", "UNIT tasks" or "UNIT monitor"."""
        unit, _, what = name.partition(" ")
        if name == "broker":
            command = [str(broker()), "-c", str(self.folder / "mosquitto.conf")]
            variables = dict(os.environ)
        else:
            python, variables = str(self._bin / "python"), self._variables(unit)
            consumer = ["pioreactor.web.tasks.huey", *CONSUMER]
            command = {
                "web": [python, "-c", WEB],
                "tasks": [str(self._bin / "huey_consumer"), *consumer],
                "monitor": [str(self._bin / "pio"), "run", "monitor"],
            }[what]
        with (self.folder / f"{name.replace(' ', '-')}.log").open("ab") as log:
            self.processes[name] = subprocess.Popen(
                command, env=variables, stdout=log, stderr=log, cwd=self.folder, start_new_session=True,
                preexec_fn=_end_with_us,
            )  # fmt: skip

    def _variables(self, unit: str) -> dict[str, str]:
        home, k = self.folder / unit, self.units.index(unit) + 1
        return {
            "PATH": f"{home}:{self._bin}:/usr/local/bin:/usr/bin:/bin",
            "HOME": str(home), "TESTING": "1", "HOSTNAME": unit, "ACTIVE": "1",
            "DOT_PIOREACTOR": str(home), "RUN_PIOREACTOR": str(home), "GLOBAL_CONFIG": str(home / "config.ini"),
            "LOCAL_CONFIG": str(home / "unit_config.ini"), "PLUGINS_DEV": str(home / "plugins"),
            "PIO_EXECUTABLE": str(home / "pio"), "PIOS_EXECUTABLE": str(home / "pios"),
            "HARDWARE": "1.2", "FIRMWARE": "0.5", "MODEL_NAME": "pioreactor_40ml", "MODEL_VERSION": "1.5",
            "BLINKA_FORCECHIP": "BCM2XXX", "BLINKA_FORCEBOARD": "RASPBERRY_PI_4B",
            "TURBIDOSTAT_RIG_PORT": str(self.vials.port), "RIG_HOST": f"127.0.0.{k}", "RIG_WEB_PORT": str(self.port),
            "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1",
        }  # fmt: skip

    def kill(self, name: str) -> None:
        """kill -9 of one process."""
        self.processes[name].kill()
        self.processes[name].wait()

    def reboot(self, unit: str) -> None:
        """A unit loses its power and boots: its processes end at once, its pins fall to 0, what lay in memory is gone.

        Raises: DeviceStateError if its web server does not come back.
        """
        for name in UNIT:
            self.kill(f"{unit} {name}")
        for pid in self._left(f"{self.folder / unit}\0"):
            with contextlib.suppress(ProcessLookupError):
                os.kill(pid, signal.SIGKILL)
        self.vials.power_cut(unit)
        shutil.rmtree(self.folder / unit / "cache")
        (self.folder / unit / "cache").mkdir()
        for name in UNIT:
            self.start(f"{unit} {name}")
        _wait(lambda: _answers(f"{self.web[unit]}/unit_api/health"), f"the web server of {unit}")

    def jobs(self, unit: str, job: str) -> list[int]:
        """Process ids of the vendor's jobs of this name on a unit, by what the system says of them."""
        found = []
        for path in Path("/proc").glob("[0-9]*"):
            with contextlib.suppress(OSError):
                words = (path / "cmdline").read_bytes().split(b"\0")
                home = f"DOT_PIOREACTOR={self.folder / unit}\0".encode()
                if job.encode() in words and home in (path / "environ").read_bytes():
                    found.append(int(path.name))
        return found

    def close(self) -> None:
        """End everything that the rig started, the vendor's jobs too. Idempotent."""
        for process in self.processes.values():
            with contextlib.suppress(ProcessLookupError):
                process.kill()
            process.wait()
        for pid in self._left(f"{self.folder}/"):
            with contextlib.suppress(ProcessLookupError):
                os.kill(pid, signal.SIGKILL)
        self.vials.close()

    def _left(self, place: str) -> list[int]:
        """Jobs that the task queues started: they have sessions of their own, and our folder in their environment."""
        found, home = [], f"RUN_PIOREACTOR={place}".encode()
        for path in Path("/proc").glob("[0-9]*"):
            with contextlib.suppress(OSError):
                if home in (path / "environ").read_bytes() and int(path.name) != os.getpid():
                    found.append(int(path.name))
        return found

    def __enter__(self) -> Rig:
        return self

    def __exit__(self, *raised: object) -> None:
        self.close()
        shutil.rmtree(self.folder, ignore_errors=True)


def _end_with_us() -> None:
    """In a child: be killed when the process that started us is, whatever ended it."""
    with contextlib.suppress(OSError, AttributeError):
        ctypes.CDLL(None).prctl(1, signal.SIGKILL)  # PR_SET_PDEATHSIG


def _free_port(host: str) -> int:
    with socket.socket() as probe:
        probe.bind((host, 0))
        return int(probe.getsockname()[1])


def _listens(host: str, port: int) -> bool:
    with contextlib.suppress(OSError), socket.create_connection((host, port), 0.5):
        return True
    return False


def _answers(url: str) -> bool:
    try:
        urllib.request.urlopen(url, timeout=2.0).close()
    except (OSError, urllib.error.URLError):
        return False
    return True


def _wait(ready: object, what: str) -> None:
    deadline = time.monotonic() + BOOT_S
    while not ready():  # type: ignore[operator]
        if time.monotonic() > deadline:
            raise DeviceStateError(f"{what} of the rig did not start within {BOOT_S:.0f} s; look at its log")
        time.sleep(0.1)
