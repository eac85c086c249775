"""The files that the vendor's software needs on a unit, written in its documented formats."""

import json
import sqlite3
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from hardware.pioreactor.config import vial_ml
from hardware.pioreactor.versions import Facts

AT = "2026-01-01T00:00:00.000Z"  # creation time in all files

LOGIN = ("pioreactor", "raspberry")  # name and password at the broker, as the vendor ships them

PINS = {"stirring": 17, "media": 13, "alt_media": 16, "waste": 12, "heating": 18}
"""GPIO pin of each output; a chip drives pins 12 and 13, which therefore stay on when their process is killed."""

CHANNELS = {"stirring": 1, "media": 2, "alt_media": 3, "waste": 4, "heating": 5}  # wiring as shipped

ADC = ("pd2", "pd1", "aux", "version")  # by channel

# One section with its entries per line. The tube's level has both of its names; the rest is the vendor's default.
CONFIG = """cluster.topology leader_hostname={leader} leader_address=127.0.0.1
cluster.addresses {addresses}
mqtt username={login[0]} password={login[1]} broker_address=127.0.0.1 broker_port={broker} use_tls=0
ui port={port} proto=http
storage database={database} temporary_cache={folder}/cache/temporary.sqlite \
persistent_cache={folder}/storage/persistent.sqlite
logging log_file={folder}/unit.log ui_log_file={folder}/unit.log console_log_level=ERROR
PWM {channels}
leds A=IR
bioreactor max_working_volume_ml={volume_ml} efflux_tube_volume_ml={volume_ml} initial_volume_ml={volume_ml} \
initial_alt_media_fraction=0
od_config.photodiode_channel 1=REF 2=90
od_reading.config samples_per_second=0.2 pd_reference_ema=0.4 ir_led_intensity=80 turn_off_leds_during_reading=1 \
use_dark_offsets=1 smoothing_penalizer=3.0 ref_normalization=classic
stirring.config initial_target_rpm=500 initial_duty_cycle=30 pwm_hz=200 use_rpm=1 duration_between_updates_seconds=23 \
target_rpm_during_od_reading=0 target_rpm_outside_od_reading=500 enable_dodging_od=0 \
post_delay_duration=0.25 pre_delay_duration=0.25
stirring.pid Kp=0.005 Ki=0 Kd=0
temperature_automation.thermostat Kp=2.6 Ki=0 Kd=4.6
turbidostat.config signal_channel=2 od_smoothing_ema=0.5
dosing_automation.turbidostat biomass_signal=auto
dosing_automation.config pause_between_subdoses_seconds=0.5 waste_removal_multiplier=2 max_subdose=1.0"""

HATS: dict[str, dict[str, Any]] = {
    "pwm": {"controller": "rpi_gpio", "pwm_to_pin": {str(k): PINS[name] for name, k in CHANNELS.items()}},
    "adc": {name: {"driver": "ads1115", "address": 0x48, "channel": k} for k, name in enumerate(ADC)},
    "dac": {"address": 0x49},
    "temp": {"address": 0x4F},
    "gpio": {"pcb_led_pin": 23, "pcb_button_pin": 24, "hall_sensor_pin": 25, "sda_pin": 2, "scl_pin": 3},
}
HATS["pwm"]["heater_pwm_channel"] = str(CHANNELS["heating"])

TABLES = """CREATE TABLE experiments (experiment, created_at, description);
CREATE TABLE experiment_tags (experiment, tag, created_at);
CREATE TABLE workers (pioreactor_unit, added_at, model_name, model_version, is_active);
CREATE TABLE experiment_worker_assignments (pioreactor_unit, experiment, assigned_at);
"""

FOLDERS = (
    "cache", "exports", "experiment_profiles", "exportable_datasets", "plugins", "ui/automations/dosing",
    "ui/automations/led", "ui/automations/temperature", "ui/charts", "ui/jobs", "ui/settings", "hardware/hats/1.2",
    *(f"storage/calibrations/{pump}_pump" for pump in ("media", "alt_media", "waste")),
)  # fmt: skip


