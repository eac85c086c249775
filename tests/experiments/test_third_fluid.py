"""A third fluid and an actuator of one's own, each commanded by a signal: dosed, booked, limited, resumed, refused."""

import json
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from envs.bench import Bench
from envs.plant.plant import Plant, PlantConfig
from envs.scenario import Scenario
from envs.task import EnvConfig
from experiments.cli import frame
from experiments.control import assemble
from experiments.laws import registry
from experiments.loop.loop import ClosedLoop
from experiments.loop.messages import NoActuator, PartMissing, WrongShape
from experiments.loop.signals import Findings
from hardware.actuator import FEED, SPARE, THERMOSTAT, Actuator
from hardware.chibio.dosing import SupplyConfig
from hardware.family import family_of
from hardware.pioreactor.config import PioreactorConfig
from hardware.pioreactor.doses import replay
from hardware.reactor import Command, Receipt
from hardware.safety.interlock import Interlock, kinds_of
from hardware.simulated import SimulatedConfig, SimulatedReactors
from tests.campaigns.rehearsal import Killed, Rehearsal, rehearsed
from tests.extensions.drug import Drug, StressConfig
from tests.hardware.emulator_lab import BIAS_S, quiet
from tests.hardware.pioreactor_lab import ALT_PIN, Lab

HOUR = Scenario((0.45,), (60.0,), (37.0,))
SOON = StressConfig(growth=0.012, gain=0.03, most=0.007, memory=3.0)
UNIT, FOURTH = PioreactorConfig(reactors=("M0",)), replace(SOON, pump="pump 4")


def drugged(**changes: Any) -> Any:
    made = rehearsed(["M0"], HOUR, controller="inverse")
    backend = replace(made.backend, supply=SupplyConfig(pump3_ml_s=0.7, bias_s=BIAS_S))
    return replace(made, **{"backend": backend, "signals": {"drug": SOON}, **changes})


def test_a_drug_is_given_while_growth_is_too_fast_booked_and_goes_on_after_a_kill_in_its_dose(tmp_path: Path) -> None:
    run = Rehearsal(tmp_path, drugged(), quiet(mu=0.025), od=0.45)
    run.begin()
    inner = run.device.submit

    def submit(method: str, path: str, *rest: Any) -> Any:
        exchange = inner(method, path, *rest)
        if path.startswith("/SetOutputOn/Pump3/1") and run.clock.now() > 25 * 60.0:
            run.device.submit = inner  # type: ignore[method-assign]
            run.clock.sleep(0.4)
            run.kill()
        return exchange

    run.device.submit = submit  # type: ignore[method-assign]
    with pytest.raises(Killed):
        for _ in run.run():
            pass
    run.close()
    run.wait(20.0)
    run.begin()
    drug = next(s for s in run.loop.signals if isinstance(s, Drug))
    resumed = drug.law._rate.copy()
    assert resumed[0] > 0.0
    steps = list(run.run())
    run.reactors.stop()
    vial = run.device.vials["M0"]
    given = [dose for dose in vial.doses if dose.pump == "Pump3"]
    true_ml = float(vial.plant.feed.delivered_ml[0]) + vial.supplied_ml["Pump3"]
    assert len(given) > 5
    assert float(run.loop.interlock.budget.fed_ml[0]) == pytest.approx(true_ml, rel=0.05, abs=0.1)
    assert vial.peak_ml < 23.5
    share = steps[-1].columns["drug"][0]
    assert 0.1 < share < 0.7  # of 20 mL, as replaced so often
    assert not any(run.truth("M0")["motors"].values())


def vials() -> SimulatedReactors:
    plant = PlantConfig(start_od=0.45, growth=replace(PlantConfig().growth, mu=0.025))
    reactors = SimulatedConfig(reactors=("M0", "M1"))
    return SimulatedReactors(Plant(plant, 2, np.random.default_rng(5), np.array([20.0, 14.0])), reactors)


def loop(reactors: SimulatedReactors, *signals: Any, actuators: Any = (FEED, THERMOSTAT, SPARE[3])) -> ClosedLoop:
    law = registry.build(registry.config("inverse"), model=EnvConfig())
    schedules = [HOUR, replace(HOUR, setpoints=(0.6,))]
    return ClosedLoop(reactors, law, Interlock(2), schedules, further=signals, actuators=actuators)


def test_a_resumed_run_gives_the_drug_that_one_without_a_pause_gives() -> None:
    def told(run: ClosedLoop, steps: int) -> list[Any]:
        found = [run.step() for _ in range(steps)]
        return [[s.pump.tolist(), s.volume_ml.tolist(), s.columns["drug"].tolist()] for s in found]  # type: ignore[union-attr]

    slow = replace(SOON, gain=0.004, memory=1.0)
    expected = told(loop(vials(), Drug(slow, [HOUR] * 2)), 55)
    reactors = vials()
    first = loop(reactors, Drug(slow, [HOUR] * 2))
    begun = told(first, 31)
    second = loop(reactors, Drug(slow, [HOUR] * 2))
    second.restore(json.loads(json.dumps(first.state())))
    assert begun + told(second, 24) == expected
    pumps = np.array([pump for pump, *_ in expected])
    assert set(pumps.ravel()) == {1, 3}
    assert (pumps[:, 0] != pumps[:, 1]).any()


