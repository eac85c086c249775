"""Optical density and temperature as the device misreads them (docs/device.md, OD measurement and Thermostat)."""

import numpy as np
import pytest

from hardware.emulator.faults import inject
from tests.hardware.emulator_lab import BLANK, Lab, quiet, running

A, B = 0.226, 1.833


def test_formula_with_a_calibrated_and_an_uncalibrated_zero() -> None:
    lab = Lab(od=0.5)
    lab.post("/MeasureOD/M0")
    raw = lab.state()["OD0"]["raw"]
    # 0.5 = B r + A r^2  ->  r = 0.2637..., raw = 14000 10^-r (+ 3 dark counts)
    assert raw == pytest.approx(14000 * 10**-0.264131 + 3, abs=3.0)
    r = np.log10(65000.0 / raw)
    assert lab.state()["OD"]["current"] == pytest.approx(B * r + A * r * r)
    assert lab.state()["OD"]["record"] == []
    lab.post("/CalibrateOD/OD0/M0/14000/0")
    assert lab.state()["OD"]["current"] == pytest.approx(B * r + A * r * r)  # not recomputed yet
    lab.post("/MeasureOD/M0")
    assert lab.state()["OD"]["current"] == pytest.approx(0.5, abs=1e-3)


def test_calibration_to_a_known_od() -> None:
    lab = Lab()
    lab.post("/CalibrateOD/OD0/M0/8000/0.5")
    r = -B / (2 * A) + np.sqrt(0.5 / A + (B / (2 * A)) ** 2)
    assert lab.state()["OD0"]["target"] == pytest.approx(8000 * 10**r)
    lab.post("/CalibrateOD/OD0/M0/8000/-1")
    assert lab.state()["OD0"]["target"] == 8000.0
    lab.post("/CalibrateOD/OD0/M0/900000/0")
    assert lab.state()["OD0"]["target"] == 100000.0


@pytest.mark.parametrize("path", ["/CalibrateOD/OD0/M0/0/0", "/SetOutputTarget/Volume/M0/0"])
def test_a_zero_or_a_volume_of_0_kills_the_cycle(path: str) -> None:
    """The zero in every measurement, the volume where the device regulates itself."""
    lab = Lab()
    lab.post(path)
    assert lab.post("/MeasureOD/M0") == (500 if "OD0" in path else 204)
    lab.post("/Experiment/1/M0")
    lab.post("/SetOutputOn/OD/1/M0")
    lab.wait(600.0)
    state = lab.state()
    assert (state["Experiment"]["ON"], state["Experiment"]["cycles"]) == (1, 1)
    assert state["OD"]["record"] == []


@pytest.mark.parametrize(
    ("fault", "value", "zero", "raw", "od"),
    [
        ("spectrometer_dead", 1.0, 65000.0, 1.0, 14.06),
        ("spectrometer_dead", 1.0, 16000.0, 1.0, 11.7),
        ("spectrometer_dark", 1.0, 65000.0, 0.0, 0.0),
        ("od_offset", -0.5, 65000.0, 65535.0, -0.0065),  # saturated at 16 bits
    ],
)
def test_a_spectrometer_at_its_ends(fault: str, value: float, zero: float, raw: float, od: float) -> None:
    lab = Lab(options=quiet(blank_low=60000.0, blank_high=60000.0), od=0.0)
    lab.post(f"/CalibrateOD/OD0/M0/{zero}/0")
    inject(lab.device, fault, "M0", value)
    assert lab.post("/MeasureOD/M0") == 204
    assert lab.state()["OD0"]["raw"] == raw
    assert lab.state()["OD"]["current"] == pytest.approx(od, abs=1e-4 if abs(od) < 1.0 else 0.01)


def test_one_bad_reading_of_four_shifts_the_mean_by_about_3() -> None:
    lab = Lab(options=quiet(), od=0.5, blanked=True)
    inject(lab.device, "spectrometer_glitch", "M0", 1.0)
    lab.post("/Experiment/1/M0")
    lab.wait_until(6.5)  # after the first reading
    inject(lab.device, "spectrometer_glitch", "M0", 0.0)
    lab.wait_until(20.0)
    r = np.log10(BLANK / 1.0)
    assert lab.state()["OD"]["record"][-1] == pytest.approx((B * r + A * r * r + 3 * 0.5) / 4, abs=0.01)
    assert lab.state()["OD"]["record"][-1] - 0.5 == pytest.approx(2.8, abs=0.3)


def test_stirred_reading_is_several_times_smaller() -> None:
    lab = Lab(od=0.5)
    lab.post("/MeasureOD/M0")
    still = lab.state()["OD0"]["raw"]
    lab.post("/SetOutputOn/Stir/1/M0")
    lab.post("/MeasureOD/M0")
    assert lab.state()["OD0"]["raw"] == pytest.approx(0.4 * still, rel=0.01)
    lab.post("/SetOutputOn/Stir/0/M0")
    lab.wait(5.0)
    lab.post("/MeasureOD/M0")
    assert lab.state()["OD0"]["raw"] == still


