"""The agenda: tasks at their times, in their order, and an error that costs only its own task."""

import math

import pytest

from hardware.chibio.agenda import Agenda, Task
from hardware.clock import VirtualClock


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
