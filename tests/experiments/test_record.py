"""What a kill kept from being written is completed from the journal when the run is opened again."""

import csv
import itertools
import json
import math
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from envs.scenario import Scenario
from experiments.loop.loop import Step
from experiments.loop.progress import Progress
from experiments.record import messages, summary
from experiments.record.curves import Curves, _results, windows_table
from experiments.record.record import Record, Recordings
from experiments.record.recovery import COLUMNS, Rows, _caught_up, _put_off, load_state
from experiments.reporting import charts
from hardware.storage.doses import Ending
from hardware.storage.journal import Journal
from hardware.storage.marks import Mark, add_mark


def decision(minute: float) -> dict[str, object]:
    row = dict.fromkeys(COLUMNS, 0.0) | {"time_min": minute, "elapsed_min": minute - 1.0, "phase": 0, "od": 0.5}
    return {"reactor": "M0", "row": row | {"setpoint": 0.4, "interlock": "", "volume_ml": None}}


def sample(minute: float) -> dict[str, object]:
    return {"reactor": "M0", "time_s": 60.0 * minute, "od": 0.51, "temperature": 37.0}


def intent(ml: float) -> dict[str, object]:
    return {"reactor": "M0", "feed_ml": ml, "waste_ml": 9.0, "on_s": 130.0}


FED = ("feed_on", {"reactor": "M0", "on_s": 131.0})


def rows(folder: Path) -> list[dict[str, str]]:
    with open(folder / "recordings" / "M0.csv", newline="") as f:
        return list(csv.DictReader(f))


def killed_after(folder: Path, *events: tuple[str, dict[str, object]]) -> None:
    record = Record(folder, ("M0",), fsync=False)
    for kind, fields in events:
        record.journal.append(kind, fields)
    record.close()


def test_a_decided_row_is_completed_with_the_dose_of_its_intent(tmp_path: Path) -> None:
    killed_after(tmp_path, ("sample", sample(2.0)), ("decision", decision(2.0)), ("intent", intent(0.7)), FED)
    record = Record(tmp_path, ("M0",), fsync=False)
    record.close()
    assert [(r["time_min"], r["volume_ml"], r["elapsed_min"]) for r in rows(tmp_path)] == [("2.0", "0.7", "1.0")]
    assert [len(own) for own in record.rows] == [1]
    assert len(record.repairs) == 1
    Record(tmp_path, ("M0",), fsync=False).close()
    assert len(rows(tmp_path)) == 1


def test_a_sample_that_was_not_decided_on_becomes_a_row_without_a_dose(tmp_path: Path) -> None:
    killed_after(tmp_path, ("sample", sample(2.0)), ("decision", decision(2.0)), ("intent", intent(0.7)), FED,
                 ("sample", sample(3.0)))  # fmt: skip
    Record(tmp_path, ("M0",), fsync=False).close()
    last = rows(tmp_path)[-1]
    expected = {"time_min": 3.0, "elapsed_min": 2.0, "od": 0.51, "setpoint": 0.4, "volume_ml": 0.0}
    assert {key: float(last[key]) for key in expected} == expected
    assert last["interlock"] == "the program ended before it decided"
    killed_after(tmp_path, ("sample", sample(9.0)), ("decision", decision(9.0)))
    Record(tmp_path, ("M0",), fsync=False).close()
    assert [float(r["time_min"]) for r in rows(tmp_path)] == [2.0, 3.0, 9.0]


def test_what_the_device_repeated_while_nobody_watched_stands_in_the_row_after_it(tmp_path: Path) -> None:
    """0.7 mL at minute 2 and once more before minute 5, where 0.4 mL are given; and the vial beside it has its own."""
    other = {"reactor": "M1"}
    ended = ("dose_end", {"reactor": "M0", **Ending(131.0, 0.7, 9.0, 1, 1).row()})
    events = [("sample", sample(2.0)), ("decision", decision(2.0)), ("intent", intent(0.7)), FED]
    events += [("sample", sample(2.1) | other), ("decision", decision(2.1) | other), ended]
    events += [("intent", intent(0.2) | other), ("feed_on", {**FED[1], **other})]
    events += [("sample", sample(5.0)), ("decision", decision(5.0)), ("intent", intent(0.4)), FED]
    killed_after(tmp_path, *events)
    record = Record(tmp_path, ("M0", "M1"), fsync=False)
    record.close()
    assert [list(own.columns["volume_ml"]) for own in record.rows] == [[0.7, pytest.approx(1.1)], [0.2]]


