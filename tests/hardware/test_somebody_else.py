"""Doses that this program did not give: from the web page, by a late command, by a target that somebody changed."""

import math
from collections.abc import Iterator
from typing import Any

import pytest

from hardware.chibio import messages
from hardware.chibio.dose_sequence import DOSE_OFF_S
from hardware.errors import LinkError
from hardware.link.transport import Reply
from tests.hardware.driver_lab import DriverLab
from tests.hardware.test_slow_commands import FALSE_ALARMS, FEED_OFF, FEED_ON, WASTE_ON, check_booked, lab_of


def check_held(lab: DriverLab) -> None:
    """The truth lies between what is told at least and what is booked, but for what a motor gives by itself."""
    lab.run(2)
    lab.clock.sleep(15.0)
    true_ml, booked_ml = float(lab.truth()["feed_ml"]), float(lab.loop.interlock.budget.fed_ml[0])
    doubt_ml = sum(e["feed_ml"] + e["repeated_ml"] - e["feed_low_ml"] for e in lab.of("dose_end"))
    doubt_ml += sum(given["feed_ml"] - given["feed_low_ml"] for given in lab.of("given"))
    assert 0.97 * (booked_ml - doubt_ml) <= true_ml <= 1.03 * booked_ml + 0.05


def send(lab: DriverLab, after_s: float, *paths: str, pause_s: float = 0.0) -> None:
    """Let a web page send these commands so long from now on, whatever the run does then."""

    def page() -> Iterator[float]:
        for path in paths:
            lab.device.handle("POST", path)
            yield pause_s

    lab.reactors._agenda.add(page(), after_s)


def upon(lab: DriverLab, when: str, after_s: float, path: str) -> list[int]:
    """Let a web page send this command once, so long after a request of the run; what is returned is empty then."""
    left = [1]

    def post(asked: str, real: Any) -> Reply:
        reply: Reply = real(asked)
        if asked.startswith(when) and left:
            left.clear()
            send(lab, after_s, path)
            if when == WASTE_ON:
                lab.reactors._agenda.run_due()
        return reply

    lab.on_post(post)
    return left


@pytest.mark.parametrize(("after_s", "times"), [(20.0, 1), (41.0, 1), (53.0, 1), (20.0, 2)])
def test_a_dose_from_the_web_page_is_booked_drained_and_told_once(after_s: float, times: int) -> None:
    """Known are its target and when the pump was last seen off; a page that was left open gives it again."""
    lab = lab_of()
    for _ in range(times):
        given = lab.truth()["feed_ml"]
        lab.step()
        send(lab, after_s, "/SetOutputTarget/Pump1/M0/0.08", "/SetOutputOn/Pump1/1/M0")
        lab.run(3)
        assert lab.truth()["feed_ml"] > given + 4.0
    assert lab.truth()["volume_ml"] < 21.0
    assert len(lab.notes(messages.TargetChanged)) == times
    if after_s < 50.0:  # else it is cut, and nobody knows when
        check_booked(lab)
    check_held(lab)
    assert not FALSE_ALARMS & lab.kinds()
    assert "overflow" not in lab.kinds()
    assert lab.of("intent")[-1]["time_s"] > lab.reactors.elapsed() - 120.0  # it goes on


def test_a_dose_from_the_web_page_that_nobody_saw_is_told_by_the_target_that_it_left() -> None:
    lab = lab_of()
    page = "/SetOutputTarget/Pump1/M0/0.04", "/SetOutputOn/Pump1/1/M0", "/SetOutputOn/Pump1/0/M0"
    lab.step()
    send(lab, 22.0, *page, pause_s=1.5)
    lab.run(3)
    [given] = lab.notes(messages.GivenWithoutDose)
    assert (given["pump"], given["low_ml"], round(given["most_ml"], 2)) == ("Pump1", 0.0, 2.62)
    check_held(lab)


@pytest.mark.parametrize(
    ("when", "after_s", "path", "told"),
    [
        (WASTE_ON, 0.0, "/SetOutputTarget/Pump1/M0/0.002", True),  # it was read back already
        (FEED_ON, 0.2, "/SetOutputTarget/Pump1/M0/0.002", True),
        (FEED_ON, 0.6, "/SetOutputTarget/Pump1/M0/0.03", True),
        (FEED_ON, 0.6, "/SetOutputTarget/Pump1/M0/nan", True),
        (FEED_ON, 0.5, "/SetOutputOn/Pump1/0/M0", True),
        (FEED_OFF, 0.5, "/SetOutputOn/Pump1/1/M0", True),
        (FEED_OFF, 0.5, "/SetOutputTarget/Pump1/M0/0.03", True),
        (FEED_ON, 0.5, "/SetOutputTarget/Pump2/M0/0.5", False),  # more of the waste harms nothing
    ],
)
def test_what_somebody_changes_in_a_dose_is_told_as_an_interval(
    when: str, after_s: float, path: str, told: bool
) -> None:
    lab = lab_of(rate=1.04 / 60.0)
    upon(lab, when, after_s, path)
    lab.run(4)
    assert bool(lab.notes(messages.DoseGave, messages.DoseRepeated)) == told
    check_held(lab)
    assert not FALSE_ALARMS & lab.kinds()


