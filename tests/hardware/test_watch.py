"""Reactors that are only watched: nothing reaches the wire, doses of others are evidence, a pump that fails is told."""

import json
from collections.abc import Callable

import numpy as np
import pytest

from envs.bench import Bench
from envs.scenario import Scenario
from envs.task import EnvConfig
from experiments.laws import registry
from experiments.loop.loop import ClosedLoop, Step
from hardware.clock import VirtualClock
from hardware.emulator.device import ChiBioDevice
from hardware.emulator.transport import EmulatorTransport
from hardware.link.transport import Reply
from hardware.messages import LinkFault
from hardware.pioreactor.config import PioreactorConfig
from hardware.pioreactor.mailbox import Mailbox
from hardware.reactor import Measurement, Vitals
from hardware.safety.config import SafetyConfig
from hardware.safety.interlock import kinds_of
from hardware.watch import pioreactor
from hardware.watch.chibio import WatchedChiBio
from hardware.watched import WatchedInterlock

BY_PAGE = ("SetOutputTarget/Volume/M0/20", "SetOutputTarget/OD/M0/0.5", "Experiment/1/M0", "SetOutputOn/OD/1/M0")


class Counted(EmulatorTransport):
    """A link that counts what is sent."""

    sent: tuple[str, ...] = ()

    def _request(self, method: str, path: str) -> Reply:
        self.sent = (*self.sent, method)
        return super()._request(method, path)


class Beside:
    """An emulated Chi.Bio that regulates itself at OD 0.5, and the loop that watches it."""

    def __init__(self, seed: int = 0) -> None:
        self.clock, rng = VirtualClock(), np.random.default_rng(seed)
        device = ChiBioDevice(("M0",), self.clock, rng, od=0.5, temperature=37.0, blanked=True)
        page, self.link = EmulatorTransport(device), Counted(device)
        assert [page.post(f"/{path}").status for path in BY_PAGE] == [204] * 4
        self.plant = device.vials["M0"].plant
        self.law = registry.build(registry.config("inverse"), model=EnvConfig())
        reactors = WatchedChiBio(self.link.get, self.clock, "M0", 1.0)
        asked = Scenario((0.5,), (1e5,), (37.0,))
        self.loop = ClosedLoop(reactors, self.law, WatchedInterlock(1, SafetyConfig()), asked, at_end="hold")

    def run(self, hours: float) -> list[Step]:
        """Steps of so many hours."""
        until, steps = self.clock.now() + 3600.0 * hours, []
        while self.clock.now() < until:
            steps.append(self.loop.step())
        return steps


def told(steps: list[Step]) -> set[str]:
    return {kind for step in steps for kind in kinds_of(step.reasons[0] or "")} - {"filter_alarm"}


def test_nothing_is_sent_the_device_s_doses_are_evidence_and_a_feed_that_fails_is_told_within_half_an_hour() -> None:
    watch = Beside()
    steps = watch.run(3.0)
    assert told(steps) == set()
    assert np.nansum([step.volume_ml for step in steps]) > 20.0
    truth = float(watch.plant.culture.rates(watch.plant.age_min)[0].max())
    assert watch.law.explain()["mu"][0] == pytest.approx(truth, rel=0.2)
    watch.plant.feed.gain_factor[:] = 0.0
    assert "no_dilution" in told(watch.run(0.5))
    assert set(watch.link.sent) == {"GET"}


@pytest.mark.slow
def test_a_sound_day_is_quiet() -> None:
    assert told(Beside(seed=1).run(24.0)) == set()


def test_a_fault_is_told_in_its_third_sample_in_a_row_of_its_own_reactor() -> None:
    interlock, n = WatchedInterlock(2, SafetyConfig()), 2
    steps = ("x.", ".x", "x.", "xx", "xx", ".x", "x.", "x.")
    lines = []
    for minute, faults in enumerate(steps):
        seen = tuple(LinkFault("x") if one == "x" else None for one in faults)
        vitals = Vitals(np.zeros(n), np.full(n, 9000.0), seen)
        od = np.full(n, 0.5 + 1e-3 * (minute % 5))
        m = Measurement(np.full(n, 60.0 * minute), od, np.full(n, 37.0), np.full(n, True), vitals)
        reasons = interlock.check(m, np.zeros(n), np.full(n, 0.5), np.full(n, np.nan), 60.0 * minute).reasons
        lines.append([bool(reason) for reason in reasons])
    assert lines == [[k == 4, k == 5] for k in range(len(steps))]


class Unit(VirtualClock):
    """Time, in which a Pioreactor's turbidostat doses 1 mL above OD 0.5; its pump may fail. It says what it does."""

    def __init__(self) -> None:
        super().__init__(1000.0)
        self.said: Callable[[str, bytes, bool], None] | None = None
        self.od, self.sound, self._next_s, self._rng = 0.49, True, 1000.0, np.random.default_rng(0)

    def sleep(self, seconds: float) -> None:
        super().sleep(seconds)
        while self.said is not None and self._next_s <= self.now():
            self._next_s += 5.0
            self.od *= np.exp(0.02 * 5.0 / 60.0)
            self.say("od_reading/ods", ods={"2": {"od": self.od + self._rng.normal(0.0, 0.002), "calibrated": 0}})
            if self.od > 0.5 and self._next_s % 60.0 < 5.0:
                fluid = ("add_media", "add_alt_media")[int(self._next_s) // 60 % 2]
                self.say("dosing_events", volume_change=1.0, event=fluid, source_of_event="turbidostat")
                self.od *= np.exp(-1.0 / 20.0) if self.sound else 1.0

    def say(self, rest: str, **what: object) -> None:
        assert self.said is not None
        text = json.dumps({"timestamp": f"t{self._next_s}", **what})
        self.said(f"pioreactor/pio01/turbidostat/{rest}", text.encode(), False)


class Heard:
    """In the place of the broker: there is no way to say anything."""

    connected, refusal = True, ""

    def __init__(self, config: object, boxes: dict[str, Mailbox], name: str, clock: Unit) -> None:
        clock.said = boxes["pio01"].take

    def close(self) -> None:
        """Nothing is open."""


def test_of_a_pioreactor_doses_of_its_automation_are_evidence_and_a_dry_one_is_told(monkeypatch) -> None:
    monkeypatch.setattr(pioreactor, "Cluster", Heard)
    unit = Unit()
    law = registry.build(registry.config("inverse"), model=EnvConfig())
    reactors = pioreactor.WatchedPioreactors(
        PioreactorConfig(reactors=("pio01",), experiment="turbidostat"), unit, Bench()
    )
    asked = Scenario((0.5,), (1e5,), (37.0,))
    loop = ClosedLoop(reactors, law, WatchedInterlock(1, SafetyConfig()), asked, at_end="hold")
    sound = [loop.step() for _ in range(240)]
    assert told(sound) == set()
    assert law.explain()["mu"][0] == pytest.approx(0.02, rel=0.1)
    assert law.explain()["gain"][0] == pytest.approx(1.0, rel=0.1)
    unit.sound = False
    began_s, steps = unit.now(), []
    while unit.now() < began_s + 1800.0:
        steps.append(loop.step())
    assert "no_dilution" in told(steps)
