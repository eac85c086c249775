"""The same requests to the vendor's app and to the emulator at the same device seconds, and the same sysdata then."""

from __future__ import annotations

import math
import re
import threading
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any, NamedTuple

import pytest

from hardware.emulator.faults import inject
from tests.hardware.emulator_lab import Lab, quiet
from tests.vendor.bench import App, missing

LATE_S = 1.0  # a look later than this is no comparison, the machine was busy
BEHIND_S = 3  # the app's own work takes real time: it may show what the emulator showed up to so long before
STAGGER_S = 17.0  # device s between the starts of sequences on one board: the bus serves one reactor after the other
TOLERANCE = 0.06  # of OD and duty
BATCH, BOARDS = 4, 4  # sequences on a board, boards at a time
BLANK = 16000.0  # counts of the stand-ins' clear medium

DEAD = "!thread_dead"  # of the thermometer that is read after the four readings, in a cycle's tenth second
START, STOP = "/Experiment/1/M", "/Experiment/0/M"
Action = str | None  # a request, "!fault", or None: look
Steps = dict[float, Action | list[Action]]


def looks(*at: float) -> Steps:
    return dict.fromkeys(at, None)


SEQUENCES: dict[str, Steps] = {
    "start": {0: START} | looks(2.5, 7.5, 12, 25, 45, 62.5, 67.5, 72, 85),
    "stopped while settling": {0: START, 62.5: STOP} | looks(61.5, 63.7, 68, 85, 130),
    "stopped while measuring": {0: START, 67.5: STOP} | looks(66.5, 68.7, 75, 85, 130),
    "stopped while sleeping": {0: START, 30: STOP} | looks(28, 32, 50, 63, 72),
    "stopped and started early": {0: START, 30: STOP, 35: START} | looks(37, 42.5, 50, 57, 63, 75, 98, 110, 135),
    "stopped while measuring, started at once": {0: START, 67: STOP, 68.3: START} | looks(69.6, 84, 100, 125, 140),
    "stopped while measuring, started late": {0: START, 67.5: STOP, 140: START} | looks(139, 142, 147.5, 153, 165, 210),
    "stopped, waited, started": {0: START, 30: STOP, 75: START} | looks(74, 77, 82.5, 90, 100, 138),
    "started twice": {0: START, 30: START} | looks(32, 50, 63),
    "stopped without a start": {0: STOP} | looks(2, 10),
    "thread dead in measuring": {0: START, 66: DEAD} | looks(64, 67.5, 75, 85, 125, 140),
    "thread dead, stopped, started": {0: START, 66: DEAD, 90: STOP, 95: START}
    | looks(92, 97, 102.5, 110, 120, 160),
    "worker killed in measuring": {0: START, 67.5: "!worker"} | looks(66, 110, 130),
    "worker killed, started": {0: START, 30: "!worker", 80: START} | looks(79, 82.5, 87.5, 95, 110, 145),
    "stopped with pumps on": {0: START, 18: "/SetOutputTarget/Pump1/M/0.3", 18.5: "/SetOutputOn/Pump1/1/M"}
    | {19: "/SetOutputTarget/Pump3/M/0.3", 19.5: "/SetOutputOn/Pump3/1/M", 30: STOP}
    | looks(22, 32, 50, 63, 85),
    "waste pump on over a cycle": {0: START, 20: "/SetOutputTarget/Pump2/M/0.3", 21: "/SetOutputOn/Pump2/1/M"}
    | looks(23, 58, 67.5, 80, 88, 97, 110),
    "regulated on board": {0: START, 18: "/SetOutputTarget/OD/M/0.3", 20: "/SetOutputOn/OD/1/M"}
    | {215: "/SetOutputOn/OD/0/M"}
    | looks(22, 50, 85, 145, 205, 217, 230),
    "stopped while regulated": {0: START, 20: "/SetOutputOn/OD/1/M", 90: STOP} | looks(22, 88, 92, 130),
    "fluorescence toggled": {0: START, 20: ["/changeDevice/M", "/SetFPMeasurement/FP1/LEDA/CLEAR/nm440/OFF/x10"]}
    | {95: ["/changeDevice/M", "/SetFPMeasurement/FP1/LEDB/CLEAR/nm510/nm550/x4"]}
    | looks(22, 62.5, 85, 97, 145),
    "stopped while it measures fluorescence": {
        0: ["/changeDevice/M", "/SetFPMeasurement/FP1/LEDA/CLEAR/nm440/OFF/x10"], 0.5: START, 10.7: STOP
    } | looks(13, 20, 40),
    "outputs by hand": {0: "/SetOutputTarget/Stir/M/0.6", 1: "/SetOutputOn/Stir/1/M", 5: "/SetOutputOn/Thermostat/1/M"}
    | {9: "/SetOutputTarget/Pump1/M/0.2", 9.5: "/SetOutputOn/Pump1/1/M", 13: "/SetOutputTarget/Pump1/M/0"}
    | {16: "/SetOutputTarget/Pump1/M/0.1", 20: "/SetOutputOn/Thermostat/0/M", 23: "/SetOutputOn/Stir/0/M"}
    | looks(4.5, 7.5, 11.5, 14.5, 18, 22, 26, 45),
    "measured by hand": {0: "/MeasureOD/M", 4: "/MeasureTemp/IR/M", 7: "/CalibrateOD/OD0/M/9000/0.2"}
    | {10: "/MeasureOD/M"}
    | looks(2.5, 6, 9, 13),
    "asked for a reactor that is absent": {0: START, 20: "/SetOutputOn/Stir/0/M7"} | looks(18, 25),
}  # fmt: skip
ALONE = ("worker", "absent", ", started", "regulated")  # in the name: befalls the board, or meets a neighbour's cycle
RIVALS = ("stopped while measuring, started at once",)  # two threads measure at a time: no OD is right


