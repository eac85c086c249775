"""A device that is a list: every request must be the next one expected, and gets the answer written beside it."""

import json
from collections.abc import Sequence
from typing import Any

import numpy as np
import pytest

from conf.messages import Message
from hardware.clock import VirtualClock
from hardware.emulator.device import ChiBioDevice
from hardware.errors import LinkError
from hardware.link.transport import Reply, Transport

DONE = Reply(204, b"")


def state(name: str = "M0", **changes: Any) -> dict[str, Any]:
    """sysData of a reactor in a running experiment with one sample; `changes` by dotted path with __ for the dots."""
    device = ChiBioDevice(("M0", "M1"), VirtualClock(), np.random.default_rng(0))
    software = device.supervisor.software
    software.select(name)
    data: dict[str, Any] = json.loads(software.sysdata())
    data["OD0"].update(target=14000.0, raw=9000.0)
    data["Experiment"].update(ON=1, cycles=1, startTime="2026-01-01 00:00:00")
    data["Thermostat"]["ON"] = data["Stir"]["ON"] = 1
    data["time"]["record"], data["OD"]["record"], data["ThermometerIR"]["record"] = [0.07], [0.36], [37.0]
    for path, value in changes.items():
        *groups, key = path.split("__")
        node = data
        for group in groups:
            node = node[group]
        node[key] = value
    return data


def answer(data: dict[str, Any]) -> Reply:
    return Reply(200, json.dumps(data).encode())


class Script(Transport):
    """Expects `steps` of (request, answer), request as "POST /path"; an answer that is an exception is raised."""

    def __init__(self, steps: Sequence[tuple[str, Reply | Exception]]) -> None:
        self.steps = list(steps)

    def _next(self, request: str) -> Reply:
        assert self.steps, f"unexpected {request}"
        expected, reply = self.steps.pop(0)
        assert request == expected
        if isinstance(reply, Exception):
            raise reply
        return reply

    def get(self, path: str) -> Reply:
        return self._next(f"GET {path}")

    def post(self, path: str) -> Reply:
        return self._next(f"POST {path}")

    def close(self) -> None:
        assert not self.steps, f"never asked: {self.steps}"


def read(data: dict[str, Any], name: str = "M0") -> list[tuple[str, Reply | Exception]]:
    """The pair of requests that reads `name`."""
    return [(f"POST /changeDevice/{name}", DONE), ("GET /getSysdata/", answer(data))]


def posts(*paths: str) -> list[tuple[str, Reply | Exception]]:
    """POSTs that succeed."""
    return [(f"POST {path}", DONE) for path in paths]


LOST = LinkError("no answer")


def noted(rows: Sequence[dict[str, Any]], *kinds: type[Message]) -> list[dict[str, Any]]:
    """The values of what a journal's rows note of these messages, or because of them."""
    notes = [row for row in rows if row["kind"] == "note"]
    found = [one for note in notes for one in (note, *note["fields"].values()) if isinstance(one, dict)]
    return [one["fields"] for one in found if one["name"] in [kind.__name__ for kind in kinds]]


def why(note: Message) -> type[Message]:
    """Name what a note tells: of one that no dose was begun, the reason."""
    return type(note.fields.get("why", note))


def logged(caplog: pytest.LogCaptureFixture, *kinds: type[Message]) -> list[dict[str, Any]]:
    """The values of these messages on the screen."""
    return [record.msg.fields for record in caplog.records if isinstance(record.msg, kinds)]
