"""Steps of a schedule that end by a condition: when, for whom, and over a kill; expected minutes by hand."""

import json
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from envs.plant.plant import Plant, PlantConfig
from envs.scenario import Scenario
from envs.task import EnvConfig
from experiments.coculture.program import composed
from experiments.comparison.config import BenchmarkConfig
from experiments.laws.density.baselines import Hold, HoldConfig
from experiments.loop.loop import ClosedLoop
from experiments.loop.progress import Progress
from experiments.record.summary import summarise
from hardware import memory
from hardware.safety.interlock import Interlock
from hardware.simulated import SimulatedConfig, SimulatedReactors
from tests.campaigns.rehearsal import Rehearsal, rehearsed
from tests.hardware.emulator_lab import quiet

ALL = np.array([True, True])
STEPS = Scenario((0.8, 0.8, 0.3), (60.0, 30.0, 20.0), (37.0, 37.0, 30.0), until=("od >= 0.7", "settled", None))
GROWS = Scenario((0.6, 0.3), (600.0, 10.0), (37.0, 30.0), until=("od >= 0.5", None))


def fed(progress: Progress, minute: float, *od: float, believed: np.ndarray = ALL) -> list[bool]:
    return progress.watch(np.full(len(od), minute), np.array(od), believed).tolist()


def test_each_reactor_moves_on_by_itself_and_its_later_steps_begin_earlier() -> None:
    progress = Progress([STEPS, STEPS])
    assert fed(progress, 0.0, 0.9, 0.2) == [False, False]  # a step is judged after its first sample
    assert fed(progress, 5.0, 0.72, 0.69) == [True, False]
    phase, setpoint, temperature = progress.asked(np.array([5.0, 5.0]))
    assert phase.tolist() == [1, 0]
    assert setpoint.tolist() == [0.8, 0.8]
    assert temperature.tolist() == [37.0, 37.0]
    assert progress.edges.tolist() == [[0.0, 5.0, 35.0, 55.0], [0.0, 60.0, 90.0, 110.0]]
    assert progress.totals.tolist() == [55.0, 110.0]
    assert progress.phase(np.array([35.0, 35.0])).tolist() == [2, 0]
    assert progress.phase(np.array([np.nan, -1.0])).tolist() == [-1, -1]
    assert progress.steps(0) == [(0.0, 5.0, "condition"), (5.0, 35.0, "time"), (35.0, 55.0, "time")]


def test_a_recovery_that_dilutes_grows_beyond_is_diluted_by_full_pump_and_survives_a_kill_at_any_sample() -> None:
    """Against the rule read sample by sample; the second reactor, which only grows, begins on its way up."""
    scenarios = [Scenario((0.8,), recovery_od=0.6, recovery="dilute", settled_band=0.1), Scenario(recovery_od=0.6)]
    two = SimulatedConfig(reactors=("M0", "M1"))
    vials = SimulatedReactors(Plant(PlantConfig(start_od=0.5), 2, np.random.default_rng(0)), two)
    laws = [Hold(HoldConfig(), EnvConfig()) for _ in range(2)]
    loop, grown, doses = ClosedLoop(vials, laws[0], Interlock(2), scenarios), False, 0
    while np.isnan(loop.began).any():
        again = ClosedLoop(vials, laws[1], Interlock(2), scenarios)
        again.restore(json.loads(json.dumps(loop.state())))
        loop, laws = again, laws[::-1]
        step = loop.step()
        grown = grown or step.od[0] >= 0.66
        ends = grown and step.od[0] <= 0.6
        assert step.phase[0] == (0 if ends else -1)
        assert ends or step.rate[0] == (0.02 if grown else 0.0)
        doses += grown and not ends
    assert doses > 1
    assert loop.began[1] < loop.began[0]


