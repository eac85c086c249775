"""The device's routes: which paths exist, the order of their arguments, what they answer (docs/device.md, Routes)."""

import re
from collections.abc import Callable, Generator, Mapping
from dataclasses import dataclass
from typing import NamedTuple
from urllib.parse import unquote

from hardware.emulator.computer import Steps
from hardware.emulator.software import Software
from hardware.emulator.sysdata import ALL_REACTORS, clear_terminal

LONG_ROUTE_S = 1.9  # GetSpectrum, ExperimentReset
HTML = {"Content-Type": "text/html; charset=utf-8"}

Answer = tuple[int, bytes, dict[str, str]]  # status, body, headers


@dataclass(eq=False)
class Exchange:
    """One request and its outcome.

    answer: status, body, headers; None before the answer. fate: how the request ended without an answer: "refused" (no
    server listens), "reset" (connection broken) or "lost" (silence until the client's time-out), else "". cut: bytes of
    the body to leave out. shows: reactor whose state a readable answer holds, else "".
    """

    method: str
    path: str
    headers: Mapping[str, str]
    answer: Answer | None = None
    fate: str = ""
    cut: int = 0
    shows: str = ""

    @property
    def done(self) -> bool:
        return self.answer is not None or self.fate != ""


class Route(NamedTuple):
    """A path with one "*" per argument; `run(software, *arguments)` serves it, as a generator if that takes time."""

    method: str
    path: str
    run: Callable[..., Steps | None]


def _change(s: Software, m: str) -> None:
    if s.apps[m].data["present"] == 1:
        s.select(m)


def _scan(s: Software, which: str) -> Steps:
    for name in ALL_REACTORS if which == "all" else (which,):
        app = s.apps[name]
        s.computer.bus(name)
        app.data["present"] = int(app.answers)
        app.data["DeviceID"] = app.device_id if app.answers else ""
        yield 0.02


def _direction(s: Software, item: str, m: str) -> None:
    data = s.app(m).data
    data[item]["target"] = -1.0 * data[item]["target"]
    if data["OD"]["ON"] == 1:
        data[item]["direction"] = -1.0 * data[item]["direction"]


def _calibrate(s: Software, item: str, m: str, raw: str, od: str) -> None:
    s.app(m).optics.calibrate(item, float(raw), float(od))


def _measure_temperature(s: Software, which: str, m: str) -> Steps:
    s.app(m).measure_temperature(which)
    yield 0.003


def _reset(s: Software) -> Steps:
    app = s.apps[s.selected]
    app.initialise(s.selected)
    if app.data["present"]:
        yield from app.outputs.everything_off()
        yield LONG_ROUTE_S


def _set_fp(s: Software, slot: str, led: str, base: str, emit1: str, emit2: str, gain: str) -> None:
    entry = s.apps[s.selected].data[slot]
    entry["ON"] = int(entry["ON"] != 1)
    if entry["ON"]:
        entry.update(LED=led, BaseBand=base, Emit1Band=emit1, Emit2Band=emit2, Gain=gain)


ROUTES = (
    Route("GET", "/", lambda s: None),
    Route("GET", "/getSysdata/", lambda s: None),
    Route("POST", "/changeDevice/*", _change),
    Route("POST", "/scanDevices/*", _scan),
    Route("POST", "/SetOutputTarget/*/*/*", lambda s, item, m, value: s.app(m).outputs.set_target(item, float(value))),
    Route("POST", "/SetOutputOn/*/*/*", lambda s, item, force, m: s.app(m).outputs.set_on(item, int(force))),
    Route("POST", "/Direction/*/*", _direction),
    Route("POST", "/MeasureOD/*", lambda s, m: s.app(m).optics.measure_od()),
    Route("POST", "/CalibrateOD/*/*/*/*", _calibrate),
    Route("POST", "/MeasureTemp/*/*", _measure_temperature),
    Route("POST", "/MeasureFP/*", lambda s, m: s.app(m).optics.measure_fluorescence()),
    Route("POST", "/Experiment/*/*", lambda s, value, m: s.app(m).experiment.start_or_stop(int(value))),
    Route("POST", "/ExperimentReset", _reset),
    Route("POST", "/ClearTerminal/*", lambda s, m: clear_terminal(s.app(m).data, s.computer.stamp())),
    Route("POST", "/SetFPMeasurement/*/*/*/*/*/*", _set_fp),
)


def _split(path: str) -> list[str]:
    return path.strip("/").split("/") if path.strip("/") else []


def find_route(method: str, path: str) -> tuple[Route | None, list[str], int]:
    """Return (route, arguments, 200), or (None, [], 308 | 404 | 405); 308: the path lacks its final slash."""
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


def answer_request(software: Software, exchange: Exchange) -> Generator[float, None, Answer]:
    """Run one request and return its answer. Raises: what the device's software raises."""
    path = unquote(exchange.path.split("?", 1)[0])
    merged = re.sub("/+", "/", path)
    found, arguments, code = find_route(exchange.method, merged)
    if path != merged and found is not None:
        found, code = None, 308
    if found is None:
        slash = "" if merged != path else "/"
        location = {"Location": merged + slash} if code == 308 else {}
        return code, f"<!doctype html>\n<title>{code}</title>\n".encode(), HTML | location
    faults, headers = software.computer.faults, {key.lower() for key in exchange.headers}
    if faults.require_requested_with and found.method == "POST" and "x-requested-with" not in headers:
        return 403, b"<!doctype html>\n<title>403 Forbidden</title>\n", HTML
    if found.method == "POST":
        if not faults.take("lying"):
            yield from found.run(software, *arguments) or ()
        return 204, b"", HTML
    if found.path == "/":
        return 200, b"<!doctype html>\n<title>Chi.Bio emulator</title>\n", HTML
    body, exchange.shows = software.sysdata(), software.selected
    if faults.take("malformed"):
        body, exchange.shows = body[: len(body) // 2] + b'}{"OD":' + body[len(body) // 2 :], ""
    if faults.take("truncated"):
        exchange.cut, exchange.shows = len(body) // 2, ""
    return 200, body, {"Content-Type": "application/json"}
