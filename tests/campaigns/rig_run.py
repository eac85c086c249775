"""A Pioreactor rig with a deployment on some of its units and the vendor's own turbidostat on one more, as processes.

A real process `experiments.deploy backend=pioreactor` controls its units; the vendor's dosing automation is given the
same setpoints at the same moments. What is left behind is the deployment's folder, with the truth of all vials.
"""

import json
import logging
import os
import time
from collections.abc import Iterator
from contextlib import ExitStack, closing, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TextIO

from conf.presets import groups
from conf.schema import check, part, require, setting
from experiments.cli.words import UserError
from hardware.clock import RealClock
from hardware.errors import DeviceStateError
from hardware.pioreactor.config import PioreactorConfig, RigConfig
from hardware.pioreactor.mailbox import Cluster, Mailbox
from hardware.pioreactor.versions import Facts, facts
from hardware.pioreactor.web import Web
from hardware.rig.processes import Rig
from tests.campaigns.client import Client
from tests.campaigns.rig_truth import Limits

__all__ = ["LOOK_S", "RigStudyConfig", "VendorConfig", "run_on_rig"]

log = logging.getLogger(__name__)

EXPERIMENT = "turbidostat"
OD, AUTOMATION = "od_reading", "dosing_automation"
LOOK_S = 15.0  # real time between two looks of the vendor's turbidostat, which it lets nobody change
START_S = 60.0  # real time a job of the vendor's may take to come up
AGAIN_S = 10.0  # real time after which a target that was not taken is told again
LEAVE_S = 40.0  # real time a deployment may take to verify its pumps off
TOLD_S = 60.0  # real time between two lines of progress


@dataclass(frozen=True)
class VendorConfig:
    """What the vendor's turbidostat is given. Raises: ValueError naming key, value and allowed range."""

    unit: str = setting("vendor", "name of the unit that it regulates")
    exchange_ml: float = setting(1.0, "medium whenever the target is passed", "mL", within=(0.1, 5))
    reading_s: float = setting(1.0, "real time between its readings", "s", within=(1, 30))
    reading_smoothing: float = setting(0.0, "the vendor's smoothing_penalizer; it ships 3", within=(0, 100))
    look_smoothing: float = setting(0.5, "the vendor's od_smoothing_ema, as it ships", within=(0, 1))

    def __post_init__(self) -> None:
        check(self, "vendor")


@dataclass(frozen=True)
class RigStudyConfig:
    """What is run and what it has to keep. Raises: ValueError naming key, value and allowed range."""

    run: str = setting("", "folder of a run on the rig, which is judged; empty: run one")
    reactors: tuple[str, ...] = setting(("pio01", "pio02"), "units that the deployment controls", some=True)
    speed: float = setting(
        4.0, "growth faster than real time: device seconds per real second", within=(1, 60), note="10 on idle cores"
    )
    scenario: str = setting("setpoint_steps", "preset of the deployment", choices=tuple(groups()["scenario"]))
    reading_s: float = setting(1.0, "real time between the readings of those units", "s", within=(1, 30))
    volumes_ml: tuple[float, ...] = setting(
        (20.0, 14.0, 20.0), "cultures of those units and of vendor.unit", "mL", within=(5, 38), some=True
    )
    overrides: tuple[str, ...] = setting(("scenario.recovery_od=0.7",), "further words of the deploy command")
    rig: RigConfig = part(RigConfig, "the software and the vials")
    vendor: VendorConfig = part(VendorConfig, "the unit that the vendor's turbidostat regulates")
    limits: Limits = part(Limits, "what the deployment has to keep")

    def __post_init__(self) -> None:
        check(self)
        names = (*self.reactors, self.vendor.unit)
        require(len(set(names)) == len(names), "reactors and vendor.unit", names, "unique names")
        require(len(names) == len(self.volumes_ml), "volumes_ml", self.volumes_ml, f"one for each of {names}")

    @property
    def cultures(self) -> dict[str, float]:
        """mL of each unit, the vendor's last."""
        return dict(zip((*self.reactors, self.vendor.unit), self.volumes_ml, strict=True))


