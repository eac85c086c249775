"""The config of `calibrate`."""

import re
from dataclasses import dataclass

from conf.schema import check, part, require, setting
from envs.identification.calibration import IdentifyConfig
from envs.identification.open_loop import OpenLoop

__all__ = ["CalibrateConfig"]

LAWS = ("open_loop", "pi", "pi_tuned", "threshold", "proportional")


@dataclass(frozen=True)
class CalibrateConfig:
    """Config of a calibration, of the generator of recordings, or of the study of the intervals' coverage."""

    data: str | None = setting(None, "recording (CSV); null: the simulated recording of the project")
    rows: str | None = setting(None, "FIRST:END, data rows from 0, without END; null: all")
    run: int | None = setting(None, "run in a file of several concatenated runs, from 0; null: the longest")
    reactor: str | None = setting(None, "reactor in a file with a column `reactor`; null: the first")
    pump_ml_s: float = setting(
        1.0,
        "flow of the Chi.Bio's feed pump at full power (its CSV has duties, not flows)",
        "mL/s",
        above=0.0,
        at_most=10.0,
    )
    name: str = setting("calibrated", "name of the environment file RUN/<name>.yaml")
    pumps: tuple[int, ...] = setting(
        (1,), "pumps in the Chi.Bio's CSV that feed the vial (1 to 4); their flows are added", within=(1, 4), some=True
    )
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
        (0.5,), "setpoints of a feedback controller, in equal parts", "OD", within=(0.05, 2), some=True
    )
    rest_min: float = setting(
        0.0, "pause of the pump at the start of every hour, for a feedback controller", "min", within=(0, 50)
    )
    gain: float = setting(0.1, "gain of law=proportional", "mL/s per OD", within=(0, 1))
    protocol: OpenLoop = part(OpenLoop, "protocol, culture and sensor of a simulated recording")

    def __post_init__(self) -> None:
        check(self)
        named = re.fullmatch(r"[\w-]+", self.name)
        require(bool(named), "name", self.name, "letters, digits, _ and - (it names a file)")
        spans = self.rows is None or re.fullmatch(r"\d*:\d*", self.rows)
        require(bool(spans), "rows", self.rows, "FIRST:END, e.g. 0:700 (data rows from 0, END excluded)")