class Look(NamedTuple):
    """Device s since the sequence's start, and what sysData showed; {"alive": False} if nobody answered."""

    at_s: float
    fields: dict[str, Any]


def fields(data: dict[str, Any]) -> dict[str, Any]:
    """What is compared of sysData."""
    newest = re.split(r"</br>|\n", str(data["Terminal"]["text"]))[0]
    return (
        {"alive": True, "Measuring": data["OD"]["Measuring"], "Terminal": newest.partition(" - ")[2].strip()}
        | {f"Experiment.{key}": data["Experiment"][key] for key in ("ON", "cycles", "threadCount")}
        | {"Experiment.startTime": data["Experiment"]["startTime"] != " Waiting "}
        | {"Experiment.startTimeRaw": data["Experiment"]["startTimeRaw"] != 0}
        | {f"{key}.ON": data[key]["ON"] for key in ("OD", "Stir", "Thermostat", "Heat", "FP1", "Light")}
        | {f"Pump{k}.{key}": data[f"Pump{k}"][key] for k in range(1, 5) for key in ("ON", "target")}
        | {"OD.current": data["OD"]["current"], "OD.target": data["OD"]["target"]}
        | {"Stir.target": data["Stir"]["target"], "OD0.raw = 65000": data["OD0"]["raw"] == 65000}
        | {"OD0.target = 65000": data["OD0"]["target"] == 65000, "FP1.LED": data["FP1"]["LED"]}
        | {f"temperatures[{k}]": data[f"Thermometer{k}"]["current"] > 0 for k in ("IR", "Internal", "External")}
        | {f"len {key}.record": len(data[key]["record"]) for key in ("time", "OD", "Pump1", "ThermometerIR")}
        | {"len OD.targetrecord": len(data["OD"]["targetrecord"]), "len FP1.BaseRecord": len(data["FP1"]["BaseRecord"])}
        | {"FP1 reads": data["FP1"]["Base"] > 0}
    )


def steps(name: str) -> list[tuple[float, Action]]:
    every = [(at, one) for at, what in SEQUENCES[name].items() for one in (what if isinstance(what, list) else [what])]
    return sorted(every, key=lambda step: step[0])


def named(request: str, m: str) -> str:
    return re.sub(r"/M(/|$)", rf"/{m}\1", request)


