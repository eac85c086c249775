"""OD, temperature, pumps and volume of an emulated vial (docs/device.md), times computed independently."""

import math
from dataclasses import replace

import numpy as np
import pytest

from conf import schema
from conf.presets import groups, load
from envs.plant.plant import PlantConfig
from hardware.chibio.config import EmulatorConfig
from hardware.emulator.faults import inject
from hardware.emulator.server import build, parser
from tests.hardware.emulator_lab import BIAS_S, BLANK, START_S, STOP_S, Lab, quiet, running

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
    lab = Lab(options=quiet(blank=(60000.0, 60000.0)), od=0.0)
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
    names, options = tuple(f"M{k}" for k in range(8)), quiet(blank=(11600.0, 15800.0))
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


PERIOD_S = 63.0 + 0.8 * START_S  # it counts from when the registers are off, four of the five writes of a start


def test_a_pump_left_on_doses_63_s_times_target_every_63_s_for_ever() -> None:
    lab = Lab()
    lab.pump("Pump1", 0.02)
    lab.wait(10.0 * PERIOD_S + 5.0)
    starts, lengths = zip(*lab.doses(), strict=True)
    assert len(starts) == 11
    assert starts[0] == pytest.approx(START_S, abs=0.02)  # the dose comes first, the pause after
    np.testing.assert_allclose(np.diff(starts), PERIOD_S, atol=0.02)
    np.testing.assert_allclose(lengths, 63 * 0.02 + BIAS_S, atol=1e-6)


@pytest.mark.parametrize(
    ("target", "off_s", "lengths"),
    [
        (0.05, START_S + 63 * 0.05 + BIAS_S, [3.15 + BIAS_S]),  # a single shot
        (0.5, START_S + 2.0, [2.0 + STOP_S]),  # ended in its progress
        (0.5, 0.5 * START_S, []),  # before the motor turns
    ],
)
def test_off_leaves_what_was_dosed_until_then(target: float, off_s: float, lengths: list[float]) -> None:
    lab = Lab()
    lab.pump("Pump1", target)
    lab.wait(off_s)
    lab.post("/SetOutputOn/Pump1/0/M0")
    lab.wait(300.0)
    assert [length for _, length in lab.doses()] == pytest.approx(lengths, abs=0.02)
    assert lab.device.truth("M0")["feed_ml"] == pytest.approx(sum(lengths), abs=0.02)  # 1 mL/s, perfect head


def test_the_motor_starts_after_a_delay_of_its_own_each_time() -> None:
    lab = Lab(options=quiet(pump_start_s=(0.2, 0.7)))
    delays = []
    for _ in range(200):
        lab.pump("Pump1", 0.05)
        answered = lab.clock.now()
        lab.wait(10.0)
        lab.post("/SetOutputOn/Pump1/0/M0")
        [start, length] = lab.doses()[-1]
        delays.append(start - answered)
        assert length == pytest.approx(3.15 + BIAS_S)
    assert 0.2 <= min(delays) < 0.23
    assert 0.67 < max(delays) <= 0.7
    assert np.mean(delays) == pytest.approx(0.45, abs=0.03)


def test_the_delay_is_an_option_of_the_program() -> None:
    for arguments, expected in (([], (0.2, 0.7)), (["--pump-start", "0.1", "3"], (0.1, 3.0))):
        vial = build(parser().parse_args(arguments)).options.vial
        assert vial.pump_start_s == expected


@pytest.mark.parametrize("name", groups()["plant"])
def test_the_emulated_plant_is_the_preset_dosed_in_pulses(name: str) -> None:
    preset = schema.build(PlantConfig(), load(f"plant/{name}"), "plant")
    device = build(parser().parse_args(["--plant", name]))
    assert device.vials["M0"].plant.config == replace(preset, pump=replace(preset.pump, dosing="pulse"))
    assert EmulatorConfig(plant=name).plant == name


