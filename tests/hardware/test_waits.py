"""No wait of the driver is without an end and a word; where pumps or a link do not obey, nothing is spilled."""

import logging
import re
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from hardware.chibio import messages
from hardware.chibio.resume import replay
from hardware.clock import VirtualClock
from hardware.errors import DeviceStateError, LinkError
from hardware.link.transport import Reply, SharedLink, Transport
from hardware.messages import NotLeftOff
from hardware.storage.doses import Ending
from tests.hardware.driver_lab import DriverLab, begun
from tests.hardware.emulator_lab import quiet


def test_a_flag_that_a_stopped_measurement_left_holds_no_start_up() -> None:
    """Somebody stopped the experiment in the five seconds of a measurement: its flag stays 1."""
    lab = DriverLab(options=quiet(mu=0.025))
    data = lab.device.apps["M0"].data["OD"]
    lab.device.handle("POST", "/Experiment/1/M0")
    while not data["Measuring"]:
        lab.clock.sleep(0.1)
        lab.device.run_until(lab.clock.now())
    lab.device.handle("POST", "/Experiment/0/M0")
    lab.clock.sleep(120.0)
    assert data["Measuring"]
    lab.reactors.begin()
    assert lab.device.apps["M0"].data["Experiment"]["ON"] == 1
    lab.run(5)
    assert lab.samples[0] >= 4
    assert not lab.kinds()


@pytest.mark.parametrize("fault", ["internal_zero", "cycle_dead"])  # the first leaves the flag of a measurement at 1
def test_a_dead_thread_costs_one_restart_neither_heat_nor_stirring_and_the_neighbour_nothing(fault: str) -> None:
    lab = begun(("M0", "M1"), options=quiet(mu=0.025), rate=0.008, minutes=5)
    fed, before = lab.truth("M1")["feed_ml"], lab.samples.copy()
    lab.fault(fault, 1.0, "M0")
    lab.run(12)
    assert {"stalled"} < lab.kinds() <= {"stalled", "stale", "lost", "stopped"}
    assert lab.truth("M1")["feed_ml"] > fed + 4.0
    got = lab.samples - before
    assert got[1] >= 11
    assert 6 <= got[0] <= 10
    data = lab.device.apps["M0"].data
    assert [data[item]["ON"] for item in ("Thermostat", "Stir", "Experiment")] == [1, 1, 1]
    assert lab.truth("M0")["temperature"] > 36.0
    assert lab.notes(messages.RestartedAfter) == [{"kind": "stalled"}]


def test_a_running_experiment_that_measures_for_ever_is_started_anew(caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.INFO)
    lab = DriverLab(options=quiet(mu=0.025))
    lab.device.handle("POST", "/Experiment/1/M0")
    lab.fault("internal_zero", 1.0, "M0")
    lab.clock.sleep(120.0)
    began = lab.clock.now()
    lab.reactors.begin()
    assert 90.0 <= lab.clock.now() - began < 120.0
    assert f"M0: {messages.MeasuresTooLong(seconds=20.0)}" in caplog.text
    lab.run(3)
    assert lab.samples[0] >= 2
    assert "stalled" not in lab.kinds()


def test_a_restart_that_brings_no_sample_is_said_and_tried_again() -> None:
    lab = begun(options=quiet(mu=0.025), minutes=3)
    lab.fault("internal_zero", 2)
    lab.run(20)
    assert lab.notes(messages.RestartedAgain)[0] == {"attempt": 2}
    assert lab.steps[-1].reasons[0] is None
    assert lab.samples[0] >= 8


