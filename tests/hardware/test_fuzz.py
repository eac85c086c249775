"""Garbage in every place where bytes come in: no traceback, and no dose on it.

FUZZ_CASES=10000 python -m pytest tests/hardware/test_fuzz.py      the long version
"""

import json
import os
import random
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from experiments.recordings.reader import read_recording
from hardware.chibio.config import ChiBioConfig
from hardware.chibio.reactors import ChiBioReactors
from hardware.clock import VirtualClock
from hardware.emulator.device import ChiBioDevice
from hardware.emulator.transport import EmulatorTransport
from hardware.errors import RecordingError
from hardware.link.transport import Reply, Transport
from hardware.reactor import Command

CASES = int(os.environ.get("FUZZ_CASES", "300"))
STRANGE: tuple[Any, ...] = (None, "", "x", -1, 0, 1, 2, 1e308, float("nan"), float("inf"), True, [], {}, [[]], "M7")


def mutilate(body: bytes, rng: random.Random) -> bytes:
    """An answer as a dying server, a bad line, a fork or a stranger would give it."""
    match rng.randrange(5):
        case 0:
            return body[: rng.randrange(len(body))]
        case 1:
            garbled = bytearray(body)
            for _ in range(rng.randint(1, 20)):
                garbled[rng.randrange(len(garbled))] = rng.randrange(256)
            return bytes(garbled)
        case 2:
            return rng.randbytes(rng.randrange(200))
        case 3:
            data = json.loads(body)
            for _ in range(rng.randint(1, 4)):
                node = data
                while isinstance(node, dict) and node and rng.random() < 0.7:
                    above, key = node, rng.choice(list(node))
                    node = node[key]
                if node is not data:
                    above[key] = rng.choice(STRANGE)
            return json.dumps(data).encode()
        case _:
            return json.dumps(rng.choice(STRANGE)).encode()


class Hostile(Transport):
    """A link whose answers are mutilated while `angry`; remembers what is sent then."""

    def __init__(self, inner: EmulatorTransport, rng: random.Random) -> None:
        self.inner, self.rng, self.angry = inner, rng, False
        self.cases, self.torn = 0, False
        self.switched_on: list[str] = []

    def get(self, path: str) -> Reply:
        reply = self.inner.get(path)
        if not self.angry:
            return reply
        self.cases += 1
        if self.torn:
            return Reply(200, reply.body[: self.rng.randrange(len(reply.body) - 1)])
        status = self.rng.choice((200, 200, 200, 200, 204, 404, 500, 302, 0, 999))
        return Reply(status, mutilate(reply.body, self.rng))

    def post(self, path: str) -> Reply:
        if self.angry and path.startswith(("/SetOutputOn/Pump1/1", "/SetOutputOn/Pump2/1")):
            self.switched_on.append(path)
        reply = self.inner.post(path)
        return Reply(500, b"") if self.angry and not self.torn and self.rng.random() < 0.1 else reply


Rows = list[dict[str, Any]]


def lab(names: tuple[str, ...], rng: random.Random) -> tuple[VirtualClock, ChiBioDevice, Hostile, ChiBioReactors, Rows]:
    clock = VirtualClock()
    device = ChiBioDevice(names, clock, np.random.default_rng(0), od=0.5, temperature=37.0, blanked=True)
    wire = Hostile(EmulatorTransport(device), rng)
    rows: Rows = []
    config = ChiBioConfig(reactors=names)
    reactors = ChiBioReactors(wire, clock, config, log=lambda kind, row: rows.append({"kind": kind, **row}))
    reactors.begin()
    return clock, device, wire, reactors, rows


def test_no_traceback_and_no_overdose_on_mutilated_answers() -> None:
    """Answers to a whole run are mutilated: it goes on, within its limits, and the pumps are off in the end."""
    clock, device, wire, reactors, rows = lab(("M0", "M1"), random.Random(1))
    wire.angry = True
    while wire.cases < CASES:
        m = reactors.measure()
        receipt = reactors.actuate(Command(m.fresh, np.where(m.fresh, 0.01, 0.0), np.full(2, 37.0)))
        assert np.isfinite(receipt.volume_ml).all()
    wire.angry = False
    for _ in range(20):
        reactors.measure()
    reactors.stop()
    device.run_until(clock.now())
    for name in ("M0", "M1"):
        acted = [tuple(row["sample"]) for row in rows if row["kind"] == "intent" and row["reactor"] == name]
        assert len(set(acted)) == len(acted) > 0
        truth = device.truth(name)
        assert not any(truth["motors"].values())
        assert not truth["overflowed"]
        assert max((d.seconds for d in device.vials[name].doses if d.pump == "Pump1"), default=0.0) < 3.0


def test_no_dose_is_begun_when_the_read_back_is_garbage() -> None:
    """Every read-back between targets and switch-on is mutilated: the pumps are never switched on."""
    rng = random.Random(2)
    _, _, wire, reactors, _ = lab(("M0",), rng)
    for _ in range(max(CASES // 10, 5)):
        while not (m := reactors.measure()).fresh[0]:
            pass
        wire.angry, wire.torn = True, True
        reactors.actuate(Command(m.fresh, np.array([0.01]), np.array([37.0])))
        wire.angry = wire.torn = False
    assert wire.cases > 0
    assert wire.switched_on == []
    reactors.stop()


@pytest.mark.parametrize("seed", range(4))
def test_a_mutilated_recording_is_read_or_refused_in_one_line(seed: int, tmp_path: Path) -> None:
    rng = random.Random(seed)
    headers = ("time_min,od,pump_rate_ml_s,temperature_degc\n", "exp_time,od_measured,pump_1_rate,media_temp\n", "")
    header = headers[seed % 3]
    lines = "".join(f"{k},{0.5 + 0.01 * (k % 7):.4f},{0.01 * (k % 2)},37.0\n" for k in range(60))
    text = (header + (lines if header else lines.replace(",37.0", ""))).encode()
    path = tmp_path / "run.csv"
    for _ in range(max(CASES // 4, 1)):
        data = bytearray(text)
        for _ in range(rng.choice((1, 3, 30))):
            at = rng.randrange(len(data))
            match rng.randrange(4):
                case 0:
                    data[at] = rng.randrange(256)
                case 1:
                    del data[at : at + rng.randrange(1, 80)]
                case 2:
                    data[at:at] = rng.choice((b"nan", b"inf", b"-", b"\n", b",,", b"1e999", b"\x00", b'"', b"\xff\xfe"))
                case _:
                    data[at:at] = bytes(data[at : at + 40])
            if not data:
                data = bytearray(b",")
        path.write_bytes(data)
        try:
            recording = read_recording(path)
        except RecordingError as refused:
            lines_said = str(refused).splitlines()
            assert [str(path) in line for line in lines_said] == [True]
        else:
            assert np.isfinite(recording.time_min).all()
            assert np.isfinite(recording.pump_rate).all()
            assert (np.diff(recording.time_min) > 0.0).all()
            assert not (np.abs(recording.od) > 10.0).any()
