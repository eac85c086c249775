"""The vendor's jobs that a run keeps going on a unit: what each is started with."""

import math
from typing import Any

from hardware.errors import DeviceStateError
from hardware.pioreactor.config import PioreactorConfig

__all__ = ["AUTOMATION", "HEAT", "OD", "STIR", "flow", "gone", "request"]

OD, HEAT, STIR, AUTOMATION = "od_reading", "temperature_automation", "stirring", "dosing_automation"
EXCHANGE_ML = 1.0  # of the vendor's turbidostat
WORDS = {OD: "takes no OD readings", HEAT: "does not heat", STIR: "does not stir", AUTOMATION: "does not regulate"}


def gone(job: str) -> str:
    """What is said of a unit on which this job ended although it should run."""
    return f"the unit {WORDS[job]}"


def request(
    job: str, config: PioreactorConfig, temperature: float, setpoint: float
) -> tuple[dict[str, Any], list[list[str]]]:
    """Options and overrides of its configuration that a job is asked for with.

    Args: temperature: target of the thermostat, degC. setpoint: of the vendor's turbidostat, OD, nan without one.
    """
    if job == OD:
        rate = str(round(1.0 / config.reading_s, 4))
        return {}, [[f"{OD}.config", "samples_per_second", rate], [f"{OD}.config", "smoothing_penalizer", "0"]]
    if job == HEAT:
        return {"automation-name": "thermostat", "target-temperature": temperature}, []
    if job == AUTOMATION:
        target = setpoint / config.od_scale + config.od_zero
        overrides = [["turbidostat.config", "signal_channel", config.channel]]
        return {"automation-name": "turbidostat", "target-od": target, "exchange-volume-ml": EXCHANGE_ML}, overrides
    return {}, []


def flow(calibrations: object, pump: str, unit: str) -> float:
    """mL per second at the calibrated duty. Raises: DeviceStateError if the unit has no usable calibration of it."""
    remedy = f"calibrate it in the vendor's page (Calibrations, {pump}); doses in mL are refused without"
    try:
        slope = float(calibrations[pump]["curve_data_"][-2])  # type: ignore[index]
    except (KeyError, TypeError, IndexError, ValueError):
        raise DeviceStateError(f"{unit}: no active calibration of the {pump}; {remedy}") from None
    if not (slope > 0.0 and math.isfinite(slope)):
        raise DeviceStateError(f"{unit}: calibration of the {pump} = {slope} mL/s: allowed > 0; {remedy}")
    return slope
