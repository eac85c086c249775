"""The device's routes: which paths exist, the order of their arguments, what they answer (docs/device.md, Routes)."""

from __future__ import annotations

import re
from collections.abc import Callable, Generator
from typing import TYPE_CHECKING, NamedTuple
from urllib.parse import unquote

from hardware.emulator.reactor_app import ReactorApp, Steps
from hardware.emulator.sysdata import ALL_REACTORS, add_terminal, clear_terminal

if TYPE_CHECKING:
    from hardware.emulator.device import ChiBioDevice, Exchange

__all__ = ["HTML", "Answer", "answer_request", "find_route"]

Answer = tuple[int, bytes, dict[str, str]]  # status, body, headers

LONG_ROUTE_S = 1.9  # GetSpectrum, ExperimentReset
HTML = {"Content-Type": "text/html; charset=utf-8"}


class Route(NamedTuple):
    """A path with one "*" per argument; `run(device, *arguments)` is the view."""

    method: str
    path: str
    run: Callable[..., Steps]


def _app(device: ChiBioDevice, name: str) -> ReactorApp:
    return device.apps[device.selected if name == "0" else name]


def _set_target(d: ChiBioDevice, item: str, m: str, value: str) -> Steps:
    number = float(value)
    yield from _app(d, m).set_target(item, number)


def _set_on(d: ChiBioDevice, item: str, force: str, m: str) -> Steps:
    number = int(force)
    yield from _app(d, m).set_on(item, number)


def _change(d: ChiBioDevice, m: str) -> Steps:
    if d.apps[m].data["present"] == 1:
        d.select(m)
    yield from ()


def _scan(d: ChiBioDevice, which: str) -> Steps:
    for name in ALL_REACTORS if which == "all" else (which,):
        app = d.apps[name]
        d.bus(name)
        app.data["present"] = int(app.answers)
        app.data["DeviceID"] = app.device_id if app.answers else ""
        yield 0.02


def _direction(d: ChiBioDevice, item: str, m: str) -> Steps:
    data = _app(d, m).data
    data[item]["target"] = -1.0 * data[item]["target"]
    if data["OD"]["ON"] == 1:
        data[item]["direction"] = -1.0 * data[item]["direction"]
    yield from ()


def _measure_od(d: ChiBioDevice, m: str) -> Steps:
    yield from _app(d, m).measure_od()


def _calibrate(d: ChiBioDevice, item: str, m: str, raw: str, od: str) -> Steps:
    _app(d, m).calibrate(item, float(raw), float(od))
    yield from ()


def _measure_temperature(d: ChiBioDevice, which: str, m: str) -> Steps:
    _app(d, m).measure_temperature(which)
    yield 0.003


def _measure_fp(d: ChiBioDevice, m: str) -> Steps:
    yield from _app(d, m).measure_fluorescence()


def _spectrum(d: ChiBioDevice, gain: str, m: str) -> Steps:
    int(gain[1:])
    app = _app(d, m)
    yield from app.expose(LONG_ROUTE_S / 2)
    raw = yield from app.expose(LONG_ROUTE_S / 2)
    app.data["AS7341"]["spectrum"]["CLEAR"] = raw


def _experiment(d: ChiBioDevice, value: str, m: str) -> Steps:
    yield from _app(d, m).start_or_stop(int(value))


def _reset(d: ChiBioDevice) -> Steps:
    app = d.apps[d.selected]
    app.initialise(d.selected)
    if app.data["present"]:
        yield from app.everything_off()
        yield LONG_ROUTE_S


def _clear(d: ChiBioDevice, m: str) -> Steps:
    clear_terminal(_app(d, m).data, d.stamp())
    yield from ()


def _set_fp(d: ChiBioDevice, slot: str, led: str, base: str, emit1: str, emit2: str, gain: str) -> Steps:
    data = d.apps[d.selected].data[slot]
    data["ON"] = int(data["ON"] != 1)
    if data["ON"]:
        data.update({"LED": led, "BaseBand": base, "Emit1Band": emit1, "Emit2Band": emit2, "Gain": gain})
    yield from ()


def _set_custom(d: ChiBioDevice, program: str, status: str) -> Steps:
    data = d.apps[d.selected].data["Custom"]
    data["ON"] = int(data["ON"] != 1)
    if data["ON"]:
        data.update({"Program": program, "Status": float(status), "param1": 0.0, "param2": 0.0, "param3": 0.0})
    yield from ()


