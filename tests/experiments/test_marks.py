"""What was done at the bench, and the counts behind every OD: in the run folder, the figure and after a resume."""

import fcntl
import json
import os
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from envs.plant.sensor import od_from_counts
from envs.scenario import Scenario
from experiments.cli import frame
from experiments.control.messages import LevelMarked, ShareMarked
from experiments.control.run import BenchMarks
from experiments.loop.loop import Step
from experiments.loop.progress import Progress
from experiments.mark import MarkConfig, mark
from experiments.mark import main as command
from experiments.record.messages import RowCompleted
from experiments.record.summary import figure_of, summarise
from hardware.emulator.faults import inject
from hardware.emulator.vial import DARK_COUNTS
from hardware.errors import RecordingError
from hardware.storage.marks import Mark, add_mark, read_marks
from hardware.storage.messages import MarksDamaged
from tests.campaigns.rehearsal import Killed, Rehearsal, rehearsed
from tests.hardware.emulator_lab import BLANK, quiet
from tests.hardware.script import logged

SCHEDULE = Scenario((0.6,), (20.0,), (37.0,))


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Rehearsal:
    """Twenty minutes of growth from 0.4, killed at the sixth decision and resumed."""
    made = Rehearsal(tmp_path_factory.mktemp("marks"), rehearsed(("M0",), SCHEDULE), quiet(mu=0.03), od=0.4)
    made.begin()
    made.kill_decided(lambda step: bool(step.elapsed[0] > 5.0))
    made.killed()
    made.begin()
    list(made.run())
    return made


def test_every_od_has_its_counts_and_the_blank_also_in_a_row_from_the_journal(run: Rehearsal) -> None:
    series = {key: run.record.series(key)[0] for key in ("od", "raw_counts", "blank_counts")}
    assert series["od"].size > 15
    assert any(isinstance(repair, RowCompleted) for repair in run.record.repairs)
    blank = BLANK + DARK_COUNTS
    assert np.isfinite(series["raw_counts"]).all()
    np.testing.assert_allclose(series["blank_counts"], blank, rtol=0.01)
    formula = od_from_counts(series["raw_counts"], series["blank_counts"])
    np.testing.assert_allclose(formula, series["od"], atol=2e-3)  # the last of four readings, whole counts


def test_a_reading_that_is_not_believed_counts_for_no_metric(tmp_path: Path) -> None:
    whole = Rehearsal(tmp_path, rehearsed(("M0",), Scenario((0.5,), (40.0,), (37.0,))), quiet(mu=0.025), od=0.5)
    whole.begin()
    steps = whole.run()
    for step in steps:
        if step.rows.any() and float(step.minute[0]) > 12.0:
            break
    inject(whole.device, "spectrometer_dead")
    for step in steps:
        if step.rows.any() and float(step.minute[0]) > 15.0:
            break
    inject(whole.device, "spectrometer_dead", value=0.0)
    list(steps)
    record, scenarios = whole.record, whole.loop.schedules
    od, minute = record.series("od")[0], record.series("elapsed_min")[0]
    wild = od > 5.0
    assert 2 <= wild.sum() <= 5
    assert (record.series("believed")[0] == 0.0)[wild].all()
    [window] = summarise(record.table(), scenarios, ["policy"], "completed", Progress(scenarios))["windows"]
    kept = record.series("believed")[0] == 1.0
    by_hand = np.trapezoid((od[kept] - 0.5) ** 2, minute[kept])
    assert window["ise"] == pytest.approx(by_hand, rel=1e-3)
    assert window["ise"] < 0.5  # 400 with them
    record.close()


def test_a_mark_stands_in_the_figure_and_in_the_summary(run: Rehearsal) -> None:
    (run.folder / "marks.csv").unlink(missing_ok=True)
    add_mark(run.folder, Mark(9.0, "", "new bottle"))
    add_mark(run.folder, Mark(3.5, "M0", "inoculated, twice"))
    assert read_marks(run.folder) == [Mark(9.0, "", "new bottle"), Mark(3.5, "M0", "inoculated, twice")]
    axes = figure_of(run.record.table(), [SCHEDULE], "").axes
    assert [text.get_text() for text in axes[0].texts] == ["M0 inoculated, twice", "new bottle"]
    for ax in axes:
        at = [line.get_xdata()[0] for line in ax.lines if len(set(line.get_xdata())) == 1]
        assert at == [3.5, 9.0]
    summary = summarise(run.record.table(), [SCHEDULE], ["replicate"], "completed", run.loop.progress)
    assert [m["text"] for m in summary["marks"]] == ["inoculated, twice", "new bottle"]