def test_a_reading_ends_a_step_at_its_level_if_it_is_believed() -> None:
    assert fed(Progress([STEPS, STEPS]), 5.0, 0.9, math.nan, believed=np.array([False, True])) == [False, False]
    progress = Progress([replace(STEPS, until=("od <= 0.3", None, None))] * 2)
    ended = [fed(progress, minute, 0.31, od) for minute, od in ((1.0, 0.31), (2.0, 0.3))]
    assert ended == [[False, False], [False, True]]


def test_a_step_that_begins_between_two_samples_is_asked_for_before_it_is_judged() -> None:
    """The first step ends by its time at minute 10, samples come at 9.4, 10.4 and 11.4; OD is above 0.7 all along."""
    progress = Progress([Scenario((0.8, 0.8, 0.3), (10.0, 30.0, 20.0), (37.0,) * 3, until=(None, "od >= 0.7", None))])
    one = np.array([True])
    assert [fed(progress, minute, 0.75, believed=one)[0] for minute in (9.4, 10.4, 11.4)] == [False, False, True]
    assert progress.steps(0)[1] == (10.0, pytest.approx(11.4), "condition")


def test_settled_is_the_band_for_the_time_and_begins_anew_after_a_reading_outside_also_if_killed_at_any_sample() -> (
    None
):
    """Within 0.76 to 0.84 from minute 5 to 10, outside at 11, within from 12: settled at 22, ten minutes later."""
    scenario, ended = replace(STEPS, until=("settled", "settled", None)), []
    kept, one = memory.rows(Progress([scenario])), np.array([True])
    for minute in range(40):
        progress = Progress([scenario])
        memory.restore_rows(progress, json.loads(json.dumps(kept)), "steps")
        od = 0.85 if minute < 5 or minute == 11 else 0.77
        ended += [minute] * fed(progress, float(minute), od, believed=one)[0]
        kept = memory.rows(progress)
    assert ended == [22, 32]  # the second step counts from its own beginning
    assert progress.edges.tolist() == [[0.0, 22.0, 32.0, 52.0]]


def test_reactors_are_judged_by_their_own_band_minutes_and_number_of_steps() -> None:
    """Both read 0.72. That is 10 % below 0.8, where the first allows 5 %, and within 0.15 of the second's, for 4 min.
    After its schedule the second goes on at its own last step."""
    wide = Scenario((0.8, 0.6), (40.0, 7.0), (37.0, 31.0), until=("settled", None), settled_band=0.15, settled_min=4.0)
    progress = Progress([STEPS, wide])
    ended = [minute for minute in range(12) if fed(progress, float(minute), 0.72 - 0.1 * (minute < 2), 0.72)[1]]
    assert ended == [4]
    assert progress.totals.tolist() == [progress.edges[0, 3], 11.0]
    assert progress.steps(1) == [(0.0, 4.0, "condition"), (4.0, 11.0, "time")]
    phase, setpoint, temperature = progress.asked(np.array([200.0, 200.0]))
    assert (phase.tolist(), setpoint.tolist(), temperature.tolist()) == ([2, 1], [0.3, 0.6], [30.0, 31.0])


def test_conditions_do_not_go_with_shares_and_need_one_for_each_step() -> None:
    with pytest.raises(ValueError, match=r"scenario\.until = .*: allowed \[\] with setpoints of a share"):
        Scenario(until=("settled",), ratios=(0.3,))
    with pytest.raises(ValueError, match=r"scenario\.until = .*: allowed no entry, or one for each of the 1 phases"):
        Scenario(until=("settled", None))
    assert composed(Scenario(until=(None,), ratios=(0.3,)))


def _run(folder: Path, schedule: Scenario = GROWS, **each: object) -> Rehearsal:
    """M0 and M1 grow with 0.03 1/min from 0.4: 0.5 is reached after 7.4 min, M1's 0.45 after 3.9."""
    folder.mkdir(exist_ok=True)
    own = {"M1": {"until": ["od >= 0.45", None]} | each}
    run = Rehearsal(folder, replace(rehearsed(("M0", "M1"), schedule), each=own), quiet(mu=0.03), od=0.4)
    run.begin()
    return run


