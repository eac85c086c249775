"""The experiment cycle: timing, records, start and stop races, the turbidostat on board (docs/device.md)."""

import math
from dataclasses import replace

import numpy as np
import pytest

from envs.plant.plant import PlantConfig
from hardware.chibio.config import EmulatorConfig
from hardware.emulator import family
from hardware.emulator.faults import inject
from hardware.emulator.sysdata import append_records, fresh_sysdata, thin_records
from tests.hardware.emulator_lab import Lab, quiet, running


def cycle_start(lab: Lab, cycles: int) -> float:
    """Run until cycle number `cycles` has begun; its start, device s, to 10 ms."""
    while lab.peek()["Experiment"]["cycles"] < cycles:
        lab.wait(0.01)
    return lab.clock.now()


def test_start_turns_everything_off_and_the_thermostat_on() -> None:
    lab = Lab()
    for pump in range(1, 5):
        lab.pump(f"Pump{pump}", -0.1)
    lab.post("/SetOutputOn/Stir/1/M0")
    lab.post("/Direction/Pump1/M0")
    before = lab.clock.now()
    lab.post("/Experiment/1/M0")
    assert lab.clock.now() - before == pytest.approx(0.07, abs=0.03)
    state = lab.state()
    assert [state[f"Pump{k}"]["ON"] for k in (1, 2, 3, 4)] == [0, 0, 0, 0]
    assert state["Pump1"]["direction"] == 1.0
    assert (state["Stir"]["ON"], state["Thermostat"]["ON"], state["Thermostat"]["target"]) == (0, 1, 37.0)
    assert (state["Experiment"]["ON"], state["OD"]["ON"]) == (1, 0)
    assert state["Experiment"]["startTime"] == "2026-01-01 00:00:02"
    assert state["Experiment"]["startTimeRaw"] == "Thu, 01 Jan 2026 00:00:02 GMT"
    lab.wait(0.2)
    truth = lab.device.truth("M0")
    assert set(truth["motors"].values()) == {0}


def test_timetable_of_one_cycle() -> None:
    lab = running()
    zero = cycle_start(lab, 2)
    seen: dict[str, float] = {}
    was = {"Measuring": 0, "Stir": 0, "records": 1}
    assert lab.peek()["Stir"]["ON"] == 0  # stirrer off at 0
    while lab.clock.now() < zero + 59.0:
        data = lab.peek()
        now = {"Measuring": data["OD"]["Measuring"], "Stir": data["Stir"]["ON"], "records": len(data["OD"]["record"])}
        for key, value in now.items():
            if value != was[key]:
                seen[f"{key} {value}"] = lab.clock.now() - zero
        was = now
        lab.wait(0.01)
    assert seen["Measuring 1"] == pytest.approx(5.0, abs=0.05)
    assert seen["Measuring 0"] == pytest.approx(10.0, abs=0.15)  # 4 (0.97 + 0.25), then temperatures
    assert seen["Stir 1"] == pytest.approx(10.5, abs=0.15)
    assert seen["records 2"] == pytest.approx(13.0, abs=0.5)
    assert set(seen) == {"Measuring 1", "Measuring 0", "Stir 1", "records 2"}


def test_period_is_60_07_s_and_time_record_is_the_start_of_the_cycle() -> None:
    lab = running(wait=150 * 60.07 + 20.0)
    times = np.array(lab.state()["time"]["record"])
    periods = np.diff(times)
    assert np.median(periods) == pytest.approx(60.07, abs=0.02)
    assert periods.min() >= 60.03 - 0.01
    assert periods.max() <= 60.17
    assert times[0] < 0.2
    assert np.all(times == np.round(times, 2))


