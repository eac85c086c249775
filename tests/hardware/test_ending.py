"""What became of a dose, case by case: from answers, from a look at the device, and from the board agent's own record.

Pumps move 1 mL/s without bias, so volumes are seconds: 1.2 mL of feed asked on at run time 100, 9 mL of waste at 99.
"""

import itertools
import json
import math
from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from hardware.chibio import ending as endings
from hardware.chibio.dosing import PumpCalibration
from hardware.chibio.ending import conclude, found
from hardware.chibio.messages import DoseGave, DoseRepeated
from hardware.chibio.protocol import PERIOD_S, DeviceState, parse_state
from hardware.chibio.resume import ReactorHistory, replay
from hardware.errors import RecordingError
from hardware.storage.doses import REPEAT_S, Ending, Given, dosed
from tests.hardware.script import state

PUMP = PumpCalibration()
START = "2026-01-01 00:00:00"
OPEN = ReactorHistory(
    open=True, feed_ml=1.2, waste_ml=9.0, feed_s=1.2, waste_s=9.0, on_s=100.0, fed=True, wasted=True, experiment=START,
    feed_on=(100.0, 100.1), waste_on=(99.0, 99.1),
)  # fmt: skip
UNHEARD = replace(OPEN, feed_on=(math.nan, math.nan))
UNFED = replace(UNHEARD, on_s=98.0, fed=False)
ENDED = replace(OPEN, feed_off=(103.2, 103.3))
SILENCE_S = 120.0


def read(feed: bool, waste: bool, start_time: str = START, **changes: Any) -> DeviceState:
    targets = (1.2 / PERIOD_S, 9.0 / PERIOD_S, 1.2 / PERIOD_S, 0.0)
    found_so = replace(parse_state(json.dumps(state()).encode()), pump_targets=targets)
    return replace(found_so, pumps_on=(feed, waste, False, False), start_time=start_time, **{"cycles": 5, **changes})


def after(
    known: ReactorHistory, state: DeviceState, now_s: float, seen_s: float = 101.0, off: dict[str, float] | None = None
) -> tuple[Ending, Any]:
    """How the dose ended that is known and was looked at so, its pumps verified off at once; `off` by an agent."""
    row = found(known, state, now_s, seen_s, SILENCE_S, off)
    return conclude(known.after({"kind": "found", **json.loads(json.dumps(row))}), now_s, PUMP, PUMP)


def test_a_dose_whose_every_command_was_answered_gave_what_was_planned() -> None:
    known = replace(OPEN, feed_off=(103.2, 103.3), waste_off=(110.0, 110.1))
    ending, told = conclude(known, 110.5, PUMP, PUMP)
    assert ending == Ending(100.0, 1.2, 9.0, 0, 0, 0, 0.0, 0.0, 1.2)
    assert told is None
    assert ending.beyond(1.2) == []


@pytest.mark.parametrize(
    ("answered_s", "off_s", "most_ml", "least_ml"),
    [
        (100.1, 100.6, 0.7, 0.0),  # asked off .5 s after on was answered: its motor may not have started
        (100.1, 101.2, 1.2, 0.4),
        (100.1, 102.0, 1.2, 1.2),
        (102.65, 105.85, 1.2, 1.2),  # a command that was slow is counted from its answer
        (104.5, 107.7, 1.2, 1.2),
        (104.5, 104.6, 1.2, 0.0),
        (119.9, 123.2, 1.2, 1.2),
    ],
)
def test_a_dose_cut_short_lies_between_two(answered_s: float, off_s: float, most_ml: float, least_ml: float) -> None:
    known = replace(OPEN, feed_on=(100.0, answered_s), feed_off=(off_s, off_s + 0.1), waste_off=(130.0, 130.1))
    ending, told = conclude(known, 131.0, PUMP, PUMP)
    assert (ending.feed_ml, ending.feed_low_ml) == pytest.approx((most_ml, least_ml))
    assert isinstance(told, DoseGave) == (least_ml < 1.0)


