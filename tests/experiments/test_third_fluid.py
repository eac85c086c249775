"""A third fluid, an actuator, a signal and a family of reactors of one's own: commanded, booked, resumed, refused."""

import csv
import importlib.util
import json
import sys
from collections.abc import Iterator
from dataclasses import replace
from datetime import datetime
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from conf import presets
from conf.messages import NameTaken
from dqn import policy as policies
from envs.bench import Bench
from envs.plant.plant import Plant, PlantConfig
from envs.scenario import Scenario
from envs.task import EnvConfig
from experiments.cli import frame
from experiments.coculture.signal import COLUMNS
from experiments.control import assemble
from experiments.control import run as control
from experiments.control.assemble import unpack
from experiments.control.timetable import timetable
from experiments.deploy import main
from experiments.laws import registry
from experiments.loop import signals
from experiments.loop.loop import ClosedLoop
from experiments.loop.messages import NoActuator, PartMissing, WrongShape
from experiments.loop.signals import Findings
from experiments.record.recovery import COLUMNS as USUAL
from experiments.training import agents, tasks
from hardware import family
from hardware.actuator import FEED, SPARE, THERMOSTAT, Actuator
from hardware.chibio.dosing import SupplyConfig
from hardware.family import family_of
from hardware.pioreactor.config import PioreactorConfig
from hardware.pioreactor.doses import replay
from hardware.reactor import Command, Receipt
from hardware.safety.interlock import Interlock, kinds_of
from hardware.simulated import SimulatedConfig, SimulatedReactors
from hardware.storage.journal import read_journal
from tests.campaigns.rehearsal import Killed, Rehearsal, rehearsed
from tests.evolver_stub import VIALS, EvolverStub
from tests.experiments import laws
from tests.experiments.test_composition_deploy import rows
from tests.extensions import light
from tests.extensions.drug import Drug, StressConfig
from tests.hardware.emulator_lab import BIAS_S, quiet
from tests.hardware.pioreactor_lab import ALT_PIN, Lab
from tests.programs import ROOT, Program, run

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
    forgetful = Lone("decide")
    forgetful.memory = SimpleNamespace(law=1.0)
    with pytest.raises(PartMissing) as error:
        loop(vials(), forgetful)
    assert error.value.fields["parts"] == "memory.remembers"


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"backend": UNIT}, "signals.drug of M0: pump 3, the vendor's alt-media pump, has no tube"),
        ({"backend": UNIT, "signals": {"drug": FOURTH}}, "drug needs the pump 4: .* use feed pump"),
        ({"signals": {"drug": FOURTH}}, "signals.drug of M0: Pump4 has no tube"),
        ({"bench": Bench(max_rate=0.005)}, "bench.max_rate = 0.005 mL/s: allowed .* with signals.drug"),
        ({"scenario": replace(HOUR, outputs=("pump3 1 mL",))}, "signals.drug: pump 3 is in scenario.outputs, too"),
    ],
)
def test_what_cannot_give_it_is_refused_before_anything_begins(changes, said, tmp_path):
    with pytest.raises(frame.UserError, match=said):
        assemble.unpack(drugged(**changes), tmp_path)


DRIVER = ROOT / "tests" / "evolver.py"
AWAY = "http://127.0.0.1:9"


@pytest.fixture
def known(monkeypatch: pytest.MonkeyPatch) -> None:
    """The driver's file is loaded, as by `extend=`, and forgotten afterwards."""
    monkeypatch.setattr(presets, "_added", dict(presets._added))
    monkeypatch.setattr(family, "_loaded", dict(family._loaded))
    spec = importlib.util.spec_from_file_location("evolver_of_the_tests", DRIVER)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    monkeypatch.setitem(sys.modules, spec.name, module)
    spec.loader.exec_module(module)


@pytest.fixture
def device() -> Iterator[EvolverStub]:
    with EvolverStub() as stub:
        yield stub


def words(url: str, *more: str) -> list[str]:
    hold = ["scenario=hold", "scenario.setpoints=[0.5]", "scenario.minutes=[25]", "fsync=false"]
    return ["backend=evolver", f"backend.url={url}", "controller=pi", *hold, *more]


def looked_at(url: str, folder: Path) -> None:
    assemble.run_preflight(assemble.unpack(main.config(words(url, "preflight_only=true")), folder), folder)


