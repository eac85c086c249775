"""One reactor's verified conversation, played from a script of (request, answer) pairs."""

from collections.abc import Sequence
from contextlib import nullcontext
from typing import Any

import pytest

from hardware.chibio.connection import Connection
from hardware.chibio.protocol import Permitted
from hardware.clock import VirtualClock
from hardware.errors import DeviceStateError, IdentityError, LinkError, ProtocolError, ReactorError
from hardware.link.transport import Reply
from tests.hardware.script import DONE, LOST, Script, answer, posts, read, state

OFF = [f"/SetOutputOn/{pump}/0/M0" for pump in ("Pump1", "Pump3", "Pump4", "Pump2")]
PROBE = "/MeasureTemp/IR/M0"
Steps = Sequence[tuple[str, Reply | Exception]]
Act = tuple[Any, ...]  # error or None, its words, method, arguments
LOOK, NO_M0 = "GET /getSysdata/", {"M0": 0, "M1": 1}
HERE, GONE = (LOOK, answer(state("M1"))), (LOOK, answer(state("M1", presentDevices=NO_M0)))
ABSENT, UNSEEN = (DeviceStateError, "absent"), (DeviceStateError, "not seen present", "post")
READ, SENT, PAUSE = (None, "", "read"), (None, "", "post", OFF[0]), (None, "", "sleep", 3.0)
ALL_OFF = (None, "", "pumps_off")


def connection(steps: Steps, log: list[Any] | None = None) -> tuple[Connection, Script]:
    script = Script(steps)
    rows = [] if log is None else log
    return Connection(
        "M0", Permitted(("M0", "M1")), script, VirtualClock(), lambda kind, fields: rows.append((kind, fields))
    ), script


def after_a_refusal(refusal: Reply | Exception) -> tuple[Steps, list[Act]]:
    """A command is refused, once while the reactor is there, and once before a look finds it gone."""
    steps = [*read(state()), (f"POST {OFF[0]}", refusal), HERE, *posts(OFF[1], OFF[2])]
    steps += [(f"POST {OFF[3]}", refusal), (LOOK, refusal), GONE]
    error = (ReactorError, "no answer|status 502", "post")
    posted = [(None, "", "post", path) for path in OFF[1:3]]
    refused = 2 * [(*error, OFF[3])]
    return steps, [READ, (*error, OFF[0]), *posted, *refused, (*ABSENT, "post", OFF[3]), (*UNSEEN, OFF[3])]


def at(sample_s: float, cycles: int, started: str = "2026-01-01 00:00:00") -> Steps:
    """A read of an experiment that has come so far."""
    return read(state(time__record=[sample_s], Experiment__cycles=cycles, Experiment__startTime=started))


