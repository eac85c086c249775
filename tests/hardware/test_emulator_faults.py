"""Failure behaviour (docs/device.md, Failures) as a client sees it, through the in-process transport."""

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from hardware.emulator.device import plant_preset
from hardware.emulator.faults import FAULTS, PLANT, inject
from hardware.emulator.transport import EmulatorTransport
from hardware.errors import LinkError
from tests.hardware.emulator_lab import Lab, quiet


class Client:
    """A lab with a client on its transport."""

    def __init__(self, timeout_s: float = 20.0, **kwargs: object) -> None:
        self.lab = Lab(**kwargs)  # type: ignore[arg-type]
        self.device, self.clock = self.lab.device, self.lab.clock
        self.link = EmulatorTransport(self.device, timeout_s)

    def fails(self, act: Callable[[], object]) -> tuple[str, float]:
        """(message, how long it took) of a request that must not be answered."""
        before = self.clock.now()
        with pytest.raises(LinkError) as caught:
            act()
        return str(caught.value), self.clock.now() - before

    def state(self, reactor: str = "M0") -> dict:  # type: ignore[type-arg]
        assert self.link.post(f"/changeDevice/{reactor}").status == 204
        return dict(json.loads(self.link.get("/getSysdata/").body))


def wiped(state: dict) -> bool:  # type: ignore[type-arg]
    """Signature of a worker that was replaced."""
    return bool(
        state["Experiment"]["cycles"] == 0
        and state["Experiment"]["startTime"] == " Waiting "
        and state["OD0"]["target"] == 65000.0
        and not any(state[f"Pump{k}"]["ON"] for k in (1, 2, 3, 4))
    )


DEADLY = "MeasureOD/M5 MeasureTemp/Internal/M5 SetOutputOn/Stir/1/M5 SetOutputOn/LEDA/1/M5 Experiment/1/M5"
HARMLESS = ("SetOutputTarget/Pump1/M5/0.1", "changeDevice/M5", "scanDevices/M5")
ANSWERED = {"SetOutputOn/Pump1/0/M5": False} | dict.fromkeys(HARMLESS, True)


@pytest.mark.parametrize("path", [*DEADLY.split(), *ANSWERED])
def test_every_access_to_an_absent_reactor_is_deadly_at_once_or_a_pump_s_a_moment_later(path: str) -> None:
    c = Client()
    if path in ANSWERED:
        assert c.link.post(f"/{path}").status == 204
    else:
        message, took = c.fails(lambda: c.link.post(f"/{path}"))
        assert ("reset" in message, took < 0.1, c.device.supervisor.alive) == (True, True, False)
        c.lab.wait(3600.0)
        assert "refused" in c.fails(lambda: c.link.get("/getSysdata/"))[0]  # nobody restarts it by itself
    c.lab.wait(1.0)
    assert c.device.supervisor.alive is ANSWERED.get(path, False)


@pytest.mark.parametrize(("fault", "scanned"), [("unplugged", False), ("unplugged", True), ("marked_absent", False)])
def test_a_running_reactor_that_is_unplugged_or_taken_for_absent_takes_all_down(fault: str, scanned: bool) -> None:
    """By its own threads, also where a scan or a glitch has marked it."""
    c = Client()
    for m in ("M0", "M1"):
        c.link.post(f"/Experiment/1/{m}")
    c.lab.wait(100.0)
    inject(c.device, fault, "M1")
    if scanned:
        assert c.link.post("/scanDevices/M1").status == 204
    assert c.state("M0")["presentDevices"]["M1"] == int(fault == "unplugged" and not scanned)
    c.lab.pump("Pump3", 1)
    c.lab.wait(60.0)
    assert not c.device.supervisor.alive
    truth = c.device.truth("M0")  # the latch has cut the power
    assert not truth["powered"]
    assert (truth["heat"], truth["stir"], set(truth["motors"].values())) == (0.0, 0.0, {0})
    inject(c.device, "restart")
    assert c.link.post("/changeDevice/M0").status == 204  # waits for the boot
    assert wiped(c.state("M0"))
    present = c.state("M0")["presentDevices"]
    assert (present["M0"], present["M1"]) == (1, int(fault != "unplugged"))