def test_a_damaged_file_of_marks_costs_no_summary(run: Rehearsal, caplog: pytest.LogCaptureFixture) -> None:
    (run.folder / "marks.csv").write_text("time_min,reactor,text,written\nnever,M0,x,y\n")
    assert not figure_of(run.record.table(), [SCHEDULE], "").axes[0].texts
    assert "marks.csv: damaged" in caplog.text
    with pytest.raises(MarksDamaged):
        read_marks(run.folder)
    (run.folder / "marks.csv").unlink()


def begun(folder: Path, *names: str, minutes: float) -> tuple[Rehearsal, Iterator[Step], BenchMarks]:
    """A run whose first sample is taken."""
    made = Rehearsal(folder, rehearsed(names, Scenario((0.4,), (minutes,), (37.0,))), quiet(mu=0.03), od=0.5)
    made.begin()
    steps = made.run()
    next(steps)
    return made, steps, BenchMarks(made.record)


def dies(made: Rehearsal) -> None:
    with pytest.raises(Killed):
        made.kill()
    made.close()


def test_a_level_that_was_read_off_a_vial_is_the_ledger_from_then_on_also_after_a_kill(tmp_path: Path) -> None:
    """Killed after the level was journalled and before the state was saved; a damaged file stops nothing."""
    made, _, levels = begun(tmp_path, "M0", "M1", minutes=12.0)
    ledger = made.loop.interlock.budget
    add_mark(tmp_path, Mark(1.0, "M0", "inoculated"))
    add_mark(tmp_path, Mark(1.0, "M1", "level", 23.5))
    levels.take(made.loop)
    assert ledger.volume_ml.tolist() == [20.0, 23.5]
    levels.take(made.loop)
    assert [row["level_ml"] for row in made.record.journal.reread() if row["kind"] == "level"] == [23.5]
    dies(made)
    made.begin()
    levels = BenchMarks(made.record)
    levels.take(made.loop)
    assert made.loop.interlock.budget.volume_ml[1] == 23.5
    (tmp_path / "marks.csv").write_text("damaged\n")
    levels.take(made.loop)
    steps = made.run()
    while made.loop.interlock.budget.volume_ml[1] > 20.0:  # a dose brings it back to its tube
        next(steps)
    dies(made)
    (tmp_path / "marks.csv").unlink()
    add_mark(tmp_path, Mark(1.0, "M1", "level", 23.5))
    made.begin()  # once more: the level was taken over in a life before, whose state knows it
    levels = BenchMarks(made.record)
    levels.take(made.loop)
    assert made.loop.interlock.budget.volume_ml.tolist() == [20.0, 20.0]
    add_mark(tmp_path, Mark(2.0, "M0", "level", 0.0))
    levels.take(made.loop)
    assert made.loop.interlock.budget.volume_ml.tolist() == [0.0, 20.0]
    made.close()


def test_a_level_and_the_doses_after_it_are_replayed_in_their_order(tmp_path: Path) -> None:
    """The state on the disk is of before the level."""
    made, steps, levels = begun(tmp_path, "M0", minutes=20.0)
    before = (tmp_path / "state.json").read_bytes()
    add_mark(tmp_path, Mark(1.0, "M0", "level", 23.5))
    levels.take(made.loop)
    given = 0
    while given < 3:
        given += float(np.nansum(next(steps).volume_ml)) > 0.0
    expected = made.loop.interlock.budget.volume_ml.copy()
    dies(made)
    (tmp_path / "state.json").write_bytes(before)
    made.begin()
    np.testing.assert_allclose(made.loop.interlock.budget.volume_ml, expected)
    assert expected[0] < 23.5
    made.close()


