"""When the board agent's dead-man switch trips, on a clock that moves only while it waits."""

import json
import threading
from types import SimpleNamespace

import numpy as np
import pytest

from hardware.board import board_agent
from hardware.board.board_agent import BoardAgent, Device
from hardware.emulator.faults import inject
from hardware.link.serial import encode_request
from tests.hardware.emulator_lab import Lab
from tests.hardware.test_board_agent import Recorder


class Wait(threading.Event):
    """An event whose `wait` passes the time by itself, until the end of the test."""

    def __init__(self, end_s: float, meanwhile: dict[float, str], agent: "BoardAgent") -> None:
        super().__init__()
        self.now, self._end_s, self._meanwhile, self._agent = 0.0, end_s, meanwhile, agent

    def wait(self, timeout: float | None = None) -> bool:
        assert timeout is not None
        until = self.now + timeout
        for at in sorted(t for t in self._meanwhile if self.now < t <= until):
            self.now = at
            assert not self._agent.claim("a line", 1, arm=self._meanwhile[at] == "request")
        self.now = until
        return self.now >= self._end_s


class Watched:
    """An agent and its clock. bad: of the passes, which one by one cannot be verified; all others are.

    Attributes: seen, when it made a pass.
    """

    def __init__(
        self, monkeypatch: pytest.MonkeyPatch, end_s: float, meanwhile: dict[float, str], bad: str = ""
    ) -> None:
        clock = SimpleNamespace(monotonic=lambda: 0.0, strftime=lambda form: "")
        monkeypatch.setattr(board_agent, "time", clock)
        self.agent, self.seen = BoardAgent(Recorder(), 120.0), list[float]()
        wait = Wait(end_s, meanwhile, self.agent)
        self.agent._stop, clock.monotonic = wait, lambda: wait.now

        def sweep(beats: int) -> list[str]:
            self.seen.append(wait.now)
            return ["M0: still on: Pump1"] if bad[len(self.seen) - 1 :][:1] == "x" else []

        monkeypatch.setattr(self.agent, "sweep", sweep)


@pytest.mark.parametrize(
    ("meanwhile", "trips"),
    [
        ({}, [120.0]),  # armed from the start
        ({100.0: "request"}, [220.0]),
        ({100.0: "request", 219.0: "request", 338.0: "request"}, [458.0]),
        ({100.0: "request", 300.0: "request"}, [220.0, 420.0]),
        ({100.0: "bye"}, []),
        ({100.0: "bye", 400.0: "request"}, [520.0]),
    ],
)
def test_it_trips_after_two_minutes_without_a_request_and_once_for_each_silence(
    meanwhile: dict[float, str], trips: list[float], monkeypatch: pytest.MonkeyPatch
) -> None:
    watched = Watched(monkeypatch, 600.0, meanwhile)
    watched.agent._watch()
    assert len(watched.seen) == len(trips)
    assert all(due < at <= due + 0.5 for at, due in zip(watched.seen, trips, strict=True))
    assert watched.agent.trips == len(trips)


def test_what_is_not_verified_off_is_tried_ever_later_up_to_a_minute_anew(monkeypatch: pytest.MonkeyPatch) -> None:
    """A pump that runs on empties a bottle in minutes: the first tries follow at once, and it is never given up."""
    watched = Watched(monkeypatch, 900.0, {700.0: "request"}, "xxxxxxxxx.xx.")
    watched.agent._watch()
    first, second = watched.seen[:10], watched.seen[10:]
    assert np.diff(first).tolist() == [2.0, 4.0, 8.0, 16.0, 32.0, 60.0, 60.0, 60.0, 60.0]
    assert np.diff(second).tolist() == [2.0, 4.0]
    assert watched.agent.trips == 2


def test_a_client_that_comes_back_ends_the_tries(monkeypatch: pytest.MonkeyPatch) -> None:
    watched = Watched(monkeypatch, 240.0, {125.0: "request"}, "xxxxxx")
    watched.agent._watch()
    assert len(watched.seen) == 3  # at 120, 122 and 126 s; the last one finds it back
    assert watched.agent.trips == 1


def test_the_same_request_is_carried_out_again_after_a_trip_which_undid_it(monkeypatch: pytest.MonkeyPatch) -> None:
    """An answer from memory would tell a client that a pump runs which the switch has switched off."""
    watched = Watched(monkeypatch, 130.0, {})
    device = watched.agent.device
    assert isinstance(device, Recorder)
    line = encode_request(1 << 16 | 5, "POST", "/SetOutputOn/Pump1/1/M0")[:-1]
    answers = [watched.agent.answer_line(line) for _ in range(2)]
    assert len(device.asked) == 1  # a client that heard no answer asks the same again
    watched.agent._watch()
    assert watched.agent.trips == 1
    answers.append(watched.agent.answer_line(line))
    assert len(device.asked) == 2
    assert len(set(answers)) == 1


class Emulated(Device):
    """The requests of an agent, carried out on an emulated device."""

    def __init__(self, lab: Lab) -> None:
        super().__init__("http://127.0.0.1:9", 1.0)
        self.lab = lab

    def request(self, method: str, path: str, timeout_s: float | None = None) -> tuple[int, bytes, str]:
        return (*self.lab.device.handle(method, path), "")


def test_a_pass_switches_every_pump_off_and_remembers_each_that_it_found_on() -> None:
    lab = Lab()
    for pump, reactor in (("Pump1", "M0"), ("Pump2", "M0"), ("Pump4", "M1")):
        lab.pump(pump, 1.0, reactor=reactor)
    lab.wait(2.0)
    agent = BoardAgent(Emulated(lab), 120.0)
    inject(lab.device, "lying", "all", -1)
    assert agent.sweep(agent._beats) == ["M0: still on: Pump1, Pump2", "M1 cannot be selected"]
    inject(lab.device, "lying", "all", 0)
    assert agent.sweep(agent._beats) == []
    lab.wait(1.0)
    assert not any(any(lab.device.truth(m)["motors"].values()) for m in ("M0", "M1"))
    found = json.loads(agent.status())["switched_off"]
    assert {m: sorted(pumps) for m, pumps in found.items()} == {"M0": ["Pump1", "Pump2"], "M1": ["Pump4"]}


def test_the_allowed_silence_is_two_minutes_unless_said_otherwise() -> None:
    assert board_agent.parser().parse_args(["--tty", "x"]).deadman == 120.0