def test_od_current_shows_single_readings_while_measuring_then_the_mean_of_their_ods() -> None:
    lab = running(options=quiet(noise_fraction=0.05), blanked=True)
    lab.wait_until(5.0)
    singles: list[float] = []
    while lab.clock.now() < 12.0:
        lab.wait(0.05)
        data = lab.peek()
        if data["OD"]["Measuring"] == 1 and data["OD"]["current"] not in singles:
            singles.append(data["OD"]["current"])
    data = lab.peek()
    readings = singles[1:] if singles[0] == 0.0 else singles  # 0 from power-on, until the first reading
    assert len(set(readings[:4])) == 4
    mean = sum(readings[:4]) / 4
    assert data["OD"]["current"] == pytest.approx(mean, abs=1e-12)
    raw_od = 1.833 * np.log10(14000.0 / data["OD0"]["raw"]) + 0.226 * np.log10(14000.0 / data["OD0"]["raw"]) ** 2
    assert raw_od == pytest.approx(readings[3], abs=1e-9)  # OD0.raw stays the last raw
    assert raw_od != pytest.approx(mean, abs=1e-6)


def test_waste_pump_lengthens_the_still_phase_and_beyond_60_s_the_cycle() -> None:
    """Pumps 3 and 4 lengthen nothing."""
    lab = Lab()
    lab.post("/SetOutputTarget/Pump2/M0/0.5")
    lab.post("/Experiment/1/M0")
    lab.post("/SetOutputOn/Pump2/1/M0")
    for pump in ("Pump3", "Pump4"):
        lab.pump(pump, 0.9)
    zero = cycle_start(lab, 2)
    while lab.peek()["Stir"]["ON"] == 0:
        lab.wait(0.05)
    assert lab.clock.now() - zero == pytest.approx(10.0 + 63 * 0.5 + 0.5, abs=0.2)
    lab.post("/SetOutputTarget/Pump2/M0/0.9")
    third = cycle_start(lab, 4)
    assert cycle_start(lab, 5) - third == pytest.approx(69.8, abs=0.5)  # run of the real software: 69.8 s
    assert "too short" in lab.state()["Terminal"]["text"]


def test_records_grow_to_200_then_201_become_109() -> None:
    data = fresh_sysdata("1", "M0")
    for k in range(200):
        append_records(data, 60.0 * k)
        thin_records(data)
    assert len(data["time"]["record"]) == 200
    append_records(data, 60.0 * 200)
    thin_records(data)
    times = data["time"]["record"]
    assert len(times) == 109
    assert times[-11:] == [60.0 * k for k in range(190, 201)]  # the newest stay as they are
    assert times[0] == 0.0
    assert set(np.diff(times[:90])) <= {60.0, 120.0, 180.0}
    others = ("OD", "Pump1", "Pump2", "ThermometerIR", "Thermostat", "GrowthRate")
    assert {len(data[k]["record"]) for k in others} == {109}
    assert len(data["OD"]["targetrecord"]) == len(data["FP1"]["Emit2Record"]) == 109
    assert data["Heat"]["record"] == []


def test_terminal_is_emptied_every_tenth_cycle_newest_line_first() -> None:
    lab = running(wait=8 * 60.07 + 5.0)
    text = lab.state()["Terminal"]["text"]
    assert text.startswith("2026-01-01 00:08:00  - Cycle 9 Started</br>")
    assert "Experiment Started" in text
    lab.wait(15.0)
    text = lab.state()["Terminal"]["text"]
    assert text.endswith("  - Terminal Cleared</br>")
    assert "Cycle 9 Started" not in text


def test_start_time_raw_is_0_for_an_instant_in_cycles_1_11_21() -> None:
    lab = running()
    hits = set()
    while lab.clock.now() < 12 * 60.07:
        lab.wait(0.05)
        if lab.peek()["Experiment"]["startTimeRaw"] == 0:
            hits.add(lab.peek()["Experiment"]["cycles"])
    assert hits == {1, 11}
    assert isinstance(lab.peek()["Experiment"]["startTimeRaw"], str)


