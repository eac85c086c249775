"""Routes, status codes, clamps, toggles and selection, statement by statement of docs/device.md, Routes."""

import json
import math
from pathlib import Path

import numpy as np
import pytest

from hardware.clock import VirtualClock
from hardware.emulator.device import ChiBioDevice
from hardware.emulator.faults import inject
from tests.hardware.emulator_lab import Lab, running

SAMPLE = Path(__file__).parents[2].parent / "shared" / "samples" / "chibio_sysdata.json"


ANSWERS = {  # by method and status
    ("GET", 200): "/ /getSysdata/ /getSysdata/?t=1",
    ("POST", 204): """
        /changeDevice/M0 /changeDevice/M5 /scanDevices/all /scanDevices/M5 /SetOutputTarget/Pump1/M0/0.02
        /SetOutputTarget/Pump1/0/0.02 /SetOutputOn/Pump1/0/M0 /SetOutputOn/Zigzag/1/M0 /Direction/Pump1/M0
        /MeasureOD/M0 /CalibrateOD/OD0/M0/14000/0 /CalibrateOD/OD/M0/14000/0 /MeasureTemp/IR/M0 /MeasureFP/M0
        /Experiment/0/M0 /ExperimentReset /ClearTerminal/M0
        /SetFPMeasurement/FP1/LEDB/CLEAR/nm510/nm550/x10 /SetOutputTarget/Pump1/M0/0%2e02""",
    ("GET", 308): "/getSysdata",
    ("POST", 308): "//changeDevice//M0",
    ("POST", 404): """
        /changeDevice/M0/ /SetOutputTarget/Pump1/M0 /SetOutputTarget/Pump1/M0/1/2 //changeDevice//M0//x
        /NoSuchRoute""",
    ("GET", 405): "/changeDevice/M0",
    ("POST", 405): "/getSysdata/",
    ("PUT", 405): "/getSysdata/",
    ("POST", 500): """
        /changeDevice/M9 /changeDevice/0 /SetOutputTarget/Pump1/0.02/M0 /SetOutputTarget/Pump1/M0/abc
        /SetOutputTarget/Pump1/M8/0.02 /SetOutputTarget/Pump1/m0/0.02 /SetOutputTarget/Pump9/M0/0.02
        /SetOutputTarget/Chemostat/M0/0.02 /SetOutputTarget/GrowthRate/M0/1 /SetOutputTarget/Zigzag/M0/1
        /SetOutputTarget/OD0/M0/14000 /SetOutputOn/Pump1/0.5/M0 /SetOutputOn/Volume/0/M0
        /SetOutputOn/Chemostat/0/M0 /SetOutputOn/OD0/0/M0 /SetOutputOn/Pump9/0/M0 /CalibrateOD/Blank/M0/14000/0
        /MeasureTemp/Culture/M0""",
}


@pytest.mark.parametrize(
    ("method", "path", "status"),
    [(method, path, status) for (method, status), paths in ANSWERS.items() for path in paths.split()],
)
def test_status_codes(method: str, path: str, status: int) -> None:
    lab = Lab()
    got, body = lab.device.handle(method, path)
    assert got == status
    assert lab.device.supervisor.alive
    assert body == b"" if status == 204 else body
    if status == 500:
        assert b"html" in body  # no JSON errors exist
        assert lab.state()["UIDevice"] == "M0"  # and the software survives


def test_the_state_has_every_field_of_a_recorded_answer_with_its_type_and_sorted_keys() -> None:
    if not SAMPLE.exists():
        pytest.skip(f"no recorded answer at {SAMPLE}")
    lab = running(wait=9 * 60.07 + 20.0)
    lab.post("/changeDevice/M0")
    body = lab.device.handle("GET", "/getSysdata/")[1]
    recorded, mine = json.loads(SAMPLE.read_text()), json.loads(body)

    def compare(want: dict, got: dict, where: str) -> None:  # type: ignore[type-arg]
        assert sorted(want) == sorted(got), where
        for key, value in want.items():
            if isinstance(value, dict):
                compare(value, got[key], f"{where}.{key}")
            elif isinstance(value, (int, float)):
                assert isinstance(got[key], (int, float)), f"{where}.{key}"
            else:
                assert type(got[key]) is type(value), f"{where}.{key}"

    compare(recorded, mine, "sysData")
    assert list(mine) == sorted(mine)
    assert len(mine["OD"]["record"]) == len(mine["time"]["record"]) == 10


