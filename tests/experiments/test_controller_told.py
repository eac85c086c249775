"""What the loop tells a controller: readings that the interlock believes, and what was really dosed."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import pytest

from envs.bench import Bench
from envs.scenario import Scenario
from experiments.laws.base import Array, Mask
from experiments.loop.loop import ClosedLoop
from experiments.loop.signals import Density, Sample
from hardware.emulator.device import DeviceOptions
from hardware.emulator.vial import VialConfig
from hardware.reactor import Command, Measurement, Receipt
from hardware.safety.config import Response, SafetyConfig
from hardware.safety.interlock import Interlock, Ruling
from tests.hardware.driver_lab import DriverLab, Law

QUIET = DeviceOptions(vial=VialConfig(outlier_rate=0.0))


@dataclass
class Call:
    """What a controller was shown once."""

    od: float
    row: bool
    minute: float


class Listening(Law):
    """Remembers what it is shown of the first reactor, and what it is told was dosed there."""

    def __init__(self, rate: float | None = None) -> None:
        self.rate, self.calls, self.told = rate, list[Call](), 0.0

    def act(self, od: Array, setpoint: Array, minute: Array, rows: Mask) -> Array:
        self.calls.append(Call(float(od[0]), bool(rows[0]), float(minute[0])))
        return super().act(od, setpoint, minute, rows)

    def dosed(self, volume_ml: Array) -> None:
        self.told += float(volume_ml[0])


def begun(od: float, scenario: Scenario, rate: float | None = None) -> tuple[DriverLab, Listening]:
    lab, law = DriverLab(od=od, options=QUIET, scenario=scenario), Listening(rate)
    lab.loop.density.law = law
    lab.reactors.begin()
    return lab, law


def jump(lab: DriverLab) -> None:
    """The next reading is 0.3 too high; up to that."""
    lab.fault("od_jump", 0.3)
    while not lab.step().rows[0]:
        pass
    assert "jump" in str(lab.steps[-1].reasons[0])
    assert lab.steps[-1].od[0] > 0.85


def test_a_reading_that_is_not_believed_begins_no_schedule_and_is_not_shown() -> None:
    lab, law = begun(0.6, Scenario((0.8,), (600.0,), (37.0,), recovery_od=0.8))
    lab.run(4)
    jump(lab)
    assert np.isnan(lab.loop.began[0])
    while np.isnan(lab.loop.began[0]):
        lab.step()
    assert lab.truth()["od"] == pytest.approx(0.8, abs=0.02)
    assert not any(call.row for call in law.calls[:-1])
    assert law.calls[-1].row
    lab.run(4)
    jump(lab)
    assert np.isnan(law.calls[-1].od)
    assert not law.calls[-1].row
    assert lab.steps[-1].proposed[0] == 0.0
    lab.run(2)
    assert law.calls[-1].row
    assert all(call.od < 0.87 for call in law.calls if call.row)


@pytest.mark.parametrize(
    ("looks", "then"),
    [(0, "kept for the next dose"), (1, "no dose: "), (4, "no dose: ")],
    ids=["put off", "late", "later"],
)
def test_a_controller_is_told_what_was_given_put_off_refused_and_repeated(looks: int, then: str) -> None:
    """looks: at a silent device, by so many the link is back later, so that a sample is seen in time or too late."""
    lab, law = begun(0.5, Scenario((0.5,), (600.0,), (37.0,)), rate=0.004)
    lab.run(12)  # 0.24 mL are less than the pump can deliver: every second dose gives them together
    asked_ml = 60.0 * sum(step.rate[0] for step in lab.steps if step.rows[0])
    assert law.told == pytest.approx(asked_ml, abs=1e-3)
    assert 0.0 < lab.fed[0] < asked_ml
    while lab.steps[-1].volume_ml[0] == 0.0:
        lab.step()
    lab.fault("lost_request", -1.0)  # in the middle of a dose, which the device repeats
    doses = lab.loop.reactors.stations[0].doses  # type: ignore[attr-defined]
    before_ml, fed_ml, carry_ml = law.told, lab.fed[0], doses.carry_ml
    lab.run(20)
    assert law.told == before_ml
    for _ in range(looks):
        lab.step()
    lab.fault("lost_request", 0.0)
    while not lab.step().rows[0]:
        pass
    assert law.told - before_ml == pytest.approx(lab.fed[0] - fed_ml + doses.carry_ml - carry_ml, abs=1e-3)
    assert law.told - before_ml > 15 * 0.45
    assert then in str(lab.steps[-1].notes)
    assert lab.steps[-1].rate[0] > 0.0
    assert doses.carry_ml == pytest.approx(0.0 if "no dose" in then else 0.24)


class Turns:
    """Two reactors by the script: minute and OD of the one that is sampled; `warm`: of both, degC. Commands are kept.

    Attributes: again: minute -> what the devices dosed by themselves since the sample before.
    """

    names = ("M0", "M1")
    handed_over = np.zeros(2, dtype=bool)

    def __init__(self, *script: tuple[float, float | None, float | None], warm: tuple[float, float] = (37.0, 37.0)):
        self.script, self.warm, self.commands, self.levels = list(script), np.array(warm), [], []
        self.again: dict[float, Receipt] = {}
        self.at = -1

    def measure(self) -> Measurement:
        self.at += 1
        minute, *od = self.script[self.at]
        fresh = np.array([value is not None for value in od])
        readings = np.array([np.nan if value is None else value for value in od])
        return Measurement(np.full(2, 60.0 * minute), readings, self.warm, fresh)

    def elapsed(self) -> float:
        return 60.0 * self.script[self.at][0]

    def actuate(self, command: Command) -> Receipt:
        self.commands.append(command)
        return Receipt(np.where(command.rows, 60.0 * command.pump_rate, 0.0))

    def repeated(self) -> list[tuple[float, Receipt]]:
        told = self.again.pop(self.script[self.at][0], None)
        return [] if told is None else [(self.elapsed() - 20.0, told)]

    def heat_off(self, rows: Mask) -> list[str]:
        return [f"{name}: cold" for name, row in zip(self.names, rows, strict=True) if row]

    def set_level(self, n: int, level_ml: float) -> None:
        self.levels.append((n, level_ml))


class Shown(Law):
    """Doses 2 and 3 uL/s, and keeps all that it is shown and told."""

    def __init__(self) -> None:
        self.acts, self.watches, self.told = [], [], []

    def watch(self, od: Array, temperature: Array, minute: Array, rows: Mask) -> None:
        self.watches.append((temperature.tolist(), rows.tolist()))

    def act(self, od: Array, setpoint: Array, minute: Array, rows: Mask) -> Array:
        self.acts.append((setpoint.tolist(), minute.tolist(), rows.tolist()))
        return np.array([0.002, 0.003])

    def dosed(self, volume_ml: Array) -> None:
        self.told.append(volume_ml.tolist())


def turns(reactors: Turns, *schedules: Scenario, at_end: Sequence[str] = ("hold", "hold")) -> tuple[ClosedLoop, Shown]:
    law = Shown()
    return ClosedLoop(reactors, law, Interlock(2), schedules, at_end=at_end), law


def test_reactors_sampled_in_turn_are_asked_for_and_dosed_by_their_own_schedule_and_clock() -> None:
    """M1 is first sampled three minutes later; both change after two minutes of their own, one to 30 degC."""
    first = Scenario((0.5, 0.6), (2.0, 60.0), (37.0, 30.0))
    second = Scenario((0.3, 0.4, 0.5), (2.0, 2.0, 60.0), (33.0, 34.0, 35.0))
    script = [(0.0, 0.5, None), (1.0, 0.501, None), (2.0, 0.502, None), (3.0, None, 0.31), (4.0, 0.503, 0.311)]
    reactors = Turns(*script, (5.0, None, 0.312))
    loop, law = turns(reactors, first, second)
    steps = [loop.step() for _ in range(6)]
    assert [step.elapsed[0] for step in steps[:3]] == [0.0, 1.0, 2.0]
    assert [step.elapsed[1] for step in steps[3:]] == [0.0, 1.0, 2.0]
    assert [step.phase.tolist() for step in steps] == [[0, -1], [0, -1], [1, -1], [1, 0], [1, 0], [1, 1]]
    assert [setpoint for setpoint, _, _ in law.acts][-2:] == [[0.6, 0.3], [0.6, 0.4]]
    assert [rows for _, _, rows in law.acts] == [[True, False]] * 3 + [[False, True], [True, True], [False, True]]
    assert [minute[1] for _, minute, _ in law.acts][3:] == [3.0, 4.0, 5.0]  # of the run
    degc = [command.temperature.tolist() for command in reactors.commands]
    assert degc == [[37.0, 33.0]] * 2 + [[30.0, 33.0]] * 3 + [[30.0, 34.0]]
    np.testing.assert_allclose([step.volume_ml for step in steps[2:5]], [[0.12, 0.0], [0.0, 0.18], [0.12, 0.18]])
    assert law.told == [step.volume_ml.tolist() for step in steps]


def test_a_recovery_lasts_no_longer_than_its_own_limit_whatever_the_culture_has_reached() -> None:
    """Neither grows to 0.8; M1 is waited for until minute 3 and M0 until minute 5, and the law sees both meanwhile."""
    waits = [Scenario((0.5,), (60.0,), (37.0,), recovery_od=0.8, recovery_limit_min=limit) for limit in (5.0, 3.0)]
    reactors = Turns(*((float(k), 0.5 + 1e-3 * k, 0.4 + 1e-3 * k) for k in range(7)), warm=(36.5, 37.5))
    loop, law = turns(reactors, *waits)
    steps = [loop.step() for _ in range(7)]
    assert loop.began.tolist() == [5.0, 3.0]
    assert [step.phase.tolist() for step in steps] == [[-1, -1]] * 3 + [[-1, 0]] * 2 + [[0, 0]] * 2
    assert [step.proposed.tolist() for step in steps[2:6]] == [[0.0, 0.0], [0.0, 0.003], [0.0, 0.003], [0.002, 0.003]]
    assert [rows for _, _, rows in law.acts[2:6]] == [[False, False], [False, True], [False, True], [True, True]]
    assert law.watches == [([36.5, 37.5], [True, True])] * 7


def test_a_reactor_whose_schedule_is_over_goes_on_or_rests_as_it_was_told() -> None:
    """Both are over at minute 2, while nothing ends the run: M0 stops, M1 is held."""
    script = [(float(k), 0.5 + 1e-3 * k, 0.4 + 1e-3 * k) for k in range(5)]
    schedules = [Scenario((0.5,), (2.0,), (37.0,)), Scenario((0.6, 0.4), (1.0, 1.0), (37.0, 31.0))]
    for ends, rows, proposed in (
        (("stop", "hold"), [False, True], [0.0, 0.003]), (("hold", "stop"), [True, False], [0.002, 0.0]),
        (("stop", "stop"), [False, False], [0.0, 0.0]),
    ):  # fmt: skip
        loop, law = turns(Turns(*script), *schedules, at_end=ends)
        steps = [loop.step() for _ in range(5)]
        assert [step.done.tolist() for step in steps] == [[False, False]] * 2 + [[True, True]] * 3
        assert steps[3].rows.tolist() == rows
        assert steps[3].proposed.tolist() == proposed
        assert law.acts[3][0] == [0.5, 0.4]
        assert loop.over


def test_a_spare_pump_gives_nothing_any_more_once_its_schedule_is_over() -> None:
    """20 mL/h owe half a millilitre every 1.5 min; M0's two steps are over at minute 4, M1's at minute 60."""
    script = [(float(k), 0.5 + 1e-3 * k, 0.4 + 1e-3 * k) for k in range(8)]
    short = Scenario((0.5, 0.5), (3.0, 1.0), (37.0, 37.0), outputs=("pump3 20 mL/h", "pump3 20 mL/h"))
    long = Scenario((0.5,), (60.0,), (37.0,), outputs=("pump4 20 mL/h",))
    loop, _ = turns(Turns(*script), short, long)
    pumps = [step.pump.tolist() for step in (loop.step() for _ in range(8)) if step.pump is not None]
    assert [pump for pump, _ in pumps] == [1, 1, 3, 1, 1, 1, 1, 1]  # what is owed at the end of a step is left out
    assert [pump for _, pump in pumps] == [1, 1, 4, 1, 4, 1, 4, 1]


def test_what_a_device_dosed_by_itself_is_in_the_next_row_of_its_own_and_off_what_its_step_owes() -> None:
    """0.7 mL by M1's third pump, of the 2 mL that its step gives, told between its samples."""
    schedules = [Scenario((0.5,), (60.0,), (37.0,)), Scenario((0.4,), (60.0,), (37.0,), outputs=("pump3 2 mL",))]
    script = [(0.0, 0.5, 0.4), (0.5, 0.501, None), (1.0, None, 0.401)]
    reactors = Turns(*script)
    reactors.again[0.5] = Receipt(np.array([0.0, 0.7]), pump=3)
    loop, law = turns(reactors, *schedules)
    steps = [loop.step() for _ in range(3)]
    assert [step.pump.tolist() for step in steps if step.pump is not None] == [[1, 3], [1, 1], [1, 1]]
    np.testing.assert_allclose([step.volume_ml for step in steps], [[0.12, 1.0], [0.12, 0.0], [0.0, 0.18 + 0.7]])
    np.testing.assert_allclose(loop.supply.owed_ml, [[0.0, 0.0], [0.3, 0.0]])  # less than a dose
    assert loop.interlock.budget.fed_ml.tolist() == pytest.approx([0.24, 1.88])
    assert np.sum(law.told, axis=0).tolist() == pytest.approx([0.24, 1.88])


