"""How Pioreactors are reached and run: `backend=pioreactor` and `backend=pioreactor_rig`."""

from dataclasses import dataclass

from conf.schema import check, part, require, setting
from hardware.pioreactor.rig.processes import RigConfig

__all__ = ["PioreactorConfig", "RigBackendConfig"]

JOB_WAIT_S = 12.0  # real seconds in which an accepted job must have shown itself


@dataclass(frozen=True)
class PioreactorConfig:
    """How to reach the units of a cluster, and what differs from other families.

    Raises: ValueError naming key, value and allowed range.
    """

    kind: str = setting("pioreactor", "which backend")
    reactors: tuple[str, ...] = setting(("pio01",), "names of the units, as in the vendor's page", some=True)
    addresses: dict[str, str] = setting(
        {}, "of a unit's web server, e.g. addresses.pio01=http://10.42.0.2; one that is missing is http://NAME.local"
    )
    broker: str = setting("pioreactor.local", "host of the cluster's MQTT broker, its leader")
    broker_port: int = setting(1883, "of the broker", within=(1, 65535))
    username: str = setting("pioreactor", "of the broker")
    password: str = setting("raspberry", "of the broker; the vendor ships this one")
    experiment: str = setting("turbidostat", "name of the experiment in the vendor's pages and data")
    speed: float = setting(
        1.0, "growth faster than real time, only in the rig: device seconds per real second", within=(1, 60)
    )
    period_s: float = setting(60.0, "control period", "s", within=(30, 600))
    reading_s: float = setting(5.0, "real time between the vendor's readings", "s", within=(1, 30))
    window_s: float = setting(30.0, "a sample is the median of the readings of at most so long", "s", within=(5, 300))
    mix_s: float = setting(5.0, "after a dose no reading counts for so long", "s", within=(0, 60))
    channel: str = setting("2", "photodiode that shows the culture", choices=("1", "2", "3", "4"))
    od_zero: float = setting(
        0.0, "the vendor's reading of clear medium", within=(-10, 10), note="0 where a calibration is active"
    )
    od_scale: float = setting(
        1.0, "OD per unit of the vendor's reading", above=0.0, at_most=1000.0, note="1 where a calibration is active"
    )
    temperature: float = setting(37.0, "thermostat at the start; scenarios may change it", "degC", within=(15, 42))
    thermostat: bool = setting(True, "run the vendor's thermostat; else temperatures are not controlled")
    stirring: bool = setting(True, "run the vendor's stirring")
    volume_ml: float = setting(20.0, "culture up to the efflux tube, as safety.volume_ml", "mL", within=(5, 38))
    min_dose_ml: float = setting(
        0.05, "less is put off to the next dose: the pump does not give it well", "mL", within=(0, 1)
    )
    max_dose_ml: float = setting(1.5, "the largest dose", "mL", within=(0.1, 5), note="the vendor has no limit")
    waste_factor: float = setting(2.0, "waste pump over media pump, as the vendor's automations", within=(1, 5))
    pump_pins: tuple[int, ...] = setting((13, 16, 12), "GPIO pins of media, alt-media and waste pump", some=True)
    start_s: float = setting(
        JOB_WAIT_S, "real time in which an accepted dose must begin; later its fate is unknown", "s", within=(2, 120)
    )
    stale_s: float = setting(100.0, "age at which a newest sample is no basis for a dose", "s", within=(35, 1200))
    retry_s: float = setting(2.0, "real time between attempts", "s", within=(0.2, 60))
    stop_s: float = setting(30.0, "real time a stop tries to verify the pumps off", "s", within=(1, 600))

    def __post_init__(self) -> None:
        check(self, "backend")
        unique = len(set(self.reactors)) == len(self.reactors)
        require(unique, "backend.reactors", self.reactors, "one or more unique names")
        later = f"more than period_s = {self.period_s} s"
        require(self.stale_s > self.period_s, "backend.stale_s", f"{self.stale_s} s", later)
        least = f"min_dose_ml = {self.min_dose_ml} or more"
        require(self.max_dose_ml >= self.min_dose_ml, "backend.max_dose_ml", f"{self.max_dose_ml} mL", least)
        unknown = [name for name in self.addresses if name not in self.reactors]
        require(not unknown, "backend.addresses", tuple(unknown), f"names of {', '.join(self.reactors)}")

    @property
    def control_min(self) -> float:
        """Control period, min; a policy must have been trained for the same one, or for any."""
        return self.period_s / 60.0

    def address(self, unit: str) -> str:
        """Of a unit's web server."""
        return self.addresses.get(unit, f"http://{unit}.local").rstrip("/")


@dataclass(frozen=True)
class RigBackendConfig(PioreactorConfig):
    """`backend=pioreactor_rig`: the same driver against the vendor's software around our vials, started for the run."""

    kind: str = setting("pioreactor_rig", "which backend")
    speed: float = setting(10.0, "growth faster than real time: device seconds per real second", within=(1, 60))
    reactors: tuple[str, ...] = setting(("pio01", "pio02"), "names of the units", some=True)
    reading_s: float = setting(1.0, "real time between the vendor's readings", "s", within=(1, 30))
    rig: RigConfig = part(RigConfig, "the software and the vials; growth_x is `speed`")
