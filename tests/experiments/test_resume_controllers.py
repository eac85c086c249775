"""A run that is stopped or killed and resumed: its controller decides what one that never stopped decides."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from conf import presets
from conf.schema import build
from envs.plant.plant import Plant, PlantConfig
from envs.scenario import Scenario
from envs.task import EnvConfig
from experiments.certification import certificate
from experiments.cli import files
from experiments.control.policies import find_policy, load_policy
from experiments.laws import registry
from experiments.laws.base import Array, Controller, Mask
from experiments.laws.density import estimators
from experiments.laws.density.learned import settings
from experiments.loop.loop import ClosedLoop, Step
from experiments.loop.signals import AIM
from experiments.record.recovery import load_state
from hardware.reactor import Receipt
from hardware.safety.interlock import Interlock
from hardware.simulated import SimulatedConfig, SimulatedReactors
from hardware.storage.journal import read_journal
from tests.campaigns.rehearsal import Rehearsal, rehearsed
from tests.extensions import ekf  # noqa: F401  (registers its estimator)
from tests.hardware.emulator_lab import quiet

pytestmark = pytest.mark.numeric

NAMES = ("M0", "M1", "M2")
KINDS = ("pi", "pi_tuned", "mpc", "inverse", "dqn", "threshold", "gain_scheduled", "inverse ekf", "dqn ekf")
SCHEDULE = Scenario((0.5, 0.35), (20.0, 40.0), (37.0, 30.0), recovery_od=0.5, announce_min="auto")
LENGTH, CUTS = 44, (19, 26)  # before and after an announced change of two of the vials
HOLD = Scenario((0.5,), (600.0,), (37.0,))
REQUESTS = {  # what a program is killed at -> whether the dose under way was given
    "/SetOutputTarget/Pump1/M0/": False,
    "/SetOutputOn/Pump2/1/M0": False,
    "/SetOutputOn/Pump1/1/M0": True,
    "/SetOutputOn/Pump1/0/M0": True,
}


def controller(kind: str) -> Controller:
    law, _, estimator = kind.partition(" ")
    config = registry.config(law)
    if estimator:
        believed = {"kind": estimator} if law == "dqn" else estimators.config_at(estimator)
        config = replace(config, estimator=believed)
    if kind == "threshold":
        config = type(config)(hysteresis=0.05)
    policy = load_policy("shipped", 1.0, 0.02)
    bounds = certificate.bounds(policy, settings(policy), find_policy("shipped"), EnvConfig())
    assert bounds is not None
    return registry.build(config, model=EnvConfig(), policy=policy, bounds=bounds)


def vials() -> SimulatedReactors:
    """Three vials, each with its own growth, pump and optics, whose doses and readings scatter."""
    plant = build(PlantConfig(start_od=0.45), presets.load("plant/bench"), "plant")
    return SimulatedReactors(Plant(plant, 3, np.random.default_rng(3)), SimulatedConfig(reactors=NAMES))


def loop(kind: str, reactors: SimulatedReactors) -> ClosedLoop:
    return ClosedLoop(reactors, controller(kind), Interlock(len(NAMES)), SCHEDULE)


def decisions(steps: list[Step]) -> list[list[float]]:
    return [step.proposed.tolist() for step in steps]


def cut_and_continued(kind: str, folder: Path, forgets: bool = False) -> list[Step]:
    """`LENGTH` steps; after each cut they are of another loop, which got the former one's state by way of its file."""
    reactors, steps = vials(), list[Step]()
    running = loop(kind, reactors)
    for cut in CUTS:
        steps += [running.step() for _ in range(cut - len(steps))]
        files.write_json(folder / "state.json", {"journal_row": 0, **running.state()}, False, indent=None)
        running, state = loop(kind, reactors), load_state(folder / "state.json")
        if forgets:
            state["controller"] = running.state()["controller"]
        running.restore(state)
    return steps + [running.step() for _ in range(LENGTH - len(steps))]


@pytest.fixture(scope="module")
def uninterrupted() -> dict[str, list[Step]]:
    found = {}
    for kind in KINDS:
        whole = loop(kind, vials())
        found[kind] = [whole.step() for _ in range(LENGTH)]
    return found


@pytest.mark.parametrize("kind", KINDS)
def test_a_resumed_run_decides_what_one_without_a_pause_decides(kind, uninterrupted, tmp_path):
    whole, continued = uninterrupted[kind], cut_and_continued(kind, tmp_path)
    assert decisions(continued) == decisions(whole)
    assert len({rate for rates in decisions(whole[CUTS[0] :]) for rate in rates}) > (1 if kind == "threshold" else 3)
    for one, other in zip(whole, continued, strict=True):
        assert one.columns[AIM].tolist() == other.columns[AIM].tolist()
        for key, value in one.explanation.items():
            np.testing.assert_array_equal(value, other.explanation[key], key)