def test_state_that_cannot_be_written_ends_the_run_with_the_remedy(tmp_path: Path) -> None:
    record = Record(tmp_path, ("M0",), fsync=False)
    record.save({"began": [1.0, float("nan")]})
    assert json.loads((tmp_path / "state.json").read_text())["began"] == [1.0, None]
    (tmp_path / "state.json").unlink()
    (tmp_path / "state.json").mkdir()
    with pytest.raises(OSError, match="state.json"):
        record.save({})
    record.close()
    with pytest.raises(messages.NoState):
        load_state(tmp_path / "recordings" / "state.json")


def recorded(minutes: list[float], words: dict[float, str], **cells: float) -> Rows:
    """A recording whose schedule began with its first row."""
    found = Rows()
    for minute in minutes:
        row = dict.fromkeys(COLUMNS, 0.0) | {"believed": 1.0, **cells, "interlock": words.get(minute, "")}
        found.append(row | {"time_min": minute, "elapsed_min": minute - minutes[0]})
    return found


def two_reactors() -> Recordings:
    """M0 stays 0.02 above its 0.5 for 4 min; M1 at 0.7 begins 10 min later and is not over."""
    words = {1.0: "budget: none left | stale: as before", 3.0: "stale: as before"}
    rows = [recorded([0.0, 1.0, 2.0, 3.0, 4.0], words, od=0.52, volume_ml=0.5, setpoint=0.5)]
    rows.append(recorded([10.0, 11.0, 12.0], {}, od=0.7, volume_ml=0.2, setpoint=0.8, temperature_degc=33.0))
    columns = {
        key: np.array([[*own.columns[key], *[np.nan] * (5 - len(own))] for own in rows]) for key in rows[0].columns
    }
    return Recordings(("M0", "M1"), columns, rows, ["mended"], [Mark(2.0, "M1", "looked")])


SCHEDULES = Scenario((0.5,), (4.0,), (37.0,)), Scenario((0.8, 0.6), (1.0, 3.0), (33.0, 30.0))


def test_the_summary_has_of_each_reactor_its_own_medium_words_and_windows() -> None:
    """Of five rows and of three; the second step of M1 was not over when the run ended."""
    found = summary.summarise(two_reactors(), SCHEDULES, ("replicate", "control"), "stopped", Progress(SCHEDULES))
    assert found["reactors"] == {
        "M0": {
            "role": "replicate", "volume_ml": pytest.approx(2.5), "rows": 5, "interlock": 2,
            "reasons": {
                "budget": {"rows": 1, "first_min": 1.0, "last_min": 1.0},
                "stale": {"rows": 2, "first_min": 1.0, "last_min": 3.0},
            },
        },
        "M1": {"role": "control", "volume_ml": pytest.approx(0.6), "rows": 3, "interlock": 0, "reasons": {}},
    }  # fmt: skip
    assert (found["outcome"], found["minutes"], found["volume_ml"]) == ("stopped", 12.0, pytest.approx(3.1))
    assert (found["repairs"], [mark["text"] for mark in found["marks"]]) == (["mended"], ["looked"])
    keys = ("reactor", "phase", "setpoint", "start_min", "end_min", "ended", "temperature")
    assert [tuple(w[key] for key in keys) for w in found["windows"]] == [
        ("M0", 0, 0.5, 0.0, 4.0, "time", 37.0), ("M1", 0, 0.8, 0.0, 1.0, "time", 33.0),
        ("M1", 1, 0.6, 1.0, 4.0, None, 30.0),
    ]  # fmt: skip
    assert [w["steady_abs_error"] for w in found["windows"]] == pytest.approx([0.02, 0.1, 0.1])
    assert [w["ise"] for w in found["windows"]] == pytest.approx([4.0 * 0.0004, 0.01, 0.01])
    assert [w["itae"] for w in found["windows"]] == pytest.approx([8.0 * 0.02, 0.5 * 0.1, 0.5 * 0.1])


def test_what_the_interlock_said_most_often_is_said_first() -> None:
    m0, m1 = two_reactors().rows
    assert summary.reasons_line(m0) == "stale in 2 of 5 rows, minute 1 to 3; budget in 1 of 5 rows, minute 1 to 1"
    assert summary.reasons_line(m1) == ""