def test_a_bottle_that_was_filled_is_dosed_from_at_once_and_counted_from_then_also_after_a_kill(tmp_path: Path) -> None:
    """Without its mark nothing is dosed for the rest of the pause, and the ledger ends the doses when it is full."""
    made, steps, marks = begun(tmp_path, "M0", minutes=90.0)
    inject(made.device, "media_left_ml", "M0", 0.0)
    reasons = ""
    while "no_dilution" not in reasons:
        reasons = next(steps).reasons[0] or ""
    inject(made.device, "media_left_ml", "M0", 700.0)
    add_mark(tmp_path, Mark(1.0, "M0", "bottle", bottle_ml=700.0))
    marks.take(made.loop)
    fed_ml = float(made.loop.interlock.budget.fed_ml[0])
    first = next(steps)
    assert first.volume_ml[0] > 0.0
    later = [next(steps) for _ in range(20)]
    assert not any("no_dilution" in (step.reasons[0] or "") for step in [first, *later])
    dies(made)
    made.begin()
    assert made.loop.interlock.budget.bottle_ml[0] == pytest.approx(fed_ml + 700.0)
    made.close()


def test_what_was_measured_is_told_of_its_own_reactor_with_its_own_numbers(tmp_path, caplog):
    """Of a reactor that is not in the run it stands in the journal alone; what is doubtful is a warning."""
    told: list[tuple[Any, ...]] = []
    journal = SimpleNamespace(rows=[], append=lambda kind, fields: told.append((kind, fields)))

    def set_level(name: str, level_ml: float) -> float:
        told.append((name, level_ml))
        return 19.52

    def counted(name: str, share: float, sd: float, minute: float) -> tuple[str, bool]:
        told.append((name, share, sd, minute))
        return f"answered for {name}", name == "M1"

    loop: Any = SimpleNamespace(reactors=SimpleNamespace(names=("M0", "M1")), set_level=set_level, counted=counted)
    record: Any = SimpleNamespace(folder=tmp_path, journal=journal)
    marks = BenchMarks(record)
    add_mark(tmp_path, Mark(1.0, "M0", "inoculated"))
    add_mark(tmp_path, Mark(4.0, "M1", "level", 23.46))
    add_mark(tmp_path, Mark(7.0, "M0", "share", None, 0.4, 0.05))
    add_mark(tmp_path, Mark(7.5, "M7", "level", 12.0))
    add_mark(tmp_path, Mark(8.0, "M7", "share", None, 0.6, 0.01))
    with caplog.at_level("INFO"):
        marks.take(loop)
        assert len(told) == 6
        add_mark(tmp_path, Mark(9.4, "M1", "share", None, 0.25, 0.02))
        marks.take(loop)
    assert len(told) == 8
    journal.rows = [{"kind": kind} for kind in ("level", "share", "sample", "level", "share", "share")]
    BenchMarks(record).take(loop)  # a resumed run knows what its earlier life has taken
    assert told == [
        ("level", {"reactor": "M1", "level_ml": 23.46}), ("M1", 23.46),
        ("share", {"reactor": "M0", "share": 0.4, "sd": 0.05, "minute": 7.0}), ("M0", 0.4, 0.05, 7.0),
        ("level", {"reactor": "M7", "level_ml": 12.0}),
        ("share", {"reactor": "M7", "share": 0.6, "sd": 0.01, "minute": 8.0}),
        ("share", {"reactor": "M1", "share": 0.25, "sd": 0.02, "minute": 9.4}), ("M1", 0.25, 0.02, 9.4),
    ]  # fmt: skip
    assert [record.levelname for record in caplog.records] == ["INFO", "INFO", "WARNING"]
    assert [r.msg.fields["reactor"] for r in caplog.records] == ["M1", "M0", "M1"]  # type: ignore[attr-defined]
    assert logged(caplog, LevelMarked) == [{"reactor": "M1", "level_ml": 23.46, "ledger_ml": 19.52}]
    assert [told["answer"] for told in logged(caplog, ShareMarked)] == ["answered for M0", "answered for M1"]