CASES: dict[str, tuple[Steps, list[Act]]] = {
    "another unit at this position, and whatever stands there now is not ours": (
        [*read(state()), *read(state(DeviceID="garbled")), *read(state()), *(3 * read(state(DeviceID="other")))],
        [READ, READ, (IdentityError, "pinned", "read"), (*UNSEEN, OFF[0])],
    ),
    "an answer of an earlier time comes again, by its record or its count of cycles": (
        [*at(120.3, 3), *at(60.2, 3), *at(120.3, 2), *at(120.3, 3), *at(0.07, 1, "2026-01-02 00:00:00")],
        [READ, *(2 * [(LinkError, "earlier time", "read")]), READ, READ],
    ),
    "a board's clock that went back by an hour, with winter time": ([*at(3780.3, 64), *at(240.4, 65)], [READ, READ]),
    "another client's selection: the pair is repeated": (2 * read(state("M1")) + read(state()), [READ]),
    "a client that keeps selecting": (3 * read(state("M1")), [(DeviceStateError, "another client", "read")]),
    "absent": (read(state(presentDevices=NO_M0)), [(*ABSENT, "read"), *((*UNSEEN, path) for path in OFF)]),
    "before the first read": ([], [(*UNSEEN, OFF[0])]),
    "no identity": (3 * read(state(DeviceID="")), [(IdentityError, "none", "read")]),
    "a lost answer: presence is looked at before the next command": after_a_refusal(LOST),
    "a board agent without a server: alike": after_a_refusal(Reply(502, b"the board agent finds no server")),
    "a while without a request: presence is looked at before the next command": (
        [*read(state()), *posts(OFF[0]), HERE, *posts(OFF[1], OFF[2]), GONE],
        [READ, SENT, PAUSE, (None, "", "post", OFF[1]), (None, "", "post", OFF[2]), PAUSE, (*ABSENT, "post", OFF[3])],
    ),
    **{
        f"a post answered by {status}": (
            [*read(state()), (f"POST {OFF[0]}", Reply(status, b"<html>"))],
            [READ, (ProtocolError, words, "switch", "Pump1", False)],
        )
        for status, words in ((500, "status 500"), (403, "status 403"), (200, "expected 204"))
    },
    "pumps off touches the bus, reads back": ([*read(state()), *posts(*OFF, PROBE), *read(state())], [READ, ALL_OFF]),
    "every pump is tried although one request is lost, but for the waste pump, and then all again": (
        [*read(state()), (f"POST {OFF[0]}", LOST), HERE, *posts(*OFF[1:3], *OFF, PROBE), *read(state())],
        [READ, ALL_OFF],
    ),
    "a pump that stays on, after three rounds": (
        [*read(state()), *(3 * [*posts(*OFF, PROBE), *read(state(Pump2__ON=1))])],
        [READ, (DeviceStateError, "Pump2 still on", "pumps_off")],
    ),
    "a hung bus is not verified off whatever the flags say": (
        [*read(state()), *posts(*OFF), (f"POST {PROBE}", LOST)],
        [READ, (LinkError, "^Pump1, Pump2, Pump3, Pump4 not verified off: no answer", "pumps_off", 1)],
    ),
    "a dead link: given up after two time-outs until the next try": (
        [*read(state()), (f"POST {OFF[0]}", LOST), (LOOK, LOST)],
        [READ, (LinkError, "no answer", "pumps_off", 1)],
    ),
    "one command that is lost: its pump is named, and the waste pump that waits for it": (
        [*read(state()), *posts(OFF[0]), (f"POST {OFF[1]}", LOST), HERE, *posts(OFF[2])],
        [READ, (LinkError, "^Pump2, Pump3 not verified off: no answer", "pumps_off", 1)],
    ),
    "a command outside the limits": (
        read(state()),
        [READ, (DeviceStateError, "refused", "switch", "Heat", True)]
        + [
            (DeviceStateError, "refused", "target", item, value)
            for item, value in (("Pump1", 0.06), ("Pump2", 0.6), ("Thermostat", 50.0), ("UV", 0.5))
        ],
    ),
}


@pytest.mark.parametrize("case", CASES)
def test_each_request_and_each_refusal_in_its_order(case: str) -> None:
    steps, acts = CASES[case]
    m0, script = connection(steps)
    for error, words, method, *arguments in acts:
        with pytest.raises(error, match=words) if error else nullcontext():
            (m0.clock.sleep if method == "sleep" else getattr(m0, method))(*arguments)
    script.close()


def test_every_command_and_its_answer_are_logged() -> None:
    log: list[Any] = []
    m0, _ = connection([*read(state()), (f"POST {OFF[0]}", DONE), (f"POST {OFF[3]}", LOST)], log)
    m0.read()
    m0.switch("Pump1", False)
    with pytest.raises(LinkError):
        m0.switch("Pump2", False)
    assert [(kind, f["path"], f["answer"]) for kind, f in log] == [
        ("command", OFF[0], 204), ("command", OFF[3], "no answer"),
    ]  # fmt: skip


def test_a_state_that_is_not_readable_is_no_state() -> None:
    m0, _ = connection([("POST /changeDevice/M0", DONE), ("GET /getSysdata/", Reply(200, b"{"))])
    with pytest.raises(ProtocolError):
        m0.read()
    assert m0.state is None
    m0, _ = connection([("POST /changeDevice/M0", DONE), ("GET /getSysdata/", Reply(500, answer(state()).body))])
    with pytest.raises(ProtocolError, match="status 500"):
        m0.read()


def test_what_a_switch_on_the_way_did_is_told_of_this_reactor_alone() -> None:
    m0, script = connection([])
    other, own_too = {"M1": {"Pump1": 3.0}}, {"M1": {"Pump1": 3.0}, "M0": {"Pump2": 8.0}}
    for said, own in ((own_too, {"Pump2": 8.0}), (other, {}), ({}, {})):
        script.switched_off = lambda said=said: said  # type: ignore[method-assign, misc]
        assert m0.switched_off() == own


def test_a_pump_that_stays_on_ends_its_experiment_and_then_the_bus_is_touched_whatever_the_first_did() -> None:
    for first in (DONE, LOST):
        rows: list[Any] = []
        steps = [("POST /Experiment/0/M0", first)]
        steps += [("GET /getSysdata/", answer(state()))] if first is LOST else []
        m0, script = connection([*read(state()), *steps, *posts(PROBE)], rows)
        m0.read()
        m0.escalate()
        assert script.steps == []
        assert [kind for kind, _ in rows].count("escalation") == (1 if first is LOST else 0)