@pytest.mark.parametrize("path", ["/Experiment/0/M0", "/Experiment/1/M0"])  # a second start stops
def test_a_stop_switches_pumps_1_and_2_off_at_once_and_the_end_of_its_cycle_all_else(path: str) -> None:
    """Pumps 3 and 4, and what was started meanwhile."""
    lab = running(wait=20.0)
    for pump in (1, 2, 3, 4):
        lab.pump(f"Pump{pump}", 0.3)
    lab.post(path)
    seen = [lab.state()]
    lab.post("/SetOutputOn/Stir/1/M0")
    lab.post("/SetOutputOn/Thermostat/1/M0")
    for at in (58.0, 62.0):
        lab.wait_until(at)
        seen.append(lab.state())
    items = ("Pump1", "Pump2", "Pump3", "Pump4", "OD", "Experiment", "Thermostat", "Stir")
    assert [[state[item]["ON"] for item in items] for state in seen] == [
        [0, 0, 1, 1, 0, 0, 0, 0], [0, 0, 1, 1, 0, 0, 1, 1], [0] * 8,
    ]  # fmt: skip
    said = [state["Terminal"]["text"].partition("</br>")[0] for state in seen]
    assert ["Stopped" in text for text in said] == [False, False, True]


def test_stop_in_the_first_five_seconds_takes_the_cycle_back() -> None:
    lab = running()
    zero = cycle_start(lab, 3)
    lab.post("/Experiment/0/M0")
    lab.wait_until(zero + 6.0)
    state = lab.state()
    assert state["Experiment"]["cycles"] == 2
    assert len(state["OD"]["record"]) == 2


@pytest.mark.parametrize("rest_s", [5.0, 70.0])
def test_a_restart_within_the_old_cycle_loses_the_thermostat_and_one_after_its_end_is_clean(rest_s: float) -> None:
    lab = running(wait=30.0)
    lab.post("/Experiment/0/M0")
    lab.wait(rest_s)
    first, within = lab.state()["Experiment"]["startTime"], rest_s < 30.0
    lab.post("/Experiment/1/M0")
    lab.wait(20.0)
    state = lab.state()
    assert [state[item]["ON"] for item in ("Experiment", "Thermostat", "Stir")] == [1, 1, 1]
    lab.wait(70.0)
    state = lab.state()
    assert (state["Experiment"]["ON"], state["Thermostat"]["ON"]) == (1, int(not within))  # silently without heating
    assert state["Experiment"]["cycles"] >= 3  # the new chain runs on
    assert state["Experiment"]["startTime"] == first  # cycles > 0: the old start stays, records continue
    assert np.all(np.diff(state["time"]["record"]) > 0)
    lab.post("/SetOutputOn/Thermostat/1/M0")
    lab.wait(200.0)
    assert lab.state()["Thermostat"]["ON"] == 1


def test_a_dead_cycle_thread_leaves_a_plausible_picture() -> None:
    lab = running(mu=0.03, blanked=True, wait=100.0)
    inject(lab.device, "cycle_dead", "M0")
    before = lab.state()
    lab.wait(600.0)
    after = lab.state()
    assert after["Experiment"]["ON"] == 1
    assert after["Experiment"]["cycles"] == before["Experiment"]["cycles"]
    assert after["OD"]["current"] == before["OD"]["current"]
    assert lab.device.truth("M0")["od"] > 1.2 * before["OD"]["current"]
    lab.post("/Experiment/0/M0")
    lab.wait(70.0)
    lab.post("/Experiment/1/M0")  # recovery used in the field
    lab.wait(20.0)
    assert lab.state()["time"]["record"][-1] > 700.0


def test_a_pair_that_a_run_is_for_is_its_devices() -> None:
    _, plant = family.EmulatorFamily().vials(EmulatorConfig(plant="coculture", pair="ecoli_psyringae"), PlantConfig())
    assert plant.pair.second.name == "P. syringae"


