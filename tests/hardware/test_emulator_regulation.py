"""The on-board turbidostat (docs/device.md, Regulation): the law by hand, and in closed loop."""

import math

import numpy as np
import pytest

from tests.hardware.emulator_lab import Lab


def regulate(lab: Lab, target: float) -> None:
    lab.post(f"/SetOutputTarget/OD/M0/{target}")
    lab.post("/Experiment/1/M0")
    lab.post("/SetOutputOn/OD/1/M0")


def after_regulation(lab: Lab, cycle: int) -> None:
    """Just after the regulator of a cycle has run, before the next record."""
    lab.wait_until(60.07 * (cycle - 1) + 10.3)


def test_first_two_cycles_feed_nothing_but_run_the_waste() -> None:
    lab = Lab(od=0.8, blanked=True)
    regulate(lab, 0.5)
    for cycle in (1, 2):
        after_regulation(lab, cycle)
        data = lab.peek()
        assert (data["Pump1"]["target"], data["Pump1"]["ON"]) == (0.0, 0)
        assert (data["Pump2"]["target"], data["Pump2"]["ON"]) == (0.25 if cycle == 1 else 0.07, 1)


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
    ("od", "target", "mu"), [(0.58, 0.5, 0.0), (0.51, 0.5, 0.0), (0.65, 0.5, 0.0), (0.4, 0.5, 0.03), (0.48, 0.5, 0.03)]
)
def test_law_cycle_by_cycle(od: float, target: float, mu: float) -> None:
    lab = Lab(od=od, mu=mu, blanked=True)
    regulate(lab, target)
    integrals = (0.0, 0.0)
    seen = set()
    for cycle in range(3, 16):
        after_regulation(lab, cycle)
        data = lab.peek()
        assert data["Experiment"]["cycles"] == cycle
        duty, *new = law(data, data["OD"]["record"][-1], integrals)
        integrals = (new[0], new[1])
        assert data["Pump1"]["target"] == pytest.approx(duty)
        assert (data["OD"]["Integral"], data["OD"]["Integral2"]) == pytest.approx(integrals)
        assert data["Pump2"]["target"] == pytest.approx(0.25 if cycle % 5 == 1 else 4 * duty + 0.07)
        assert (data["Pump1"]["ON"], data["Pump2"]["ON"]) == (int(duty > 0), 1)
        seen.add(round(duty, 6))
    assert len(seen) > 1 or od == 0.4


@pytest.mark.parametrize("how", ["a jump upwards", "the mode of a chemostat, whose rate no route can set"])
def test_what_stops_the_feed_for_a_cycle(how: str) -> None:
    lab = Lab(od=0.6, blanked=True)
    regulate(lab, 0.5)
    after_regulation(lab, 5)
    assert lab.peek()["Pump1"]["target"] > 0.0
    if "jump" in how:
        lab.device.vials["M0"].faults.od_jump = 0.1
    else:
        lab.post("/SetOutputOn/Chemostat/1/M0")
    after_regulation(lab, 6)
    assert lab.peek()["Pump1"]["target"] == 0.0


def test_idle_waste_pump_rests_from_cycle_16_on() -> None:
    lab = Lab(od=0.2, blanked=True)
    regulate(lab, 0.5)
    after_regulation(lab, 15)
    assert lab.peek()["Pump2"]["ON"] == 1
    after_regulation(lab, 16)
    data = lab.peek()
    assert (data["Pump2"]["target"], data["Pump2"]["ON"], data["Pump1"]["ON"]) == (0.0, 0, 0)


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


def test_bang_bang_through_the_turbidostat() -> None:
    """OD.target 0 pumps at the cap at the next measurement, 10 does not (docs/device.md, Dosing)."""
    lab = Lab(od=0.5, blanked=True)
    regulate(lab, 0.0)
    after_regulation(lab, 7)
    assert lab.peek()["Pump1"]["target"] == 0.02
    lab.post("/SetOutputTarget/OD/M0/10")
    after_regulation(lab, 8)
    assert lab.peek()["Pump1"]["target"] == 0.0