def test_a_temperature_is_drawn_where_any_of_the_schedules_changes_it() -> None:
    drawn = summary.figure_of(two_reactors(), SCHEDULES, "")
    assert [ax.get_ylabel() for ax in drawn.axes] == ["OD", "pump rate, µL/s", "temperature, °C"]
    assert len(summary.figure_of(two_reactors(), (SCHEDULES[0], SCHEDULES[0]), "").axes) == 2


def step(minute: float, **told: Any) -> Step:
    """Of two reactors, both of which have a sample."""
    zero = np.zeros(2)
    given = {
        "now_s": 60.0 * minute, "rows": np.ones(2, dtype=bool), "minute": zero + minute, "elapsed": zero + minute,
        "phase": np.array([0, 0]), "od": zero + 0.5, "temperature": zero + 37.0, "setpoint": zero + 0.5,
        "proposed": zero, "rate": zero, "volume_ml": zero, "reasons": (None, None), "response": np.array([0, 0]),
        "notes": (), "explanation": {}, "done": np.zeros(2, dtype=bool),
    } | told  # fmt: skip
    return Step(**{key: np.array(v) if isinstance(v, list) else v for key, v in given.items()})


def test_the_log_of_a_run_says_of_each_reactor_what_changes_and_how_well_its_own_window_was_held(caplog):
    """M1 recovers first and moves on by its condition; a reading that is not believed counts for no error."""
    schedules = SCHEDULES[0], Scenario((0.8, 0.6), (40.0, 9.0), (37.0, 37.0), until=("od >= 0.9", None))
    reactors = SimpleNamespace(names=("M0", "M1"), handed_over=np.array([False, False]))
    progress, told = Progress(schedules), []
    changes = summary.ChangeLog(
        SimpleNamespace(reactors=reactors, progress=progress), lambda *words: told.append(words)
    )
    progress.edges[1, 1:] = [3.0, 12.0]  # where the condition has put them
    with caplog.at_level("INFO"):
        changes(step(0.0, phase=[0, -1], od=[0.5, 0.3], setpoint=[0.5, 0.8]))
        changes(step(1.0, od=[0.52, 0.75], setpoint=[0.5, 0.8], notes=("M0: drained 3 s",)))
        doubt = {"explanation": {"supervised": np.array([0.0, 1.0])}, "believed": np.array([True, False])}
        changes(step(2.0, od=[0.54, 9.9], setpoint=[0.5, 0.8], notes=("M0: drained 4.5 s",), **doubt))
        ended = {"phase": [0, 1], "setpoint": [0.5, 0.6], "ended": np.array([False, True])}
        changes(step(3.0, od=[0.53, 0.91], reasons=(None, "stale: as before"), **ended))
        reactors.handed_over[0] = True
        done = {"phase": [0, 1], "setpoint": [0.5, 0.6], "done": np.array([True, True])}
        changes(step(70.0, od=[0.5, 0.65], notes=("M0: drained 5 s",), **done))
    doubtful, sure = messages.SupervisorActs(minute=2.0), messages.PolicyActs(minute=3.0)
    assert [record.getMessage() for record in caplog.records] == [
        str(messages.PhaseBegins(reactor="M0", what="setpoint 0.5", minute=0.0, od=0.5)),
        str(messages.PhaseBegins(reactor="M1", what="recovery", minute=0.0, od=0.3)),
        str(messages.PhaseBegins(reactor="M1", what="setpoint 0.8", minute=1.0, od=0.75)),
        str(messages.NoteSeen(note="M0: drained 3 s")),
        str(doubtful.about("M1")),
        str(messages.StepEnded(reactor="M1", step=1, minutes=3.0, why="od >= 0.9", od=0.91)),
        str(messages.WindowEnds(reactor="M1", minute=3.0, error=0.05)),
        str(messages.PhaseBegins(reactor="M1", what="setpoint 0.6", minute=3.0, od=0.91)),
        str(sure.about("M1")),
        "M1: stale: as before",
        str(messages.WindowEnds(reactor="M0", minute=70.0, error=0.0225)),
        str(messages.WindowEnds(reactor="M1", minute=70.0, error=0.31)),
        f"M1: {messages.WellAgain()}",
        str(messages.NoteSeen(note="M0: drained 5 s")),
    ]
    warned = [record.getMessage() for record in caplog.records if record.levelname == "WARNING"]
    assert warned == ["M1: stale: as before", f"M1: {messages.WellAgain()}"]
    assert told == [
        ("hand_over", str(doubtful), "M1"), ("hand_over", str(sure), "M1"), ("alarm", "stale: as before", "M1"),
        ("alarm", str(messages.WellAgain()), "M1"), ("hand_over", str(messages.LeftToDevice()), "M0"),
    ]  # fmt: skip