def test_rewriting_the_target_while_on_doses_at_once_and_restarts_the_period() -> None:
    lab = Lab()
    lab.pump("Pump1", 0.02)
    lab.wait_until(30.0)
    lab.pump("Pump1", 0.05, on=False)
    lab.wait_until(120.0)
    starts = [start for start, _ in lab.doses()]
    lengths = [length for _, length in lab.doses()]
    assert starts == pytest.approx([START_S, 30.0 + START_S, 30.0 + START_S + PERIOD_S], abs=0.03)
    assert lengths == pytest.approx([1.26 + BIAS_S, 3.15 + BIAS_S, 3.15 + BIAS_S])


@pytest.mark.parametrize("target", [1.0, -1.0, math.nan])
def test_full_duty_is_continuous_and_no_number_moves_nothing(target: float) -> None:
    lab = Lab()
    lab.pump("Pump3", target)
    lab.wait(400.0)
    assert lab.device.vials["M0"].motor("Pump3") == (0 if math.isnan(target) else target)
    assert lab.doses(pump="Pump3") == []  # never switched off between periods
    lab.post("/SetOutputOn/Pump3/0/M0")
    lab.wait(1.0)
    lengths = [] if math.isnan(target) else [400.0 - START_S + STOP_S]
    assert [length for _, length in lab.doses(pump="Pump3")] == pytest.approx(lengths, abs=0.03)


@pytest.mark.parametrize("turned", [False, True])
def test_negative_target_runs_backwards_and_draws_culture_out(turned: bool) -> None:
    """Also where it is turned before the thread reads it."""
    lab = Lab()
    lab.pump("Pump1", 0.05 if turned else -0.05)
    if turned:
        lab.post("/Direction/Pump1/M0")
    lab.wait(10.0)
    assert [d.direction for d in lab.device.vials["M0"].doses] == [-1]
    truth = lab.device.truth("M0")
    assert truth["feed_ml"] == 0.0
    assert truth["volume_ml"] == pytest.approx(20.0 - 3.15 - BIAS_S)


def test_volume_balance_waste_level_and_overflow() -> None:
    lab = Lab()
    lab.pump("Pump1", 0.02)
    lab.wait(5.0)
    lab.post("/SetOutputOn/Pump1/0/M0")
    truth = lab.device.truth("M0")
    assert truth["volume_ml"] == pytest.approx(20.0 + 1.26 + BIAS_S)
    lab.pump("Pump2", 0.15)
    lab.wait(15.0)
    assert lab.device.truth("M0")["volume_ml"] == pytest.approx(20.0)  # down to the waste tube, not below
    lab.post("/SetOutputOn/Pump2/0/M0")
    inject(lab.device, "waste_gain_factor", "M0", 0.0)
    lab.pump("Pump2", 1.0)
    lab.pump("Pump1", 0.5)
    lab.wait(9.0)
    assert not lab.device.truth("M0")["overflowed"]
    lab.wait(3.0)
    truth = lab.device.truth("M0")
    assert truth["overflowed"]
    assert truth["peak_ml"] == pytest.approx(30.0)


@pytest.mark.parametrize(("overflow_pump", "level"), [("Pump3", 22.0), ("", 25.0 + BIAS_S)])
def test_a_spare_pump_moves_liquid_only_if_it_has_a_tube(overflow_pump: str, level: float) -> None:
    options = quiet()
    lab = Lab(options=replace(options, vial=replace(options.vial, overflow_pump=overflow_pump)))
    lab.pump("Pump3", 0.5)
    lab.pump("Pump1", 5.0 / 63.0)
    lab.wait(8.0)
    lab.post("/SetOutputOn/Pump1/0/M0")
    assert lab.device.truth("M0")["motors"]["Pump3"] == 1
    assert lab.device.truth("M0")["volume_ml"] == pytest.approx(level)
    inject(lab.device, "overflow_gain_factor", "M0", 0.0)
    lab.pump("Pump1", 1.0 / 63.0)
    lab.wait(5.0)
    assert lab.device.truth("M0")["volume_ml"] == pytest.approx(level + 1.0 + BIAS_S)