def test_a_start_that_the_device_does_not_take_is_said_and_tried_again(monkeypatch: pytest.MonkeyPatch) -> None:
    lab = begun(("M0", "M1"), options=quiet(mu=0.025), minutes=3)
    lab.fault("internal_zero", 1.0, "M0")
    real, deaf = lab.wire.inner.post, {"on": True}

    def post(path: str) -> Reply:
        return Reply(204, b"") if deaf["on"] and path == "/Experiment/1/M0" else real(path)

    monkeypatch.setattr(lab.wire.inner, "post", post)
    lab.run(15)
    assert lab.notes(messages.NotRestarted)[0]["error"] == messages.DoesNotStart(reactor="M0").row
    assert lab.samples[1] > lab.samples[0] + 8
    deaf["on"] = False
    before = lab.samples[0]
    lab.run(10)
    assert lab.samples[0] > before + 2


# -- one link ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("n", [2, pytest.param(8, marks=pytest.mark.slow)])
@pytest.mark.parametrize("silent", ["lost_request", "lost_reply"])
def test_a_link_that_never_answers_is_told_of_every_reactor_within_100_s_also_in_a_dose(n: int, silent: str) -> None:
    """Of one of them within a minute: ends of doses that time out again and again do not keep the loop from it."""
    names = tuple(f"M{k}" for k in range(n))
    lab = begun(names, options=quiet(mu=0.025), rate=0.006, minutes=4)
    while not any(lab.device.apps[name].data["Pump1"]["ON"] for name in names):
        lab.step()
    lab.fault(silent, -1)
    lost_s, told = lab.clock.now(), {}
    while len(told) < n and lab.clock.now() < lost_s + 600.0:
        step = lab.step()
        for name, reason in zip(names, step.reasons, strict=True):
            if "link" in (reason or ""):
                told.setdefault(name, lab.clock.now() - lost_s)
    assert len(told) == n
    assert min(told.values()) < 60.0
    assert max(told.values()) < 100.0
    lab.fault(silent, 0)
    before, back_s = lab.samples.copy(), lab.clock.now()
    lab.run(4)
    assert (lab.samples >= before + 2).all()
    lab.reactors.stop()
    assert lab.motors_off()
    assert not {"falls", "no_dilution", "cannot_hold"} & lab.kinds()
    assert lab.clock.now() - back_s < 300.0


def test_what_one_reactor_waited_for_in_vain_the_others_do_not_wait_for_again() -> None:
    lab = begun(("M0", "M1", "M2", "M3"), options=quiet(mu=0.025), minutes=3)
    lab.fault("lost_request", -1)
    began = lab.clock.now()
    failed = lab.reactors.pumps_off(np.ones(4, dtype=np.bool_))
    assert len(failed) == 4
    assert lab.clock.now() - began < 21.0  # one time-out, not eight
    assert "not sent" in failed[-1]
    lab.fault("lost_request", 0)
    lab.clock.sleep(3.0)
    assert lab.reactors.pumps_off(np.ones(4, dtype=np.bool_)) == []


# -- no reactor waits for another --------------------------------------------------------------------------------------


def test_a_resumed_run_goes_on_with_the_others_while_one_is_absent(caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.INFO)
    lab = begun(("M0", "M1", "M2"), options=quiet(mu=0.025), rate=0.006, minutes=3)
    lab.device.apps["M1"].data["present"] = 0
    lab.device.apps["M1"].data["Experiment"]["ON"] = 0  # else its own thread ends the software
    lab.device.computer.events.remove("M1/Experiment")
    lab.device.computer.events.remove("M1/Thermostat")
    lab.resume()
    assert len(lab.notes(messages.NotTakenOver)) == 1
    before, fed = lab.samples.copy(), [lab.truth(m)["feed_ml"] for m in ("M0", "M2")]
    lab.run(3)
    assert (lab.samples[[0, 2]] >= before[[0, 2]] + 2).all()
    assert all(lab.truth(m)["feed_ml"] > ml for m, ml in zip(("M0", "M2"), fed, strict=True))
    assert "absent" in lab.kinds()
    lab.device.apps["M1"].data["present"] = 1  # its data and its dead thread are as they were
    lab.run(8)
    assert lab.samples[1] > before[1]