def test_what_goes_wrong_without_a_new_sample_is_told_and_a_refusal_lasts_until_the_next_one(caplog):
    """M0 is refused its sample, then has none for two minutes; M1 falls silent; then both are well."""
    reactors, told = SimpleNamespace(names=("M0", "M1"), handed_over=np.zeros(2, dtype=bool)), []
    run = SimpleNamespace(reactors=reactors, progress=Progress((SCHEDULES[0], SCHEDULES[0])))
    changes = summary.ChangeLog(run, lambda *words: told.append(words))
    none = {"rows": [False, False]}
    changes(step(0.0, reasons=("jump: 0.5 to 3", None)))
    changes(step(1.0, reasons=(None, "lost: no sample for 3 min"), **none))
    changes(step(2.0, reasons=("pumps stopped earlier in this run", "lost: no sample for 4 min"), **none))
    changes(step(3.0))
    assert told == [
        ("alarm", "jump: 0.5 to 3", "M0"),
        ("alarm", "lost: no sample for 3 min", "M1"),
        ("alarm", "interlock: all alarms ended", "M0"),
        ("alarm", "interlock: all alarms ended", "M1"),
    ]


def curves_of(folder: Path) -> dict[str, list[tuple[int, float, float]]]:
    """Step, seconds since 1970 and value of every point, by its tag."""
    events = EventAccumulator(str(folder), size_guidance={"tensors": 0}).Reload()
    points = {tag: events.Tensors(tag) for tag in events.PluginTagToContent("scalars")}
    return {tag: [(e.step, e.wall_time, e.tensor_proto.float_val[0]) for e in each] for tag, each in points.items()}


def test_each_reactor_has_curves_of_its_own_dated_by_the_minute_of_its_sample(tmp_path: Path) -> None:
    """The interlock speaks of M0, the reading of M1 is not believed, M0 has no setpoint yet."""
    curves = Curves(tmp_path, ("M0", "M1"), ("ratio",), 0, 1e9)
    told = {"explanation": {"mu": np.array([0.02, np.nan])}, "believed": np.array([True, False])}
    told["columns"] = {"ratio": np.array([0.3, 0.6]), "light": np.array([11.0, 12.0])}
    told |= {"od": [0.41, 0.82], "setpoint": [0.5, 0.8], "temperature": [33.0, 36.0], "phase": [-1, 0]}
    told |= {"rate": [0.004, 0.009], "proposed": [0.02, 0.02], "reasons": ("stale: as before", None)}
    curves.step(replace(step(0.0, **told), minute=np.array([5.0, 7.0])))
    curves.close()
    m0, m1 = (curves_of(tmp_path / "reactors" / name) for name in ("M0", "M1"))
    assert m0 == {
        tag: [(5, 1e9 + 300.0, pytest.approx(value))]
        for tag, value in {
            "culture/od": 0.41, "culture/temperature_degc": 33.0, "pump/rate_ml_s": 0.004, "safety/interlock": 1.0,
            "share/estimate": 0.3, "further/light": 11.0, "controller/mu": 0.02,
        }.items()
    }  # fmt: skip
    assert m1 == {
        tag: [(7, 1e9 + 420.0, pytest.approx(value))]
        for tag, value in {
            "culture/setpoint": 0.8, "culture/setpoint_low": 0.76, "culture/setpoint_high": 0.84,
            "culture/temperature_degc": 36.0, "pump/rate_ml_s": 0.009, "safety/interlock": 0.0, "share/estimate": 0.6,
            "further/light": 12.0,
        }.items()
    }  # fmt: skip


def test_the_points_of_a_resumed_run_are_dated_by_the_beginning_of_its_first_life(tmp_path: Path) -> None:
    clock = itertools.count(1e9, 500.0)
    killed_after(tmp_path)
    earlier = Journal(tmp_path / "journal.jsonl", lambda: next(clock))
    earlier.append("sample", sample(2.0))
    earlier.append("decision", decision(2.0))
    earlier.close()
    record = Record(tmp_path, ("M0",), fsync=False)
    began = record.journal.rows[0]["wall"]
    assert record.journal.rows[1]["wall"] == began + 500.0
    record.curves.step(step(150.0, rows=[True, False]))
    record.close()
    [(minute, wall, _)] = curves_of(tmp_path)["culture/od"]
    assert (minute, wall) == (150, pytest.approx(began + 9000.0, abs=1e-3))