@pytest.mark.parametrize(
    ("on_s", "times", "last_ml"),
    [(62.9, 0, 0.0), (63.5, 1, 0.5), (64.2, 1, 1.2), (125.9, 1, 1.2), (126.3, 2, 0.3), (900.0, 14, 1.2)],
)
def test_a_pump_left_on_repeats_every_63_s_its_last_dose_may_be_cut(on_s: float, times: int, last_ml: float) -> None:
    ending, told = after(OPEN, read(True, True), 100.0 + on_s)
    assert (ending.feed_times, ending.waste_times) == (times, int((on_s + 1.0) // 63))
    assert ending.feed_last_ml == pytest.approx(last_ml)
    assert ending.repeated_ml == pytest.approx(1.2 * max(times - 1, 0) + last_ml)
    assert (told.fields["times"] if isinstance(told, DoseRepeated) else 0) == times
    assert REPEAT_S == PERIOD_S  # as the journal counts


@pytest.mark.parametrize(
    ("known", "seen", "now_s", "seen_s", "stopped", "most_ml", "least_ml"),
    [
        # still on: it goes on until it is switched off now; the period is up to .7 s longer
        (OPEN, read(True, False), 1000.0, 101.0, {}, 18.0, 18.0),
        # found off after the link was gone, and the agent says when it switched it off
        (OPEN, read(False, False), 1500.0, 102.0, {"Pump1": 222.5, "Pump2": 222.6}, 2.4, 2.4),
        (UNHEARD, read(False, False), 1500.0, 102.0, {"Pump1": 222.5}, 2.4, 2.4),
        # an agent without a record: after its silence at most, and at least nothing
        (OPEN, read(False, False), 1500.0, 102.0, None, 3.6, 0.0),
        (OPEN, read(False, False), 1500.0, 95.9, None, 2.4, 0.0),  # until 225.9 s
        # its command was not answered, and no agent can have acted yet: found off, it never went on
        (UNHEARD, read(False, True), 219.0, 100.0, {}, 0.0, 0.0),
        (UNHEARD, read(True, True), 130.0, 100.0, {}, 1.2, 0.0),  # a tunnel may have kept it until just now
        (UNHEARD, read(False, False), 219.9, 100.0, None, 0.0, 0.0),
        (UNHEARD, read(False, False), 220.1, 100.0, None, 2.4, 0.0),
        (UNHEARD, read(False, False), 900.0, 100.0, {}, 0.0, 0.0),
        # heard and found off: somebody switched it off, nobody knows when; the agent would have ended both pumps
        (OPEN, read(False, False), 130.0, 101.0, {}, 1.2, 0.0),
        (OPEN, read(False, True), 130.0, 101.0, {}, 1.2, 0.0),
        (OPEN, read(False, True), 350.0, 101.0, {}, 4.8, 0.0),
        # asked off without an answer, and found off: done at once, or when a tunnel delivered it just now
        (replace(OPEN, feed_tried=103.5, waste_tried=111.0), read(False, False), 600.0, 101.0, {}, 9.6, 1.2),
        (replace(OPEN, feed_tried=166.0), read(False, False), 600.0, 101.0, {}, 9.6, 2.4),
        (replace(OPEN, feed_tried=103.5), read(False, False), 600.0, 101.0, {"Pump1": 222.5}, 2.4, 2.4),
        (replace(OPEN, feed_tried=103.5), read(False, False), 600.0, 101.0, None, 3.6, 0.0),
        (replace(UNHEARD, feed_tried=123.3), read(False, False), 600.0, 101.0, {}, 9.6, 0.0),
        # refused, and its experiment was ended for that
        (OPEN, read(False, False, running=False), 130.0, 120.0, {}, 1.2, 1.2),
        (replace(OPEN, feed_tried=103.5), read(True, False), 240.0, 101.0, {}, 3.6, 3.6),
        # never fed
        (UNFED, read(False, True), 1000.0, 98.0, {}, 0.0, 0.0),
        (UNFED, read(False, False), 1000.0, 98.0, {}, 0.0, 0.0),
        # answered off, and found on: an old answer delivered again, not done, or switched on anew by somebody
        (replace(OPEN, feed_off=(103.0, 103.1)), read(True, True), 240.0, 101.0, {}, 4.8, 1.2),
        (replace(OPEN, feed_off=(103.0, 103.1)), read(True, True), 103.4, 101.0, {}, 1.6, 1.2),
        (replace(OPEN, feed_off=(103.0, 103.1)), read(False, True), 1000.0, 101.0, {}, 1.2, 1.2),
        # another target than was set: by somebody, before the dose, in it or after it
        (OPEN, read(True, True, pump_targets=(0.13 / 63.0, 9.0 / 63.0, 0.0, 0.0)), 110.0, 101.0, {}, 1.33, 0.0),
        (ENDED, read(False, True, pump_targets=(5.04 / 63.0, 9.0 / 63.0, 0.0, 0.0)), 110.0, 101.0, {}, 6.24, 0.0),
        (ENDED, read(False, True, pump_targets=(5.04 / 63.0, 9.0 / 63.0, 0.0, 0.0)), 104.0, 101.0, {}, 5.2, 0.0),
        (ENDED, read(False, True, pump_targets=(math.nan, 9.0 / 63.0, 0.0, 0.0)), 110.0, 101.0, {}, 1.2, 0.0),
        (UNFED, read(False, True, pump_targets=(0.0, 9.0 / 63.0, 0.0, 0.0)), 1000.0, 98.0, {}, 0.0, 0.0),
        (OPEN, read(False, False), 500.0, 101.0, {}, 8.4, 0.0),  # where there is no agent, however long it went on
        # a device that was restarted forgot its pumps, nobody knows when; until then it repeated the dose
        (OPEN, read(True, True, "another"), 1000.0, 101.5, {}, 18.0, 0.7),
        (OPEN, read(False, False, " Waiting "), 155.0, 101.5, {}, 1.2, 0.7),
        (OPEN, read(False, False, " Waiting "), 1000.0, 101.5, None, 18.0, 0.7),
        (replace(OPEN, experiment=""), read(True, True, "another"), 1000.0, 101.0, {}, 18.0, 18.0),
    ],
)  # fmt: skip
def test_what_a_look_says_of_a_dose_whose_course_nobody_saw(
    known: ReactorHistory, seen: DeviceState, now_s: float, seen_s: float, stopped: dict[str, float] | None,
    most_ml: float, least_ml: float,
) -> None:  # fmt: skip
    ending, _ = after(known, seen, now_s, seen_s, stopped)
    assert ending.feed_ml + ending.repeated_ml == pytest.approx(most_ml)
    assert ending.feed_low_ml == pytest.approx(least_ml, abs=1e-6)
    assert ending.least == pytest.approx(least_ml / most_ml if most_ml else 1.0)


PERIODS_S = (PERIOD_S, PERIOD_S + 0.68)  # the app begins a period up to .7 s late, and its motor too
ENDS_S = (100.4, 101.9, 164.0, 229.3)  # in a dose, after it, in its second and third repetition


def motor_s(on_s: float, off_s: float, period_s: float) -> float:
    """How long a motor turns in the vendor's app, whose pump goes on and off at these times, for doses of 1.2 s.

    Its thread turns the motor, sleeps until the end of a period, and starts the next thread as long as the pump is on.
    A command that comes meanwhile stops the motor at once; so do an end of the experiment and a restart.
    """
    begun_s = on_s + period_s - PERIOD_S
    periods = int((off_s - begun_s) // period_s) + 1 if begun_s < off_s else 0
    return sum(min(off_s - begun_s - k * period_s, 1.2) for k in range(periods))


def courses() -> Iterator[tuple[str, float, dict[str, Any]]]:
    """Everything that may befall a dose asked on at 100 s, its truth in mL, and what a look shows of it later.

    The command was answered; it was carried out at once, or late, without an answer; or it was lost. Two faults at once
    are not seen: a command without an answer that was carried out, and somebody who switched its pump off.
    """
    heard = {"answered": 100.05, "at once": 100.05, "late": 137.0, "lost": math.inf}
    for (how, on_s), end_s, later_s, period_s in itertools.product(heard.items(), ENDS_S, (2.9, 300.0), PERIODS_S):
        known, seen_s = OPEN if how == "answered" else UNHEARD, 101.0 if how == "answered" else 99.9
        agent_s = seen_s + SILENCE_S + 1.3
        off = {"known": known, "seen_s": seen_s, "state": read(False, False)}
        tried = off | {"known": replace(known, feed_tried=103.5)}
        causes: dict[str, tuple[float, dict[str, Any]]] = {
            "still on": (end_s, off | {"state": read(on_s < end_s, True)}),
            "still on, asked off": (end_s, tried | {"state": read(on_s < end_s, True)}),
            "asked off": (103.5, tried),
            "asked off, late": (max(end_s, 103.5), tried),
            "restarted": (end_s, off | {"state": read(False, False, "another")}),
            "restarted, and on again by a web page": (end_s, off | {"state": read(True, True, "another")}),
            "ended": (end_s, off | {"state": read(False, False, running=False)}),
        }
        if how in ("answered", "at once"):
            causes["agent"] = agent_s, off | {"stopped": {"Pump1": agent_s}}
            causes["agent that does not say"] = agent_s, off | {"stopped": None}
        if how in ("answered", "lost"):
            causes["by hand"] = end_s, off
            causes["by hand, waste on"] = end_s, off | {"state": read(False, True)}
            causes["by hand, before the agent"] = min(end_s, agent_s), off | {"stopped": None}
        if how == "answered":
            causes["killed as it was asked off"] = 104.0, off | {"state": read(False, True), "killed": True}
        for cause, (off_s, look) in causes.items():
            since_s = {"restarted": seen_s, "ended": seen_s}.get(cause.partition(",")[0], on_s)
            if off_s < since_s < math.inf:  # what was answered came before
                continue
            now_s = off_s if look["state"].pumps_on[0] and look["state"].start_time == START else off_s + later_s
            yield f"{how}, {cause}", motor_s(on_s, off_s, period_s), look | {"now_s": now_s}


def bounds(look: dict[str, Any]) -> tuple[float, float]:
    known, how = look["known"], {"stopped": {}, **look}
    row = found(silence_s=SILENCE_S, **how)
    ending, _ = conclude(known.after({"kind": "found", **row}), look["now_s"], PUMP, PUMP)
    return ending.feed_low_ml, ending.feed_ml + ending.repeated_ml


def test_whatever_ended_a_dose_its_truth_lies_between_the_bounds_and_where_the_end_is_known_on_them() -> None:
    for course, true_ml, look in courses():
        least_ml, most_ml = bounds(look)
        assert least_ml - 1e-6 <= true_ml <= most_ml + 1e-6, (course, look)
        if look.get("stopped") or "killed" in course:
            assert most_ml == pytest.approx(true_ml, abs=0.71), course


@pytest.mark.parametrize("k", range(len(endings.OFF) - 1))
def test_no_row_of_the_table_is_idle(k: int, monkeypatch: pytest.MonkeyPatch) -> None:
    before = [bounds(look) for _, _, look in courses()]
    rows = list(endings.OFF)
    rows[k] = (rows[k][0], *endings.OFF[-1][1:])
    monkeypatch.setattr(endings, "OFF", tuple(rows))
    assert [bounds(look) for _, _, look in courses()] != before


def test_a_look_says_nothing_of_a_pump_whose_end_was_answered_nor_without_an_open_dose() -> None:
    ended = replace(OPEN, feed_off=(103.0, 103.1), waste_off=(110.0, 110.1))
    assert found(ended, read(False, False), 1000.0, 101.0, SILENCE_S, {}) == {}
    assert found(ReactorHistory(), read(True, True), 1000.0, 101.0, SILENCE_S, {}) == {}


@pytest.mark.parametrize(
    ("stopped", "repeats"),
    [
        # feed on for 122.5 s, waste for 129 s: two periods of 63 s and 3 s of a third
        ({"Pump1": 222.5, "Pump2": 228.0}, [(163.0, 1.2, 6.3), (226.0, 0.0, 2.1)]),
        # an agent that keeps no record: at most 130 s after the last answer, feed for 132 s, waste for 133
        (None, [(163.0, 1.2, 6.3), (226.0, 1.2, 4.9)]),
    ],
)
def test_the_waste_pump_s_repeats_end_when_an_agent_stopped_it_and_have_its_own_flow(
    stopped: dict[str, float] | None, repeats: list[tuple[float, float, float]]
) -> None:
    """The vial's ledger is lower by them; forgotten, a sound vial would be said to overflow."""
    row = found(OPEN, read(False, False), 1500.0, 102.0, SILENCE_S, stopped)
    ending, _ = conclude(OPEN.after({"kind": "found", **row}), 1500.0, PUMP, PumpCalibration(flow_ml_s=0.7))
    np.testing.assert_allclose(ending.repeats(), repeats)
    booked = [(one.at_s, one.feed_ml, one.waste_ml) for one in ending.beyond(1.2)]
    np.testing.assert_allclose(booked[-2:], repeats)


def test_a_spare_pump_s_dose_is_told_as_its_own() -> None:
    known = replace(OPEN, feed_pump="Pump3")
    ending, _ = after(known, replace(read(False, False), pumps_on=(False, False, True, False)), 170.0)
    assert (ending.pump, ending.feed_times) == (3, 1)
    assert {g.pump for g in ending.beyond(1.2)} == {3}


def test_what_was_given_beyond_what_was_booked_comes_one_by_one_with_the_least_that_it_was() -> None:
    ending = Ending(10.0, 1.2, 9.0, 2, 2, 0, 0.6, 9.0, 1.5)
    assert ending.least == pytest.approx(0.5)
    assert ending.beyond(1.2) == [
        Given(10.0, 0.0, pytest.approx(-0.6), 0.0), Given(73.0, 1.2, pytest.approx(0.6), 9.0),
        Given(136.0, 0.6, pytest.approx(0.3), 9.0),
    ]  # fmt: skip
    assert Ending(10.0, 0.0, 9.0, feed_low_ml=0.0).beyond(1.2) == [Given(10.0, -1.2, -1.2, -1.2)]


def test_repetitions_are_told_one_by_one_and_survive_the_journal() -> None:
    ending = Ending(10.0, 1.2, 9.0, 1, 2, 4, 0.4, 3.0, 1.0)
    assert ending.repeats() == [(73.0, 0.4, 9.0), (136.0, 0.0, 3.0)]
    assert Ending.of_row(json.loads(json.dumps(ending.row()))) == ending
    assert ending.row()["repeated_ml"] == 0.4


def test_every_dose_of_a_journal_in_the_order_of_time() -> None:
    def intent(n: int, name: str, on_s: float, **pump: str) -> dict[str, object]:
        return {
            "n": n, "kind": "intent", "reactor": name, "on_s": on_s, "feed_ml": 1.2, "waste_ml": 9.0,
            "sample": [0, 1], "feed_duty": 0.019, "waste_duty": 0.143, **pump,
        }  # fmt: skip

    rows = [
        intent(0, "M0", 10.0), {"n": 1, "kind": "feed_on", "reactor": "M0", "on_s": 11.0},
        intent(2, "M1", 12.0),  # its feed pump was never switched on
        {"n": 3, "kind": "dose_end", "reactor": "M0", **Ending(11.0, 0.7, 9.0).row()},
        intent(4, "M0", 70.0), {"n": 5, "kind": "feed_on", "reactor": "M0", "on_s": 71.0},
        intent(6, "M1", 72.0), {"n": 7, "kind": "feed_on", "reactor": "M1", "on_s": 73.0},
        {"n": 8, "kind": "dose_end", "reactor": "M0", **Ending(71.0, 1.2, 9.0, 1, 2, waste_last_ml=3.0).row()},
        intent(9, "M0", 300.0, feed_pump="Pump3"), {"n": 10, "kind": "feed_on", "reactor": "M0", "on_s": 301.0},
        {"n": 11, "kind": "dose_end", "reactor": "M0", **Ending(301.0, 1.2, 9.0, 2, 0, 3, 0.2).row()},
        intent(12, "M2", 74.0), {"n": 13, "kind": "feed_on", "reactor": "M2", "on_s": 75.0},
        {"n": 14, "kind": "dose_end", "reactor": "M2", **Ending(75.0, 1.2, 9.0, 1, 1).row()},
    ]  # fmt: skip
    assert [(d.n, d.reactor, d.at_s, d.feed_ml, d.waste_ml, d.again, d.pump) for d in dosed(rows)] == [
        (0, "M0", 11.0, 0.7, 9.0, False, 1), (4, "M0", 71.0, 1.2, 9.0, False, 1), (6, "M1", 72.0, 1.2, 9.0, False, 1),
        (12, "M2", 75.0, 1.2, 9.0, False, 1), (8, "M0", 134.0, 1.2, 9.0, True, 1), (14, "M2", 138.0, 1.2, 9.0, True, 1),
        (8, "M0", 197.0, 0.0, 3.0, True, 1), (9, "M0", 301.0, 1.2, 9.0, False, 3), (11, "M0", 364.0, 1.2, 0.0, True, 3),
        (11, "M0", 427.0, 0.2, 0.0, True, 3),
    ]  # fmt: skip
    assert replay(rows)["M1"].fed
    assert not replay(rows[:3])["M1"].fed
    with pytest.raises(RecordingError, match=r"row 4 \(intent\) is damaged"):
        dosed([*rows[:4], {"n": 4, "kind": "intent", "reactor": "M0"}])
