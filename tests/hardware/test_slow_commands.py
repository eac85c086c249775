"""Doses whose commands are slow, lost or cut off, and doses of somebody else: booked is what was given."""

import math
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import pytest

from hardware.chibio import messages
from hardware.chibio.dose_sequence import DOSE_OFF_S
from hardware.chibio.dosing import PumpCalibration, ReactorCalibration
from hardware.errors import LinkError
from hardware.link.transport import Reply, SwitchedOff
from tests.hardware.driver_lab import DriverLab
from tests.hardware.emulator_lab import BIAS_S, quiet

FEED_ON, FEED_OFF, WASTE_ON = "/SetOutputOn/Pump1/1/", "/SetOutputOn/Pump1/0/", "/SetOutputOn/Pump2/1/"
FALSE_ALARMS = {"falls", "no_dilution", "cannot_hold"}
SHARE, SLACK_ML = 0.05, 0.1
WEIGHED = PumpCalibration(bias_s=BIAS_S)


def lab_of(names: tuple[str, ...] = ("M0",), rate: float = 0.01) -> DriverLab:
    lab = DriverLab(names, options=quiet(mu=0.03))
    lab.client([ReactorCalibration(WEIGHED, WEIGHED)] * len(names))
    lab.law.rate = rate
    lab.reactors.begin()
    lab.run(4)
    return lab


def check_booked(lab: DriverLab) -> None:
    """Booked against true volume, once the dose under way has ended: 5 % and .1 mL."""
    lab.run(2)
    lab.clock.sleep(15.0)
    true = [lab.truth(name)["feed_ml"] for name in lab.names]
    np.testing.assert_allclose(lab.loop.interlock.budget.fed_ml, true, rtol=SHARE, atol=SLACK_ML)


def delayed(lab: DriverLab, seconds: float, path: str, before: bool) -> None:
    """From now on requests of a kind are that slow on their way there, or the answer on its way back."""

    def post(asked: str, real: Any) -> Reply:
        late = asked.startswith(path)
        lab.clock.sleep(seconds * late * before)
        reply = real(asked)
        lab.clock.sleep(seconds * late * (not before))
        return reply

    lab.on_post(post)


def cable(lab: DriverLab, out: Callable[[], bool]) -> None:
    """Requests reach nobody while it is out."""
    post, get = lab.wire.inner.post, lab.wire.inner.get

    def through(whole: Callable[[str], Reply], path: str) -> Reply:
        if out():
            lab.clock.sleep(3.0)
            raise LinkError(f"{path}: no route to the device")
        return whole(path)

    lab.wire.inner.post = lambda path: through(post, path)  # type: ignore[method-assign]
    lab.wire.inner.get = lambda path: through(get, path)  # type: ignore[method-assign]


@pytest.mark.parametrize("before", [True, False], ids=["there", "back"])
@pytest.mark.parametrize("seconds", [2.65, 4.5, 9.0])
@pytest.mark.parametrize("path", [FEED_ON, WASTE_ON, FEED_OFF])
def test_a_slow_command_costs_no_medium_and_blames_no_tube_or_bottle(path: str, seconds: float, before: bool) -> None:
    lab = lab_of()
    delayed(lab, seconds, path, before)
    given = lab.truth()["feed_ml"]
    lab.run(14)
    check_booked(lab)
    assert lab.truth()["feed_ml"] - given > 10.5 * 0.6
    assert not FALSE_ALARMS & lab.kinds()
    assert bool(lab.notes(messages.SlowLink)) == (path == FEED_ON)