def test_the_results_of_a_run_are_its_worst_error_the_sum_of_its_costs_and_the_mean_of_its_shares() -> None:
    windows = [
        {"reactor": name, "setpoint": goal, "start_min": start, "end_min": 2.0 * start, "steady_abs_error": steady,
         "settling_min": settled, "ise": ise, "abs_error": 0.07, "ratio_setpoint": 0.4, "ratio_abs_error_mean": share}
        for name, goal, start, steady, settled, ise, share in (
            ("M0", 0.5, 30.0, 0.01, 4.0, 0.2, 0.03), ("M1", 0.8, 40.0, 0.03, math.nan, 0.5, None),
            ("M1", 0.6, 50.0, None, 7.0, 0.1, 0.05),
        )
    ]  # fmt: skip
    assert _results({"windows": windows, "volume_ml": 61.0}) == pytest.approx(
        {"result/steady_abs_error": 0.03, "result/ise": 0.8, "result/share_abs_error": 0.04, "result/medium_ml": 61.0}
    )
    head, _, *rows = (line.strip("| ").replace(" | ", "|").split("|") for line in windows_table(windows).splitlines())
    assert [dict(zip(head, row, strict=True)) for row in rows] == [
        {"reactor": name, "setpoint, OD": goal, "from, min": start, "to, min": end, "steady error, OD": steady,
         "settled after, min": settled, "ISE, OD² min": ise, "mean error, OD": "0.07", "error of the share": share}
        for name, goal, start, end, steady, settled, ise, share in (
            ("M0", "0.5", "30", "60", "0.01", "4", "0.2", "0.03"), ("M1", "0.8", "40", "80", "0.03", "–", "0.5", "–"),
            ("M1", "0.6", "50", "100", "–", "7", "0.1", "0.05"),
        )
    ]  # fmt: skip


def test_what_a_kill_left_behind_of_the_second_reactor_is_not_that_of_the_first() -> None:
    """Schedules as their newest decisions have them, and what was put off last by each."""
    state = {"began": [1.0, 2.0], "steps": [{"edges": [0]}, {"edges": [5]}], "other": [8, 9]}
    places = [("M1", 7.5, 1), ("M9", 3.0, 2), ("M1", 7.5, 3)]
    rows = [
        {"kind": "decision", "reactor": name, "position": {"began": began, "edges": [k]}} for name, began, k in places
    ]
    assert _caught_up(state, rows, ["M0", "M1"]) == {
        "began": [1.0, 7.5], "steps": [{"edges": [0]}, {"began": 7.5, "edges": [3]}], "other": [8, 9],
    }  # fmt: skip
    intents = [
        {"kind": kind, "reactor": name, "carry_ml": ml}
        for kind, name, ml in (("intent", "M1", 0.1), ("intent", "M0", 0.2), ("intent", "M1", 0.3), ("x", "M0", 0.9))
    ]
    loop = SimpleNamespace(reactors=SimpleNamespace(names=("M0", "M1", "M2")))
    np.testing.assert_array_equal(_put_off(intents, loop), [0.2, 0.3, 0.0])


def test_marks_are_in_order_of_time_and_recordings_side_by_side_whoever_wrote_first(tmp_path: Path) -> None:
    """Two rows of M0 and one of M1; the marks were written late."""
    killed_after(tmp_path, ("decision", decision(2.0)), ("decision", decision(3.0)))
    other = decision(2.5) | {"reactor": "M1"}
    record = Record(tmp_path, ("M0", "M1"), fsync=False)
    record.journal.append("decision", other)
    record.close()
    for minute, name in ((9.0, "M1"), (4.0, "M0")):
        add_mark(tmp_path, Mark(minute, name, "looked"))
    record = Record(tmp_path, ("M0", "M1"), fsync=False)
    table = record.table()
    record.close()
    assert [(mark.time_min, mark.reactor) for mark in table.marks] == [(4.0, "M0"), (9.0, "M1")]
    np.testing.assert_array_equal(table.columns["time_min"], [[2.0, 3.0], [2.5, np.nan]])
    assert "interlock" not in table.columns


