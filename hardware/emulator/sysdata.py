"""The device's memory: the sysData dictionary of one reactor after `initialise()`, and its record lists."""

from bisect import bisect_left
from collections.abc import Iterator
from typing import Any

SysData = dict[str, Any]

ALL_REACTORS = tuple(f"M{k}" for k in range(8))
PUMPS = ("Pump1", "Pump2", "Pump3", "Pump4")
SLOTS = ("FP1", "FP2", "FP3")
BANDS = ("nm410", "nm440", "nm470", "nm510", "nm550", "nm583", "nm620", "nm670", "CLEAR", "NIR")
WAVELENGTHS = {
    "LEDA": "395", "LEDB": "457", "LEDC": "500", "LEDD": "523", "LEDE": "595", "LEDF": "623", "LEDG": "6500K",
    "LEDH": "600", "LEDI": "550", "LEDV": "White",
}  # fmt: skip
LIGHTS = tuple(WAVELENGTHS)
UNSET_ZERO = 65000.0  # OD0 after every initialise: the blank is forgotten

THIN_ABOVE = 200
THIN_KEEP = 10


def _output(default: float, **extra: Any) -> SysData:
    return {"ON": 0, "default": default, "max": 1.0, "min": 0.0, "target": default, **extra}


def _pump() -> SysData:
    return {**_output(0.0), "min": -1.0, "direction": 1.0, "record": [], "thread": 0}


def _slot(led: str, emit1: str, emit2: str) -> SysData:
    return {
        "ON": 0, "LED": led, "Base": 0, "Emit1": 0, "Emit2": 0, "BaseBand": "CLEAR", "Emit1Band": emit1,
        "Emit2Band": emit2, "Gain": "x10", "BaseRecord": [], "Emit1Record": [], "Emit2Record": [],
    }  # fmt: skip


def fresh_sysdata(device_id: str, selected: str) -> SysData:
    """Build all fields of one reactor after `initialise()` (docs/device.md, State fields; from a real server's answer).

    Args:
      device_id: decimal ID of the reactor, "" if none is plugged in. selected: position that the web page shows.
    """
    spectral = (*BANDS, "DARK", "ExtGPIO", "ExtINT", "FLICKER")
    data: SysData = {
        "UIDevice": selected,
        "present": int(bool(device_id)),
        "presentDevices": dict.fromkeys(ALL_REACTORS, 0),
        "DeviceID": device_id,
        "Version": {"value": "Turbidostat V3.0", "LED": 1},
        "time": {"record": []},
        "Experiment": {
            "ON": 0, "cycles": 0, "cycleTime": 60.0, "indicator": "USR0", "startTime": " Waiting ", "startTimeRaw": 0,
            "threadCount": 0,
        },
        "OD": {
            "current": 0.0, "target": 0.5, "default": 0.5, "max": 10, "min": 0, "record": [], "targetrecord": [],
            "Measuring": 0, "ON": 0, "Integral": 0.0, "Integral2": 0.0, "device": "LASER650",
        },
        "OD0": {
            "target": UNSET_ZERO, "raw": UNSET_ZERO, "max": 100000.0, "min": 0.0, "LASERa": 0.226, "LASERb": 1.833,
            "LEDAa": 7.0, "LEDFa": 0.673,
        },
        **{pump: _pump() for pump in PUMPS},
        "Stir": _output(0.5),
        "Heat": {**_output(0), "record": []},
        "Thermostat": {**_output(37.0), "max": 50.0, "Integral": 0, "last": -1, "cycleTime": 30.0, "record": []},
        **{f"Thermometer{name}": {"current": 0.0, "record": []} for name in ("IR", "Internal", "External")},
        "Volume": {"ON": 0, "target": 20.0, "max": 50.0, "min": 0.0},
        "Chemostat": {"ON": 0, "p1": 0.0, "p2": 0.1},
        "Zigzag": {"ON": 0, "Zig": 0.04, "target": 0.0, "SwitchPoint": 0},
        "GrowthRate": {"current": 2.0, "default": 2.0, "record": []},
        "Custom": {
            "ON": 0, "Program": "C1", "Status": 0.0, "default": 0.0, "param1": 0.0, "param2": 0.0, "param3": 0.0,
            "record": [],
        },
        "Light": {**_output(0.5), "Excite": "LEDD", "record": []},
        "FP1": _slot("LEDB", "nm510", "nm550"),
        "FP2": _slot("LEDD", "nm583", "nm620"),
        "FP3": _slot("LEDE", "nm620", "nm670"),
        **{led: _output(0.1, WL=wl) for led, wl in WAVELENGTHS.items()},
        "LASER650": _output(0.5, name="LASER650"),
        "UV": _output(0.5, WL="UV"),
        "AS7341": {
            "spectrum": dict.fromkeys(spectral, 0),
            "channels": dict.fromkeys(spectral, 0),
            "current": {f"ADC{k}": 0 for k in range(6)},
        },
        "biofilm": {led: dict.fromkeys(BANDS, 0) for led in (*LIGHTS[:7], "LASER650")},
        "Terminal": {"text": ""},
    }  # fmt: skip
    data["LEDV"]["ScaleFactor"] = 0.4
    return data