def test_targets_are_clamped_nan_passes_and_comes_out_as_a_bare_token() -> None:
    lab = Lab()
    for value, kept in (("5", 1.0), ("-5", -1.0), ("-0.2", -0.2), ("inf", 1.0), ("-inf", -1.0)):
        assert lab.post(f"/SetOutputTarget/Pump1/M0/{value}") == 204
        assert lab.state()["Pump1"]["target"] == kept
    lab.post("/SetOutputTarget/Thermostat/M0/80")
    assert lab.state()["Thermostat"]["target"] == 50.0
    assert lab.post("/SetOutputTarget/Pump3/M0/nan") == 204
    body = lab.device.handle("GET", "/getSysdata/")[1]
    assert b":NaN" in body
    assert math.isnan(json.loads(body)["Pump3"]["target"])


def test_force_is_on_off_and_anything_else_toggles() -> None:
    lab = Lab()
    lab.post("/SetOutputTarget/Pump1/M0/0.1")
    for force, on in (("1", 1), ("1", 1), ("0", 0), ("0", 0), ("2", 1), ("7", 0), ("-1", 1)):
        lab.post(f"/SetOutputOn/Pump1/{force}/M0")
        assert lab.state()["Pump1"]["ON"] == on


@pytest.mark.parametrize(
    ("path", "item", "key"),
    [
        ("SetOutputTarget/OD0/M0/{}", "OD0", "target"),
        *((f"SetOutputOn/{m}/{{}}/M0", m, "ON") for m in ("Chemostat", "Custom", "Volume", "OD0", "Experiment")),
    ],
)
def test_what_drives_nothing_is_set_and_then_answers_500(path: str, item: str, key: str) -> None:
    lab = Lab()
    for value in (0, 1):
        assert lab.post(f"/{path.format(value)}") == 500
        assert lab.state()[item][key] == value
    lab.wait(200.0)
    assert lab.state()["Experiment"]["cycles"] == 0  # no thread was started


def test_only_the_selected_reactor_is_served_and_an_absent_one_is_ignored() -> None:
    lab = Lab()
    lab.post("/SetOutputTarget/Stir/M1/0.7")
    assert lab.state("M1")["Stir"]["target"] == 0.7
    assert lab.post("/changeDevice/M6") == 204
    data = json.loads(lab.device.handle("GET", "/getSysdata/")[1])
    assert data["UIDevice"] == "M1"
    assert data["presentDevices"] == {"M0": 1, "M1": 1} | {f"M{k}": 0 for k in range(2, 8)}
    lab.post("/SetOutputTarget/Stir/0/0.6")  # 0 = the one selected
    assert lab.state("M1")["Stir"]["target"] == 0.6
    assert lab.state("M0")["Stir"]["target"] == 0.5


@pytest.mark.parametrize(
    ("path", "seconds"),
    [
        ("/MeasureOD/M0", 0.97),
        ("/SetOutputOn/Pump1/0/M0", 0.0),
        *((f"/SetOutputTarget/Stir/M0/{k}", s) for k, s in ((0.4, 1.5), (0.5, 2.25), (0.8, 2.25), (0.9, 3.0))),
    ],
)
def test_blocking_times(path: str, seconds: float) -> None:
    """The stirrer blocks by its target, where it is switched on and where the target of one that is on is rewritten."""
    lab = Lab()

    def taken(path: str) -> float:
        before = lab.clock.now()
        lab.post(path)
        return lab.clock.now() - before

    stirs = "Stir" in path
    assert taken(path) == pytest.approx(0.0 if stirs else seconds, abs=0.02)
    if stirs:
        assert [taken("/SetOutputOn/Stir/1/M0"), taken(path)] == pytest.approx([seconds] * 2, abs=0.02)
        assert lab.device.vials["M0"].stir == float(path.rpartition("/")[2])


def test_switching_regulation_either_way_turns_both_pumps_off() -> None:
    lab = Lab()
    for force in ("1", "0"):
        for pump in ("Pump1", "Pump2"):
            lab.post(f"/SetOutputTarget/{pump}/M0/0.1")
            lab.post(f"/SetOutputOn/{pump}/1/M0")
        lab.post(f"/SetOutputOn/OD/{force}/M0")
        state = lab.state()
        assert (state["OD"]["ON"], state["Pump1"]["ON"], state["Pump2"]["ON"]) == (int(force), 0, 0)


def test_direction_negates_the_target_and_under_regulation_the_direction_too() -> None:
    lab = Lab()
    lab.post("/SetOutputTarget/Pump1/M0/0.1")
    lab.post("/Direction/Pump1/M0")
    assert (lab.state()["Pump1"]["target"], lab.state()["Pump1"]["direction"]) == (-0.1, 1.0)
    lab.post("/SetOutputOn/OD/1/M0")
    lab.post("/Direction/Pump1/M0")
    assert (lab.state()["Pump1"]["target"], lab.state()["Pump1"]["direction"]) == (0.1, -1.0)


