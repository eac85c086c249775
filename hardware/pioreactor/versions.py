"""The vendor's software: differences between its versions, and the options with which its jobs are started."""

import math
import re
from dataclasses import dataclass, replace
from typing import Any

from hardware.pioreactor.config import PioreactorConfig
from hardware.pioreactor.messages import NotCalibrated

TESTED = ("25.11.19", "26.7.2", "26.11.1")  # versions that the tests run against
OD, HEAT, STIR, AUTOMATION = "od_reading", "temperature_automation", "stirring", "dosing_automation"
Asked = tuple[dict[str, Any], list[list[str]]]
EXCHANGE_ML = 1.0  # of the vendor's turbidostat
GONE = {OD: "takes no OD readings", HEAT: "does not heat", STIR: "does not stir", AUTOMATION: "does not regulate"}
"""Text, by job, on a unit whose job ended although it should run."""


@dataclass(frozen=True)
class Facts:
    """Facts about one version of the software; the defaults are those of 25.11.12.

    curve_struct: a calibration's curve is {type, coefficients}, not a list. purge: command that clears an entry of a
    cache. forget: command that removes a dead job from the list, "" if only a reboot does. target: the turbidostat's
    option for its target. signal: its further options. ledger: the unit keeps the vial's volume, reports it by MQTT,
    changes it by HTTP, and refuses doses by it. tube: setting with the level of the efflux tube.
    """

    curve_struct: bool = False
    purge: str = "pio cache clear"
    forget: str = ""
    target: str = "target-od"
    signal: tuple[tuple[str, str], ...] = ()
    ledger: bool = False
    tube: str = "max_working_volume_ml"


CHANGES: tuple[tuple[str, dict[str, Any]], ...] = (
    ("25.12.10", {"forget": "pio jobs remove"}),
    ("26.1.30", {"curve_struct": True}),
    ("26.2.23", {"purge": "pio cache purge", "forget": "pio jobs purge", "target": "target-biomass"}),
    ("26.2.23", {"signal": (("biomass-signal", "od"),)}),
    ("26.3.0", {"ledger": True}),
    ("26.4.0", {"tube": "efflux_tube_volume_ml"}),
)


def number(version: str) -> tuple[int, ...]:
    return tuple(int(part) for part in re.findall(r"\d+", version)[:3])


def facts(version: str) -> Facts:
    """Return the facts of a version: all changes up to it apply; a version without a number counts as the oldest."""
    known = Facts()
    for since, changed in CHANGES:
        if number(version) >= number(since):
            known = replace(known, **changed)
    return known


def target_of(config: PioreactorConfig, facts: Facts, setpoint: float) -> dict[str, Any]:
    """Build the options of the vendor's turbidostat, with the setpoint, OD, converted to its reading."""
    return {facts.target: setpoint / config.od_scale + config.od_zero, **dict(facts.signal)}


def request(job: str, config: PioreactorConfig, facts: Facts, temperature: float, setpoint: float) -> Asked:
    """Build the options and configuration overrides of a request for a job."""
    if job == OD:
        rate = str(round(1.0 / config.reading_s, 4))
        return {}, [[f"{OD}.config", "samples_per_second", rate], [f"{OD}.config", "smoothing_penalizer", "0"]]
    if job == HEAT:
        return {"automation-name": "thermostat", "target-temperature": temperature}, []
    if job == AUTOMATION:
        options = {"automation-name": "turbidostat", "exchange-volume-ml": EXCHANGE_ML}
        overrides = [["turbidostat.config", "signal_channel", config.channel]]
        return options | target_of(config, facts, setpoint), overrides
    return {}, []


def regulates(settings: Any, asked: dict[str, Any]) -> bool:
    try:
        pairs = [(settings["settings"][key.replace("-", "_")], value) for key, value in asked.items()]
        return all(abs(float(a) - b) <= 1e-6 if isinstance(b, float) else a == b for a, b in pairs)
    except (KeyError, TypeError, ValueError):
        return False


def flow(calibrations: Any, pump: str) -> float:
    """Return mL per second at the calibrated duty. Raises: NotCalibrated.

    A linear curve is a list [slope, intercept], or in newer versions {type: poly, coefficients: [slope, intercept]}.
    For another curve the slope is that of the line through 0 that fits the weighed data.
    """
    try:
        curve = calibrations[pump]["curve_data_"]
        if isinstance(curve, dict) and curve.get("type") != "poly":
            x, y = (list(map(float, calibrations[pump]["recorded_data"][key])) for key in ("x", "y"))
            slope = sum(a * b for a, b in zip(x, y, strict=True)) / sum(a * a for a in x)
        else:
            slope = float((curve["coefficients"] if isinstance(curve, dict) else curve)[-2])
    except (KeyError, TypeError, IndexError, ValueError, ZeroDivisionError):
        slope = math.nan
    if not (slope > 0.0 and math.isfinite(slope)):
        raise NotCalibrated(pump=pump)
    return slope