def test_a_slow_request_delays_everybody_and_is_answered_after_all() -> None:
    c = Client()
    inject(c.device, "hang_s", value=25.0)
    _, took = c.fails(lambda: c.link.post("/SetOutputTarget/Stir/M0/0.7"))
    assert took == pytest.approx(20.0, abs=0.01)
    before = c.clock.now()
    assert c.state()["Stir"]["target"] == 0.7  # it acted although the client had given up
    assert c.clock.now() - before == pytest.approx(5.0, abs=0.1)


def test_a_hang_beyond_30_s_costs_the_worker_and_its_memory() -> None:
    """A client that waits long enough sees the reset of the killed worker."""
    c = Client(timeout_s=300.0)
    for m in ("M0", "M1"):
        c.link.post(f"/Experiment/1/{m}")
    c.lab.wait(200.0)
    inject(c.device, "hang_s", value=60.0)
    began = c.clock.now()
    message, took = c.fails(lambda: c.link.post("/SetOutputTarget/Stir/M0/0.7"))
    assert "reset" in message
    assert took == pytest.approx(30.0, abs=0.01)
    assert c.link.get("/getSysdata/").status == 200
    assert c.clock.now() - began == pytest.approx(30.0 + 8.0, abs=0.1)  # killed at 30 s, booted in 8
    assert wiped(c.state("M0"))
    assert wiped(c.state("M1"))
    assert c.device.supervisor.restarts == 1


def test_stuck_bus_lies_with_204_and_the_temperature_probe_is_the_kill_switch() -> None:
    c = Client()
    c.link.post("/Experiment/1/M0")
    c.lab.wait(70.0)
    inject(c.device, "bus_stuck_when_pumping")
    c.lab.pump("Pump1", 0.05)
    c.lab.wait(10.0)
    assert c.link.post("/SetOutputOn/Pump1/0/M0").status == 204
    state = c.state()
    assert state["Pump1"]["ON"] == 0  # says the device
    assert c.device.truth("M0")["motors"]["Pump1"] == 1
    cycles = state["Experiment"]["cycles"]
    c.lab.wait(120.0)
    assert c.state()["Experiment"]["cycles"] <= cycles + 1  # measurement hangs
    assert c.device.truth("M0")["motors"]["Pump1"] == 1
    c.fails(lambda: c.link.post("/MeasureTemp/IR/M0"))
    c.lab.wait(20.0)
    assert wiped(c.state())
    assert set(c.device.truth("M0")["motors"].values()) == {0}
    assert c.link.post("/MeasureTemp/IR/M0").status == 204


def test_a_full_disk_stalls_the_cycles_of_all_reactors_while_the_server_answers() -> None:
    c = Client()
    for m in ("M0", "M1"):
        c.link.post(f"/Experiment/1/{m}")
    c.lab.wait_until(100.0)
    inject(c.device, "disk_full")
    c.lab.wait_until(600.0)
    assert [c.state(m)["Experiment"]["cycles"] for m in ("M0", "M1")] == [3, 3]
    assert c.state()["Experiment"]["ON"] == 1


@pytest.mark.parametrize("fault", ["worker_wipe", "power_cut"])
def test_software_that_begins_anew_has_forgotten_all_and_its_pumps_are_off(fault: str) -> None:
    """After a power cut the clock starts again, too."""
    c = Client(blanked=True)
    c.lab.wait(1000.0)
    for m in ("M0", "M1"):
        c.link.post(f"/Experiment/1/{m}")
        c.lab.pump("Pump1", 0.5, reactor=m)
    c.lab.wait(5.0)
    inject(c.device, fault)
    c.lab.wait(1.5)
    assert set(c.device.truth("M0")["motors"].values()) == {0}
    if fault == "power_cut":
        c.lab.wait(598.5)
        inject(c.device, "restart")
        c.link.post("/changeDevice/M0")  # waits for the boot
    assert wiped(c.state("M1"))
    c.lab.wait(300.0)
    assert c.device.truth("M0")["on_s"]["Pump1"] < 8.0
    assert c.state("M0")["Experiment"]["ON"] == 0
    c.link.post("/Experiment/1/M0")
    begun = "2026-01-01 00:15" if fault == "power_cut" else "2026-01-01 00:21"
    assert c.state("M0")["Experiment"]["startTime"].startswith(begun)