def test_on_the_device_steps_end_where_growth_by_hand_has_them_and_windows_follow(tmp_path: Path) -> None:
    run = _run(tmp_path)
    list(run.run())
    first = [window for window in _windows(run) if window["phase"] == 0]
    for window, level in zip(first, (0.5, 0.45), strict=True):
        assert window["ended"] == "condition"
        late = window["end_min"] - math.log(level / 0.4) / 0.03
        assert -0.1 < late <= 1.6  # the next sample; one that comes later than the culture's start by part of a minute
    second = [window for window in _windows(run) if window["phase"] == 1]
    for a, b, n in zip(first, second, (0, 1), strict=True):
        assert (b["start_min"], b["end_min"]) == (a["end_min"], pytest.approx(a["end_min"] + 10.0, abs=1e-3))
        assert b["ended"] == "time"
        minute, setpoint = run.record.rows[n].columns["elapsed_min"], run.record.rows[n].columns["setpoint"]
        assert [s for m, s in zip(minute, setpoint, strict=True) if m < a["end_min"] - 1e-6 and m >= 0] == [0.6] * (
            sum(0 <= m < a["end_min"] - 1e-6 for m in minute)
        )
        assert {s for m, s in zip(minute, setpoint, strict=True) if m >= a["end_min"] - 1e-6} == {0.3}
        errors = [o - 0.3 for m, o in zip(minute, run.record.rows[n].columns["od"], strict=True)
                  if a["end_min"] - 1e-6 <= m <= b["end_min"] + 1e-6]  # fmt: skip
        times = [m for m in minute if a["end_min"] - 1e-6 <= m <= b["end_min"] + 1e-6]
        assert b["ise"] == pytest.approx(float(np.trapezoid(np.square(errors), times)))


def _windows(run: Rehearsal) -> list[dict[str, object]]:
    summary = summarise(run.record.table(), run.loop.schedules, ["replicate"] * 2, "completed", run.loop.progress)
    return list(summary["windows"])


@pytest.mark.slow
def test_a_run_killed_between_the_decision_that_ends_a_step_and_its_record_goes_on_in_the_next(tmp_path: Path) -> None:
    whole = _run(tmp_path / "whole")
    list(whole.run())
    run = _run(tmp_path / "killed")
    run.kill_decided(lambda step: bool(step.ended[0]))
    run.killed()
    assert json.loads((run.folder / "state.json").read_text())["steps"][0]["edges"][1] == 600.0  # it does not know
    run.wait(30.0)
    run.begin()
    assert run.loop.progress.edges[0, 1] == pytest.approx(whole.loop.progress.edges[0, 1], abs=0.05)
    moved = run.loop.progress.edges.tolist()
    for step in run.run():
        assert step.phase[0] == 1
    assert run.loop.progress.edges.tolist() == moved
    (window,) = [w for w in _windows(run) if w["reactor"] == "M0" and w["phase"] == 0]
    assert window["ended"] == "condition"
    assert run.record.series("phase")[0].tolist().count(0.0) == whole.record.series("phase")[0].tolist().count(0.0)


def test_a_run_killed_after_its_first_decision_began_only_once(tmp_path: Path) -> None:
    run = _run(tmp_path)
    run.kill_decided(lambda step: bool(step.elapsed[1] == 0.0))
    run.killed()
    run.begin()
    list(run.run(run.clock.now() + 120.0))
    minute, elapsed = run.record.series("time_min")[1], run.record.series("elapsed_min")[1]
    began = (minute - elapsed)[np.isfinite(elapsed)]
    assert began.size >= 2
    np.testing.assert_allclose(began, began[0], atol=1e-3)


def test_a_comparison_takes_no_steps_of_unequal_length() -> None:
    with pytest.raises(ValueError, match=r"scenarios\.mine = \['settled'\]: allowed no until and no outputs"):
        BenchmarkConfig(scenarios={"mine": Scenario(until=("settled",))})