def test_the_thermostat_holds_what_its_thermometer_shows() -> None:
    options = quiet(mu=0.01)
    off = replace(options.plant, thermal=replace(options.plant.thermal, offset_c=(0.6, 0.6)))
    lab = running(options=replace(options, plant=off))
    lab.post("/SetOutputTarget/Thermostat/M0/35")
    lab.wait(3600.0)
    shown = float(lab.state()["ThermometerIR"]["current"])
    assert shown == pytest.approx(35.0, abs=0.35)
    assert lab.device.truth("M0")["temperature"] == pytest.approx(shown - 0.6, abs=0.2)


@pytest.mark.parametrize("offset_c", [-0.6, 0.6])
def test_a_heater_warms_alike_whatever_the_thermometer_shows(offset_c: float) -> None:
    options = quiet(mu=0.0)
    thermal = replace(options.plant.thermal, offset_c=(offset_c, offset_c))
    lab = Lab(options=replace(options, plant=replace(options.plant, thermal=thermal)))
    begun = lab.device.truth("M0")["temperature"]
    inject(lab.device, "heater_runaway", "M0")
    lab.wait(120.0)
    cooled = 2.0 * (begun - thermal.ambient_c) / thermal.cooling_min
    risen = lab.device.truth("M0")["temperature"] - begun
    assert risen == pytest.approx(2.0 * thermal.heating_c_per_min - cooled, abs=0.1)


def test_each_record_has_its_own_value_and_nothing_of_what_is_off() -> None:
    data = fresh_sysdata("77", "M0")
    data["OD"].update(current=0.41, target=0.6, ON=1)
    data["Thermostat"].update(target=35.5, ON=1)
    for k, is_on in ((1, 1), (2, 0), (3, 1), (4, 1)):
        data[f"Pump{k}"].update(target=0.01 * k, ON=is_on)
    for k, name in enumerate(("IR", "Internal", "External")):
        data[f"Thermometer{name}"]["current"] = 30.0 + k
    data["FP2"].update(ON=1, Base=200, Emit1=0.5, Emit2=0.25)
    data["FP3"].update(ON=0, Base=9, Emit1=9, Emit2=9)
    append_records(data, 120.5)
    last = {name: [entry["record"]] for name, entry in data.items() if isinstance(entry, dict) and "record" in entry}
    assert {name: record for name, (record,) in last.items() if record and any(record)} == {
        "time": [120.5], "OD": [0.41], "Thermostat": [35.5], "Pump1": [0.01], "Pump3": [0.03], "Pump4": [0.04],
        "ThermometerIR": [30.0], "ThermometerInternal": [31.0], "ThermometerExternal": [32.0],
    }  # fmt: skip
    assert data["OD"]["targetrecord"] == [0.6]
    assert data["Pump2"]["record"] == [0.0]
    for name, values in (("FP1", [0, 0, 0]), ("FP2", [200, 0.5, 0.25]), ("FP3", [0, 0, 0])):
        assert [data[name][f"{key}Record"][0] for key in ("Base", "Emit1", "Emit2")] == values


def regulate(lab: Lab, target: float) -> None:
    lab.post(f"/SetOutputTarget/OD/M0/{target}")
    lab.post("/Experiment/1/M0")
    lab.post("/SetOutputOn/OD/1/M0")


def after_regulation(lab: Lab, cycle: int) -> None:
    """Just after the regulator of a cycle has run, before the next record."""
    lab.wait_until(60.07 * (cycle - 1) + 10.3)


def law(data: dict, previous: float, integrals: tuple[float, float]) -> tuple[float, float, float]:  # type: ignore[type-arg]
    """Feed duty, integral 1, integral 2 as docs/device.md words it, from what the client can see."""
    x, r, v = data["OD"]["current"], data["OD"]["target"], data["Volume"]["target"]
    t = data["time"]["record"]
    p = math.log(x / r) / ((t[-1] - t[-2]) / 60.0) / (240.0 / v) if x > 0 else 0.0
    e, d = x - r, x - previous
    i1, i2 = integrals
    if e < 0.01:
        i1 = 0.0
    elif abs(d) < 0.05 and e > 0.025:
        i1 += 0.1 * e
    if abs(e) > 0.1 and abs(d) < 0.05:
        i2 = 0.0
    elif abs(d) < 0.1:
        i2 += 0.01 * e
        p *= 0.7
    duty = 0.0 if d > 0.04 else p + i1 + i2
    return min(max(duty, 0.0), 0.02), i1, i2


