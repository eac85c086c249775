"""The files that the vendor's software looks for on a unit, written to its documented formats."""

from collections.abc import Mapping, Sequence
from pathlib import Path

__all__ = ["FLOWS", "PINS", "calibration", "layout", "wrapper"]

PINS = {"stirring": 17, "media": 13, "alt_media": 16, "waste": 12, "heating": 18}
"""GPIO pin of each output; 12 and 13 are the two that a chip drives on, whatever becomes of the process."""

CHANNELS = {"stirring": 1, "media": 2, "alt_media": 3, "waste": 4, "heating": 5}  # wiring as shipped

FLOWS = {"media_pump": 1.0, "waste_pump": 2.0}  # mL/s

CONFIG = """[cluster.topology]
leader_hostname={leader}
leader_address=127.0.0.1
[cluster.addresses]
{addresses}
[mqtt]
username=pioreactor
password=raspberry
broker_address=127.0.0.1
broker_port={broker}
broker_ws_port=9001
ws_protocol=ws
use_tls=0
[ui]
port={port}
proto=http
[storage]
database={folder}/storage/pioreactor.sqlite
temporary_cache={folder}/cache/temporary.sqlite
persistent_cache={folder}/storage/persistent.sqlite
number_of_backup_replicates_to_workers=0
[logging]
log_file={folder}/unit.log
ui_log_file={folder}/unit.log
ui_log_level=DEBUG
console_log_level=ERROR
[PWM]
{channels}
[leds]
A=IR
B=
C=
D=
[bioreactor]
max_working_volume_ml={volume_ml}
initial_volume_ml={volume_ml}
initial_alt_media_fraction=0
[od_config.photodiode_channel]
1=REF
2=90
[od_reading.config]
samples_per_second=0.2
turn_off_leds_during_reading=1
pd_reference_ema=0.4
ir_led_intensity=80
smoothing_penalizer=3.0
ref_normalization=unity
[stirring.config]
initial_target_rpm=500
initial_duty_cycle=30
pwm_hz=200
use_rpm=1
duration_between_updates_seconds=23
enable_dodging_od=0
post_delay_duration=0.25
pre_delay_duration=0.25
target_rpm_during_od_reading=0
target_rpm_outside_od_reading=500
[stirring.pid]
Kp=0.005
Ki=0
Kd=0
[temperature_automation.thermostat]
Kp=2.6
Ki=0
Kd=4.6
[turbidostat.config]
signal_channel=2
od_smoothing_ema=0.5
[dosing_automation.config]
pause_between_subdoses_seconds=0.5
waste_removal_multiplier=2
max_subdose=1.0
experimental_detect_pump_malfunction=0
[growth_rate_kalman]
obs_std=1.0
od_std=0.0025
rate_std=0.15
[growth_rate_calculating.config]
ekf_outlier_std_threshold=5.0
samples_for_od_statistics=10
"""

HATS = {
    "pwm": "controller: rpi_gpio\nheater_pwm_channel: '5'\npwm_to_pin: {"
    + ", ".join(f"'{CHANNELS[name]}': {pin}" for name, pin in PINS.items())
    + "}\n",
    "adc": "".join(
        f"{name}: {{driver: ads1115, address: 0x48, channel: {k}}}\n"
        for name, k in (("pd1", 1), ("pd2", 0), ("aux", 2), ("version", 3))
    ),
    "dac": "address: 0x49\n",
    "temp": "address: 0x4f\n",
    "gpio": "pcb_led_pin: 23\npcb_button_pin: 24\nhall_sensor_pin: 25\nsda_pin: 2\nscl_pin: 3\n",
}

FOLDERS = (
    "cache", "exports", "experiment_profiles", "exportable_datasets", "plugins", "ui/automations/dosing",
    "ui/automations/led", "ui/automations/temperature", "ui/charts", "ui/jobs", "ui/settings", "hardware/hats/1.2",
    "storage/calibrations/media_pump", "storage/calibrations/waste_pump",
)  # fmt: skip


def layout(folder: Path, unit: str, units: Sequence[str], port: int, broker: int, volume_ml: float) -> None:
    """Everything below a unit's folder. Args: port: of its web server. broker: port of MQTT."""
    for name in FOLDERS:
        (folder / name).mkdir(parents=True, exist_ok=True)
    addresses = "\n".join(f"{name}=127.0.0.{k}" for k, name in enumerate(units, 1))
    channels = "\n".join(f"{k}={name}" for name, k in CHANNELS.items())
    values = {"leader": units[0], "addresses": addresses, "channels": channels, "volume_ml": volume_ml}
    text = CONFIG.format(folder=folder, port=port, broker=broker, **values)
    (folder / "config.ini").write_text(text, encoding="utf-8")
    (folder / "unit_config.ini").write_text("", encoding="utf-8")
    (folder / "storage" / "pioreactor.sqlite").touch()
    for name, content in HATS.items():
        (folder / "hardware" / "hats" / "1.2" / f"{name}.yaml").write_text(content, encoding="utf-8")
    for pump in ("media_pump", "waste_pump"):
        path = folder / "storage" / "calibrations" / pump / f"rig-{pump}.yaml"
        path.write_text(calibration(pump, unit, FLOWS[pump]), encoding="utf-8")


def calibration(pump: str, unit: str, flow_ml_s: float) -> str:
    """A calibration of a pump in the vendor's format, which moves `flow_ml_s` at full duty."""
    points = [0.5, 1.0, 2.0]
    return (
        f"calibration_type: simple_peristaltic_pump\ncalibration_name: rig-{pump}\n"
        f"calibrated_on_pioreactor_unit: {unit}\ncreated_at: 2026-01-01T00:00:00Z\n"
        f"curve_data_: [{flow_ml_s}, 0.0]\ncurve_type: poly\nx: Duration\ny: Volume\n"
        f"recorded_data: {{x: {points}, y: {[flow_ml_s * p for p in points]}}}\nhz: 250.0\ndc: 100.0\nvoltage: 12.0\n"
    )


def wrapper(program: Path, variables: Mapping[str, str]) -> str:
    """A script that runs one of the vendor's programs with the rig's variables, which its task queue drops."""
    lines = "".join(f"export {key}='{value}'\n" for key, value in variables.items())
    return f'#!/bin/sh\n{lines}exec "{program}" "$@"\n'
