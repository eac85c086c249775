"""One reactor's verified conversation, played from a script of (request, answer) pairs."""

from collections.abc import Sequence
from typing import Any

import pytest

from hardware.chibio.connection import Connection
from hardware.chibio.protocol import Permitted
from hardware.clock import VirtualClock
from hardware.errors import DeviceStateError, IdentityError, LinkError, ProtocolError
from hardware.link.transport import Reply
from tests.hardware.script import DONE, LOST, Script, answer, posts, read, state

OFF = [f"/SetOutputOn/{pump}/0/M0" for pump in ("Pump1", "Pump3", "Pump4", "Pump2")]
PROBE = "/MeasureTemp/IR/M0"
Steps = Sequence[tuple[str, Reply | Exception]]


def connection(steps: Steps, log: list[Any] | None = None) -> tuple[Connection, Script]:
    script = Script(steps)
    rows = [] if log is None else log
    return Connection(
        "M0", Permitted(("M0", "M1")), script, VirtualClock(), lambda kind, fields: rows.append((kind, fields))
    ), script


def test_a_read_is_a_pair_and_pins_the_identity() -> None:
    m0, script = connection(read(state()) + read(state(DeviceID="other")))
    assert m0.read().cycles == 1
    assert m0.device_id == state()["DeviceID"]
    with pytest.raises(IdentityError, match="pinned"):
        m0.read()
    with pytest.raises(DeviceStateError, match="not seen present"):
        m0.post(OFF[0])  # whatever stands there now is not ours
    script.close()


def test_another_clients_selection_means_the_pair_is_repeated() -> None:
    m0, script = connection(read(state("M1")) + read(state("M1")) + read(state()))
    assert m0.read().selected == "M0"
    script.close()


def test_a_client_that_keeps_selecting_is_named() -> None:
    m0, script = connection(3 * read(state("M1")))
    with pytest.raises(DeviceStateError, match="another client"):
        m0.read()
    script.close()


def test_nothing_is_sent_to_a_reactor_that_is_absent() -> None:
    m0, script = connection(read(state(presentDevices={"M0": 0, "M1": 1})))
    with pytest.raises(DeviceStateError, match="absent"):
        m0.read()
    for path in OFF:
        with pytest.raises(DeviceStateError, match="not seen present"):
            m0.post(path)
    script.close()


def test_nothing_is_sent_before_the_first_read() -> None:
    m0, _ = connection([])
    with pytest.raises(DeviceStateError, match="not seen present"):
        m0.switch("Pump1", False)


@pytest.mark.parametrize("refusal", [LOST, Reply(502, b"the board agent finds no server")])
def test_after_a_lost_answer_presence_is_looked_at_before_the_next_command(refusal: Reply | Exception) -> None:
    gone, here, look = answer(state("M1", presentDevices={"M0": 0, "M1": 1})), answer(state("M1")), "GET /getSysdata/"
    steps = [*read(state()), (f"POST {OFF[0]}", refusal), (look, here), *posts(OFF[1], OFF[2])]
    m0, script = connection([*steps, (f"POST {OFF[3]}", refusal), (look, refusal), (look, gone)])
    m0.read()
    with pytest.raises((LinkError, ProtocolError)):
        m0.post(OFF[0])
    m0.post(OFF[1])
    m0.post(OFF[2])
    for _ in range(2):
        with pytest.raises((LinkError, ProtocolError)):
            m0.post(OFF[3])
    with pytest.raises(DeviceStateError, match="absent"):
        m0.post(OFF[3])
    with pytest.raises(DeviceStateError, match="not seen present"):
        m0.post(OFF[3])
    script.close()


def test_after_a_while_without_a_request_presence_is_looked_at_before_the_next_command() -> None:
    gone, here, look = answer(state("M1", presentDevices={"M0": 0, "M1": 1})), answer(state("M1")), "GET /getSysdata/"
    clock = VirtualClock()
    script = Script([*read(state()), *posts(OFF[0]), (look, here), *posts(OFF[1], OFF[2]), (look, gone)])
    m0 = Connection("M0", Permitted(("M0", "M1")), script, clock, lambda kind, fields: None)
    m0.read()
    m0.post(OFF[0])
    clock.sleep(3.0)
    m0.post(OFF[1])
    m0.post(OFF[2])
    clock.sleep(3.0)
    with pytest.raises(DeviceStateError, match="absent"):
        m0.post(OFF[3])
    script.close()