def test_what_was_counted_stands_before_the_note_which_is_cut_to_a_line(tmp_path: Path) -> None:
    folder = _under_way(tmp_path / "run")
    mark(MarkConfig(str(folder), "M0", "x" * 80, share=0.4, sd=0.012, minute=3.0))
    mark(MarkConfig(str(folder), "M0", level_ml=0.0))
    mark(MarkConfig(str(folder), "M0", level_ml=40.0, text="foam"))
    first, second, third = read_marks(folder)
    assert first == Mark(3.0, "M0", "share 0.4 +- 0.012, " + "x" * 60, None, 0.4, 0.012)
    assert (second.text, second.level_ml, third.text, third.level_ml) == ("level 0 mL", 0.0, "level 40 mL, foam", 40.0)
    with pytest.raises(ValueError, match=r"share = 0\.4: allowed null together with level_ml; mark each separately"):
        MarkConfig(str(folder), "M0", share=0.4, level_ml=20.0)
    for key, value in {"share": 0.4, "level_ml": 18.5, "bottle_ml": 500.0}.items():
        with pytest.raises(ValueError, match=f"reactor = '': allowed a reactor, because {key} is given"):
            MarkConfig(str(folder), **{key: value})
    with pytest.raises(ValueError, match="minute = 3.0"):  # a level is of now
        MarkConfig(str(folder), "M0", level_ml=18.5, minute=3.0)
    (folder / "journal.jsonl").write_text("")
    with pytest.raises(frame.UserError, match=r"run=.*run: the run has not begun; wait for its first sample"):
        mark(MarkConfig(str(folder), "M0"))


def test_a_sample_may_be_of_any_minute_up_to_the_newest_row_of_any_reactor(tmp_path: Path) -> None:
    """M0 was given up at minute 7, M1 came to minute 93.5; the run is over."""
    over = _under_way(tmp_path / "over", "sim")
    (over / "recordings" / "M0.csv").write_text("time_min,od\n7.0,0.4\n")
    (over / "recordings" / "M1.csv").write_text("time_min,od\n3.0,0.4\n93.5,0.5\n")
    (over / "recordings" / "M2.csv").write_text("time_min,od\n")
    said = mark(MarkConfig(str(over), "M0", share=0.4, minute=93.5))
    assert said.startswith("M0: share 0.4 +- 0.03 at minute 93.5, in ")
    assert said.endswith("marks.csv; a running deployment uses this value at its next sample")
    said = mark(MarkConfig(str(over), text="new bottle", minute=-30.0))
    assert said == f"all reactors: new bottle at minute -30.0, in {over}/marks.csv"
    with pytest.raises(frame.UserError, match=r"reactor=M3: not in this run; allowed M0, M1, M2$"):
        mark(MarkConfig(str(over), "M3", minute=1.0))
    with pytest.raises(frame.UserError, match=r"minute=93\.6: allowed up to 94"):
        mark(MarkConfig(str(over), "M0", share=0.4, minute=93.6))


def _under_way(folder: Path, kind: str = "emulator") -> Path:
    """A run that began two minutes ago, ten times faster than the clock."""
    (folder / "recordings").mkdir(parents=True)
    (folder / "recordings" / "M0.csv").write_text("time_min\n")
    (folder / "config.yaml").write_text(f"backend: {{kind: {kind}, speed: 10}}\n")
    row = {"n": 0, "wall": time.time() - 120.0, "mono": 1.0, "kind": "command"}
    (folder / "journal.jsonl").write_text(json.dumps(row) + "\n")
    return folder


def _ends(folder: Path, *kinds: str) -> None:
    with open(folder / "journal.jsonl", "a", encoding="utf-8") as f:
        for n, kind in enumerate(kinds, 1):
            f.write(json.dumps({"n": n, "wall": time.time(), "mono": 2.0, "kind": kind}) + "\n")


def test_a_run_that_was_stopped_and_resumed_is_under_way_again(tmp_path: Path) -> None:
    folder = _under_way(tmp_path / "run")
    (folder / "summary.json").write_text("{}")
    _ends(folder, "start", "stop", "start")
    mark(MarkConfig(str(folder), "M0", "inoculated"))
    (found,) = read_marks(folder)
    assert found.time_min == pytest.approx(20.0, abs=2.0), "of the run, not since it was resumed"
    mark(MarkConfig(str(folder), "", "bottle", minute=1.25))
    assert read_marks(folder)[1] == Mark(1.25, "", "bottle")


