"""How Pioreactors are reached and run: `backend=pioreactor` and `backend=pioreactor_rig`."""

import os
from dataclasses import dataclass, replace

from conf.schema import check, part, require, setting
from hardware.clock import DeviceClock
from hardware.link.transport import read_secret, require_web_address

PASSWORD = "PIOREACTOR_MQTT_PASSWORD"
"""Environment variable with the broker's password; without this and a file, the vendor's own password is used."""
SHIPPED = "raspberry"  # public password that the vendor's installation sets
PUBLISHED = "26.11.1"
"""Version of the vendor's software that the rig runs: the newest tested version."""
FULL_ML = {20: 18.0, 40: 36.0}  # the vendor's largest volume in each vial


def vial_ml(volume_ml: float) -> int:
    """Return the size of the vendor's vial for a culture volume, mL."""
    return 20 if volume_ml <= 15.0 else 40


@dataclass(frozen=True)
class UnitConfig:
    """Settings of one unit that replace those of `backend`. Raises: ValueError naming key, value and allowed range."""

    address: str = setting("", "address of the unit's web server, e.g. http://10.42.0.2; '': http://NAME.local")
    channel: str | None = setting(None, "replaces backend.channel", choices=("1", "2", "3", "4"))
    od_zero: float | None = setting(None, "replaces backend.od_zero", within=(-10, 10))
    od_scale: float | None = setting(None, "replaces backend.od_scale", above=0.0, at_most=1000.0)

    def __post_init__(self) -> None:
        check(self, "backend.units.NAME")
        require_web_address("backend.units.NAME.address", self.address or "http://NAME.local")


