"""A short form of `python -m tests.vendor`: one fault whole, the judge finds what is planted, and a watched feed."""

import os
import re
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
from tests.vendor.faults import FAULTS, PLANTED, Fault, play

pytestmark = [pytest.mark.skipif(bool(missing()), reason=missing() or ""), pytest.mark.timeout(3600)]

SHORT = "stopped in measuring, then blank"
WHOLE = [pytest.param(fault, id=fault.name, marks=pytest.mark.campaign) for fault in FAULTS if fault.name != SHORT]
NOW = [pytest.param(fault, id=fault.name, marks=pytest.mark.slow) for fault in FAULTS if fault.name == SHORT]


def judged(fault: Fault, made: pytest.TempPathFactory) -> list[str]:
    work = made.getbasetemp() / "vendor"  # pumps are weighed once
    work.mkdir(exist_ok=True)
    failures: list[str] = play("app", fault, work, unit=os.getpid() % 900)["failures"]
    return failures


@pytest.mark.parametrize("fault", NOW + WHOLE)
def test_a_fault_is_told_counted_and_over(fault: Fault, tmp_path_factory: pytest.TempPathFactory) -> None:
    assert judged(fault, tmp_path_factory) == []


@pytest.mark.campaign
@pytest.mark.parametrize("fault", PLANTED, ids=lambda fault: fault.name)
def test_the_judge_finds_what_is_planted(fault: Fault, tmp_path_factory: pytest.TempPathFactory) -> None:
    assert any(re.search("booked|false|strays", failure) for failure in judged(fault, tmp_path_factory))


@pytest.mark.campaign
def test_a_feed_that_fails_is_told_within_half_an_hour_beside_the_vendor_s_regulation(tmp_path: Path) -> None:
    with App(tmp_path / "app", ["M0"], 3) as app, pytest.MonkeyPatch.context() as patch:
        for path in ("SetOutputTarget/Volume/M0/20", "SetOutputTarget/OD/M0/0.45", "Experiment/1/M0"):
            app.post(f"/{path}")
        app.sleep(20.0)
        app.post("/SetOutputOn/OD/1/M0")
        link = HttpTransport(app.url, SPEED)
        patch.setattr(link, "post", pytest.fail)
        law = registry.build(registry.config("inverse"), model=EnvConfig())
        reactors = WatchedChiBio(link.get, DeviceClock(SPEED), "M0", 1.0)
        interlock, asked = WatchedInterlock(1, SafetyConfig()), Scenario((0.45,), (1e5,), (37.0,))
        loop = ClosedLoop(reactors, law, interlock, asked, at_end="hold")
        while app.now() < 3600.0:
            assert loop.step().reasons[0] is None
        app.change("M0", feed=0.0)
        app.until(lambda: "cannot_hold" in (loop.step().reasons[0] or ""), patience=1800.0)