def test_a_controller_is_told_of_a_dose_as_in_the_volume_of_its_model_with_what_is_kept_of_it() -> None:
    law = Shown()
    Density(law, scale=np.array([0.6, 1.25])).dosed(np.array([0.3, 0.5]), np.array([0.12, -0.25]), np.array([1, 1]))
    assert law.told == [pytest.approx([0.7, 0.2])]


def test_the_heater_of_the_vial_that_is_too_warm_goes_off_and_that_of_the_other_stays() -> None:
    reactors = Turns(*((float(k), 0.5 + 1e-3 * k, 0.4 + 1e-3 * k) for k in range(4)), warm=(37.0, 48.0))
    loop, _ = turns(reactors, *[Scenario((0.5,), (60.0,), (36.0,))] * 2)
    last = [loop.step() for _ in range(4)][-1]
    np.testing.assert_array_equal(reactors.commands[-1].temperature, [36.0, np.nan])
    assert last.notes == ("M1: cold",)
    assert "hot" in str(last.reasons[1])
    assert last.reasons[0] is None


def test_what_the_interlock_demands_is_done_to_its_own_reactor_and_what_failed_is_told_before_the_doses() -> None:
    """M0's pumps go off, M1 is handed over at its setpoint; one that could not be given up is tried again."""
    done: list[tuple[object, ...]] = []
    reactors, n = Turns((0.0, 0.5, 0.4)), 2
    for name in ("pumps_off", "give_up"):
        setattr(reactors, name, lambda rows, name=name: done.append((name, rows.tolist())) or [f"M0: {name}"])
    reactors.regulate = lambda rows, setpoint: done.append((rows.tolist(), setpoint.tolist())) or []  # type: ignore[attr-defined]
    loop, _ = turns(reactors, *[Scenario()] * 2)
    none = np.zeros(n, dtype=bool)

    def asked(*codes: Response, left: np.ndarray = none) -> list[str]:
        done.clear()
        lines, setpoint = [None] * n, np.array([0.3, 0.6])
        return loop._respond(Ruling(np.zeros(n), np.array(codes), lines, ((), ()), none, setpoint), left)

    assert asked(Response.PUMPS_OFF, Response.REGULATE) == ["M0: pumps_off"]
    assert done == [("pumps_off", [True, False]), ([False, True], [0.3, 0.6])]
    assert asked(Response.HOLD, Response.PASS, left=np.array([False, True])) == []
    assert done == [([False, True], [0.3, 0.6])]
    assert asked(Response.STOP, Response.STOP) == ["M0: give_up"]
    assert loop.stopped.tolist() == [False, True]
    assert asked(Response.STOP, Response.STOP) == ["M0: give_up"]
    assert done == [("give_up", [True, False])]
    assert asked(Response.HOLD, Response.HOLD) == []
    assert done == []