class Witness(Mailbox):
    """What one unit says, its dosing events also as rows of a file.

    Attributes: target, OD, that the vendor's turbidostat told.
    """

    def __init__(self, unit: str, into: TextIO) -> None:
        super().__init__(unit, PioreactorConfig(experiment=EXPERIMENT), RealClock())
        self.unit, self._into, self.target = unit, into, float("nan")

    def take(self, topic: str, payload: bytes, retained: bool) -> None:
        """One message."""
        super().take(topic, payload, retained)
        try:
            if topic.endswith("/dosing_events") and not retained:
                row = {"wall": round(time.time(), 3), "unit": self.unit, **json.loads(payload)}
                self._into.write(json.dumps(row) + "\n")
            elif topic.endswith((f"/{AUTOMATION}/target_od", f"/{AUTOMATION}/target_biomass")):
                self.target = float(payload)
        except (ValueError, TypeError):
            self.refused += 1


class VendorUnit:
    """The unit that the vendor's turbidostat regulates, with the setpoints that a deployment's journal tells.

    Args: web, box: of the unit. folder: of the deployment; vendor.jsonl is written there. known: of the version.
    """

    def __init__(
        self, config: VendorConfig, web: Web, mqtt: Cluster, box: Witness, folder: Path, leader: str, known: Facts
    ) -> None:
        self._config, self._web, self._mqtt, self._box, self._leader = config, web, mqtt, box, leader
        self._known = known
        self._journal, self._read = folder / "journal.jsonl", 0
        self._told = folder / "vendor.jsonl"
        self._setpoint, self._phase, self._asked_s = float("nan"), -1, -float("inf")

    def read(self) -> None:
        """Start its readings. Raises: ReactorError."""
        rate, smoothing = str(round(1.0 / self._config.reading_s, 4)), str(self._config.reading_smoothing)
        values = {"samples_per_second": rate, "smoothing_penalizer": smoothing}
        self._run(OD, {}, [[f"{OD}.config", key, value] for key, value in values.items()])

    def _run(self, job: str, options: dict[str, Any], overrides: list[list[str]]) -> None:
        self._web.run(job, options, overrides)
        deadline = time.monotonic() + START_S
        while not self._box.live(job):
            if time.monotonic() > deadline:
                raise DeviceStateError(f"{job} of {self._config.unit} did not start within {START_S:.0f} s")
            time.sleep(0.1)

    def follow(self) -> None:
        """Take over what the schedule of the first unit asks for now. Raises: ReactorError."""
        for row in self._new():
            decided = row.get("kind") == "decision" and row.get("reactor") == self._leader
            if decided and (row["row"]["setpoint"], row["row"]["phase"]) != (self._setpoint, self._phase):
                self._setpoint, self._phase = float(row["row"]["setpoint"]), int(row["row"]["phase"])
                self._regulate()
                if self._phase >= 0:
                    self.note(self._setpoint)
        if self._box.target != self._setpoint and time.monotonic() > self._asked_s + AGAIN_S:
            self._regulate()

    def _new(self) -> Iterator[dict[str, Any]]:
        """Whole rows of the journal since the last call."""
        if self._journal.exists():
            with self._journal.open("rb") as file:
                file.seek(self._read)
                for line in file:
                    if line.endswith(b"\n"):
                        self._read += len(line)
                        yield json.loads(line)

    def _regulate(self) -> None:
        """Start it, or tell it another target."""
        if self._setpoint != self._setpoint:
            return
        self._asked_s = time.monotonic()
        if self._box.live(AUTOMATION):
            target = self._known.target.replace("-", "_")
            topic = f"pioreactor/{self._config.unit}/{EXPERIMENT}/{AUTOMATION}/{target}/set"
            self._mqtt.publish(topic, str(self._setpoint))
            return
        options = {"automation-name": "turbidostat", self._known.target: self._setpoint, **dict(self._known.signal)}
        options["exchange-volume-ml"] = self._config.exchange_ml
        smoothing = [["turbidostat.config", "od_smoothing_ema", str(self._config.look_smoothing)]]
        self._run(AUTOMATION, options, smoothing)

    def note(self, setpoint: float | None) -> None:
        """A row of vendor.jsonl: a target, or None for the end."""
        with self._told.open("a", encoding="utf-8") as file:
            row = {"wall": round(time.time(), 3), "unit": self._config.unit, "setpoint": setpoint}
            file.write(json.dumps(row) + "\n")