def flows(k: int) -> dict[str, float]:
    """Return the flows of unit k's pumps, mL/s: all different, except that unit 1 has three equal pumps."""
    flow = {"media_pump": (1.0, 0.8, 1.25), "alt_media_pump": (0.9, 0.8, 1.1), "waste_pump": (2.0, 0.8, 1.9)}
    return {pump: ml_s[k % 3] for pump, ml_s in flow.items()}


def model(volume_ml: float) -> str:
    return f"pioreactor_{vial_ml(volume_ml)}ml"


def layout(
    folder: Path, unit: str, hosts: Mapping[str, str], known: Facts, flow: Mapping[str, float],
    values: Mapping[str, object],
) -> None:  # fmt: skip
    """Write all files of a unit. Args: hosts: of all units. values: port, broker, database, login, volume_ml."""
    for name in FOLDERS:
        (folder / name).mkdir(parents=True, exist_ok=True)
    addresses = " ".join(f"{name}={host}" for name, host in hosts.items())
    channels = " ".join(f"{k}={name}" for name, k in CHANNELS.items())
    words = {"folder": folder, "leader": next(iter(hosts)), "addresses": addresses, "channels": channels}
    sections = (line.split() for line in CONFIG.format(**words, **values).splitlines())
    text = "".join("\n".join([f"[{section}]", *entries, ""]) for section, *entries in sections)
    (folder / "config.ini").write_text(text, encoding="utf-8")
    (folder / "unit_config.ini").write_text("", encoding="utf-8")
    for name, content in HATS.items():
        (folder / "hardware" / "hats" / "1.2" / f"{name}.yaml").write_text(json.dumps(content), encoding="utf-8")
    for pump, ml_s in flow.items():
        path = folder / "storage" / "calibrations" / pump / f"rig-{pump}.yaml"
        path.write_text(_calibration(pump, unit, ml_s, known), encoding="utf-8")


def _calibration(pump: str, unit: str, flow_ml_s: float, known: Facts) -> str:
    """Build the calibration of a pump with `flow_ml_s` at full duty, in the vendor's format."""
    points, line = [0.5, 1.0, 2.0], [flow_ml_s, 0.0]
    curve = f"{{type: poly, coefficients: {line}}}" if known.curve_struct else f"{line}\ncurve_type: poly"
    return (
        f"calibration_type: simple_peristaltic_pump\ncalibration_name: rig-{pump}\n"
        f"calibrated_on_pioreactor_unit: {unit}\ncreated_at: {AT}\ncurve_data_: {curve}\nx: Duration\ny: Volume\n"
        f"recorded_data: {{x: {points}, y: {[flow_ml_s * p for p in points]}}}\nhz: 250.0\ndc: 100.0\nvoltage: 12.0\n"
    )


def database(path: Path, units: Mapping[str, float], experiment: str) -> None:
    """Write the leader's database: its units, and the experiment to which all of them are assigned."""
    with sqlite3.connect(path) as db:
        db.executescript(TABLES)
        db.execute("INSERT INTO experiments VALUES (?, ?, '')", (experiment, AT))
        for unit, volume_ml in units.items():
            db.execute("INSERT INTO workers VALUES (?, ?, ?, '1.5', 1)", (unit, AT, model(volume_ml)))
            db.execute("INSERT INTO experiment_worker_assignments VALUES (?, ?, ?)", (unit, experiment, AT))


def wrapper(program: Path, variables: Mapping[str, str]) -> str:
    """Return a script that runs a program of the vendor with the rig's variables, which the task queue would drop."""
    lines = "".join(f"export {key}='{value}'\n" for key, value in variables.items())
    return f'#!/bin/sh\n{lines}exec "{program}" "$@"\n'
