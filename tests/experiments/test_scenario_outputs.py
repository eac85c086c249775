"""What a step gives by a spare pump: how much, by whom, never twice, never two pumps at one time."""

import json
from collections.abc import Iterable
from contextlib import nullcontext
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from envs.bench import Bench
from envs.plant.plant import Plant, PlantConfig
from envs.scenario import Output, Scenario, outputs_of
from experiments.cli import frame
from experiments.control import assemble
from experiments.loop.loop import ClosedLoop
from experiments.loop.supply import Supply
from hardware import memory
from hardware.chibio.config import ChiBioConfig
from hardware.chibio.dosing import SupplyConfig
from hardware.chibio.overflow_pump import OverflowPumpConfig
from hardware.chibio.protocol import Permitted, check_command
from hardware.emulator.faults import inject
from hardware.errors import DeviceStateError
from hardware.safety.interlock import Interlock
from hardware.simulated import SimulatedConfig, SimulatedReactors
from hardware.storage.journal import read_journal
from tests.campaigns.rehearsal import Rehearsal, rehearsed
from tests.hardware.emulator_lab import BIAS_S, quiet

STEPS = Scenario((0.4, 0.4), (60.0, 20.0), (37.0, 37.0), outputs=("pump3 3 mL/h, pump4 1.5 mL", None))
FEEDS = ("Pump1", "Pump3", "Pump4")
Dose = tuple[float, int, int, float]


def test_outputs_are_read() -> None:
    assert outputs_of(None) == ()
    assert outputs_of("Pump3 2 mL/h, pump4 1.5 mL") == (Output(3, ml_h=2.0), Output(4, ml=1.5))
    assert STEPS.supplied == {3, 4}
    assert Scenario().supplied == Scenario(outputs=("",)).supplied == frozenset()
    with pytest.raises(ValueError, match="scenario.outputs = .*allowed"):
        Scenario(outputs=("LEDD 0.3",))


def steps(*outputs: str | None, first_min: float = 60.0) -> Scenario:
    """A step for each of these outputs."""
    n = len(outputs)
    return Scenario((0.4,) * n, (first_min, 60.0)[:n], (37.0,) * n, outputs=outputs)


def doses(supply: Supply, minutes: Iterable[float], phase: Any = 0, believed: Any = True) -> list[Dose]:
    """Doses (minute, reactor, pump, mL); phase, believed: of all reactors, of each, or by the minute."""
    found = []
    for minute in minutes:
        step, rows = (of(minute) if callable(of) else of for of in (phase, believed))
        at, step, rows = (np.broadcast_to(v, len(supply.owed_ml)) for v in (float(minute), step, rows))
        pump, ml = supply.due(at, step, rows)
        supply.given(pump, ml)
        found += [(minute, int(n), int(pump[n]), round(float(ml[n]), 6)) for n in np.flatnonzero(ml)]
    return found


