"""The emulated Chi.Bio as a separate process: a real HTTP server in scaled real time.

    python -m hardware.emulator --port 5000 --reactors M0,M1,M2 --speed 60

The server handles one request at a time and closes the connection after each, as the device's single gunicorn worker
does. Faults and the true state are under /_emulator/ (docs/emulator.md), on the device's port and on a control port
that also answers while the emulated software is dead. The server uses sockets, not a web framework, because it also
emulates resets, partial answers and half-open connections.
"""

from __future__ import annotations

import argparse
import json
import os
import signal
import socket
import struct
import sys
import threading
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from http.server import BaseHTTPRequestHandler, HTTPServer, ThreadingHTTPServer
from typing import Any

import numpy as np

from conf.presets import groups
from envs.plant.plant import OPTIONS, with_options
from hardware.clock import Clock, DeviceClock
from hardware.emulator.device import ChiBioDevice, DeviceOptions, plant_preset
from hardware.emulator.faults import FAULTS, inject
from hardware.emulator.routes import Exchange
from hardware.emulator.vial import SPARE, VialConfig

PREFIX = "/_emulator/"
POLL_S = 0.05  # real seconds between two steps of the device without a request
CLIENT_PATIENCE_S = 5.0  # real seconds for a client to send its request


class EmulatorServer:
    """Server of `device` on two ports until `stop`; port 0 picks a free port. Raises: OSError if a port is taken."""

    def __init__(self, device: ChiBioDevice, host: str, port: int, control_port: int) -> None:
        self.device, self.lock = device, threading.Lock()
        self._host = host
        self._stop = threading.Event()
        self._web: _DevicePort | None = _DevicePort((host, port), self)
        self.port = int(self._web.server_address[1])
        try:
            self._control = ThreadingHTTPServer((host, control_port), partial(_Handler, self))
        except OSError as problem:
            self._web.server_close()
            raise OSError(problem.errno, f"control port {control_port}: {problem.strerror}") from problem
        self.control_port = int(self._control.server_address[1])

    def stop(self) -> None:
        """End `run` soon; a signal handler or another thread may call this."""
        self._stop.set()

    def run(self) -> None:
        control = threading.Thread(target=self._control.serve_forever, args=(POLL_S,), daemon=True)
        control.start()
        try:
            while not self._stop.is_set():
                self._turn()
        finally:
            self._control.shutdown()
            self._control.server_close()
            if self._web is not None:
                self._web.server_close()

    def _turn(self) -> None:
        """Bring the device up to date, listen only while its software is alive, serve at most one request."""
        self.advance()
        if not self.device.supervisor.alive and self._web is not None:
            self._web.server_close()
            self._web = None
        elif self.device.supervisor.alive and self._web is None:
            self._web = _DevicePort((self._host, self.port), self)
        if self._web is not None:
            self._web.handle_request()
        else:
            self._stop.wait(POLL_S)

    def advance(self) -> None:
        with self.lock:
            self.device.run_until(self.device.clock.now())

    def exchange(self, method: str, path: str, headers: dict[str, str]) -> Exchange:
        """Submit one request and wait for its answer in scaled real time."""
        self.advance()
        with self.lock:
            request = self.device.submit(method, path, headers)
        clock = self.device.clock
        while not request.done and not self._stop.is_set():
            clock.sleep(max(min(self.device.next_time() - clock.now(), 1.0), 1e-3))
            self.advance()
        return request

    def control(self, method: str, path: str) -> tuple[int, bytes]:
        """Answer one of the emulator's own routes; return status and body."""
        parts = path.removeprefix(PREFIX).strip("/").split("/")
        device = self.device
        with self.lock:
            device.run_until(device.clock.now())
            try:
                if method == "POST" and parts[0] == "fault" and 2 <= len(parts) <= 4:
                    reactor, value = [*parts[2:], *["all", "1"][len(parts) - 2 :]]
                    inject(device, parts[1], reactor, float(value))
                    return 204, b""
                if method == "GET" and parts == ["truth"]:
                    s = device.supervisor
                    software = {"alive": s.alive, "restarts": s.restarts, "exits": s.exits}
                    seen = {"selected": s.software.selected, "errors": list(device.computer.errors)}
                    return 200, _json({**{m: device.truth(m) for m in device.vials}, **software, **seen})
                kept = method == "GET" and parts[0] in ("doses", "samples", "reads")
                if kept and parts[1:] in [[m] for m in device.vials]:
                    rows = getattr(device.vials[parts[1]], parts[0])
                    return 200, _json([row if isinstance(row, float) else row._asdict() for row in rows])
                if method == "GET" and parts == ["faults"]:
                    return 200, _json({name: list(entry) for name, entry in FAULTS.items()})
            except ValueError as problem:
                return 400, f"{problem}\n".encode()
        return 404, b"allowed: POST fault/<name>/<M>/<value>, GET truth, doses/<M>, samples/<M>, reads/<M>, faults\n"