def test_no_identity_is_no_reactor() -> None:
    m0, _ = connection(read(state(DeviceID="")))
    with pytest.raises(IdentityError):
        m0.read()


@pytest.mark.parametrize(("status", "words"), [(500, "status 500"), (403, "X-Requested-With"), (200, "expected 204")])
def test_a_post_is_answered_by_204_or_not_believed(status: int, words: str) -> None:
    m0, _ = connection([*read(state()), (f"POST {OFF[0]}", Reply(status, b"<html>"))])
    m0.read()
    with pytest.raises(ProtocolError, match=words):
        m0.switch("Pump1", False)


def test_pumps_off_touches_the_bus_and_reads_back() -> None:
    m0, script = connection([*read(state()), *posts(*OFF, PROBE), *read(state())])
    m0.read()
    m0.pumps_off()
    script.close()


def test_pumps_off_tries_every_pump_even_when_one_request_is_lost_and_then_all_again() -> None:
    """But for the waste pump, which goes on as long as a feed pump may run."""
    lost: Steps = [(f"POST {OFF[0]}", LOST), ("GET /getSysdata/", answer(state())), *posts(*OFF[1:3])]
    m0, script = connection([*read(state()), *lost, *posts(*OFF, PROBE), *read(state())])
    m0.read()
    m0.pumps_off()
    script.close()


def test_a_pump_that_stays_on_is_reported_after_three_rounds() -> None:
    on = state(Pump2__ON=1)
    m0, script = connection([*read(state()), *(3 * [*posts(*OFF, PROBE), *read(on)])])
    m0.read()
    with pytest.raises(DeviceStateError, match="Pump2 still on"):
        m0.pumps_off()
    script.close()


def test_a_hung_bus_is_not_verified_off_whatever_the_flags_say() -> None:
    m0, script = connection([*read(state()), *posts(*OFF), (f"POST {PROBE}", LOST)])
    m0.read()
    with pytest.raises(LinkError):
        m0.pumps_off(tries=1)
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


def test_a_command_outside_the_limits_never_reaches_the_wire() -> None:
    m0, script = connection(read(state()))
    m0.read()
    for item, value in (("Pump1", 0.06), ("Pump2", 0.6), ("Thermostat", 50.0), ("UV", 0.5)):
        with pytest.raises(DeviceStateError, match="refused"):
            m0.target(item, value)
    with pytest.raises(DeviceStateError, match="refused"):
        m0.switch("Heat", True)
    script.close()


def test_a_state_that_is_not_readable_is_no_state() -> None:
    m0, _ = connection([("POST /changeDevice/M0", DONE), ("GET /getSysdata/", Reply(200, b"{"))])
    with pytest.raises(ProtocolError):
        m0.read()
    assert m0.state is None
    m0, _ = connection([("POST /changeDevice/M0", DONE), ("GET /getSysdata/", Reply(500, answer(state()).body))])
    with pytest.raises(ProtocolError, match="status 500"):
        m0.read()


def test_after_two_time_outs_the_off_commands_of_a_dead_link_are_given_up_until_the_next_try() -> None:
    m0, script = connection([*read(state()), (f"POST {OFF[0]}", LOST), ("GET /getSysdata/", LOST)])
    m0.read()
    with pytest.raises(LinkError):
        m0.pumps_off(tries=1)
    script.close()


def test_what_a_switch_on_the_way_did_is_told_of_this_reactor_alone() -> None:
    m0, script = connection([])
    for said, own in (
        ({"M1": {"Pump1": 3.0}, "M0": {"Pump2": 8.0}}, {"Pump2": 8.0}),
        ({"M1": {"Pump1": 3.0}}, {}),
        ({}, {}),
        (None, None),
    ):
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
