"""The rig: a broker, simulated vials, and for every unit the vendor's web server and task queue."""

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
from collections.abc import Mapping, Sequence
from pathlib import Path
from urllib.request import Request, urlopen

from hardware.errors import DeviceStateError
from hardware.pioreactor.config import RigConfig
from hardware.pioreactor.versions import facts
from hardware.rig.build import broker, environment, version
from hardware.rig.files import LOGIN, database, flows, layout, model, wrapper
from hardware.rig.vials import VialServer, vial_preset

WEB = (
    "import os, pioreactor.web.app as web\n"
    "if hasattr(web, 'client'):\n"
    "    web.client._client_id = ('rig-web-' + os.environ['HOSTNAME']).encode()\n"  # equal ids disconnect each other
    "web.create_app().run(host=os.environ['RIG_HOST'], port=int(os.environ['RIG_WEB_PORT']), threaded=True)\n"
)
BOOT_S = 90.0  # a busy computer
UNIT = ("web", "tasks", "monitor")  # processes that boot with a unit; without a job, the list of jobs is an error
CONSUMER = ("-n", "-b", "1.001", "-w", "4", "-f", "-C", "-d", "0.05")  # options of the task queue, as on a unit


class Rig:
    """A bench of units as processes of this computer; use as a context manager, whose end ends all processes.

    Args: units: by name, the culture volume up to the waste tube, mL; unit k is at 127.0.0.k, and the first is the
      leader. growth_x: growth rate over that of real time. truth: folder of truth.jsonl, None: the rig's folder, which
      is removed at the end. experiment: experiment of all units. login: name and password at the broker.
    Attributes: version: of the vendor's software. web: address of each unit's web server. broker: port of MQTT. vials.
      folder: the rig's folder. processes: by name.
    Raises: DeviceStateError naming what is missing or did not start.
    """

    def __init__(
        self, units: Mapping[str, float], config: RigConfig | None = None, growth_x: float = 1.0,
        truth: Path | None = None, experiment: str = "turbidostat", login: tuple[str, str] = LOGIN,
    ) -> None:  # fmt: skip
        c = config or RigConfig()
        self.units, self.experiment, self.login = dict(units), experiment, login
        env = environment(c.package, c.folder)
        self._bin, self.version = env / "bin", version(env)
        self.folder = Path(tempfile.mkdtemp(prefix="pioreactor-rig-"))
        self.broker, self.port = _free_port(), _free_port()
        self.hosts = {unit: f"127.0.0.{k}" for k, unit in enumerate(self.units, 1)}
        self.web = {unit: f"http://{host}:{self.port}" for unit, host in self.hosts.items()}
        self.processes: dict[str, subprocess.Popen[bytes]] = {}
        plants = {u: vial_preset(c.plant, ml, c.od, flows(k), growth_x) for k, (u, ml) in enumerate(self.units.items())}
        self.vials = VialServer(plants, growth_x, truth or self.folder, c.seed)
        try:
            self._start()
        except BaseException:
            self.close()
            raise

    def _start(self) -> None:
        conf, known, secret = self.folder / "mosquitto.conf", facts(self.version), self.folder / "mosquitto.password"
        subprocess.run(["mosquitto_passwd", "-b", "-c", secret, *self.login], check=True, capture_output=True)
        conf.write_text(
            f"listener {self.broker} 127.0.0.1\npassword_file {secret}\nuser {getpass.getuser()}\n", encoding="utf-8"
        )
        self.start("broker")
        _wait("127.0.0.1", self.broker, "the broker")
        store = self.folder / "pioreactor.sqlite"
        where = {"port": self.port, "broker": self.broker, "database": store, "login": self.login}
        database(store, self.units, self.experiment)
        for k, (unit, volume_ml) in enumerate(self.units.items()):
            home = self.folder / unit
            layout(home, unit, self.hosts, known, flows(k), {**where, "volume_ml": volume_ml})
            scripts = {name: wrapper(self._bin / name, self._variables(unit)) for name in ("pio", "pios")}
            scripts["sudo"] = "#!/bin/sh\nexit 1\n"  # else a unit's shutdown or reboot would be this computer's
            for name, text in scripts.items():
                (home / name).write_text(text, encoding="utf-8")
                (home / name).chmod(0o755)
            shutil.copy(Path(__file__).with_name("plugin.py"), home / "plugins" / "rig_plugin.py")
            self.boot(unit)
            for pump in flows(k):
                path = f"/unit_api/active_calibrations/{pump}/rig-{pump}"
                urlopen(Request(self.web[unit] + path, method="PATCH"), timeout=10.0).close()

    def start(self, name: str) -> None:
        """Start, or start again, one process: "broker", "UNIT web", "UNIT tasks" or "UNIT monitor"."""
        unit, _, what = name.rpartition(" ")
        variables = self._variables(unit) if unit else dict(os.environ)
        command = {
            "broker": [str(broker()), "-c", str(self.folder / "mosquitto.conf")],
            "web": [str(self._bin / "python"), "-c", WEB],
            "tasks": [str(self._bin / "huey_consumer"), "pioreactor.web.tasks.huey", *CONSUMER],
            "monitor": [str(self._bin / "pio"), "run", "monitor"],
        }[what]
        with (self.folder / f"{name.replace(' ', '-')}.log").open("ab") as log:
            self.processes[name] = subprocess.Popen(
                command, env=variables, stdout=log, stderr=log, cwd=self.folder, start_new_session=True,
                preexec_fn=_as_on_a_unit,
            )  # fmt: skip

    def _variables(self, unit: str) -> dict[str, str]:
        home = self.folder / unit
        return {
            "PATH": f"{home}:{self._bin}:/usr/local/bin:/usr/bin:/bin",
            "HOME": str(home), "TESTING": "1", "HOSTNAME": unit, "ACTIVE": "1",
            "DOT_PIOREACTOR": str(home), "RUN_PIOREACTOR": str(home), "GLOBAL_CONFIG": str(home / "config.ini"),
            "LOCAL_CONFIG": str(home / "unit_config.ini"), "PLUGINS_DEV": str(home / "plugins"),
            "PIO_EXECUTABLE": str(home / "pio"), "PIOS_EXECUTABLE": str(home / "pios"),
            "HARDWARE": "1.2", "FIRMWARE": "0.5", "MODEL_NAME": model(self.units[unit]),
            "MODEL_VERSION": "1.5", "BLINKA_FORCECHIP": "BCM2XXX", "BLINKA_FORCEBOARD": "RASPBERRY_PI_4B",
            "TURBIDOSTAT_RIG_PORT": str(self.vials.port), "RIG_HOST": self.hosts[unit], "RIG_WEB_PORT": str(self.port),
            "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1",
        }  # fmt: skip

    def kill(self, name: str) -> None:
        self.processes[name].kill()
        self.processes[name].wait()

    def cut(self, unit: str) -> None:
        """Cut the power of a unit: its processes end at once, its pins fall to 0, its memory is lost."""
        for name in UNIT:
            self.kill(f"{unit} {name}")
        _kill(self.jobs(unit))
        self.vials.power_cut(unit)
        shutil.rmtree(self.folder / unit / "cache")
        (self.folder / unit / "cache").mkdir()

    def boot(self, unit: str) -> None:
        """Boot a unit that had no power. Raises: DeviceStateError if its web server does not come back."""
        for name in UNIT:
            self.start(f"{unit} {name}")
        _wait(self.hosts[unit], self.port, f"the web server of {unit}")

    def jobs(self, unit: str = "", job: str = "") -> list[int]:
        """List the process ids of the vendor's jobs, in sessions of their own. Args: unit, job: names, "" for all."""
        home = f"RUN_PIOREACTOR={self.folder / unit}{chr(0) if unit else '/'}".encode()
        found = []
        for path in Path("/proc").glob("[0-9]*"):
            with contextlib.suppress(OSError):
                words = (path / "cmdline").read_bytes().split(b"\0")
                mine = home in (path / "environ").read_bytes() and int(path.name) != os.getpid()
                found += [int(path.name)] * (mine and (not job or job.encode() in words))
        return found

    def close(self) -> None:
        """End all processes of the rig, including the vendor's jobs. Idempotent."""
        for process in self.processes.values():
            with contextlib.suppress(ProcessLookupError):
                process.kill()
            process.wait()
        _kill(self.jobs())
        self.vials.close()

    def __enter__(self) -> Rig:
        return self

    def __exit__(self, *raised: object) -> None:
        self.close()
        shutil.rmtree(self.folder, ignore_errors=True)


def _kill(pids: Sequence[int]) -> None:
    for pid in pids:
        with contextlib.suppress(ProcessLookupError):
            os.kill(pid, signal.SIGKILL)


def _as_on_a_unit() -> None:
    """Set up a child process: it is killed with its parent, and receives SIGINT, with which the vendor stops jobs."""
    signal.signal(signal.SIGINT, signal.SIG_DFL)
    signal.pthread_sigmask(signal.SIG_SETMASK, ())
    with contextlib.suppress(OSError, AttributeError):
        ctypes.CDLL(None).prctl(1, signal.SIGKILL)  # PR_SET_PDEATHSIG


def _free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


def _wait(host: str, port: int, what: str) -> None:
    deadline = time.monotonic() + BOOT_S
    while True:
        with contextlib.suppress(OSError), socket.create_connection((host, port), 0.5):
            return
        if time.monotonic() > deadline:
            raise DeviceStateError(f"{what} of the rig did not start within {BOOT_S:.0f} s; look at its log")
        time.sleep(0.1)