def test_reset_wipes_the_selected_reactor_only() -> None:
    lab = Lab()
    for m in ("M0", "M1"):
        lab.post(f"/CalibrateOD/OD0/{m}/14000/0")
        lab.post(f"/SetOutputTarget/Stir/{m}/0.7")
    lab.post("/changeDevice/M1")
    before = lab.clock.now()
    assert lab.post("/ExperimentReset") == 204
    assert 1.0 <= lab.clock.now() - before <= 2.0
    assert (lab.state("M1")["OD0"]["target"], lab.state("M1")["Stir"]["target"]) == (65000.0, 0.5)
    assert (lab.state("M0")["OD0"]["target"], lab.state("M0")["Stir"]["target"]) == (14000.0, 0.7)


def test_forks() -> None:
    lab = Lab()
    inject(lab.device, "require_requested_with")
    assert lab.device.handle("POST", "/changeDevice/M0")[0] == 403
    assert lab.device.handle("GET", "/getSysdata/")[0] == 200
    assert lab.device.handle("POST", "/changeDevice/M0", {"x-requested-with": "XMLHttpRequest"})[0] == 204
    inject(lab.device, "terminal_as_list")
    inject(lab.device, "extra_fields")
    data = json.loads(lab.device.handle("GET", "/getSysdata/")[1])
    assert isinstance(data["Terminal"]["text"], list)
    assert "Pump5" in data


def test_a_newer_app_names_the_reactor_in_its_log() -> None:
    lab = running(wait=1.0)
    lab.post("/Experiment/0/M0")
    lab.wait(80.0)
    plain = lab.state()["Terminal"]["text"]
    inject(lab.device, "terminal_named")
    state = lab.state()
    lines, where = state["Terminal"]["text"].split("</br>"), f"on M0 ({state['DeviceID']}) "
    assert [line.replace(where, "") for line in lines] == plain.split("</br>")
    assert [line.split(" - ")[1] for line in lines[:4]] == [
        f"Experiment {where}Stopped",
        f"Experiment {where}Stopping at end of cycle",
        f"Cycle 1 {where}Started",
        f"Experiment {where}Started",
    ]


def test_same_seed_same_readings_another_seed_others() -> None:
    def records(seed: int, reactors: tuple[str, ...]) -> list[float]:
        device = ChiBioDevice(reactors, VirtualClock(), np.random.default_rng(seed), blanked=True)
        device.handle("POST", "/Experiment/1/M0")
        device.run_until(600.0)
        return list(device.apps["M0"].data["OD"]["record"])

    assert records(1, ("M0",)) == records(1, ("M0",))
    assert records(1, ("M0",)) != records(2, ("M0",))


def test_thousands_of_random_requests_leave_a_device_that_answers() -> None:
    rng = np.random.default_rng(5)
    verbs = {"SetOutputTarget": 3, "SetOutputOn": 3, "Direction": 2, "MeasureOD": 1, "CalibrateOD": 4, "Experiment": 2}
    verbs |= {"changeDevice": 1, "MeasureTemp": 2, "ClearTerminal": 1, "SetFPMeasurement": 6}
    verbs |= {"getSysdata": 0, "getSysdata/": 0, "ExperimentReset": 0}
    arguments = ["Pump1", "Pump2", "Stir", "OD", "OD0", "Thermostat", "Heat", "Zigzag", "Light", "FP1", "LASER650"]
    arguments += ["M0", "M1", "0", "1", "2", "-1", "0.5", "nan", "inf", "1e400", "", "%00", "x", "IR", "Internal", "é"]
    lab = running(blanked=True, od=0.5)
    seen = set()
    for _ in range(1500):
        verb = str(rng.choice(list(verbs)))
        count = verbs[verb] if rng.random() < 0.9 else int(rng.integers(0, 5))
        path = "/".join(["", verb, *rng.choice(arguments, count)])
        reads = verb.startswith("get") == (rng.random() < 0.9)
        status, _ = lab.device.handle("GET" if reads else "POST", path)
        seen.add(status)
        lab.wait(float(rng.exponential(2.0)))
        assert lab.device.supervisor.alive, lab.device.computer.errors[-1]
    assert seen == {200, 204, 308, 404, 405, 500}
    for reactor in ("M0", "M1"):
        assert 0.0 < lab.device.truth(reactor)["volume_ml"] <= 30.0
        assert math.isfinite(lab.device.truth(reactor)["od"])
    assert lab.state()["UIDevice"] == "M0"
