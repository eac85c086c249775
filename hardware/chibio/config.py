"""How a Chi.Bio is reached and run: `backend=chibio` and `backend=emulator`."""

from dataclasses import dataclass

from conf.presets import groups
from conf.schema import check, part, require, setting
from hardware.chibio.dosing import SupplyConfig
from hardware.chibio.fluorescence import FluorescenceSlotConfig
from hardware.chibio.overflow_pump import OverflowPumpConfig
from hardware.chibio.protocol import POSITIONS, Permitted
from hardware.link.transport import TransportConfig, require_web_address


@dataclass(frozen=True)
class ChiBioConfig:
    """How to reach a Chi.Bio, which reactors to run and how. Raises: ValueError naming key, value and allowed range."""

    kind: str = setting("chibio", "backend")
    url: str = setting("http://192.168.7.2:5000", "address of the device's server")
    speed: float = setting(1.0, "device seconds per real second; above 1 only for a fast emulator", within=(0.1, 1000))
    reactors: tuple[str, ...] = setting(("M0",), "positions to run, all in one process", choices=POSITIONS, some=True)
    transport: TransportConfig = part(TransportConfig, "the link to the device")
    calibration: str = setting(
        "calibration", "folder with the files of calibrate_pump and blank; a missing file means nominal values"
    )
    temperature: float = setting(37.0, "thermostat at the start; scenarios may change it", "degC", within=(15, 42))
    stir: float = setting(0.5, "stirrer power", within=(0, 1))
    overflow_pump: OverflowPumpConfig = part(OverflowPumpConfig, "a second waste line against overflow")
    supply: SupplyConfig = part(SupplyConfig, "spare pumps for scenario.outputs and signals")
    fluorescence: FluorescenceSlotConfig = part(FluorescenceSlotConfig, "fluorescence measurement")
    stale_s: float = setting(100.0, "age at which the newest sample is too old for a dose", "s", within=(65, 600))
    lost_s: float = setting(
        180.0, "age of the newest sample at which the experiment is restarted; above stale_s", "s", within=(100, 3600)
    )
    stop_s: float = setting(
        60.0, "time in which a stop tries to verify the pumps off before it escalates", "s", within=(1, 600)
    )
    deadman_s: float = setting(
        120.0,
        "silence after which the board agent, if present, switches the pumps off: its --deadman",
        "s",
        within=(20, 3600),
        note="the repetitions of a dose until then are booked",
    )
    recover: bool = setting(True, "restore and restart a device that lost its memory or whose thread died")

    def __post_init__(self) -> None:
        check(self, "backend")
        require_web_address("backend.url", self.url)
        unique = len(set(self.reactors)) == len(self.reactors)
        require(unique, "backend.reactors", self.reactors, "1 to 8 different ones of M0 to M7")
        both = self.overflow_pump.pump in self.supply.pumps
        require(not both, "backend.supply", self.overflow_pump.pump, "another pump than the overflow pump")
        later = f"more than stale_s = {self.stale_s} s"
        require(self.lost_s > self.stale_s, "backend.lost_s", f"{self.lost_s} s", later)

    @property
    def permitted(self) -> Permitted:
        return Permitted(self.reactors, self.overflow_pump.pump, self.fluorescence.command, self.supply.pumps)


@dataclass(frozen=True)
class EmulatorConfig(ChiBioConfig):
    """`backend=emulator`: the same driver with an emulator that the run starts; `url` is ignored."""

    kind: str = setting("emulator", "backend")
    speed: float = setting(
        60.0,
        "device seconds per real second; 0: virtual time, as fast as possible, without sockets",
        within=(0, 1000),
    )
    od: float = setting(0.3, "OD of the emulated cultures at the start", "OD", within=(0, 4))
    plant: str = setting(
        "healthy", "preset of cultures and pumps; bench: every vial is different", choices=tuple(groups()["plant"])
    )
    seed: int = setting(0, "random seed of all noise", at_least=0)