def _json(value: object) -> bytes:
    return json.dumps(value).encode()


class _DevicePort(HTTPServer):
    """The device's port. fates: how connections end without an answer, "reset" or "lost". held: lost connections."""

    timeout = POLL_S
    allow_reuse_address = True
    request_queue_size = 64

    def __init__(self, address: tuple[str, int], owner: EmulatorServer) -> None:
        self.fates: dict[socket.socket, str] = {}
        self.held: list[socket.socket] = []
        super().__init__(address, partial(_Handler, owner))

    def shutdown_request(self, request: socket.socket | tuple[bytes, socket.socket]) -> None:
        assert isinstance(request, socket.socket)
        fate = self.fates.pop(request, "")
        if fate == "lost":
            self.held.append(request)
        elif fate:  # closing without lingering makes the kernel send a reset
            request.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
            request.close()
        else:
            super().shutdown_request(request)

    def server_close(self) -> None:
        super().server_close()
        for connection in self.held:
            connection.close()

    def handle_error(self, request: object, client_address: object) -> None:
        """Ignore a client that closes its connection, because this is no error of the server."""
        if not isinstance(sys.exc_info()[1], OSError):
            super().handle_error(request, client_address)  # type: ignore[arg-type]


class _Handler(BaseHTTPRequestHandler):
    protocol_version = "HTTP/1.1"
    server_version, sys_version = "gunicorn", ""
    timeout = CLIENT_PATIENCE_S

    def __init__(self, owner: EmulatorServer, *connection: Any) -> None:
        self._owner = owner
        super().__init__(*connection)

    def log_message(self, format: str, *args: object) -> None:
        """Log nothing, because there are thousands of requests a day."""

    def _send(self, status: int, body: bytes, headers: dict[str, str], cut: int = 0) -> None:
        self.close_connection = True
        self.send_response(status)
        for key, value in headers.items():
            self.send_header(key, value)
        if status != 204:
            self.send_header("Content-Length", str(len(body)))
        self.send_header("Connection", "close")
        self.end_headers()
        self.wfile.write(b"" if self.command == "HEAD" else body[: len(body) - cut])

    def do_GET(self) -> None:
        length = self.headers.get("Content-Length", "0")
        self.rfile.read(min(int(length), 65536) if length.isdigit() else 0)
        if not isinstance(self.server, _DevicePort) or self.path.startswith(PREFIX):
            status, body = self._owner.control(self.command, self.path)
            self._send(status, body, {"Content-Type": "application/json" if status == 200 else "text/plain"})
            return
        exchange = self._owner.exchange(self.command, self.path, dict(self.headers.items()))
        self.close_connection = True
        if exchange.answer is not None:
            self._send(*exchange.answer, cut=exchange.cut)
        else:
            self.server.fates[self.connection] = exchange.fate or "reset"

    do_POST = do_HEAD = do_PUT = do_DELETE = do_PATCH = do_OPTIONS = do_GET