SECOND_AT_3, SECOND_AT_4 = (lambda m: int(m >= 3)), (lambda m: int(m >= 4))
OWED: dict[str, tuple[list[Scenario], Iterable[float], Any, Any, list[Dose]]] = {
    "half a millilitre at a time": (
        [steps("pump3 2 mL/h")], range(61), 0, True, [(15 * k, 0, 3, 0.5) for k in (1, 2, 3, 4)],
    ),
    "a volume in equal parts of at most 1.2 mL": (
        [steps("pump4 1.5 mL"), steps("pump4 3 mL")], range(9), 0, True,
        [(0, 0, 4, 0.75), (0, 1, 4, 1.0), (1, 0, 4, 0.75), (1, 1, 4, 1.0), (2, 1, 4, 1.0)],
    ),
    "in a long pause 0.5 mL of five minutes beside 0.2 of two, and nothing of an earlier step": (
        [steps("pump3 6 mL/h", None, first_min=600.0)], [*range(3), *range(300, 305), *range(605, 620)],
        lambda m: int(m >= 605), True, [(300, 0, 3, 0.7)],
    ),
    "minutes without a reading, 2 to 4 of the second, are made up for in that reactor alone": (
        [steps("pump3 6 mL/h"), steps("pump4 3 mL/h")], range(13), 0, lambda m: [True, not 2 <= m <= 4],
        [(5, 0, 3, 0.5), (10, 0, 3, 0.5), (10, 1, 4, 0.5)],
    ),
    "a volume at the first believed reading of its step": (
        [steps("pump3 6 mL/h", "pump4 1 mL", first_min=3.0)] * 2, range(8), SECOND_AT_3,
        lambda m: [True, m not in (3, 4)], [(3, 0, 4, 1.0), (5, 1, 4, 1.0)],
    ),
    "of each its own step: 0.2 mL a minute from the fifth on, and 0.05": (
        [steps("pump3 6 mL/h", "pump4 12 mL/h", first_min=5.0), steps("pump3 3 mL/h")], range(21),
        lambda m: [int(m >= 5), 0], True,
        [(8, 0, 4, 0.6), (10, 1, 3, 0.5), *((m, 0, 4, 0.6) for m in (11, 14, 17, 20)), (20, 1, 3, 0.5)],
    ),
    "0.4 mL owed at a step's end are left out also where the next one gives by the same pump": (
        [steps("pump3 6 mL/h", "pump3 6 mL/h", first_min=4.0)], range(15), SECOND_AT_4, True,
        [(9, 0, 3, 0.5), (14, 0, 3, 0.5)],
    ),
    "of two pumps the one that owes more first": (
        [steps("pump3 0.6 mL, pump4 1.1 mL"), steps("pump3 1.1 mL, pump4 0.6 mL")], range(4), 0, True,
        [(0, 0, 4, 1.1), (0, 1, 3, 1.1), (1, 0, 3, 0.6), (1, 1, 4, 0.6)],
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", OWED)
def test_what_a_step_gives_by_a_spare_pump_is_owed_by_its_rate_or_volume(name: str) -> None:
    schedules, minutes, phase, believed, expected = OWED[name]
    assert sorted(doses(Supply(schedules, 1.2), minutes, phase, believed)) == sorted(expected)


def test_what_a_signal_asked_for_stays_owed_at_a_new_step_and_what_a_step_asked_for_does_not() -> None:
    """0.4 mL of each pump are owed when the second step begins, at which pump 4 gets 0.55 mL at once."""
    supply = Supply([steps("pump4 6 mL/h", "pump4 0.55 mL", first_min=5.0)], 1.2, asked=[3])
    supply.ask(3, np.array([6.0 / 3600.0]))
    assert doses(supply, range(6), SECOND_AT_4) == [(4, 0, 4, 0.55), (5, 0, 3, 0.5)]


def test_where_no_dose_may_be_decided_nothing_is_owed_or_given() -> None:
    supply = Supply([steps("pump4 1 mL")], 1.2)
    pump, ml = supply.due(np.array([np.nan]), np.array([-1]), np.array([False]))
    assert (pump[0], ml[0]) == (1, 0.0)
    assert doses(supply, range(2)) == [(0, 0, 4, 1.0)]


def config(schedule: Scenario = STEPS, **flows: float) -> Any:
    made = rehearsed(("M0",), schedule)
    supply = SupplyConfig(**({"pump3_ml_s": 1.0, "pump4_ml_s": 1.0} | flows))
    return replace(made, backend=replace(made.backend, supply=supply))


def whole(folder: Path, schedule: Scenario = STEPS, mu: float = 0.03, **flows: float) -> Rehearsal:
    run = Rehearsal(folder, config(schedule, **flows), quiet(mu=mu), od=0.4)
    run.begin()
    list(run.run())
    return run


def never_together(run: Rehearsal) -> None:
    """No two pumps that bring fluid in run at one time, and the waste pump runs whenever one of them does."""
    doses = sorted((d.start_s, d.start_s + d.seconds, d.pump) for d in run.device.vials["M0"].doses)
    feeds = [d for d in doses if d[2] in FEEDS]
    assert feeds
    assert all(end <= start for (_, end, _), (start, _, _) in pairwise(feeds))
    waste = [d for d in doses if d[2] == "Pump2"]
    assert all(any(a <= start and end <= b for a, b, _ in waste) for start, end, _ in feeds)


@pytest.mark.slow
def test_on_the_device_both_pumps_give_what_the_step_says_and_it_counts(tmp_path: Path) -> None:
    run = whole(tmp_path)
    vial = run.device.vials["M0"]
    never_together(run)
    doses = {pump: [d for d in vial.doses if d.pump == pump] for pump in FEEDS}
    assert (len(doses["Pump3"]), len(doses["Pump4"])) == (5, 2)  # 0.5 mL every 10 min, the sixth at the step's end
    by_hand = 3.0 - 0.5 + 5 * BIAS_S  # less than a dose is left out; the device runs so much longer, at 1 mL/s
    assert by_hand - 0.05 <= vial.supplied_ml["Pump3"] <= by_hand + 0.5
    assert vial.supplied_ml["Pump4"] == pytest.approx(1.5 + 2 * BIAS_S, abs=0.05)
    columns = {key: run.record.series(key)[0] for key in ("feed_pump", "volume_ml", "elapsed_min", "od")}
    for number, runs in ((3, 5), (4, 2)):
        mine = columns["feed_pump"] == number
        flowed = vial.supplied_ml[f"Pump{number}"] - runs * BIAS_S
        assert columns["volume_ml"][mine].sum() == pytest.approx(flowed, abs=0.01)
        assert columns["elapsed_min"][mine].max() < 60.0
    assert run.loop.interlock.budget.fed_ml[0] == pytest.approx(np.nansum(columns["volume_ml"]))
    assert columns["od"][10:] == pytest.approx(0.4, abs=0.03)  # the controller makes up for it
    assert "falls" not in run.record.rows[0].reasons
    assert vial.peak_ml < 21.5
    run.reactors.stop()
    assert not any(run.truth("M0")["motors"].values())


def test_a_dose_by_a_spare_pump_dilutes_as_much_as_one_by_the_feed(tmp_path: Path) -> None:
    """Without growth 3 mL into 20 mL at the tube: od exp(-3 / 20), in three doses that run 0.1 s longer."""
    schedule = Scenario((1.0,), (15.0,), (37.0,), outputs=("pump3 3 mL",))
    run = whole(tmp_path, schedule, 0.0)
    assert run.truth("M0")["od"] == pytest.approx(0.4 * np.exp(-3.3 / 20.0), rel=0.02)


REQUESTS = {  # what the program is killed at, in the first dose of 1 mL by Pump3 -> whether it was given
    "/SetOutputTarget/Pump3/M0/": False,
    "/SetOutputOn/Pump2/1/M0": False,
    "/SetOutputOn/Pump3/1/M0": True,
    "/SetOutputOn/Pump3/0/M0": True,
}
TWICE = Scenario((1.0, 1.0), (3.0, 40.0), (37.0, 37.0), outputs=(None, "pump3 2 mL"))


def cut(folder: Path, request: str, stops: bool = False) -> Rehearsal:
    """Nobody but Pump3 gives anything; the program is killed at a request, or stopped as on a signal."""
    run = Rehearsal(folder, config(TWICE), quiet(mu=0.005), od=0.4)
    run.begin()
    run.kill_at(request, lambda: bool(journal(run, "intent")), stops=stops)
    run.killed()
    return run


def journal(run: Rehearsal, kind: str) -> list[dict[str, Any]]:
    rows = read_journal(run.folder / "journal.jsonl")[0]
    return [row for row in rows if row["kind"] == kind and row.get("feed_pump") == "Pump3"]


@pytest.mark.parametrize("request_", REQUESTS)
@pytest.mark.parametrize("away_s", [5.0, pytest.param(200.0, marks=pytest.mark.slow)])
def test_a_kill_in_a_dose_never_gives_it_twice_and_what_flowed_is_booked(request_, away_s, tmp_path):
    """2 mL in two doses. One cut before its pump ran was not given; the device repeats one that ran every 63 s."""
    run = cut(tmp_path, request_)
    run.wait(away_s)
    run.begin()
    assert not any(run.truth("M0")["motors"].values())
    before = len([d for d in run.device.vials["M0"].doses if d.pump == "Pump3"])
    list(run.run())
    run.wait(10.0)
    vial = run.device.vials["M0"]
    samples = [tuple(row["sample"]) for row in journal(run, "intent")]
    assert len(set(samples)) == len(samples)
    runs = [d for d in vial.doses if d.pump == "Pump3"]
    repeats = 3 if request_ == "/SetOutputOn/Pump3/1/M0" and away_s > 63.0 else 0
    assert before == REQUESTS[request_] * (1 + repeats)
    assert len(runs) - repeats == (1 if repeats else 2)  # after three repetitions the step owes nothing any more
    booked = float(run.loop.interlock.budget.fed_ml[0])
    assert booked == pytest.approx(vial.supplied_ml["Pump3"], abs=0.12 * len(runs) + 0.01)
    assert booked >= 2.0 - 0.01
    assert vial.peak_ml < 23.5
    assert not any(run.truth("M0")["motors"].values())
    never_together(run)


def test_a_stop_in_a_dose_switches_its_pump_off_verified(tmp_path: Path) -> None:
    run = cut(tmp_path, "/SetOutputOn/Pump3/1/M0", stops=True)
    run.wait(130.0)
    assert not any(run.truth("M0")["motors"].values())
    assert len([d for d in run.device.vials["M0"].doses if d.pump == "Pump3"]) == 1
    assert run.device.apps["M0"].data["Pump3"]["ON"] == 0


def test_what_the_interlock_holds_is_held_for_a_spare_pump_too(tmp_path: Path) -> None:
    """A dead spectrometer: no dose while it lasts, and the step's volume afterwards."""
    run = Rehearsal(tmp_path, config(TWICE), quiet(mu=0.005), od=0.4)
    run.begin()
    inject(run.device, "spectrometer_dead", "M0", 1)
    list(run.run(600.0))
    assert run.device.vials["M0"].supplied_ml["Pump3"] == 0.0
    inject(run.device, "spectrometer_dead", "M0", 0)
    list(run.run())
    assert run.device.vials["M0"].supplied_ml["Pump3"] == pytest.approx(2.0, abs=0.25)


def test_a_saved_state_goes_on() -> None:
    first, second = (Supply([steps("pump3 2 mL/h")], 1.2) for _ in range(2))
    doses(first, range(10))
    memory.restore_rows(second, json.loads(json.dumps(memory.rows(first))), "supply")
    assert doses(second, range(10, 16)) == [(15, 0, 3, 0.5)]


def test_a_pump_without_a_tube_is_refused_before_anything_begins(tmp_path: Path) -> None:
    weak = config()
    slow = replace(weak, backend=SimulatedConfig(), bench=Bench(period_s=900.0))
    for given, said in (
        (config(pump4_ml_s=0.0), "Pump4 has no tube; .*backend.supply.pump4_ml_s"),
        (replace(weak, bench=Bench(max_rate=0.005)), r"bench.max_rate = 0.005 mL/s: allowed 0.0167 mL/s or more"),
        (replace(weak, bench=Bench(period_s=75.0)), r"bench.period_s = 75 s: allowed 60"),
        (slow, r"bench.period_s = 900 s: allowed at most"),
        (config(pump4_ml_s=0.2), r"pump4_ml_s: Pump4 gives at most 0.63 mL a dose"),
    ):
        with pytest.raises(frame.UserError, match=said):
            assemble.unpack(given, tmp_path)
    with pytest.raises(ValueError, match="backend.supply = Pump3: allowed another pump"):
        ChiBioConfig(overflow_pump=OverflowPumpConfig("Pump3"), supply=SupplyConfig(pump3_ml_s=1.0))
    for flow, bias in ((2.0, 0.0), (0.1, 0.0), (1.5, 0.1)):  # the last would owe half a millilitre for ever
        with pytest.raises(ValueError, match=f"backend.supply.pump3_ml_s = {flow:g}"):
            SupplyConfig(pump3_ml_s=flow, bias_s=bias)


def test_the_declared_bias_is_taken_off_a_dose(tmp_path: Path) -> None:
    run = whole(tmp_path, Scenario((1.0,), (8.0,), (37.0,), outputs=("pump3 2 mL",)), bias_s=BIAS_S)
    assert run.device.vials["M0"].supplied_ml["Pump3"] == pytest.approx(2.0, abs=0.01)


@pytest.mark.parametrize(
    ("path", "allowed"),
    [
        ("Target/Pump3/M0/0.050000", True), ("On/Pump3/1/M0", True), ("Target/Pump3/M0/0.060000", False),
        ("Target/Pump4/M0/0.010000", False), ("On/Pump4/1/M0", False), ("On/Pump3/2/M0", False),
    ],
)  # fmt: skip
def test_the_last_gate_lets_only_declared_pumps_pass_and_only_small_doses(path: str, allowed: bool) -> None:
    for declared in (("Pump3",), ()):
        let = nullcontext() if allowed and declared else pytest.raises(DeviceStateError, match="refused")
        with let:
            check_command(f"/SetOutput{path}", Permitted(("M0",), supply_pumps=declared))


class Still:
    """Asks for nothing."""

    def reset(self, n: int) -> None:
        """Nothing to forget."""

    def act(self, od: np.ndarray, setpoint: np.ndarray, minute: np.ndarray, rows: np.ndarray) -> np.ndarray:
        return np.zeros(od.shape)


@pytest.mark.parametrize("period_min", [1.0, 2.0])
def test_in_a_simulation_it_dilutes_too_each_reactor_by_its_own_schedule(period_min: float) -> None:
    with_it = Scenario((0.5,), (30.0,), (37.0,), outputs=("pump3 2 mL",))
    plant = PlantConfig(start_od=0.4, growth=replace(PlantConfig().growth, mu=0.0))
    vials, both = Plant(plant, 2, np.random.default_rng(0)), SimulatedConfig(reactors=("M0", "M1"))
    reactors, bench = SimulatedReactors(vials, both, period_min), Bench(period_s=60.0 * period_min)
    loop = ClosedLoop(reactors, Still(), Interlock(2, bench=bench), [with_it, replace(with_it, outputs=())])
    list(loop.run())
    np.testing.assert_allclose(reactors.plant.culture.od, [0.4 * np.exp(-2.0 / 20.0), 0.4], rtol=0.005)