@pytest.mark.parametrize(
    ("fault", "value", "delivered"),
    [
        ("pump_gain_factor", 0.0, [0.0, 0.0]),
        ("pump_gain_factor", 0.3, [0.3, 0.6]),
        ("media_left_ml", 0.5, [0.5, 0.5]),
        ("back_leak_ml", 0.2, [0.8, 1.6]),  # from every pulse
    ],
)
def test_pump_faults_change_what_arrives_not_what_is_said(fault: str, value: float, delivered: list[float]) -> None:
    lab = Lab()
    inject(lab.device, fault, "M0", value)
    lab.pump("Pump1", (1.0 - BIAS_S) / 63.0)
    for seconds, ml in zip((5.0, 65.0), delivered, strict=True):
        lab.wait(seconds)
        assert lab.state()["Pump1"]["ON"] == 1
        assert lab.device.truth("M0")["feed_ml"] == pytest.approx(ml)


def test_stuck_open_pump_runs_although_the_device_says_off() -> None:
    lab = Lab()
    inject(lab.device, "feed_stuck_open", "M0")
    lab.wait(10.0)
    lab.post("/SetOutputOn/Pump1/0/M0")
    assert lab.state()["Pump1"]["ON"] == 0
    inject(lab.device, "feed_stuck_open", "M0", 0)
    assert lab.device.truth("M0")["feed_ml"] == pytest.approx(10.0, abs=0.1)
    lab.wait(100.0)
    assert lab.device.truth("M0")["feed_ml"] == pytest.approx(10.0, abs=0.1)


def test_dose_log_agrees_with_on_time_and_volume() -> None:
    lab = Lab(("M0", "M1", "M2"), seed=3)
    rng = np.random.default_rng(1)
    for _ in range(300):
        m = rng.choice(["M0", "M1", "M2"])
        lab.pump("Pump1", float(rng.uniform(0.0, 0.1)), on=bool(rng.random() < 0.7), reactor=m)
        if rng.random() < 0.4:
            lab.post(f"/SetOutputOn/Pump1/{rng.integers(0, 2)}/{m}")
        lab.wait(float(rng.exponential(8.0)))
    for m in lab.device.vials:
        lab.post(f"/SetOutputOn/Pump1/0/{m}")
    lab.wait(1.0)
    for m in lab.device.vials:
        truth = lab.device.truth(m)
        doses = [d for d in lab.device.vials[m].doses if d.pump == "Pump1"]
        assert sum(d.seconds for d in doses) == pytest.approx(truth["on_s"]["Pump1"])
        assert sum(d.feed_ml for d in doses) == pytest.approx(truth["feed_ml"])
        assert truth["feed_ml"] == pytest.approx(truth["on_s"]["Pump1"])


def test_spare_pumps_supply_by_their_own_flow_for_as_long_as_they_run_forward() -> None:
    """Ten seconds of 0.3 mL/s by Pump3, of which the last four beside 0.5 mL/s of Pump4; then Pump3 backwards."""
    lab = Lab(options=quiet(pump3_ml_s=0.3, pump4_ml_s=0.5))
    vial = lab.device.vials["M1"]
    for at, pump, direction in ((0.0, "Pump3", 1), (6.0, "Pump4", 1), (10.0, "Pump3", 0), (10.0, "Pump4", 0)):
        vial.drive(pump, direction, at)
    assert vial.supplied_ml == pytest.approx({"Pump3": 3.0, "Pump4": 2.0})
    vial.drive("Pump3", -1, 20.0)
    vial.drive("Pump3", 0, 25.0)
    assert vial.supplied_ml == pytest.approx({"Pump3": 3.0, "Pump4": 2.0})
    assert vial.on_s == pytest.approx({"Pump1": 0.0, "Pump2": 0.0, "Pump3": 15.0, "Pump4": 4.0})
    told = [(d.pump, d.start_s, d.seconds, d.direction) for d in vial.doses]
    assert sorted(told) == [("Pump3", 0.0, 10.0, 1), ("Pump3", 20.0, 5.0, -1), ("Pump4", 6.0, 4.0, 1)]
    truth = vial.truth(25.0)
    assert truth["volume_ml"] == pytest.approx(25.0)
    assert truth["feed_ml"] == 0.0
    assert truth["motors"] == dict.fromkeys(("Pump1", "Pump2", "Pump3", "Pump4"), 0)
    vial.set_fault("waste_stuck_open", True, 30.0)
    assert [vial.motor(pump) for pump in truth["motors"]] == [0, 1, 0, 0]