def on_emulator(name: str) -> list[Look]:
    """In the emulator's own time, one reactor; every look of the sequence, and one each second before it."""
    lab = Lab(("M0",), options=quiet(0.03, blank=(BLANK, BLANK)), od=0.45, temperature=30.0, blanked=True)
    lab.post("/MeasureOD/M0")
    lab.wait(30.0)
    began, seen = lab.clock.now(), []
    early = [(at - k, None) for at, what in steps(name) if what is None for k in range(1, BEHIND_S + 1)]
    for at, what in sorted([*steps(name), *early], key=lambda step: step[0]):
        lab.wait_until(max(began + at, lab.clock.now()))
        try:
            if what is None:
                seen.append(Look(at, fields(lab.state())))
            elif what == DEAD:
                inject(lab.device, "internal_zero", "M0")
            elif what == "!worker":
                inject(lab.device, "worker_wipe")
            else:
                lab.post(named(what, "M0"))
        except ConnectionError:
            if what is None:
                seen.append(Look(at, {"alive": False}))
    return seen


def follow(app: App, m: str, name: str, gate: threading.Lock, begin: float, seen: list[Look]) -> None:
    """One sequence on one reactor of the app."""
    for at, what in steps(name):
        app.sleep(begin + at - app.now())
        try:
            if what is None:
                with gate:
                    data = app.state(m)
                if app.now() - begin - at <= LATE_S:
                    seen.append(Look(at, fields(data)))
            elif what == DEAD:
                app.change(m, internal_zero=1)
            elif what == "!worker":
                app.kill_worker()
            else:
                with gate:
                    app.post(named(what, m))
        except OSError:
            if what is None:
                seen.append(Look(at, {"alive": False}))


def on_app(names: list[str], folder: Path) -> dict[str, list[Look]]:
    """Several sequences on reactors of one board, one after the other begun. A board for each batch."""
    alone = [[name] for name in names if any(word in name for word in ALONE)]
    rest = [name for name in names if [name] not in alone]
    batches = [rest[k : k + BATCH] for k in range(0, len(rest), BATCH)] + alone
    with ThreadPoolExecutor(BOARDS) as pool:
        boards = pool.map(on_board, batches, [folder / f"board{k}" for k in range(len(batches))])
        return {name: looks for board in boards for name, looks in board.items()}


def on_board(batch: list[str], folder: Path) -> dict[str, list[Look]]:
    found: dict[str, list[Look]] = {name: [] for name in batch}
    reactors = [f"M{k}" for k in range(len(batch))]
    with App(folder, reactors) as app:
        for m in reactors:
            app.change(m, T=30.0, x=0.45, mu=0.03)
            app.post(f"/MeasureOD/{m}")
        gate, begin = threading.Lock(), app.now() + 5.0
        threads = [
            threading.Thread(target=follow, args=(app, m, name, gate, begin + STAGGER_S * k, found[name]))
            for k, (m, name) in enumerate(zip(reactors, batch, strict=True))
        ]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
    return found


def same(left: Any, right: Any) -> bool:
    if isinstance(left, (int, float)) and isinstance(right, (int, float)):
        return math.isclose(left, right, abs_tol=TOLERANCE if isinstance(left + right, float) else 0)
    return bool(left == right)


def differences(name: str, app: list[Look]) -> list[tuple[str, float, str, Any, Any]]:
    """(sequence, device s, field, app, emulator) for every field that differs."""
    emulated = on_emulator(name)

    def shown(at_s: float, key: str) -> list[Any]:
        return [e.fields.get(key) for e in emulated if 0 <= at_s - e.at_s <= BEHIND_S]

    return [
        (name, look.at_s, key, value, shown(look.at_s, key))
        for look in app
        for key, value in look.fields.items()
        if not any(same(value, other) for other in shown(look.at_s, key))
        and not (key == "OD.current" and name in RIVALS)
    ]


@pytest.fixture(scope="module")
def seen(tmp_path_factory: pytest.TempPathFactory) -> dict[str, list[Look]]:
    if reason := missing():
        pytest.skip(reason)
    return on_app(list(SEQUENCES), tmp_path_factory.mktemp("boards"))


@pytest.mark.slow
@pytest.mark.xdist_group("vendor")
@pytest.mark.parametrize("name", SEQUENCES)
def test_the_emulator_shows_what_the_app_shows(name: str, seen: dict[str, list[Look]]) -> None:
    assert 2 * len(seen[name]) >= len([1 for _, what in steps(name) if what is None]), "the machine is too busy"
    assert differences(name, seen[name]) == []


def test_an_absent_app_is_said_in_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("CHIBIO_APP", raising=False)
    assert "\n" not in str(missing())
    assert "CHIBIO_APP" in str(missing())