def parser() -> argparse.ArgumentParser:
    program = "python -m hardware.emulator"
    usage = f"{program} [--reactors M0,M1] [--speed 60] ...; {program} --help says all"
    p = argparse.ArgumentParser(prog=program, usage=usage, description="Emulated Chi.Bio behind HTTP.")
    add = p.add_argument
    add("--host", default="127.0.0.1", help="address to listen on (default %(default)s)")
    add("--port", type=int, default=5000, help="port of the device; 0: any free port (default %(default)s)")
    add("--control-port", type=int, help="port of /_emulator/ (default: port + 1)")
    add("--reactors", default="M0", help="positions with a reactor, e.g. M0,M1,M2 (default %(default)s)")
    add("--speed", type=float, default=1.0, help="device seconds per real second (default %(default)s)")
    add("--seed", type=int, default=0, help="random seed of all noise (default %(default)s)")
    add("--od", default="0.3", help="initial OD, one for all or one per reactor (default %(default)s)")
    add("--volume", default="20", help="culture volume, mL, one for all or one per reactor (default %(default)s)")
    for key, (usual, what, _) in OPTIONS.items():
        add(f"--{key}", default=usual, help=f"{what} (default %(default)s)")
    add("--until-eof", action="store_true", help="end with the process that holds standard input open")
    add("--temperature", type=float, help="initial temperature, degC (default: the preset's, usually 37)")
    plants = groups()["plant"]
    add("--plant", choices=plants, default="healthy", help="preset of cultures and pumps (default %(default)s)")
    add("--overflow-pump", choices=SPARE, default="", help="pump that keeps a vial from overflowing (default: none)")
    for pump in SPARE:
        add(f"--{pump.lower()}-flow", type=float, default=0.0, help=f"flow of {pump} as supply pump, mL/s (default 0)")
    add("--overflow-flow", type=float, default=1.0, help="flow of the overflow pump, mL/s (default %(default)s)")
    add(
        "--pump-start",
        type=float,
        nargs=2,
        metavar=("LOW", "HIGH"),
        default=VialConfig().pump_start_s,
        help="time from the answer to a pump command until its motor turns, s (default %(default)s)",
    )
    add("--unit", type=int, default=os.getpid(), help="number of the device, sets its identities (default: unique)")
    add("--unblanked", action="store_true", help="start with a blank of 65000, as after power-on")
    return p


def _numbers(what: str, given: str) -> float | list[float]:
    try:
        numbers = [float(x) for x in given.split(",")]
    except ValueError:
        raise ValueError(f"{what} = {given}: allowed a number, or one per reactor, e.g. 0.3,0.4") from None
    return numbers[0] if len(numbers) == 1 else numbers


def build(arguments: argparse.Namespace, clock: Clock | None = None) -> ChiBioDevice:
    """Build the device of the arguments, on `clock` or else in scaled real time. Raises: ValueError."""
    ods, volumes_ml = _numbers("od", arguments.od), _numbers("volume", arguments.volume)
    vial = VialConfig(
        overflow_pump=arguments.overflow_pump, pump_start_s=tuple(arguments.pump_start),
        pump3_ml_s=arguments.pump3_flow, pump4_ml_s=arguments.pump4_flow,
    )  # fmt: skip
    plant = with_options(plant_preset(arguments.plant), vars(arguments))
    plant = replace(plant, pump=replace(plant.pump, overflow_ml_s=arguments.overflow_flow))
    return ChiBioDevice(
        tuple(arguments.reactors.split(",")),
        clock or DeviceClock(arguments.speed),
        np.random.default_rng(arguments.seed),
        DeviceOptions(unit=arguments.unit, vial=vial, plant=plant),
        od=ods,
        volumes_ml=volumes_ml,
        temperature=plant.start_temperature if arguments.temperature is None else arguments.temperature,
        blanked=not arguments.unblanked,
    )


def main(argv: Sequence[str] | None = None) -> int:
    """Run until SIGINT or SIGTERM; return the exit status."""
    arguments = parser().parse_args(argv)
    beside = arguments.port + 1 if arguments.port else 0
    control = beside if arguments.control_port is None else arguments.control_port
    try:
        for key, port in (("port", arguments.port), ("control-port", control)):
            if not 0 <= port <= 65535:
                raise ValueError(f"{key} = {port}: allowed 0 to 65535; choose another")
        server = EmulatorServer(build(arguments), arguments.host, arguments.port, control)
    except OSError as problem:
        where = f"{arguments.host}:{arguments.port}"
        print(f"emulator: {where}: {problem.strerror or problem}; choose another port or end the program that uses it")
        return 2
    except ValueError as problem:
        print(f"emulator: {problem}")
        return 2

    def orphaned() -> None:
        while os.read(0, 4096):  # ends when the process at the other end is gone
            pass
        server.stop()

    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: server.stop())
    if arguments.until_eof:
        threading.Thread(target=orphaned, daemon=True).start()
    print(
        f"emulator ready: http://{arguments.host}:{server.port} reactors {arguments.reactors} "
        f"speed {arguments.speed:g} (deploy backend=chibio backend.url=http://{arguments.host}:{server.port} "
        f"backend.speed={arguments.speed:g}) control http://{arguments.host}:{server.control_port}",
        flush=True,
    )
    server.run()
    return 0