@pytest.mark.parametrize("text", ["foam (2 mL)", "pH=7", "a, b", "it's in", "'quoted already'"])
def test_a_note_is_taken_as_it_was_typed(text, tmp_path, monkeypatch, capsys):
    """The command leaves a mark and no folder of its own."""
    monkeypatch.chdir(tmp_path)
    folder = _under_way(tmp_path / "run")
    monkeypatch.setattr("sys.argv", ["mark", "run=run", f"text={text}"])
    command()
    assert [m.text for m in read_marks(folder)] == [text.strip("'")]
    assert [path.name for path in tmp_path.iterdir()] == ["run"]
    assert text.strip("'") in capsys.readouterr().out


def test_a_share_is_of_a_sample_that_somebody_has_drawn(tmp_path: Path) -> None:
    folder = _under_way(tmp_path / "run")
    with pytest.raises(frame.UserError, match=r"minute=40: allowed up to (19|20|21|22), "):
        mark(MarkConfig(str(folder), "M0", share=0.4, minute=40.0))
    mark(MarkConfig(str(folder), "M0", "plate 7", share=0.4, minute=12.0))
    assert read_marks(folder) == [Mark(12.0, "M0", "share 0.4 +- 0.03, plate 7", None, 0.4, 0.03)]
    with pytest.raises(ValueError, match="sd = 0.05: allowed null, or together with share"):
        MarkConfig(str(folder), "M0", sd=0.05)


def test_a_mark_that_was_torn_is_not_there_and_comes_again(tmp_path: Path) -> None:
    """A full disk took half of a row; whoever reads meanwhile sees none, and the next mark is whole."""
    first, second = Mark(1.0, "M0", "a", None, 0.4, 0.03), Mark(2.0, "M0", "b", None, 0.35, 0.04)
    path = add_mark(tmp_path, first)
    size = path.stat().st_size
    add_mark(tmp_path, second)
    whole = path.read_bytes()
    for cut in range(size + 1, len(whole)):
        path.write_bytes(whole[:cut])
        assert read_marks(tmp_path) == [first]
    add_mark(tmp_path, second)
    assert read_marks(tmp_path) == [first, second]
    path.write_bytes(whole[:-5] + b"0.0\n")
    with pytest.raises(RecordingError, match=r"share 0\.35 at minute 2 has no sd above 0"):
        read_marks(tmp_path)


def test_whoever_marks_waits_for_another_one(tmp_path: Path) -> None:
    """Two files begun at once would have two headers."""
    held = os.open(tmp_path, os.O_RDONLY)
    fcntl.flock(held, fcntl.LOCK_EX)
    with ThreadPoolExecutor(1) as pool:
        waiting = pool.submit(add_mark, tmp_path, Mark(1.0, "M0", "second"))
        with pytest.raises(TimeoutError):
            waiting.result(0.5)
        assert not (tmp_path / "marks.csv").exists()
        os.close(held)
        waiting.result(30.0)
    assert [mark.text for mark in read_marks(tmp_path)] == ["second"]


@pytest.mark.parametrize(
    ("config", "message"),
    [
        ({"run": "nowhere"}, "run=nowhere: not a deployment"), ({}, "run=: not a deployment"),
        ({"run": "run", "reactor": "M7"}, "reactor=M7: not in this run; allowed M0"),
        ({"run": "over"}, "run=over: the run is over; give "),
        ({"run": "simulated"}, "run=simulated: the run is over; give "),
    ],
)  # fmt: skip
def test_what_is_wrong_is_named(config, message, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    _under_way(tmp_path / "run")
    _under_way(tmp_path / "simulated", "sim")
    _ends(_under_way(tmp_path / "over"), "stop")
    with pytest.raises(frame.UserError, match=message):
        mark(MarkConfig(**config))
    for text in ("", "two\nlines", "x" * 81):
        with pytest.raises(ValueError, match="text = .*allowed 1 to 80 characters"):
            MarkConfig("run", text=text)