@pytest.mark.parametrize("stopped", [False, True])
def test_a_resumed_run_whose_reactors_are_all_out_of_reach_ends_with_what_it_could_not_verify(stopped: bool) -> None:
    """Also where it is stopped."""
    lab = begun(("M0", "M1"), options=quiet(mu=0.025), minutes=3)
    lab.fault("lost_request", 0 if stopped else -1)

    def post(path: str, real: Any) -> Reply:
        if stopped:
            lab.on_post(lambda path, _: real(path))
            lab.fault("lost_request", -1)
            raise KeyboardInterrupt
        return real(path)

    lab.on_post(post)
    with pytest.raises(NotLeftOff) as error:
        lab.resume()
    assert ("stopped" if stopped else "no answer") in error.value.fields["why"]
    assert re.search("M0: .*; M1: ", error.value.fields["failed"].fields["failed"])


# -- a stop at the start -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("moment", range(1, 12))
def test_a_stop_while_a_killed_run_is_resumed_leaves_its_pump_off(
    moment: int, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """The program was killed in a dose, so the pump goes on; the next one is stopped at its nth request."""
    caplog.set_level(logging.INFO)
    lab = begun(options=quiet(mu=0.025), rate=0.01)
    while not lab.device.apps["M0"].data["Pump1"]["ON"]:
        lab.step()
    lab.clock.sleep(70.0)
    assert lab.device.apps["M0"].data["Pump1"]["ON"]
    real, seen = lab.wire.inner.post, []

    def post(path: str) -> Reply:
        seen.append(path)
        if len(seen) == moment:
            raise KeyboardInterrupt
        return real(path)

    monkeypatch.setattr(lab.wire.inner, "post", post)
    with pytest.raises(KeyboardInterrupt):
        lab.resume()
    assert lab.motors_off()
    assert "pumps verified off" in caplog.text
    lab.clock.sleep(200.0)
    assert lab.motors_off()


def test_one_time_out_now_and_then_rests_no_reactor():
    """Two, an hour apart, each with an answer soon after."""
    clock, asked, dead = VirtualClock(0.0), [], [False]

    class One(Transport):
        def get(self, path):
            asked.append(path)
            if dead[0]:
                clock.sleep(20.0)
                raise LinkError("time-out")
            return Reply(200, b"")

    link = SharedLink(One(), clock)
    for _ in range(2):
        dead[0] = True
        with pytest.raises(LinkError):
            link.get("/x/M0")
        dead[0] = False
        clock.sleep(link.PAUSE_S + 0.1)
        link.get("/x/M0")
        clock.sleep(3600.0)
    assert len(asked) == 4


def test_a_board_whose_clock_goes_back_by_an_hour_is_dosed_on_and_not_stirred_while_it_measures() -> None:
    lab = begun(options=quiet(mu=0.025), rate=0.008, minutes=5.0)
    lab.clock.sleep(30.0)  # to where a cycle only waits
    lab.fault("clock_step", -3600.0)
    before = len(lab.wire.posts)
    lab.run(6)
    posts = [path for _, path in lab.wire.posts[before:]]
    assert posts.count("/SetOutputOn/Pump1/1/M0") >= 3
    assert not any("/Stir/" in path for path in posts)
    assert "jump" not in lab.kinds()


FULL_ML = 21.5  # a tube at 20 mL, and a dose of .9
FEED_OFF, REFUSED = "/SetOutputOn/Pump1/0/M0", Reply(500, b"<html>")


def fed() -> DriverLab:
    """A lab whose next dose has just begun."""
    lab = begun(options=quiet(mu=0.025), rate=0.015, minutes=4)
    while not replay(lab.rows)["M0"].open:
        lab.step()
    return lab


def refusing(lab: DriverLab, *paths: str) -> set[str]:
    """The paths that are refused as long as they are in here."""
    refused = set(paths)
    lab.on_post(lambda path, act: REFUSED if path in refused else act(path))
    return refused


def test_where_a_feed_pump_does_not_go_off_waste_runs_and_the_experiment_is_ended() -> None:
    """Before its dose is repeated; then pumps are off, and the culture is taken up again."""
    lab = fed()
    began_s, refused = lab.clock.now(), refusing(lab, FEED_OFF)
    lab.run(2)
    ended_s = [at_s for at_s, path in lab.wire.posts if path == "/Experiment/0/M0"]
    assert began_s < ended_s[0] < began_s + 63.0
    assert "stopped" in lab.kinds()
    refused.clear()
    lab.run(6)
    assert lab.truth()["peak_ml"] < FULL_ML
    assert lab.device.apps["M0"].data["Experiment"]["ON"] == 1
    assert sum(Ending.of_row(row).repeated_ml for row in lab.of("dose_end")) == 0.0


@pytest.mark.parametrize("stop", [False, True])
def test_a_feed_pump_that_nothing_switches_off_spills_nothing_and_is_told_within_a_minute(stop: bool) -> None:
    """Whether the run goes on, with alarms that want the pumps off, or ends."""
    lab = fed()
    began_s = lab.clock.now()
    refusing(lab, FEED_OFF, "/Experiment/0/M0")
    if stop:
        with pytest.raises(DeviceStateError, match="Pump1 still on"):
            lab.reactors.stop()
    else:
        lab.run(1)
        assert "pump" in lab.kinds()
    assert stop or lab.clock.now() < began_s + 75.0
    for _ in range(40):
        lab.clock.sleep(20.0)
        lab.reactors.pumps_off(np.ones(1, dtype=np.bool_))  # as `overflow` has it
    assert lab.truth()["peak_ml"] < FULL_ML
    assert lab.truth()["feed_ml"] > 10.0  # it was repeated all the time
    assert lab.device.apps["M0"].data["Pump2"]["ON"] == 1


def kept(lab: DriverLab, minutes: float) -> Callable[[], None]:
    """A tunnel that takes every request, answers none for so long, and delivers all of them in their order then."""
    waiting: list[str] = []
    until_s = lab.clock.now() + 60.0 * minutes
    real_get, real_post = lab.wire.inner.get, lab.wire.inner.post

    def through(path: str, carry_out: Callable[[str], Reply]) -> Reply:
        if lab.clock.now() < until_s:
            waiting.extend([path] * (carry_out is real_post))
            lab.clock.sleep(20.0)
            raise LinkError("no answer")
        while waiting:
            real_post(waiting.pop(0))
        return carry_out(path)

    def get(path: str) -> Reply:
        return through(path, real_get)

    def post(path: str) -> Reply:
        return through(path, real_post)

    lab.wire.inner.get, lab.wire.inner.post = get, post  # type: ignore[method-assign]


@pytest.mark.parametrize("minutes", [4.0, 8.0])
@pytest.mark.parametrize("command", ["/SetOutputOn/Pump1/1/M0", FEED_OFF])
def test_commands_that_a_tunnel_delivers_late_are_booked_between_true_bounds(command: str, minutes: float) -> None:
    lab = begun(options=quiet(mu=0.025), rate=0.015, minutes=4)
    began = False

    def act(path: str, real: Callable[[str], Reply]) -> Reply:
        nonlocal began
        if path == command and not began:
            began = True
            kept(lab, minutes)
            return lab.wire.inner.post(path)
        return real(path)

    lab.on_post(act)
    lab.run(minutes + 10.0)
    lab.reactors.stop()
    lab.loop._book_repeats()
    assert began
    assert lab.motors_off()
    endings = [Ending.of_row(row) for row in lab.of("dose_end")]
    late = lab.of("given")
    most = sum(one.feed_ml + one.repeated_ml for one in endings) + sum(row["feed_ml"] for row in late)
    least = sum((one.feed_ml + one.repeated_ml) * one.least for one in endings) + sum(r["feed_low_ml"] for r in late)
    true = lab.truth()["feed_ml"]
    assert least - 0.1 <= 1.05 * true
    assert 0.95 * true <= most + 0.1
    assert lab.loop.interlock.budget.fed_ml[0] == pytest.approx(most, abs=0.1)