@pytest.mark.parametrize(
    ("fault", "acted", "patience", "word"),
    [
        ("reset_before", False, 0.0, "reset"),
        ("reset_after", True, 0.0, "reset"),
        ("lost_request", False, 20.0, "no answer"),
        ("lost_reply", True, 20.0, "no answer"),
        ("lying", False, 0.0, ""),
    ],
)
def test_link_faults(fault: str, acted: bool, patience: float, word: str) -> None:
    c = Client()
    inject(c.device, fault, value=2)
    for value in (0.7, 0.8):
        if word:
            message, took = c.fails(lambda v=value: c.link.post(f"/SetOutputTarget/Stir/M0/{v}"))  # type: ignore[misc]
            assert word in message
            assert took == pytest.approx(patience, abs=0.1)
        else:
            assert c.link.post(f"/SetOutputTarget/Stir/M0/{value}").status == 204
        assert c.device.apps["M0"].data["Stir"]["target"] == (value if acted else 0.5)
    assert c.link.post("/SetOutputTarget/Stir/M0/0.6").status == 204


def test_slow_network_and_its_recovery() -> None:
    c = Client()
    inject(c.device, "slow_s", value=5.0)
    before = c.clock.now()
    assert c.link.get("/getSysdata/").status == 200
    assert c.clock.now() - before == pytest.approx(5.0, abs=0.1)
    inject(c.device, "slow_s", value=25.0)
    c.fails(lambda: c.link.post("/SetOutputTarget/Stir/M0/0.7"))
    inject(c.device, "slow_s", value=0.0)
    assert c.state()["Stir"]["target"] == 0.5
    c.lab.wait(10.0)
    assert c.state()["Stir"]["target"] == 0.7  # the late one arrives all the same


def test_a_foreign_client_changes_the_selection_between_two_requests() -> None:
    c = Client()
    inject(c.device, "foreign_selects", value=0.5)
    wrong = 0
    for _ in range(200):
        c.link.post("/changeDevice/M0")
        wrong += json.loads(c.link.get("/getSysdata/").body)["UIDevice"] != "M0"
    assert wrong == pytest.approx(100, abs=30)


@pytest.mark.parametrize(
    ("step_s", "looks"),
    [(-600.0, {620.0: [2], 750.0: [3]}), (3600.0, {78.0: [3], 198.0: [4, 5]})],  # freezes that long, one is short
)
def test_a_clock_set_in_the_working_part_of_a_cycle(step_s: float, looks: dict[float, list[int]]) -> None:
    c = Client()
    c.link.post("/Experiment/1/M0")
    c.lab.wait_until(68.0)  # cycle 2 is measuring
    inject(c.device, "clock_step", value=step_s)
    for at, cycles in looks.items():
        c.lab.wait_until(at)
        assert c.state()["Experiment"]["cycles"] in cycles
    times = c.state()["time"]["record"]  # wall-clock time
    assert times[-1] == pytest.approx(120.0, abs=1.0) if step_s < 0.0 else np.diff(times).max() > 3600.0


def test_clock_set_back_during_a_dose_lengthens_the_pause_not_the_dose() -> None:
    c = Client()
    c.lab.pump("Pump1", 0.05)
    c.lab.wait(1.0)
    inject(c.device, "clock_step", value=-300.0)
    c.lab.wait(350.0)
    assert [round(length, 2) for _, length in c.lab.doses()] == [3.25]
    c.lab.wait(30.0)
    assert len(c.lab.doses()) == 2


def test_stirrer_that_fails_lets_cells_settle() -> None:
    c = Client(od=0.5, blanked=True)
    c.link.post("/Experiment/1/M0")
    inject(c.device, "stirrer_dead", "M0")
    c.lab.wait(20 * 60.0)
    assert c.state()["OD"]["record"][-1] < 0.48


@pytest.mark.parametrize(
    ("name", "reactor", "value"),
    [("no_such_fault", "M0", 1.0), ("od_offset", "M7", 1.0), ("od_offset", "M0", np.nan), ("slow_s", "all", -1.0)],
)
def test_impossible_faults_are_refused_by_name(name: str, reactor: str, value: float) -> None:
    with pytest.raises(ValueError, match="allowed"):
        inject(Lab().device, name, reactor, value)


