"""One reactor: its verified conversation, its samples, and what the journal says of its doses."""

import json
import math
from collections.abc import Sequence
from contextlib import nullcontext
from dataclasses import asdict, replace
from typing import Any

import pytest

from hardware.chibio.config import ChiBioConfig
from hardware.chibio.connection import Connection
from hardware.chibio.messages import SampleBeforeLate, SampleLate
from hardware.chibio.protocol import DeviceState, Permitted, parse_state
from hardware.chibio.resume import SPANS, ReactorHistory, replay
from hardware.chibio.sampling import CYCLE_S, FIRST_SAMPLE_S, Sampling
from hardware.clock import VirtualClock
from hardware.errors import DeviceStateError, IdentityError, LinkError, ProtocolError, ReactorError, RecordingError
from hardware.link.transport import Reply
from hardware.pioreactor.doses import replay as units
from hardware.storage.doses import Ending, Given, dosed
from tests.hardware.script import DONE, LOST, Script, answer, posts, read, state

OFF = [f"/SetOutputOn/{pump}/0/M0" for pump in ("Pump1", "Pump3", "Pump4", "Pump2")]
PROBE = "/MeasureTemp/IR/M0"
Steps = Sequence[tuple[str, Reply | Exception]]
Act = tuple[Any, ...]  # error or None, its words, method, arguments
LOOK, NO_M0 = "GET /getSysdata/", {"M0": 0, "M1": 1}
HERE, GONE = (LOOK, answer(state("M1"))), (LOOK, answer(state("M1", presentDevices=NO_M0)))
ABSENT, UNSEEN = (DeviceStateError, "absent"), (DeviceStateError, "refused to send", "post")
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
        [READ, READ, (IdentityError, "1000200030004000", "read"), (*UNSEEN, OFF[0])],
    ),
    "an answer of an earlier time comes again, by its record or its count of cycles": (
        [*at(120.3, 3), *at(60.2, 3), *at(120.3, 2), *at(120.3, 3), *at(0.07, 1, "2026-01-02 00:00:00")],
        [READ, *(2 * [(LinkError, "old answer", "read")]), READ, READ],
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


CONFIG = ChiBioConfig()
STATE = parse_state(json.dumps(state()).encode())


def sample(time_s: float, cycles: int) -> DeviceState:
    return replace(STATE, sample_s=time_s, cycles=cycles, sample_od=0.4)


def take(sampling: Sampling, clock: VirtualClock, seen: DeviceState) -> str:
    assert sampling.look(seen, clock.now())
    return sampling.take(seen, clock.now())


def started() -> tuple[VirtualClock, Sampling]:
    """An experiment that was just started, at 1000 s, whose first sample is there now."""
    clock = VirtualClock(1000.0)
    sampling = Sampling(CONFIG, clock)
    sampling.expect_first()
    clock.sleep(FIRST_SAMPLE_S)
    return clock, sampling


def test_a_sample_is_new_once_and_never_goes_back() -> None:
    clock = VirtualClock()
    sampling = Sampling(CONFIG, clock)
    assert not sampling.look(sample(math.nan, 0), 0.0)
    take(sampling, clock, sample(60.0, 2))
    assert not sampling.look(sample(60.0, 2), 0.0)
    assert not sampling.look(sample(60.0, 3), 0.0)  # cycles counts cycles begun
    assert not sampling.look(sample(0.0, 1), 0.0)
    assert sampling.look(sample(120.0, 3), 0.0)
    sampling.key = None
    assert sampling.look(sample(0.0, 1), 0.0)
    sampling.pass_over(sample(0.0, 1))
    assert not sampling.look(sample(0.0, 1), 0.0)
    take(sampling, clock, sample(60.0, 3))  # seen so late that the next cycle had begun: it does not hide the next one
    assert [sampling.look(sample(*each), 0.0) for each in ((120.0, 3), (0.0, 2))] == [True, False]


def test_only_a_sample_that_was_waited_for_has_a_known_age() -> None:
    clock = VirtualClock(1000.0)
    sampling = Sampling(CONFIG, clock)
    take(sampling, clock, sample(0.0, 1))
    assert sampling.appeared_s == -math.inf
    assert sampling.next_look == clock.now() + CYCLE_S - 20.0  # it may have waited long: look early
    clock.sleep(50.0)
    sampling.not_taken(is_new=False)
    clock.sleep(2.0)
    take(sampling, clock, sample(60.0, 2))
    assert sampling.appeared_s == clock.now()
    assert sampling.next_look == clock.now() + CYCLE_S - 2.5
    clock.sleep(70.0)  # ten seconds later than possible
    take(sampling, clock, sample(120.0, 3))
    assert sampling.late_s == 10.0
    assert sampling.appeared_s == clock.now() - 10.0


def lateness(looks: list[tuple[float, bool, float]], clock: VirtualClock, sampling: Sampling) -> list[float]:
    """Of a sample a minute, each seen (so late, waited for or not); the device's clock set by so much then."""
    zero_s, late = clock.now(), []
    for k, (seen_s, waited, set_s) in enumerate(looks):
        clock.sleep(zero_s + 60.0 * k + seen_s - clock.now())
        if waited:
            sampling.not_taken(is_new=False)
        told = take(sampling, clock, sample(60.0 * k + set_s, k + 1))
        assert bool(told) == (k > 0 and set_s != looks[k - 1][2])
        late.append(sampling.late_s)
    return late


def test_lateness_is_measured_against_the_earliest_of_the_last_three_that_were_waited_for() -> None:
    clock = VirtualClock()
    sampling = Sampling(CONFIG, clock)
    seen = [(5.0, True), (3.0, True), (6.0, True), (4.0, True), (7.0, True), (2.0, True)]
    seen += [(5.0, False), (6.0, True), (6.5, True), (9.0, False), (1.0, False), (2.0, True)]
    late = lateness([(seen_s, waited, 0.0) for seen_s, waited in seen], clock, sampling)
    assert late == [0.0, 0.0, 3.0, 1.0, 3.0, 0.0, 3.0, 4.0, 4.5, 7.0, 0.0, 1.0]
    sampling.pass_over(sample(math.nan, 13))
    assert sampling.key == (660.0, 12)
    clock.sleep(55.0)
    take(sampling, clock, sample(720.0, 13))
    assert sampling.late_s == math.inf  # what was known of the offsets is forgotten


@pytest.mark.parametrize(("step_s", "told"), [(64.9, False), (65.0, True), (-29.9, False), (-30.0, True)])
def test_how_much_lateness_is_a_step_of_a_clock(step_s: float, told: bool) -> None:
    clock, sampling = started()
    take(sampling, clock, sample(0.0, 1))
    clock.sleep(60.0)
    said = take(sampling, clock, sample(60.0 - step_s, 2))
    kind = SampleLate if step_s > 0.0 else SampleBeforeLate
    assert said is None if not told else (type(said), said.fields) == (kind, {"late_s": abs(step_s)})


def test_after_every_step_of_the_boards_clock_lateness_is_counted_by_its_new_time() -> None:
    """By the time before a step a sample would be minutes late, and no dose would be given any more."""
    looks = [
        (0.0, True, 0.0), (4.0, False, 0.0),
        (0.0, False, -400.0), (0.0, True, -400.0), (9.0, False, -400.0),  # put back by a time server ...
        (0.0, False, -90.0), (0.0, True, -90.0), (5.0, False, -90.0),  # ... and put right later
        (0.0, False, 700.0), (1.0, True, 700.0), (3.0, False, 700.0),
    ]  # fmt: skip
    late = lateness(looks, *started())
    assert late == [0.0, 4.0, math.inf, 0.0, 9.0, math.inf, 0.0, 5.0, math.inf, 0.0, 2.0]


def test_a_sample_is_made_of_its_own_numbers() -> None:
    clock = VirtualClock(70.0)
    sampling = Sampling(CONFIG, clock)
    seen = replace(STATE, sample_s=60.0, cycles=2, sample_od=0.41, sample_temperature=36.2, raw=8123.0, blank=14321.0)
    take(sampling, clock, seen)
    found = (sampling.od, sampling.temperature, sampling.raw, sampling.blank, sampling.at, sampling.key)
    assert found == (0.41, 36.2, 8123.0, 14321.0, 70.0, (60.0, 2))


def row(n: int, kind: str, reactor: str = "M0", **fields: Any) -> dict[str, Any]:
    return {"n": n, "kind": kind, "reactor": reactor, "time_s": 10.0 * n, **fields}


INTENT = {
    "sample": [60.0, 2], "feed_ml": 0.5, "waste_ml": 6.0, "carry_ml": 0.1, "doses": 1, "feed_duty": 0.01,
    "waste_duty": 0.1,
}  # fmt: skip


def test_nothing_is_known_of_a_reactor_without_rows_and_a_dose_may_have_given_nothing() -> None:
    known = {key: value for key, value in asdict(ReactorHistory()).items() if value == value}  # but for nan
    spans = {known.pop(key) for key in sorted(SPANS)}
    assert all(start != start and end != end for start, end in spans)
    assert {key: value for key, value in known.items() if value} == {"feed_pump": "Pump1"}
    assert {value for value in asdict(Ending(10.0)).values() if value == value} == {10.0, 0}
    assert Ending(100.0, 0.5, 6.0, 2, 0).repeats() == [(163.0, 0.5, 0.0), (226.0, 0.5, 0.0)]


def test_what_was_given_beside_says_by_which_pump_and_how_little():
    old = row(3, "given", at_s=398.0, feed_ml=0.6, waste_ml=0.6, why="without a dose")
    new = Given(398.0, 0.6, 0.1, 0.6, pump=3).row("without a dose")
    given = {"at_s": 398.0, "feed_ml": 0.6, "feed_low_ml": 0.1, "waste_ml": 0.6}
    assert new == given | {"pump": 3, "why": "without a dose"}
    (before,), (now,) = dosed([old]), dosed([row(3, "given", **new)])
    assert before == replace(now, pump=1)
    assert now.pump == 3


def test_a_resumed_run_counts_its_doses_on_and_knows_what_it_put_off() -> None:
    rows = [
        row(1, "intent", **INTENT, on_s=75.0),
        row(2, "intent", **INTENT | {"doses": 7, "carry_ml": 0.25, "sample": [120.0, 3]}, on_s=135.0),
        row(3, "temperature", temperature=33.5),
        row(4, "sample", doses=99, carry_ml=9.0),
        row(5, "intent", "M1", **INTENT | {"doses": 2}, on_s=140.0),
    ]
    for family in (replay(rows), units([entry | {"id": "run/1"} for entry in rows])):
        assert (family["M0"].doses, family["M0"].carry_ml, family["M0"].temperature) == (7, 0.25, 33.5)
        assert (family["M1"].doses, family["M1"].carry_ml) == (2, 0.1)


def test_a_resumed_run_knows_the_sample_and_the_start_of_its_newest_dose() -> None:
    known = replay([row(k, "intent", **INTENT | {"sample": [60.0 * k, k]}, on_s=75.0 * k) for k in (1, 2)])["M0"]
    assert (known.sample, known.on_s, known.open) == ((120.0, 2), 150.0, True)


def test_a_resumed_run_knows_when_a_unit_was_started_and_which_task_a_dose_was() -> None:
    rows = [
        row(1, "device", "pio01", boot="08:00", device_id="pio01"),
        row(2, "intent", "pio01", **INTENT, on_s=75.0, id="run/1"),
        row(3, "task", "pio01", id="run/1", job="add_media", task="a1"),
    ]
    known = units(rows)["pio01"]
    assert (known.boot, known.id, known.task, known.wasted) == ("08:00", "run/1", "a1", False)
    later = units([*rows, row(4, "device", "pio01", boot="09:30"), row(5, "temperature", "pio01", temperature=30.0)])
    assert later["pio01"].boot == "09:30"
    wasted = units([*rows, row(4, "task", "pio01", id="run/1", job="remove_waste", task="w1")])["pio01"]
    assert (wasted.task, wasted.wasted) == ("w1", True)
    assert units([*rows, row(4, "task", "pio01", id="run/0", job="remove_waste", task="w0")])["pio01"].task == "a1"


def test_what_later_rows_say_of_a_dose() -> None:
    rows = [row(1, "intent", **INTENT, on_s=75.0), row(2, "feed_on", on_s=76.0)]
    off = row(3, "command", path="/SetOutputOn/Pump1/0/M0", answer=204)
    waste_off = {**off, "path": "/SetOutputOn/Pump2/0/M0", "took_s": 0.5}
    never = None
    for later, expected in (
        ([off], (True, (30.0, 30.0), never)),
        ([off, {**off, "time_s": 50.0}], (True, (30.0, 30.0), never)),  # the first of them ended it
        ([{**off, "answer": "no answer"}], (True, never, never)),
        ([waste_off], (True, never, (29.5, 30.0))),
        ([off, row(4, "found", feed_off=None, waste_off=[31.0, 32.0])], (True, never, (31.0, 32.0))),
        ([row(3, "dose_end")], (False, never, never)),
        ([off, row(4, "intent", **INTENT, on_s=135.0)], (True, never, never)),
        ([row(3, "intent", **{**INTENT, "feed_ml": 0.0}, on_s=135.0)], (False, never, never)),
        ([row(3, "regulate", setpoint=0.5)], (False, never, never)),
        ([row(3, "sample", blank=1.0)], (True, never, never)),
    ):
        found = replay([*rows, *later])["M0"]
        ends = [None if end[1] != end[1] else end for end in (found.feed_off, found.waste_off)]
        assert (found.open, *ends) == expected
        assert found.blank != 1.0
    begun = replay([*rows, row(3, "command", path="/SetOutputOn/Pump2/1/M0", answer="no answer")])["M0"]
    assert begun.wasted  # it may run
    assert begun.feed_s == pytest.approx(0.63)
    assert begun.waste_s == pytest.approx(6.3)
    assert replay([row(1, "overflow_pump")])["M0"].overflow_pump_on
    assert not ReactorHistory().overflow_pump_on
    assert replay([row(1, "regulate", setpoint=0.5)])["M0"].handed_over == 0.5
    taken_back = replay([row(1, "regulate", setpoint=0.5), row(2, "regulate", setpoint=None)])["M0"]
    assert taken_back.handed_over != taken_back.handed_over
    nameless = {"n": 9, "kind": "overflow_pump"}
    for damaged in (row(9, "intent"), row(9, "regulate"), row(9, "device", blank="much"), nameless):
        with pytest.raises(RecordingError, match=r"row 9 \(.*\) is damaged .*; the file was changed by hand"):
            replay([damaged])
    assert replay([{"n": 1, "kind": "note"}]) == {}