@pytest.mark.parametrize(
    ("od", "mu"), [(0.8, 0.0), (0.58, 0.0), (0.51, 0.0), (0.65, 0.0), (0.2, 0.0), (0.4, 0.03), (0.48, 0.03)]
)
def test_law_cycle_by_cycle(od: float, mu: float) -> None:
    """The first two cycles feed nothing; from the 16th on the waste pump rests where nothing was fed."""
    lab = Lab(od=od, mu=mu, blanked=True)
    regulate(lab, 0.5)
    integrals, duties = (0.0, 0.0), list[float]()
    for cycle in range(1, 19):
        after_regulation(lab, cycle)
        data = lab.peek()
        assert data["Experiment"]["cycles"] == cycle
        duty = 0.0
        if cycle > 2:
            duty, *new = law(data, data["OD"]["record"][-1], integrals)
            integrals = (new[0], new[1])
        duties.append(duty)
        rests = cycle > 15 and not (duty or any(duties[-11:-2]))
        assert data["Pump1"]["target"] == pytest.approx(duty)
        assert (data["OD"]["Integral"], data["OD"]["Integral2"]) == pytest.approx(integrals)
        waste = 0.25 if cycle % 5 == 1 else 4 * duty + 0.07
        assert data["Pump2"]["target"] == pytest.approx(0.0 if rests else waste)
        assert (data["Pump1"]["ON"], data["Pump2"]["ON"]) == (int(duty > 0), int(not rests))
    assert len(set(duties)) > 2 or od in (0.2, 0.4)


OTHERS = ["a jump upwards", "the mode of a chemostat, whose rate no route can set", "a target that is never reached"]


@pytest.mark.parametrize("how", OTHERS)
def test_what_stops_the_feed_for_a_cycle(how: str) -> None:
    """OD.target 0 pumps at the cap at the next measurement, 10 does not (docs/device.md, Dosing)."""
    lab = Lab(od=0.6, blanked=True)
    regulate(lab, 0.0 if "target" in how else 0.5)
    after_regulation(lab, 5)
    assert lab.peek()["Pump1"]["target"] == 0.02 if "target" in how else lab.peek()["Pump1"]["target"] > 0.0
    if "jump" in how:
        lab.device.vials["M0"].faults.od_jump = 0.1
    else:
        lab.post("/SetOutputTarget/OD/M0/10" if "target" in how else "/SetOutputOn/Chemostat/1/M0")
    after_regulation(lab, 6)
    assert lab.peek()["Pump1"]["target"] == 0.0


def test_od_on_without_experiment_does_nothing() -> None:
    lab = Lab(od=0.8)
    lab.post("/SetOutputOn/OD/1/M0")
    lab.wait(600.0)
    assert lab.doses() == []


def test_closed_loop_brings_061_to_050_in_a_few_cycles_and_holds_it() -> None:
    """Behaviour of the real software with a 1 mL/s pump: 5 cycles, then mean 0.502, sd 0.007 (docs/device.md)."""
    lab = Lab(od=0.61, mu=0.03, blanked=True)
    regulate(lab, 0.5)
    lab.wait(8 * 60.07)
    assert lab.state()["OD"]["record"][-1] == pytest.approx(0.5, abs=0.04)
    lab.wait(170 * 60.07)
    held = np.array(lab.state()["OD"]["record"][-120:])
    assert held.mean() == pytest.approx(0.502, abs=0.015)
    assert held.std() < 0.015
    assert lab.device.truth("M0")["peak_ml"] < 23.0