def test_a_level_is_set_in_the_ledger_and_in_the_device_of_the_reactor_it_was_read_in() -> None:
    reactors = Turns()
    loop, _ = turns(reactors, *[Scenario()] * 2)
    assert loop.set_level("M1", 23.5) == 20.0
    assert loop.set_level("M1", 21.0) == 23.5
    assert (reactors.levels, loop.interlock.budget.volume_ml.tolist()) == ([(1, 23.5), (1, 21.0)], [20.0, 21.0])
    with pytest.raises(ValueError, match="^3 schedules: allowed one for each of the 2 reactors$"):
        turns(reactors, *[Scenario()] * 3)


class Knows:
    """Learns from counted shares, beside a law of the thermostat's."""

    name, actuator, columns, memory = "share", "thermostat", (), None
    sees_light = decide = find = dosed = None  # nobody asks here

    def __init__(self) -> None:
        self.told: list[object] = []

    def counted(self, n: int, share: float, sd: float, minute: float) -> tuple[str, bool]:
        self.told.append((n, share, sd, minute))
        return "taken", False

    def retell(self, rows: object, counted: object, light: object) -> None:
        self.told.append((rows, counted, light))


def test_a_share_is_counted_in_the_reactor_it_was_drawn_from_and_light_is_judged_by_the_run_s_limits() -> None:
    """Spectrometer counts end at 65534; what is less than the run's own least light is none."""
    knows, reactors = Knows(), Turns()
    interlock = Interlock(2, SafetyConfig(light_min=40.0))
    loop = ClosedLoop(reactors, Shown(), interlock, [Scenario()] * 2, further=[knows])  # type: ignore[list-item]
    assert loop.counted("M1", 0.25, 0.02, 7.5) == ("taken", False)
    loop.retell([{"od": [0.5]}], [(1, 0.25, 0.02, 7.5)])
    assert knows.told == [(1, 0.25, 0.02, 7.5), ([{"od": [0.5]}], [(1, 0.25, 0.02, 7.5)], (40.0, 65534.0))]
    nobody, _ = turns(reactors, *[Scenario()] * 2)
    assert nobody.counted("M1", 0.25, 0.02, 7.5) == ("ignored: no estimator uses this measurement", True)


