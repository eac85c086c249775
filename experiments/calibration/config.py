"""Config of `calibrate`."""

import re
from dataclasses import dataclass

from conf.schema import part, require, setting
from envs.identification.calibration import IdentifyConfig
from envs.identification.open_loop import OpenLoop
from experiments.recordings.reader import Source

LAWS = ("open_loop", "pi", "pi_tuned", "threshold", "proportional")


@dataclass(frozen=True)
class CalibrateConfig(Source):
    """Config of a calibration, of the generator of recordings, or of the study of the intervals' coverage."""

    name: str = setting("calibrated", "name of the environment file RUN/<name>.yaml")
    identify: IdentifyConfig = part(IdentifyConfig, "estimation of mu and tau")
    generate: bool = setting(False, "simulate the paper's open-loop protocol and write it as a recording")
    out: str | None = setting(None, "path of that recording; null: RUN/LAW.csv")
    coverage: int = setting(
        0,
        "number of simulated recordings, to count how often the 95 % intervals contain the true values; 0: no study",
        within=(0, 10000),
    )
    law: str = setting(
        "open_loop",
        "pump control of a simulated recording: the paper's open-loop protocol, the device's PI, a tuned PI, an on-off "
        "threshold, or a proportional controller, which hides tau",
        choices=LAWS,
    )
    setpoints: tuple[float, ...] = setting(
        (0.5,), "setpoints of a feedback controller, each for the same time", "OD", within=(0.05, 2), some=True
    )
    rest_min: float = setting(
        0.0, "pause of the pump at the start of every hour, with a feedback controller", "min", within=(0, 50)
    )
    gain: float = setting(0.1, "gain of law=proportional", "mL/s per OD", within=(0, 1))
    protocol: OpenLoop = part(OpenLoop, "protocol, culture and sensor of a simulated recording")

    def __post_init__(self) -> None:
        super().__post_init__()
        named = re.fullmatch(r"[\w-]+", self.name)
        require(bool(named), "name", self.name, "letters, digits, _ and - (it names a file)")