def _set_light(d: ChiBioDevice, led: str) -> Steps:
    data = d.apps[d.selected].data["Light"]
    data["ON"] = int(data["ON"] != 1)
    if data["ON"]:
        data["Excite"] = led
    yield from ()


def _characterise(d: ChiBioDevice, m: str, program: str) -> Steps:
    """Its thread dies with a TypeError for M0 to M7; with 0 it would sweep LEDs for minutes."""
    add_terminal(_app(d, m).data, d.stamp(), f"Characterisation {program} requested")
    yield from ()


def _nothing(d: ChiBioDevice) -> Steps:
    yield from ()


ROUTES = (
    Route("GET", "/", _nothing),
    Route("GET", "/getSysdata/", _nothing),
    Route("POST", "/changeDevice/*", _change),
    Route("POST", "/scanDevices/*", _scan),
    Route("POST", "/SetOutputTarget/*/*/*", _set_target),
    Route("POST", "/SetOutputOn/*/*/*", _set_on),
    Route("POST", "/Direction/*/*", _direction),
    Route("POST", "/MeasureOD/*", _measure_od),
    Route("POST", "/CalibrateOD/*/*/*/*", _calibrate),
    Route("POST", "/MeasureTemp/*/*", _measure_temperature),
    Route("POST", "/MeasureFP/*", _measure_fp),
    Route("POST", "/GetSpectrum/*/*", _spectrum),
    Route("POST", "/Experiment/*/*", _experiment),
    Route("POST", "/ExperimentReset", _reset),
    Route("POST", "/ClearTerminal/*", _clear),
    Route("POST", "/SetFPMeasurement/*/*/*/*/*/*", _set_fp),
    Route("POST", "/SetCustom/*/*", _set_custom),
    Route("POST", "/SetLightActuation/*", _set_light),
    Route("POST", "/CharacteriseDevice/*/*", _characterise),
)


def _split(path: str) -> list[str]:
    return path.strip("/").split("/") if path.strip("/") else []


def find_route(method: str, path: str) -> tuple[Route | None, list[str], int]:
    """(route, arguments, 200), or (None, [], 308 | 404 | 405); 308 is a path that lacks its final slash."""
    parts = _split(path)
    for found in ROUTES:
        pattern = _split(found.path)
        if len(pattern) != len(parts) or any(p not in ("*", part) for p, part in zip(pattern, parts, strict=True)):
            continue
        slash = found.path.endswith("/")
        if path.endswith("/") and not slash:
            return None, [], 404
        if method != found.method and not (method == "HEAD" and found.method == "GET"):
            return None, [], 405
        if slash and not path.endswith("/"):
            return None, [], 308
        return found, [part for p, part in zip(pattern, parts, strict=True) if p == "*"], 200
    return None, [], 404


def answer_request(device: ChiBioDevice, exchange: Exchange) -> Generator[float, None, Answer]:
    """Run one request to its answer. Raises: whatever the device's software raises on the way."""
    path = unquote(exchange.path.split("?", 1)[0])
    merged = re.sub("/+", "/", path)
    found, arguments, code = find_route(exchange.method, merged)
    if path != merged and found is not None:
        found, code = None, 308
    if found is None:
        slash = "" if merged != path else "/"
        location = {"Location": merged + slash} if code == 308 else {}
        return code, f"<!doctype html>\n<title>{code}</title>\n".encode(), HTML | location
    headers = {key.lower() for key in exchange.headers}
    if device.faults.require_requested_with and found.method == "POST" and "x-requested-with" not in headers:
        return 403, b"<!doctype html>\n<title>403 Forbidden</title>\n", HTML
    if found.method == "POST":
        if not device.faults.take("lying"):
            yield from found.run(device, *arguments)
        return 204, b"", HTML
    if found.path == "/":
        return 200, b"<!doctype html>\n<title>Chi.Bio emulator</title>\n", HTML
    body = device.sysdata()
    if device.faults.take("malformed"):
        body = body[: len(body) // 2] + b'}{"OD":' + body[len(body) // 2 :]
    if device.faults.take("truncated"):
        exchange.cut = len(body) // 2
    return 200, body, {"Content-Type": "application/json"}