def test_its_preflight_samples_every_vial_and_fails_where_a_pump_runs_on_or_the_server_is_away(
    known: None, device: EvolverStub, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    with caplog.at_level("INFO"):
        looked_at(device.url, tmp_path)
    said = [record.getMessage() for record in caplog.records]
    assert sum("pass  v" in line and " sample: OD 0." in line for line in said) == VIALS
    assert said.count("pass  v3 pumps: verified off") == 1
    assert not device.fed_ml.any()
    device.stuck = {3}
    away = rf"1 of 1 checks failed, the first: FAIL  reactors: no answer from {AWAY}/off .*check cable"
    for url, words in ((device.url, "FAIL  reactors: v3: pumps still on; switch them off by hand"), (AWAY, away)):
        with pytest.raises(frame.UserError, match=words):
            looked_at(url, tmp_path)


@pytest.mark.parametrize(
    ("given", "refusal"),
    [
        (["scenario.ratios=[0.5]", "scenario.temperatures=[33]"], "backend=evolver measures no fluorescence"),
        (["scenario.outputs=['pump3 2 mL/h']"], "scenario.outputs: backend=evolver has no spare pump [34]; remove it"),
        (["at_end=regulate"], "at_end = regulate: backend=evolver has no regulation of its own; allowed hold, stop"),
        (["controller=oracle"], "controller=oracle needs the exact state of a simulated plant"),
        (["backend.reactors=[a,b]"], "backend.reactors = .*: allowed 16 different names"),
        (["plant_file=twin.yaml"], "backend.kind = evolver: allowed sim with plant_file"),
    ],
)
def test_what_it_cannot_do_is_refused(known: None, tmp_path: Path, given: list[str], refusal: str) -> None:
    with pytest.raises(frame.UserError, match=refusal):
        assemble.unpack(assemble.completed(main.config(words(AWAY, *given))), tmp_path)
    assert not (tmp_path / "policy.npz").exists()


def test_a_culture_is_at_stake(known: None, tmp_path: Path) -> None:
    policies.save(tmp_path / "policy.npz", laws.law())
    poor = ["controller=dqn", f"policy={tmp_path / 'policy.npz'}"]
    with pytest.raises(frame.UserError, match="policy refused: .*force_policy=true"):
        assemble.unpack(main.config(words(AWAY, *poor)), tmp_path)
    assert assemble.unpack(main.config(words(AWAY, *poor, "force_policy=true")), tmp_path).policy is not None


def test_its_dry_run_says_where_it_is(known: None) -> None:
    text = timetable(main.config(words(AWAY)), "HERE", datetime(2026, 3, 2, 12, 0))
    assert f"backend evolver ({AWAY}), reactors v0, v1" in text
    assert text.count("bench.bottle_ml=2000 is sufficient") == VIALS


def fed(run: Path) -> np.ndarray[Any, Any]:
    """What the recordings say that each vial got, mL."""
    found = []
    for n in range(VIALS):
        with open(run / f"recordings/v{n}.csv", newline="", encoding="utf-8") as f:
            found.append(sum(float(row["volume_ml"]) for row in csv.DictReader(f)))
    return np.array(found)


def test_a_run_is_killed_in_a_dose_and_goes_on(device: EvolverStub, tmp_path: Path) -> None:
    """A dose that was given and not answered is counted once, none is given twice, and all sixteen are held."""
    device.hold_at = "15"
    given = "experiments.deploy", f"extend={DRIVER}", *words(device.url), "hydra.run.dir=here"
    with Program(*given, cwd=tmp_path, out=tmp_path / "out", WITHOUT_FIGURES="1") as first:
        assert device.held.wait(120.0), first.said()
    device.go.set()
    done = run("experiments.deploy", "resume=here", cwd=tmp_path, WITHOUT_FIGURES="1")
    assert done.returncode == 0, done.stderr + done.stdout
    summary = json.loads((tmp_path / "here/summary.json").read_text())
    assert summary["outcome"] == "completed"
    assert len(summary["reactors"]) == VIALS
    np.testing.assert_allclose(fed(tmp_path / "here"), device.fed_ml, rtol=1e-9)
    assert device.fed_ml.min() > 1.0
    intents = [row for row in read_journal(tmp_path / "here/journal.jsonl")[0] if row["kind"] == "intent"]
    assert len({(row["id"], row["reactor"]) for row in intents}) == len(intents)
    assert max(w["steady_abs_error"] for w in summary["windows"]) < 0.05


HOLD = ("plant=coculture", "scenario=hold", "scenario.setpoints=[0.5]", "scenario.temperatures=[33.2]")
WORDS = (*HOLD, "scenario.recovery_od=0", "scenario.minutes=[300]", "fsync=false")
LIGHT = ("signals.light.kind=integral", "signals.light.setpoint=1400")
SCHEDULE = Scenario((0.5,), (80.0,), (33.2,))


@pytest.mark.slow
def test_it_is_recorded_warned_of_summed_up_and_saved(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    with caplog.at_level("WARNING"):
        control.deploy(main.config([*WORDS, *LIGHT]), tmp_path)
    found = rows(tmp_path)
    minute, mean = (np.array([float(row[key]) for row in found]) for key in ("elapsed_min", "light"))
    assert {row["light_setpoint"] for row in found} == {"1400.0"}
    assert np.abs(mean[minute > 150.0] - 1400.0).mean() < 80.0  # it begins at 1786
    assert {kind for row in found for kind in kinds_of(row["interlock"])} == {"light_far"}
    assert any("light_far" in r.getMessage() and "1786" in r.getMessage() for r in caplog.records)
    summary = json.loads((tmp_path / "summary.json").read_text(encoding="utf-8"))
    (window,), told = summary["windows"], summary["reactors"]["M0"]["reasons"]
    inside = minute < 300.0
    assert window["light_setpoint"] == 1400.0
    assert window["light_abs_error_mean"] == pytest.approx(np.abs(mean[inside] - 1400.0).mean())
    assert window["light_abs_error_last2h"] < window["light_abs_error_mean"]
    assert window["od_abs_error_mean"] < 0.02
    assert "ratio_setpoint" not in window
    assert told["light_far"]["first_min"] == 0.0
    state = json.loads((tmp_path / "state.json").read_text(encoding="utf-8"))
    assert state["light"]["mean"] == [mean[-1]]
    assert state["light"]["law"]["integral"] != [0.0]
    decided = [json.loads(line) for line in (tmp_path / "journal.jsonl").read_text().splitlines()]
    assert all("thermostat_degc" in row["why"] for row in decided if row["kind"] == "decision")


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (("signals.light.kind=pid",), "signals.light.kind = pid: allowed integral"),
        (("signals.dark.kind=integral",), "signals.dark.kind = integral: allowed "),
        ((*LIGHT, "scenario.ratios=[0.5]"), "composition and light both use the thermostat"),
    ],
)
def test_what_does_not_fit_is_one_line(words: tuple[str, ...], said: str, tmp_path: Path) -> None:
    with pytest.raises((frame.UserError, ValueError), match=said.replace("[", r"\[")) as caught:
        control.deploy(main.config([*WORDS, *words]), tmp_path)
    assert "\n" not in str(caught.value)