def test_a_spare_pump_s_dose_is_as_large_as_the_bench_allows_in_a_period() -> None:
    """0.03 mL/s over 40 s are 1.2 mL at most, so 3 mL come in three of 1 mL: 0.025 mL/s each."""
    bench = Bench(period_s=40.0, max_rate=0.03)
    schedules = [Scenario(outputs=("pump4 3 mL",)), Scenario()]
    interlock = Interlock(2, SafetyConfig(ml_per_minute=3.0), bench)
    loop = ClosedLoop(Turns((0.0, 0.5, 0.4)), Shown(), interlock, schedules)
    step = loop.step()
    assert step.pump is not None
    assert step.pump.tolist() == [4, 1]
    assert step.rate.tolist() == pytest.approx([1.0 / 40.0, 0.003])


def test_the_second_filter_s_alarm_is_said_of_the_culture_that_is_steered_and_believed() -> None:
    law = Shown()
    law.explain = lambda: {"alarm": np.array([1, 1, 1, 0]), "noted": np.ones(4)}  # type: ignore[attr-defined]
    rows, nan = np.ones(4, dtype=bool), np.full(4, np.nan)
    believed, phase = np.array([True, True, False, True]), np.array([-1, 0, 0, 2])
    m = Measurement(np.zeros(4), nan, nan, rows)
    sample = Sample(m, nan, rows, believed, nan, nan, phase, nan, nan, (29.0, 36.0))
    found = Density(law).find(sample, nan)
    assert [None if line is None else line.partition(":")[0] for line in found.warnings] == [
        None, "filter_alarm", None, "filter_alarm",
    ]  # fmt: skip


def test_in_a_vial_of_another_volume_a_controller_is_told_of_doses_as_of_the_model_s() -> None:
    """What was put off, too: 14 mL in place of 20 make .5 mL, of which .2 were put off, to 1 of .7."""
    law = Listening()
    Density(law, scale=np.array([0.7])).dosed(np.array([0.5]), np.array([0.2]), np.ones(1, dtype=np.intp))
    assert law.told == pytest.approx(1.0)