@contextmanager
def deployment(config: RigStudyConfig, rig: Rig, folder: Path, out: Path) -> Iterator[Client]:
    """The process that controls the judged units; it is ended on leaving, its pumps verified off."""
    names = ",".join(config.reactors)
    command = ["backend=pioreactor", f"backend.reactors=[{names}]"]
    for unit in config.reactors:
        command += [
            f"backend.units.{unit}.address={rig.web[unit]}",
            f"bench.volumes_ml.{unit}={rig.units[unit]}",
        ]
    command += ["backend.broker=127.0.0.1", f"backend.broker_port={rig.broker}", f"backend.speed={config.speed}"]
    command += [f"backend.leader={next(iter(rig.web.values()))}"]
    command += [f"backend.reading_s={config.reading_s}", f"scenario={config.scenario}"]
    command += [*config.overrides, f"hydra.run.dir={folder}"]
    client = Client(command, out)
    try:
        yield client
    finally:
        if client.end(LEAVE_S) is None:
            log.warning("the deployment did not end within %.0f s; it was killed", LEAVE_S)


def run_on_rig(config: RigStudyConfig, folder: Path) -> Path:
    """Rig, deployment and the vendor's turbidostat until the schedule's end; returns the deployment's folder.

    Raises: ReactorError, UserError.
    """
    run, unit = folder / "run", config.vendor.unit
    run.mkdir()
    with ExitStack() as stack:
        rig = stack.enter_context(Rig(config.cultures, config.rig, config.speed, run))
        log.info("the vendor's software at %s, cultures %g times real time", rig.web, config.speed)
        into = stack.enter_context((run / "dosing_events.jsonl").open("a", encoding="utf-8", buffering=1))
        boxes = {name: Witness(name, into) for name in rig.units}
        who = f"rig-study-{os.getpid()}"
        where = PioreactorConfig(broker="127.0.0.1", broker_port=rig.broker, experiment=EXPERIMENT)
        mqtt = stack.enter_context(closing(Cluster(where, dict(boxes), who, RealClock())))
        web, known = Web(rig.web[unit], EXPERIMENT), facts(rig.version)
        vendor = VendorUnit(config.vendor, web, mqtt, boxes[unit], run, config.reactors[0], known)
        vendor.read()
        client = stack.enter_context(deployment(config, rig, run, folder / "deployment.log"))
        began = told = time.monotonic()
        while client.status is None:
            vendor.follow()
            if time.monotonic() > told + TOLD_S:
                told += TOLD_S
                log.info("minute %.0f: %s", (told - began) * config.speed / 60.0, _now(rig))
            time.sleep(0.2)
        vendor.note(None)
    if client.status:
        raise UserError(f"the deployment ended with status {client.status}: {_last_line(folder)}")
    return run


def _now(rig: Rig) -> str:
    return "true OD " + ", ".join(f"{name} {vial.truth()['od']:.3f}" for name, vial in rig.vials.vials.items())


def _last_line(folder: Path) -> str:
    lines = (folder / "deployment.log").read_text(encoding="utf-8", errors="replace").strip().splitlines()
    return f"{lines[-1] if lines else 'no word'}; {folder / 'deployment.log'} has all"
