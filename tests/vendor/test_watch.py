"""Beside the vendor's app while its own regulation runs: nothing but GETs, and a feed that fails is told."""

from pathlib import Path

import pytest

from envs.scenario import Scenario
from envs.task import EnvConfig
from experiments.laws import registry
from experiments.loop.loop import ClosedLoop
from hardware.clock import DeviceClock
from hardware.link.http import HttpTransport
from hardware.safety.config import SafetyConfig
from hardware.watch.chibio import WatchedChiBio
from hardware.watched import WatchedInterlock
from tests.vendor.bench import SPEED, App, missing


@pytest.mark.campaign
@pytest.mark.skipif(missing() is not None, reason=str(missing()))
def test_a_feed_that_fails_is_told_within_half_an_hour_beside_the_vendor_s_regulation(tmp_path: Path) -> None:
    with App(tmp_path / "app", ["M0"], 3) as app, pytest.MonkeyPatch.context() as patch:
        for path in ("SetOutputTarget/Volume/M0/20", "SetOutputTarget/OD/M0/0.45", "Experiment/1/M0"):
            app.post(f"/{path}")
        app.sleep(20.0)
        app.post("/SetOutputOn/OD/1/M0")
        link = HttpTransport(app.url, SPEED)
        patch.setattr(link, "post", pytest.fail)
        law = registry.build(registry.config("inverse"), model=EnvConfig())
        reactors = WatchedChiBio(link.get, DeviceClock(SPEED), "M0", 1.0, 2.0)
        interlock, asked = WatchedInterlock(1, SafetyConfig()), Scenario((0.45,), (1e5,), (37.0,))
        loop = ClosedLoop(reactors, law, interlock, asked, at_end="hold")
        while app.now() < 3600.0:
            assert loop.step().reasons[0] is None
        app.change("M0", feed=0.0)
        app.until(lambda: "cannot_hold" in (loop.step().reasons[0] or ""), patience=1800.0)
