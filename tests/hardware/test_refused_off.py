"""A pump that cannot be had off, commands that a tunnel keeps: nothing is spilled, the truth is between the bounds."""

from collections.abc import Callable

import numpy as np
import pytest

from hardware.chibio.resume import replay
from hardware.errors import DeviceStateError, LinkError
from hardware.link.transport import Reply
from hardware.storage.doses import Ending
from tests.hardware.driver_lab import DriverLab, begun
from tests.hardware.emulator_lab import quiet

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