def test_a_drug_on_the_alt_media_pump_of_a_pioreactor_goes_on_after_a_kill_in_its_dose(monkeypatch):
    first = Lab(monkeypatch, alt_media=True, speed=5.0, reading_s=1.0)
    world, config = first.world, first.reactors.config
    world.od_s = 1.0
    first.begin()

    def looped(lab: Lab) -> ClosedLoop:
        law = registry.build(registry.config("inverse"), model=EnvConfig())
        drug = Drug(replace(SOON, memory=1.0), [HOUR])
        actuators = family_of(config).actuators(config)
        return ClosedLoop(lab.reactors, law, Interlock(1), [HOUR], further=(drug,), actuators=actuators)

    def step(loop: ClosedLoop) -> Any:
        """A culture that grows by .025/min, diluted by both fluids."""
        fed_ml = world.truth["add_media"] + world.truth["add_alt_media"]
        minutes = 5.0 * (world.now() - 1000.0) / 60.0
        world.reading = 0.5 * float(np.exp(0.025 * minutes - fed_ml / 20.0))
        return loop.step()

    loop = looped(first)
    while step(loop).pump[0] != 3:
        assert world.now() < 2000.0
    first.until(lambda: ALT_PIN in world.since, 10.0)
    rows, state = list(first.rows), json.loads(json.dumps(loop.state()))
    assert (replay(rows)["pio01"].open, replay(rows)["pio01"].pump) == (True, 3)
    world.box = None
    world.sleep(0.4)
    again = Lab(monkeypatch, world, alt_media=True, speed=5.0, reading_s=1.0)
    again.rows = rows
    again.begin(replay(rows)["pio01"], rows[-1]["time_s"] + 2.0)
    loop = looped(again)
    loop.restore(state)
    pumps = [done.pump[0] for _ in range(12) if (done := step(loop)) is not None]
    again.until(lambda: not again.station.doses.running, 30.0)
    again.reactors.stop()
    again.book(loop.interlock.budget)
    assert set(pumps) == {1, 3}
    ids = [options["source-of-event"] for options in again.asked("add_alt_media")]
    assert len(ids) == len(set(ids)) > 2
    fed_ml = world.truth["add_media"] + world.truth["add_alt_media"]
    low, high = again.given()
    assert low - 0.1 <= fed_ml <= high + 0.1
    assert float(loop.interlock.budget.fed_ml[0]) == pytest.approx(high, abs=0.1)
    assert not world.since


class Lamp:
    """Asks for 140 % and for 30 %; an integral that nobody gets."""

    name, actuator, columns, memory, sees_light = "lamp", "lamp", ("lamp",), None, False

    def decide(self, sample: Any) -> Any:
        return np.array([140.0, 30.0])

    def find(self, sample: Any, given: Any) -> Findings:
        return Findings({"lamp": given})

    def dosed(self, volume_ml: Any, kept_ml: Any, pump: Any) -> None:
        assert pump.tolist() == [1, 1]


class Lit(SimulatedReactors):
    """Vials with a lamp each."""

    seen: list[float]

    def actuate(self, command: Command) -> Receipt:
        self.seen = command.targets["lamp"].tolist()
        return super().actuate(command)


def test_an_actuator_of_a_family_s_own_gets_its_command_cut_to_its_limits() -> None:
    plant = Plant(PlantConfig(), 2, np.random.default_rng(0))
    lit = Lit(plant, SimulatedConfig(reactors=("M0", "M1")))
    lamp = Actuator("lamp", "%", 0.0, 85.0)
    step = loop(lit, Lamp(), actuators=(FEED, lamp)).step()
    assert lit.seen == step.columns["lamp"].tolist() == [85.0, 30.0]
    assert [kinds_of(reason or "") for reason in step.reasons] == [["command_limit"], []]
    with pytest.raises(NoActuator) as error:
        loop(lit, Lamp())
    assert error.value.fields["known"].startswith("feed pump, thermostat, pump 3")


class Lone(Lamp):
    """Answers for one reactor, whatever there are."""

    def __init__(self, part: str) -> None:
        self.part = part

    def decide(self, sample: Any) -> Any:
        return np.zeros(1) if self.part == "decide" else super().decide(sample)

    def find(self, sample: Any, given: Any) -> Findings:
        return Findings(**{self.part: {"lamp": [1.0, 2.0, 3.0]}}) if self.part != "decide" else Findings()


@pytest.mark.parametrize(("part", "shape"), [("decide", (1,)), ("columns", (3,))])
def test_a_signal_that_answers_for_other_reactors_is_refused(part: str, shape: tuple[int]) -> None:
    plant = Plant(PlantConfig(), 2, np.random.default_rng(0))
    lit = Lit(plant, SimulatedConfig(reactors=("M0", "M1")))
    with pytest.raises(WrongShape) as error:
        loop(lit, Lone(part), actuators=(FEED, Actuator("lamp", "%", 0.0, 85.0))).step()
    assert (error.value.fields["shape"], error.value.fields["n"]) == (shape, 2)


def test_a_signal_without_a_part_is_refused() -> None:
    with pytest.raises(PartMissing) as error:
        loop(vials(), SimpleNamespace(name="lamp", actuator="", columns=()))
    assert error.value.fields == {"name": "lamp", "parts": "sees_light, decide, find, dosed, memory"}


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"backend": UNIT}, "signals.drug of M0: pump 3, the vendor's alt-media pump, has no tube"),
        ({"backend": UNIT, "signals": {"drug": FOURTH}}, "drug acts by the pump 4; these reactors have feed pump"),
        ({"signals": {"drug": FOURTH}}, "signals.drug of M0: Pump4 has no tube"),
        ({"bench": Bench(max_rate=0.005)}, "bench.max_rate = 0.005 mL/s: allowed .* beside signals.drug"),
        ({"scenario": replace(HOUR, outputs=("pump3 1 mL",))}, "signals.drug: pump 3 is in scenario.outputs, too"),
    ],
)
def test_what_cannot_give_it_is_refused_before_anything_begins(changes, said, tmp_path):
    with pytest.raises(frame.UserError, match=said):
        assemble.unpack(drugged(**changes), tmp_path)