@dataclass(frozen=True)
class PioreactorConfig:
    """How to reach and run the units of a cluster. Raises: ValueError."""

    kind: str = setting("pioreactor", "backend")
    reactors: tuple[str, ...] = setting(("pio01",), "names of the units as on the vendor's page", some=True)
    units: dict[str, UnitConfig] = setting({}, "settings of single units, e.g. units.pio02.channel=1")
    broker: str = setting("pioreactor.local", "host of the cluster's MQTT broker (the leader)")
    broker_port: int = setting(1883, "port of the broker", within=(1, 65535))
    username: str = setting("pioreactor", "user name at the broker")
    password_file: str = setting("", f"file with the password, mode 600; '': {PASSWORD}, else the vendor's own")
    tls: bool = setting(False, "encrypt the connection to the broker")
    ca_file: str = setting("", "certificate authority of the broker; '': those of this computer", note="with tls")
    leader: str = setting("", "address of the leader's web server; '': http://BROKER")
    experiment: str = setting("turbidostat", "name of the experiment on the vendor's pages")
    speed: float = setting(1.0, "speed-up of growth; only on the test bench", within=(1, 60))
    reading_s: float = setting(5.0, "real time between the vendor's readings", "s", within=(1, 30))
    window_s: float = setting(30.0, "longest period of readings whose median is a sample", "s", within=(5, 300))
    mix_s: float = setting(5.0, "time after a dose in which readings are ignored", "s", within=(0, 60))
    channel: str = setting("2", "photodiode that measures the culture", choices=("1", "2", "3", "4"))
    od_zero: float = setting(0.0, "reading of clear medium; 0 with an active calibration", within=(-10, 10))
    od_scale: float = setting(1.0, "OD per unit of reading; 1 with an active calibration", above=0.0, at_most=1000.0)
    temperature: float = setting(37.0, "thermostat at the start; scenarios may change it", "degC", within=(15, 42))
    thermostat: bool = setting(True, "run the vendor's thermostat; otherwise temperatures are not controlled")
    stirring: bool = setting(True, "run the vendor's stirring")
    min_dose_ml: float = setting(0.05, "smallest dose; a smaller one is added to the next dose", "mL", within=(0, 1))
    max_dose_ml: float = setting(1.5, "largest dose", "mL", within=(0.1, 5), note="the vendor has no limit")
    waste_factor: float = setting(2.0, "waste volume over media volume, as in the vendor's automations", within=(1, 5))
    pump_pins: tuple[int, ...] = setting((13, 16, 12), "GPIO pins of media, alt-media and waste pump", some=True)
    alt_media: bool = setting(False, "use the alt-media pump with a fluid of its own; signals call it pump 3")
    start_s: float = setting(12.0, "real time within which an accepted dose must begin", "s", within=(2, 120))
    stop_s: float = setting(30.0, "real time in which a stop tries to verify the pumps off", "s", within=(1, 600))

    def __post_init__(self) -> None:
        check(self, "backend")
        require_web_address("backend.leader", self.leader or "http://BROKER")
        host = bool(self.broker) and not set(self.broker) & set(" /")
        require(host, "backend.broker", repr(self.broker), "the name of a host; its port is broker_port")
        unique = len(set(self.reactors)) == len(self.reactors)
        require(unique, "backend.reactors", self.reactors, "one or more unique names")
        least = f"min_dose_ml = {self.min_dose_ml} or more"
        require(self.max_dose_ml >= self.min_dose_ml, "backend.max_dose_ml", f"{self.max_dose_ml} mL", least)
        require(len(self.pump_pins) == 3, "backend.pump_pins", self.pump_pins, "three: media, alt-media, waste")
        apart_s = DeviceClock(self.speed).of_real(self.reading_s)
        two = f"more than {apart_s:g} s (reading_s * speed), because a sample needs two readings"
        require(self.window_s > apart_s, "backend.window_s", f"{self.window_s} s", two)
        unknown = [name for name in self.units if name not in self.reactors]
        require(not unknown, "backend.units", tuple(unknown), f"names of {', '.join(self.reactors)}")
        bad = next((c for c in "#+/" if c in self.experiment or not self.experiment), "")
        require(not bad, "backend.experiment", self.experiment, "a name without # + and /")

    def of(self, unit: str) -> "PioreactorConfig":
        """Return the config of one unit: its own values replace those of all units."""
        own = self.units.get(unit, UnitConfig())
        keys = [key for key in ("channel", "od_zero", "od_scale") if getattr(own, key) is not None]
        return replace(self, **{key: getattr(own, key) for key in keys})

    def address(self, unit: str) -> str:
        return (self.units.get(unit, UnitConfig()).address or f"http://{unit}.local").rstrip("/")

    def password(self) -> str:
        """Return the broker's password, which no config, file of a run or output contains. Raises: LinkError."""
        remedy = "one line with the broker's password, mode 600"
        if not self.password_file:
            return os.environ.get(PASSWORD, SHIPPED)
        return read_secret("backend.password_file", self.password_file, 1, remedy, r"[^\x00-\x1f]")


@dataclass(frozen=True)
class RigConfig:
    """Software and vials of the rig. Raises: ValueError naming key, value and allowed range."""

    package: str = setting(PUBLISHED, "version of the vendor's software on the package index, or path of a wheel")
    folder: str = setting("", "folder of the Python environments; '': the user's cache")
    od: float = setting(0.7, "OD of the cultures at the start", "OD", within=(0.0, 4.0))
    plant: str = setting("nominal", "preset of the cultures")
    seed: int = setting(0, "random seed of the vials", at_least=0)

    def __post_init__(self) -> None:
        check(self, "backend.rig")


@dataclass(frozen=True)
class RigBackendConfig(PioreactorConfig):
    """`backend=pioreactor_rig`: the same driver with the vendor's software and simulated vials, started for the run."""

    kind: str = setting("pioreactor_rig", "backend")
    speed: float = setting(10.0, "speed-up of growth: device seconds per real second", within=(1, 60))
    reactors: tuple[str, ...] = setting(("pio01", "pio02"), "names of the units", some=True)
    reading_s: float = setting(1.0, "real time between the vendor's readings", "s", within=(1, 30))
    rig: RigConfig = part(RigConfig, "the software and the vials")