@pytest.mark.parametrize(
    ("minutes", "deadman_s"),
    [(1.0, 20.0), (22.0, 20.0), (1.0, 120.0), (22.0, 120.0), *((minutes, math.inf) for minutes in (0.5, 3.0, 12.0))],
)
def test_a_cable_pulled_in_a_dose_books_what_the_board_agent_let_the_pump_give(
    minutes: float, deadman_s: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The agent, if there is one, switches off after its own silence, although the client and its pump-off attempts
    live on; booked is before the next sample is judged."""
    lab = lab_of(("M0", "M1"))
    state = {"out": -math.inf, "heard": 0.0}
    ended: dict[str, dict[str, float]] = {}

    def out() -> bool:
        now = lab.clock.now()
        if now >= state["out"]:
            state["heard"] = now
            return False
        if now > state["heard"] + deadman_s and not ended:
            for name in lab.names:
                on = [p for p in ("Pump1", "Pump2") if lab.device.apps[name].data[p]["ON"]]
                for pump in ("Pump1", "Pump2", "Pump3", "Pump4"):
                    lab.device.handle("POST", f"/SetOutputOn/{pump}/0/{name}")
                ended[name] = {pump: lab.clock.now() for pump in on}
        return True

    def switched_off() -> SwitchedOff:
        return {name: {p: lab.clock.now() - at for p, at in of.items()} for name, of in ended.items()}

    cable(lab, out)
    monkeypatch.setattr(lab.wire.inner, "switched_off", switched_off)
    while not lab.device.apps["M0"].data["Pump1"]["ON"]:
        lab.step()
    state["heard"], state["out"] = lab.clock.now(), lab.clock.now() + 60.0 * minutes
    lab.run(minutes + 6)
    check_booked(lab)
    assert not FALSE_ALARMS & lab.kinds()
    assert "link" in lab.kinds()
    assert lab.samples[0] >= 4


@pytest.mark.parametrize("lost", ["there", "back"])
def test_a_feed_command_without_an_answer_is_looked_for_and_booked_as_found(lost: str) -> None:
    lab = lab_of()
    real, tried = lab.wire.inner.post, []

    def post(path: str) -> Reply:
        if path.startswith(FEED_ON) and not tried:
            tried.append(path)
            if lost == "back":
                real(path)
            lab.clock.sleep(20.0)
            raise LinkError("no answer")
        return real(path)

    lab.wire.inner.post = post  # type: ignore[method-assign]
    lab.run(6)
    check_booked(lab)
    assert not FALSE_ALARMS & lab.kinds()
    assert lab.notes(messages.CommandLost)
    assert bool(lab.notes(messages.DoseGaveNothing)) == (lost == "there")


@pytest.mark.parametrize("late_s", [24.0, 40.0, 500.0])
def test_a_feed_command_that_is_heard_after_it_was_given_up_is_booked_and_the_link_is_blamed(late_s: float) -> None:
    """A request in a busy server's queue, or in a cable that is back: its sender has gone, its dose is given."""
    lab = lab_of()
    real, due = lab.wire.inner.post, [math.inf]

    def post(path: str) -> Reply:
        if path.startswith(FEED_ON) and math.isinf(due[0]):
            due[0] = lab.clock.now() + late_s
            lab.clock.sleep(20.0)
            raise LinkError("no answer")
        return real(path)

    lab.wire.inner.post = post  # type: ignore[method-assign]
    get = lab.wire.inner.get

    def arrives(path: str) -> Reply:
        if lab.clock.now() > due[0] > 0.0:
            due[0] = 0.0
            real(FEED_ON + "M0")
            lab.clock.sleep(1.0)
        return get(path)

    lab.wire.inner.get = arrives  # type: ignore[method-assign]
    given = lab.truth()["feed_ml"]
    lab.run(6 + late_s / 60.0)
    assert due[0] == 0.0
    assert lab.truth()["feed_ml"] > given + 2.0
    check_booked(lab)
    assert not FALSE_ALARMS & lab.kinds()
    assert lab.notes(messages.RanAgain)


@pytest.mark.parametrize(("seconds", "fails"), [(15.0, False), (20.0, True)], ids=["slow", "silent"])
def test_one_reactor_that_is_slow_or_silent_does_not_take_its_neighbours_time(seconds: float, fails: bool) -> None:
    lab = lab_of(("M0", "M1", "M2"), rate=0.012)

    def post(path: str, real: Any) -> Reply:
        if path.endswith("/M0"):
            lab.clock.sleep(seconds)
            if fails:
                raise LinkError(f"{path}: no answer")
        return real(path)

    lab.on_post(post)
    began, given = lab.clock.now(), [lab.truth(name)["feed_ml"] for name in ("M1", "M2")]
    lab.run(12)
    minutes = (lab.clock.now() - began) / 60.0
    more = [lab.truth(name)["feed_ml"] - before for name, before in zip(("M1", "M2"), given, strict=True)]
    assert min(more) > 0.6 * 0.72 * minutes  # 0.72 mL a minute are asked for; two minutes go by until it is found out
    assert "link" in lab.kinds() if fails else lab.notes(messages.TooSlow)


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