FAULTY = {"pump_gain_factor": 0.5, "waste_gain_factor": 0.0, "overflow_gain_factor": 0.5, "media_left_ml": 0.0,
          "mu_factor": 0.5, "clock_step": 30.0}  # fmt: skip
SOUND = {"pump_gain_factor": 1.0, "waste_gain_factor": 1.0, "overflow_gain_factor": 1.0, "media_left_ml": 1e6,
         "mu_factor": 1.0}  # fmt: skip
"""Values of faults, and values at which they are none, where these are not 1 and 0."""


def course(*faults: tuple[str, float]) -> list[object]:
    """What a client sees and what truly is, every 10 s, of two species that are fed, drained and lit; a fault sets in
    with the fifth time, another one with the ninth."""
    options = replace(quiet(overflow_pump="Pump4"), plant=plant_preset("coculture"))
    c, seen = Client(blanked=True, options=options), []

    def answer(act: Callable[[], object]) -> None:
        try:
            seen.append(act())
        except (LinkError, ConnectionError) as error:
            seen.append(str(error))

    for pump in ("Pump1", "Pump2", "Pump4"):
        c.link.post(f"/SetOutputTarget/{pump}/M0/1")
    for path in ("changeDevice/M0", "SetFPMeasurement/FP1/LEDA/CLEAR/nm440/OFF/x10", "Experiment/1/M0",
                 "SetOutputTarget/Thermostat/M0/20", "SetOutputOn/Stir/1/M0"):  # fmt: skip
        c.link.post(f"/{path}")
    for k in range(24):
        for name, value in faults[k // 4 - 1 : k // 4] if k in (4, 8) else ():
            inject(c.device, name, "M0", value)
        for number, pump in enumerate(("Pump1", "Pump2", "Pump4")):
            path = f"/SetOutputOn/{pump}/{int((k + number) % 3 == 0)}/M0"
            answer(lambda path=path: c.link.post(path).status)
        answer(lambda k=k: c.link.post(f"/changeDevice/M{k % 2}").status)
        answer(lambda: c.link.get("/getSysdata/").body)
        answer(lambda: c.lab.post("/changeDevice/M0"))  # as somebody's script does, without our headers
        seen += [c.device.truth("M0"), c.clock.now()]
        c.lab.wait(10.0)
    return seen


@pytest.mark.parametrize("name", sorted(FAULTS))
def test_every_fault_changes_what_a_client_sees_or_what_is_true(name: str) -> None:
    """And before it everything is as without it. The software is started again where it had crashed."""
    before = [("crash", 1.0)] if name == "restart" else []
    none = [] if FAULTS[name][0] == "act" else [(name, SOUND.get(name, 0.0))]
    one, other = course(*before, (name, FAULTY.get(name, 1.0))), course(*before, *none)
    assert len(one) == len(other) == 24 * 8
    differs = [k for k, (a, b) in enumerate(zip(one, other, strict=True)) if a != b]
    assert differs
    assert differs[0] >= 8 * (8 if before else 4)


@pytest.mark.parametrize("name", sorted(name for name, (kind, *_) in FAULTS.items() if kind in ("vial", "plant")))
def test_a_fault_of_one_reactor_is_not_its_neighbour_s(name: str) -> None:
    device = Lab(options=replace(quiet(), plant=plant_preset("coculture"))).device

    def switches(reactor: str) -> list[object]:
        vial = device.vials[reactor]
        plant = [getattr(getattr(vial.plant, part), switch)[0] for part, switch in PLANT.values()]
        return [*vars(vial.faults).values(), *plant]

    before = switches("M0")
    assert before == switches("M1")
    value = 0.7 if "factor" in name or name.endswith("_ml") else 1.0
    inject(device, name, "M1", value)
    assert switches("M0") == before
    changed = [now for was, now in zip(before, switches("M1"), strict=True) if was != now]
    assert changed == [value]
    inject(device, name, "all", value)
    assert switches("M0") == switches("M1")


def test_every_fault_is_documented() -> None:
    text = (Path(__file__).parents[2] / "docs" / "emulator.md").read_text(encoding="utf-8")
    for name, (_, values, effect) in FAULTS.items():
        assert f"- `{name}` (" in text
        assert values in text
        assert effect in text