def add_terminal(data: SysData, stamp: str, text: str) -> None:
    """Put a line at the top of the web page's text log; `stamp` is "YYYY-MM-DD HH:MM:SS"."""
    data["Terminal"]["text"] = f"{stamp}  - {text}</br>{data['Terminal']['text']}"


def clear_terminal(data: SysData, stamp: str) -> None:
    data["Terminal"]["text"] = ""
    add_terminal(data, stamp, "Terminal Cleared")


def _series(data: SysData) -> Iterator[tuple[SysData, str, float]]:
    """Yield, for every record list, its dictionary, its key and the value to append at the end of a cycle."""
    yield data["OD"], "record", data["OD"]["current"]
    yield data["OD"], "targetrecord", data["OD"]["target"] * data["OD"]["ON"]
    yield data["Thermostat"], "record", data["Thermostat"]["target"] * float(data["Thermostat"]["ON"])
    yield data["Light"], "record", float(data["Light"]["ON"])
    for name in ("ThermometerInternal", "ThermometerExternal", "ThermometerIR"):
        yield data[name], "record", data[name]["current"]
    for pump in PUMPS:
        yield data[pump], "record", data[pump]["target"] * float(data[pump]["ON"])
    yield data["GrowthRate"], "record", data["GrowthRate"]["current"] * float(data["Zigzag"]["ON"])
    for name in SLOTS:
        slot = data[name]
        for key in ("Base", "Emit1", "Emit2"):
            yield slot, f"{key}Record", slot[key] if slot["ON"] == 1 else 0.0


def append_records(data: SysData, started: float) -> None:
    """Append one value to every list. Args: started: start of the cycle, s since startTimeRaw."""
    data["time"]["record"].append(started)
    for owner, key, value in _series(data):
        owner[key].append(value)


def thin_records(data: SysData) -> None:
    """Thin lists above 200 entries: keep about every other old entry and the newest 10 (docs/device.md, Records)."""
    times = data["time"]["record"]
    if len(times) <= THIN_ABOVE:
        return
    old = round(len(times) / 2, 2) - 1
    count = int(old)
    first, last = times[0], times[-THIN_KEEP - 1]
    wanted = [first + (last - first) * k / (count - 1) for k in range(count)]
    index = [_nearest(times, t) for t in wanted] + list(range(len(times) - THIN_KEEP, len(times)))
    for owner, key in [(data["time"], "record"), *((o, k) for o, k, _ in _series(data))]:
        owner[key] = [float(owner[key][i]) for i in index]


def _nearest(times: list[float], wanted: float) -> int:
    low = bisect_left(times, wanted, 0, len(times) - 1)
    return low - 1 if low > 0 and wanted - times[low - 1] < times[low] - wanted else low
