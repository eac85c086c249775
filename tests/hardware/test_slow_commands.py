"""A dose whose commands are slow, lost, or cut off with the cable, the program alive: booked is what was given."""

import math
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from hardware.chibio import messages
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
