"""When the board agent's dead-man switch trips, on a clock that moves only while it waits."""

import threading
from types import SimpleNamespace

import pytest

from hardware.board import board_agent
from hardware.board.board_agent import Agent, Device


class Wait(threading.Event):
    """An event whose `wait` passes the time by itself, until the end of the test."""

    def __init__(self, end_s: float, meanwhile: dict[float, str], agent: "Agent") -> None:
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
    clock = SimpleNamespace(monotonic=lambda: 0.0, strftime=lambda form: "")
    monkeypatch.setattr(board_agent, "time", clock)
    agent = Agent(Device("http://127.0.0.1:1", 1.0), 120.0)
    wait = Wait(600.0, meanwhile, agent)
    agent._stop, clock.monotonic = wait, lambda: wait.now
    seen: list[float] = []

    def sweep(beats: int) -> list[str]:
        seen.append(wait.now)
        return []

    monkeypatch.setattr(agent, "sweep", sweep)
    agent._watch()
    assert len(seen) == len(trips)
    assert all(due < at <= due + 0.5 for at, due in zip(seen, trips, strict=True))
    assert agent.trips == len(trips)


def test_the_allowed_silence_is_two_minutes_unless_said_otherwise() -> None:
    assert board_agent.parser().parse_args(["--tty", "x"]).deadman == 120.0