def test_every_decision_is_journalled_for_its_own_reactor_in_the_units_of_the_recording(tmp_path: Path) -> None:
    """M1 alone has a sample; of M0 the interlock says why it has none. The rate is what was let through."""
    record = Record(tmp_path, ("M0", "M1"), fsync=False)
    told = {"rows": [False, True], "od": [0.41, 0.82], "phase": [0, 2], "setpoint": [0.5, 0.8], "rate": [0.01, 0.004]}
    told |= {"proposed": [0.02, 0.015], "volume_ml": [0.6, 0.24], "temperature": [33.0, 36.12345]}
    told |= {"raw": [900.0, 1200.0], "blank": [80.0, 95.0], "pump": [1, 4], "believed": np.array([True, False])}
    told |= {"reasons": ("no answer: for 90 s", "stale: as before"), "elapsed": [3.0, 5.5]}
    told |= {"explanation": {"mu": np.array([0.02, 0.03])}, "position": ({"began": 1.0}, {"began": 2.0})}
    now = replace(step(0.0, **told), minute=np.array([7.0, 8.23456]))
    record.decided(now)
    record.done(now, {"began": [1.0, 2.0]})
    record.close()
    trouble, decided = (json.loads(line) for line in (tmp_path / "journal.jsonl").read_text().splitlines())
    assert (trouble["kind"], trouble["reactor"], trouble["interlock"]) == ("trouble", "M0", "no answer: for 90 s")
    assert (decided["kind"], decided["reactor"], decided["why"]) == ("decision", "M1", {"mu": 0.03})
    assert decided["position"] == {"began": 2.0}
    expected = {
        "time_min": 8.2346, "elapsed_min": 5.5, "phase": 2, "od": 0.82, "setpoint": 0.8, "pump_rate_ml_s": 0.004,
        "proposed_ml_s": 0.015, "volume_ml": 0.24, "temperature_degc": 36.123, "interlock": "stale: as before",
        "raw_counts": 1200.0, "blank_counts": 95.0, "feed_pump": 4, "believed": 0,
    }  # fmt: skip
    assert decided["row"] == expected
    with open(tmp_path / "recordings" / "M1.csv", newline="") as f:
        [row] = csv.DictReader(f)
    assert {key: type(expected[key])(row[key]) for key in expected} == expected
    assert rows(tmp_path) == []
    assert json.loads((tmp_path / "state.json").read_text()) == {"journal_row": 2, "began": [1.0, 2.0]}


def test_what_a_share_adds_to_a_run_has_curves_of_its_own_names(tmp_path: Path) -> None:
    """No two values are alike; a reactor that is alone has its curves in the run folder, with figures and outcome."""
    tags = {
        "fluorescence": "share/fluorescence", "ratio_setpoint": "share/setpoint", "ratio": "share/estimate",
        "ratio_low": "share/low", "ratio_high": "share/high", "true_ratio": "share/true",
        "temperature_target_degc": "culture/temperature_target_degc",
    }  # fmt: skip
    values = {key: 10.0 + k for k, key in enumerate(tags)}
    curves = Curves(tmp_path, ("M0",), ("ratio",), 0, 1e9)
    columns = {key: np.array([value, 99.0]) for key, value in values.items()}
    curves.step(step(4.0, rows=[True, False], columns=columns))
    pictures = {}
    for k, name in enumerate(("closed_loop", "composition"), 1):
        pictures[name] = charts.save(charts.new_figure(1.0, float(k))[0], tmp_path, name)
    windows = [{"reactor": "M0", "setpoint": 0.5, "ise": 0.25}]
    curves.end({"outcome": "stopped by you", "windows": windows, "volume_ml": 6.5}, {"seed": 3.0}, pictures)
    curves.close()
    found = curves_of(tmp_path)
    assert {tags[key]: value for key, value in values.items()}.items() <= {
        tag: points[0][2] for tag, points in found.items()
    }.items()
    assert found["result/ise"] == [(4, 1e9 + 240.0, 0.25)]
    assert found["result/medium_ml"] == [(4, 1e9 + 240.0, 6.5)]
    assert "result/share_abs_error" not in found
    events = EventAccumulator(str(tmp_path), size_guidance={"tensors": 0}).Reload()
    for name, path in pictures.items():
        assert events.Tensors(f"figures/{name}")[0].tensor_proto.string_val[2] == path.read_bytes()
    [said] = events.Tensors("run/summary")
    assert said.tensor_proto.string_val[0].decode().startswith("stopped by you\n\n| reactor | setpoint, OD | ISE")
