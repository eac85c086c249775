"""The time of a run that is resumed, and tasks at their times."""

import json
import math
import time
from typing import Any

import pytest

from hardware.chibio.agenda import Agenda, Task
from hardware.chibio.resume import replay
from hardware.clock import DeviceClock, VirtualClock, run_time
from hardware.storage.doses import dosed
from tests.hardware.driver_lab import DriverLab
from tests.hardware.emulator_lab import quiet

DAY_S, DEAD_S, HOUR_S = 1_800_000_000.0, 600.0, 3600.0


class Killed(DriverLab):
    """A run that was killed in a dose, whose journal says when each row was written, by both clocks."""

    def log(self, kind: str, fields: Any) -> None:
        now = self.clock.now()
        self.rows.append({"n": len(self.rows), "wall": DAY_S + now, "mono": now, "kind": kind, **fields})


@pytest.fixture
def lab() -> Killed:
    lab = Killed(("M0", "M1"), options=quiet(mu=0.025))
    lab.law.rate = 0.008
    lab.reactors.begin()
    lab.log("start", {"time_s": lab.reactors.elapsed(), "boot": "first"})
    lab.run(5)
    lab.step()
    assert replay(lab.rows)["M0"].open or replay(lab.rows)["M1"].open
    return lab


def test_a_clock_goes_on_while_the_computer_sleeps(monkeypatch: pytest.MonkeyPatch) -> None:
    """Else nobody knows of the doses that a device repeats meanwhile."""
    clock = DeviceClock(2.0)
    awake, before_s = time.clock_gettime, clock.now()
    monkeypatch.setattr("time.clock_gettime", lambda which: awake(which) + 420.0 * (which == time.CLOCK_BOOTTIME))
    assert clock.now() - before_s >= 840.0


def computer(monkeypatch: pytest.MonkeyPatch, lab: Killed, step_s: float, boot: str) -> None:
    """This computer's clocks from now on, that of the day set by so much; which boot it is."""
    monkeypatch.setattr("hardware.clock.time.time", lambda: DAY_S + lab.clock.now() + step_s)
    monkeypatch.setattr("hardware.clock.uptime", lab.clock.now)
    monkeypatch.setattr("hardware.clock.boot", lambda: boot)


@pytest.mark.parametrize("boot", ["first", "second", ""])
@pytest.mark.parametrize("step_s", [0.0, -HOUR_S, HOUR_S])
def test_a_clock_that_was_set_moves_neither_the_run_nor_what_is_booked(
    lab: Killed, monkeypatch: pytest.MonkeyPatch, step_s: float, boot: str
) -> None:
    """Ten minutes after the kill: one more dose in each of them, and not sixty."""
    truth_s = lab.reactors.elapsed() + DEAD_S
    lab.clock.sleep(DEAD_S)
    computer(monkeypatch, lab, step_s, boot)
    rows = json.loads(json.dumps(lab.rows))
    lab.client()
    found = run_time(rows, 1.0, *lab.reactors.bounds_s(rows))
    exact = boot == "first" or not step_s
    assert found.s == pytest.approx(truth_s, abs=1.0 if exact else 90.0)
    assert found.low_s - 1.0 <= truth_s <= found.high_s + 1.0
    assert found.step_s == pytest.approx(step_s, abs=1.0 if exact else 90.0)
    lab.reactors.begin(replay(rows), found.s)
    lab.run(2)
    booked = {name: sum(d.feed_ml for d in dosed(lab.rows) if d.reactor == name) for name in lab.names}
    for name, ml in booked.items():
        assert ml == pytest.approx(lab.truth(name)["feed_ml"], abs=1.2 if exact else 2.0)


@pytest.mark.parametrize("step_s", [-HOUR_S, HOUR_S])
def test_without_a_telling_device_no_run_goes_back(lab: Killed, monkeypatch: pytest.MonkeyPatch, step_s: float) -> None:
    newest_s = max(row["time_s"] for row in lab.rows)
    computer(monkeypatch, lab, step_s, "second")
    lab.device.handle("POST", "/Experiment/0/M0")
    lab.device.handle("POST", "/Experiment/0/M1")
    assert lab.reactors.bounds_s(lab.rows)[1] == float("inf")
    assert run_time(lab.rows).s == newest_s + max(lab.clock.now() + DAY_S - lab.rows[-1]["wall"] + step_s, 0.0)
    assert run_time(lab.rows, 0.0).s == newest_s  # virtual time
    assert run_time([]).s == 0.0


def test_a_clock_that_was_set_in_an_earlier_life_is_not_believed_either(monkeypatch: pytest.MonkeyPatch) -> None:
    """The computer began in 1970 and was put right a minute later; 40 s after its last row it is looked at."""
    rows = [{"n": 0, "wall": 5.0, "mono": 5.0, "kind": "command", "time_s": 0.0}]
    rows.append({"n": 1, "wall": DAY_S, "mono": 65.0, "kind": "sample", "time_s": 60.0})
    monkeypatch.setattr("hardware.clock.time.time", lambda: DAY_S + 40.0)
    assert run_time(rows).s == 100.0
    assert run_time(rows, 10.0).s == 460.0


def test_steps_run_when_they_are_due_in_order_and_an_error_removes_one_task_only() -> None:
    clock = VirtualClock(100.0)
    agenda, tape, closed = Agenda(clock), [], []

    def task(name: str, *pauses: float, fails: bool = False) -> Task:
        try:
            for pause in pauses:
                tape.append((name, clock.now()))
                yield pause
            tape.append((name, clock.now()))
            if fails:
                raise RuntimeError(name)
        finally:
            closed.append(name)

    assert agenda.next_due() == math.inf
    agenda.run_due()
    kept = task("a", 5.0, 100.0), task("d", 0.0, 50.0)  # so that only the agenda can end them
    agenda.add(kept[0])
    agenda.add(task("b"), 5.0)
    agenda.add(task("c", fails=True))
    agenda.add(kept[1])
    with pytest.raises(RuntimeError, match="c"):
        agenda.run_due()
    assert tape == [("a", 100.0), ("c", 100.0)]
    agenda.run_due(100.0)
    assert tape[2:] == [("d", 100.0), ("d", 100.0)]  # a pause of 0 is due at once: its time has come
    assert agenda.next_due() == 105.0
    agenda.run_due(104.9)
    assert len(tape) == 4
    clock.sleep(5.0)
    agenda.run_due()
    assert tape[4:] == [("b", 105.0), ("a", 105.0)]  # b was put there first
    assert closed == ["c", "b"]
    agenda.clear()
    assert closed == ["c", "b", "d", "a"]
    assert agenda.next_due() == math.inf


def test_what_becomes_due_while_steps_run_waits_for_the_next_call() -> None:
    clock = VirtualClock()
    agenda, ran = Agenda(clock), []

    def slow() -> Task:
        while True:
            ran.append(clock.now())
            clock.sleep(10.0)
            yield 0.0

    agenda.add(slow())
    agenda.run_due()
    assert ran == [0.0]
    agenda.run_due()
    assert ran == [0.0, 10.0]
