"""Values of `conf/backend/chibio.yaml` and the `backend/transport` group, checked."""

from __future__ import annotations

from dataclasses import dataclass, field

from conf.presets import groups
from hardware.chibio.dosing import DosingConfig
from hardware.chibio.overflow_pump import OverflowPumpConfig
from hardware.chibio.protocol import POSITIONS
from hardware.link.transport import TransportConfig

__all__ = ["ChiBioConfig", "EmulatorConfig"]


@dataclass(frozen=True)
class ChiBioConfig:
    """How to reach a Chi.Bio, which reactors to run and how.

    kind: which backend these values are for.
    url, speed: the device's address; device seconds per real second (1 on the bench, more for a fast emulator).
    reactors: positions to run, M0 to M7.
    transport: the link.
    calibration: folder with the files of `experiments.calibrate_pump` and `experiments.blank`.
    temperature: thermostat target at the start, degC.
    stir: stirrer target, 0 to 1.
    volume_ml: culture volume, mL (only told to the device's own regulator).
    dosing: how a rate becomes a dose. overflow_pump: of a second waste tube, none as a rule.
    stale_s, lost_s: age of the newest sample that marks a reactor stale, and that starts its recovery.
    poll_s: pause between two looks for a sample that is due, s.
    window_s: a dose must end this long after its sample appeared, s (the next measurement begins 47 s after).
    retry_s: pause before a failed request is tried again, s.
    stop_s: how long `stop` keeps trying to reach the device, s.
    recover: restart the experiment of a reactor whose device lost its memory or whose thread died.

    Raises: ValueError naming key, value and allowed range.
    """

    kind: str = "chibio"
    url: str = "http://192.168.7.2:5000"
    speed: float = 1.0
    reactors: tuple[str, ...] = ("M0",)
    transport: TransportConfig = field(default_factory=TransportConfig)
    calibration: str = "calibration"
    temperature: float = 37.0
    stir: float = 0.5
    volume_ml: float = 20.0
    dosing: DosingConfig = field(default_factory=DosingConfig)
    overflow_pump: OverflowPumpConfig = field(default_factory=OverflowPumpConfig)
    stale_s: float = 100.0
    lost_s: float = 180.0
    poll_s: float = 2.0
    window_s: float = 38.0
    retry_s: float = 5.0
    stop_s: float = 60.0
    recover: bool = True

    def __post_init__(self) -> None:
        unknown = [m for m in self.reactors if m not in POSITIONS]
        if not self.reactors or unknown or len(set(self.reactors)) < len(self.reactors):
            raise ValueError(f"backend.reactors = {list(self.reactors)}: allowed 1 to 8 different ones of M0 to M7")
        ranges = {
            "speed": (0.1, 1000.0),
            "temperature": (15.0, 42.0),
            "stir": (0.0, 1.0),
            "volume_ml": (10.0, 30.0),
            "stale_s": (65.0, 600.0),
            "lost_s": (100.0, 3600.0),
            "poll_s": (0.2, 10.0),
            "window_s": (10.0, 42.0),
            "retry_s": (0.5, 60.0),
            "stop_s": (1.0, 600.0),
        }
        for key, (low, high) in ranges.items():
            if not low <= getattr(self, key) <= high:
                raise ValueError(f"backend.{key} = {getattr(self, key)}: allowed {low:g} to {high:g}")
        if abs(self.dosing.period_s - 60.0) > 1e-9:
            raise ValueError(
                f"backend.dosing.period_s = {self.dosing.period_s}: allowed 60 (the device measures so often)"
            )
        if self.lost_s <= self.stale_s:
            raise ValueError(f"backend.lost_s = {self.lost_s} s: allowed more than stale_s = {self.stale_s} s")

    @property
    def control_min(self) -> float:
        """Control period, min; a policy must have been trained for the same one."""
        return self.dosing.period_s / 60.0


@dataclass(frozen=True)
class EmulatorConfig(ChiBioConfig):
    """`backend=emulator`: the same driver against an emulator that the run starts by itself; `url` is then ignored.

    od, plant, seed: of the emulated cultures, see `python -m hardware.emulator --help`.
    """

    kind: str = "emulator"
    speed: float = 60.0
    od: float = 0.3
    plant: str = "healthy"
    seed: int = 0

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.plant not in groups()["plant"]:
            raise ValueError(f"backend.plant = {self.plant}: allowed {', '.join(groups()['plant'])}")
        if not 0.0 <= self.od <= 4.0 or self.seed < 0:
            raise ValueError(f"backend.od = {self.od}, seed = {self.seed}: allowed 0 to 4, and at least 0")