def test_a_rival_measurement_spoils_the_one_of_the_cycle() -> None:
    lab = running(od=0.5, blanked=True)
    lab.wait_until(5.5)
    for _ in range(3):
        lab.post("/MeasureOD/M0")
    lab.wait_until(20.0)
    spoilt = lab.state()["OD"]["record"][-1]
    assert spoilt > 0.55  # a real run recorded 0.68 for 0.53
    lab.wait_until(80.0)
    assert lab.state()["OD"]["record"][-1] == pytest.approx(0.5, abs=0.002)


def test_noise_of_a_reading_and_of_the_mean() -> None:
    lab = running(options=quiet(noise_fraction=0.003, common_fraction=0.004), od=0.5, blanked=True, wait=180 * 60.07)
    records = np.array(lab.state()["OD"]["record"])
    assert records.mean() == pytest.approx(0.5, abs=0.002)
    assert records.std() == pytest.approx(0.0036, rel=0.2)  # median of public logs at this OD
    assert len(np.unique(records)) > 170  # true repeats are rare


def test_blanks_are_in_the_range_seen_on_real_devices() -> None:
    names, options = tuple(f"M{k}" for k in range(8)), quiet(blank_low=11600.0, blank_high=15800.0)
    labs = [Lab(names, seed=s, options=options) for s in range(5)]
    counts = [v.spectrometer.blank for lab in labs for v in lab.device.vials.values()]
    assert min(counts) >= 11600.0
    assert max(counts) <= 15800.0
    assert np.std(counts) > 500.0


def test_sensor_faults_frozen_offset_jump() -> None:
    lab = running(mu=0.02, od=0.3, blanked=True)
    lab.wait_until(200.0)
    inject(lab.device, "od_frozen", "M0")
    lab.wait_until(560.0)
    records = lab.state()["OD"]["record"]
    assert len(set(records[-4:])) == 1  # exact repetition
    inject(lab.device, "od_frozen", "M0", 0)
    inject(lab.device, "od_offset", "M0", 0.05)
    lab.wait_until(620.0)
    assert lab.state()["OD"]["record"][-1] == pytest.approx(lab.device.truth("M0")["od"] + 0.05, rel=0.02)
    inject(lab.device, "od_offset", "M0", 0.0)
    inject(lab.device, "od_jump", "M0", 0.3)
    lab.wait_until(740.0)
    last = lab.state()["OD"]["record"][-2:]
    assert last[0] - last[1] == pytest.approx(0.3, abs=0.02)  # one measurement only


def test_thermometers() -> None:
    lab = Lab(temperature=30.0)
    for which in ("IR", "Internal", "External"):
        assert lab.post(f"/MeasureTemp/{which}/M0") == 204
    state = lab.state()
    assert state["ThermometerIR"]["current"] == pytest.approx(30.0, abs=0.3)
    for which in ("Internal", "External"):
        value = state[f"Thermometer{which}"]["current"]
        assert value * 16 == pytest.approx(round(value * 16))
        assert 20.0 < value < 30.0


def test_thermostat_step_by_hand() -> None:
    lab = Lab(temperature=36.0)
    lab.post("/SetOutputOn/Thermostat/1/M0")
    state = lab.state()
    reading = state["ThermometerIR"]["current"]
    # first step: the target has "moved" from -1, so the integrator is cleared; |e| < 2: P = 0.25 e
    assert state["Thermostat"]["Integral"] == 0.0
    assert state["Heat"]["target"] == pytest.approx(0.25 * (37.0 - reading))
    lab.wait(30.5)
    state = lab.state()
    error = 37.0 - state["ThermometerIR"]["current"]
    assert state["Thermostat"]["Integral"] == pytest.approx(0.0005 * 30 * error)
    assert state["Heat"]["target"] == pytest.approx(0.25 * error + 0.0005 * 30 * error)
    lab.post("/SetOutputTarget/Thermostat/M0/30")  # acts at the next step, no restart
    assert lab.state()["Heat"]["target"] == state["Heat"]["target"]
    lab.wait(30.0)
    assert (lab.state()["Heat"]["target"], lab.state()["Heat"]["ON"]) == (0, 0)


def test_thermostat_switched_on_twice_is_cold_until_the_new_thread_s_next_step() -> None:
    lab = Lab(temperature=30.0)
    lab.post("/SetOutputOn/Thermostat/1/M0")
    lab.wait(10.0)
    lab.post("/SetOutputOn/Thermostat/1/M0")
    lab.wait(15.0)
    assert lab.device.truth("M0")["heat"] == 1.0
    lab.wait(8.0)  # the old thread woke at 30
    assert lab.device.truth("M0")["heat"] == 0.0
    lab.wait(10.0)  # the new one at 40
    assert lab.device.truth("M0")["heat"] == 1.0