@pytest.mark.parametrize("kind", KINDS)
def test_without_its_memory_it_decides_something_else(kind, uninterrupted, tmp_path):
    cold = cut_and_continued(kind, tmp_path, forgets=True)
    assert decisions(cold)[: CUTS[0]] == decisions(uninterrupted[kind])[: CUTS[0]]
    assert decisions(cold) != decisions(uninterrupted[kind])


class Counting:
    """Asks for a fixed rate, and remembers how much it was told was dosed."""

    remembers = ("told",)

    def __init__(self, rate: float) -> None:
        self.rate, self.told = rate, np.zeros(1)

    def reset(self, n: int) -> None:
        self.told = np.zeros(n)

    def act(self, od: Array, setpoint: Array, minute: Array, rows: Mask) -> Array:
        return np.full(od.shape, self.rate)

    def dosed(self, volume_ml: Array) -> None:
        self.told = self.told + volume_ml


class Cut(Rehearsal):
    """One reactor at a fixed rate; the program is killed at a request of the dose after minute 6, and resumed."""

    def __init__(self, folder: Path, request: str, rate: float, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setattr(registry, "build", lambda *_, **__: Counting(rate))
        super().__init__(folder, rehearsed(("M0",), HOLD), quiet(mu=0.03), od=0.8)
        self.begin()
        list(self.run(360.0))
        self.kill_at(request, after_s=0.3)
        self.killed(900.0)

    def told_ml(self) -> float:
        law = self.loop.density.law
        assert isinstance(law, Counting)
        return float(law.told[0])

    def asked_ml(self) -> float:
        """By every decision that came to a dose or was put off."""
        rows = read_journal(self.folder / "journal.jsonl")[0]
        return sum(60.0 * row["rate"] for row in rows if row["kind"] == "intent")

    def put_off_ml(self) -> float:
        return float(self.reactors.stations[0].doses.carry_ml)


@pytest.mark.parametrize("request_", REQUESTS)
@pytest.mark.parametrize(("away_s", "again"), [(0.0, False), pytest.param(400.0, True, marks=pytest.mark.slow)])
def test_a_dose_that_a_kill_interrupted_is_told_once_with_what_the_device_repeated(
    request_: str, again: bool, away_s: float, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """again: it dies once more before its first sample. away_s: a pump left on repeats its dose every 63 s."""
    run = Cut(tmp_path, request_, 0.02, monkeypatch)
    run.wait(away_s)
    for _ in range(1 + again):
        run.begin()
        run.close()
    run.begin()
    list(run.run(run.clock.now() + 240.0))
    run.wait(5.0)
    fed_ml = float(run.truth("M0")["feed_ml"])
    assert run.told_ml() == pytest.approx(float(run.loop.interlock.budget.fed_ml[0]), abs=1e-6)
    assert run.told_ml() == pytest.approx(fed_ml, abs=1.0)  # a dose is 1.2 mL; one cut short counts whole
    run.close()


@pytest.mark.parametrize("request_", REQUESTS)
def test_what_is_put_off_is_told_once_across_a_kill(request_, tmp_path, monkeypatch):
    """0.24 mL are less than the pump can deliver: every second dose gives them together."""
    run = Cut(tmp_path, request_, 0.004, monkeypatch)
    run.begin()
    assert run.told_ml() == pytest.approx(run.asked_ml() - (0.0 if REQUESTS[request_] else 0.48), abs=1e-3)
    list(run.run(run.clock.now() + 240.0))
    assert run.told_ml() == pytest.approx(float(run.loop.interlock.budget.fed_ml[0]) + run.put_off_ml(), abs=1e-3)
    run.close()


def test_after_a_kill_an_open_dose_counts_when_it_was_given(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Killed in minute 6 and resumed 400 s later; a budget of an hour or a day must not have the dose as of now."""
    booked, book = list[float](), ClosedLoop.book

    def noted(loop: ClosedLoop, receipt: Receipt, at_s: float, pump: NDArray[np.intp]) -> None:
        booked.append(at_s)
        book(loop, receipt, at_s, pump)

    run = Cut(tmp_path, next(name for name, given in REQUESTS.items() if given), 0.02, monkeypatch)
    run.wait(400.0)
    monkeypatch.setattr(ClosedLoop, "book", noted)
    run.begin()
    assert 300.0 < min(booked) < 450.0
    run.close()