def test_the_columns_of_every_signal_follow_one_another(tmp_path: Path) -> None:
    setup = unpack(main.config([*WORDS, *LIGHT]), tmp_path)
    assert setup.columns == (*USUAL, "light", "light_setpoint")
    shares = main.config(["plant=coculture", "scenario=ratio_steps", "composition=pi"])
    assert unpack(shares, tmp_path).columns == (*USUAL, *COLUMNS, "true_ratio")


def test_names_and_actuators_are_used_once() -> None:
    with pytest.raises(NameTaken):
        signals.add("light", light.Light)
    with pytest.raises(NameTaken):
        signals.add("interlock", light.Light)
    held = [signals.made("light", light.IntegralConfig(), [SCHEDULE]) for _ in range(2)]
    with pytest.raises(ValueError, match="light and light both use"):
        signals.fitting(held, [THERMOSTAT])
    with pytest.raises(NameTaken):
        agents.add("dqn", type("Other", (), {}), Any, (), "Nothing.")  # type: ignore[arg-type]
    with pytest.raises(NameTaken):
        tasks.add("density", type("Other", (), {}), Any, "Nothing.")  # type: ignore[arg-type]
    with pytest.raises(ValueError, match=r"signals\.dark: .*use one of light"):
        signals.made("dark", None, [SCHEDULE])