@pytest.mark.parametrize("after_s", [0.3, 0.62, 1.1, 2.2])
def test_a_feed_pump_switched_on_once_more_in_its_dose_gives_no_more_than_its_window(after_s: float) -> None:
    """The app shows the same as before, so nothing tells it: declared in docs/faults.md with this bound."""
    lab = lab_of(rate=0.62 / 60.0)
    left = upon(lab, FEED_ON, after_s, f"{FEED_ON}M0")
    lab.run(4)
    lab.clock.sleep(15.0)
    beyond_ml = lab.truth()["feed_ml"] - float(lab.loop.interlock.budget.fed_ml[0])
    assert left == []
    assert beyond_ml <= min(0.62, DOSE_OFF_S) + 0.15
    assert lab.truth()["peak_ml"] < 21.5
    assert not FALSE_ALARMS & lab.kinds()


@pytest.mark.parametrize("landing", [(FEED_ON, 0.4), (FEED_ON, 1.0), (FEED_OFF, 0.3), (FEED_OFF, 4.0)])
def test_a_feed_command_heard_in_a_later_dose_is_told_with_what_it_may_have_given(landing: tuple[str, float]) -> None:
    lab = lab_of(rate=0.62 / 60.0)
    kept = [1]

    def post(path: str, real: Any) -> Reply:
        if path.startswith(FEED_ON) and kept[-1] == 1:
            kept.append(2)
            lab.clock.sleep(20.0)
            raise LinkError("no answer")
        if path.startswith(landing[0]) and kept[-1] == 2 and lab.of("dose_end")[-1]["feed_ml"] == 0.0:
            kept.append(3)
            send(lab, landing[1], f"{FEED_ON}M0")
        return real(path)

    lab.on_post(post)
    lab.run(5)
    assert kept[-1] == 3
    assert lab.notes(messages.DosePerhapsTwice, messages.RanAgain)
    lab.run(2)
    lab.clock.sleep(15.0)
    booked_ml = float(lab.loop.interlock.budget.fed_ml[0])
    assert booked_ml - 0.65 <= lab.truth()["feed_ml"] <= 1.03 * booked_ml + 0.65
    assert not FALSE_ALARMS & lab.kinds()


@pytest.mark.parametrize(("since", "seconds"), [(FEED_ON, 9.0), (FEED_ON, 30.0), (FEED_ON, 80.0), (WASTE_ON, 40.0)])
def test_an_old_answer_delivered_again_does_not_become_the_least_that_was_given(since: str, seconds: float) -> None:
    """What was answered to a command stays true, whatever a look says."""
    lab = lab_of(rate=0.61 / 60.0)
    post, get, old = lab.wire.inner.post, lab.wire.inner.get, list[tuple[float, Reply]]()

    def switch(path: str) -> Reply:
        reply = post(path)
        if path.startswith(since) and not old:
            old.append((lab.clock.now(), get("/getSysdata/")))
        return reply

    def cached(path: str) -> Reply:
        return old[0][1] if old and lab.clock.now() < old[0][0] + seconds else get(path)

    lab.wire.inner.post, lab.wire.inner.get = switch, cached  # type: ignore[method-assign]
    lab.run(6)
    check_held(lab)


@pytest.mark.parametrize(
    ("pump", "after_s", "spread"), [("Pump1", 20.0, True), ("Pump3", 20.0, False), ("Pump4", 52.0, True)]
)
def test_a_target_that_is_no_number_is_told_and_mended_in_time(pump: str, after_s: float, spread: bool) -> None:
    """Once it is on record, or in the thermostat's law, the device's thread ends at its next dump, for good."""
    lab = lab_of()
    if pump == "Pump4":
        lab.device.apps["M0"].data[pump]["record"].append(math.nan)
    lab.step()
    send(lab, after_s, f"/SetOutputTarget/{pump}/M0/nan")
    lab.run(3)
    assert [note["item"] for note in lab.notes(messages.PutRight)] == [pump]
    assert len(lab.notes(messages.DumpWillFail)) == spread
    assert lab.device.apps["M0"].data[pump]["target"] == (0.0 if pump != "Pump1" else pytest.approx(0.0086, abs=1e-3))
    assert lab.of("fault") == []
    check_held(lab)
