"""The vendor's jobs that a run keeps going on a unit: what each is started with, and what shows that it works."""

import math
from typing import Any

from hardware.errors import DeviceStateError
from hardware.pioreactor.config import PioreactorConfig
from hardware.pioreactor.versions import Facts

__all__ = ["AUTOMATION", "GONE", "HEAT", "OD", "STIR", "flow", "regulates", "request", "target_of"]

OD, HEAT, STIR, AUTOMATION = "od_reading", "temperature_automation", "stirring", "dosing_automation"
Asked = tuple[dict[str, Any], list[list[str]]]
EXCHANGE_ML = 1.0  # of the vendor's turbidostat
GONE = {OD: "takes no OD readings", HEAT: "does not heat", STIR: "does not stir", AUTOMATION: "does not regulate"}
"""What is said of a unit on which a job ended although it should run."""


def target_of(config: PioreactorConfig, facts: Facts, setpoint: float) -> dict[str, Any]:
    """Build the options of the vendor's turbidostat: a setpoint, OD, as its own reading."""
    return {facts.target: setpoint / config.od_scale + config.od_zero, **dict(facts.signal)}


def request(job: str, config: PioreactorConfig, facts: Facts, temperature: float, setpoint: float) -> Asked:
    """Options and overrides of its configuration that a job is asked for with: of thermostat and turbidostat, too."""
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
    """Whether the settings of the vendor's turbidostat are those that it was asked for with."""
    try:
        pairs = [(settings["settings"][key.replace("-", "_")], value) for key, value in asked.items()]
        return all(abs(float(a) - b) <= 1e-6 if isinstance(b, float) else a == b for a, b in pairs)
    except (KeyError, TypeError, ValueError):
        return False


def flow(calibrations: Any, pump: str) -> float:
    """Return mL per second at the calibrated duty. Raises: DeviceStateError without a usable calibration.

    A line is a list [slope, intercept], or in newer versions {type: poly, coefficients: [slope, intercept]}; of other
    curves the slope is that of the line through 0 that fits what was weighed.
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
        remedy = f"calibrate it in the vendor's page (Calibrations, {pump}); doses in mL are refused without"
        raise DeviceStateError(f"no active calibration of the {pump} that gives mL per second; {remedy}")
    return slope
