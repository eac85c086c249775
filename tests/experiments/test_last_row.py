"""The end of a run: what its last doses came to, a recording that is gone, a run that another program is at."""

from pathlib import Path
from typing import Any

import pytest

from experiments.control import run as control
from experiments.record.messages import RecordingGone, RecordingUnreadable
from experiments.record.record import Record
from experiments.record.recovery import Rows, at_end
from experiments.record.summary import ChangeLog
from hardware.emulator.faults import inject
from hardware.storage.doses import Ending
from hardware.storage.messages import JournalTaken
from tests.experiments.test_open_dose import in_a_dose
from tests.hardware.script import logged


def test_what_was_repeated_after_the_last_row_is_in_it_and_once_however_often_the_run_goes_on(tmp_path: Path) -> None:
    """The link is gone for five minutes in a dose, and the run is stopped before the next sample."""
    run = in_a_dose(tmp_path, "M0")
    for life in range(3):
        inject(run.device, "lost_request", "all", -1)
        run.wait(300.0)
        inject(run.device, "lost_request", "all", 0)
        run.reactors.stop()
        run.loop._book_repeats()
        run.record.complete()
        run.record.complete()  # changes nothing more
        fed_ml = float(run.loop.interlock.budget.fed_ml[0])
        assert run.record.series("volume_ml").sum() == pytest.approx(fed_ml, abs=1e-3)
        assert float(run.truth("M0")["feed_ml"]) == pytest.approx(fed_ml, rel=0.1)
        run.close()
        run.begin()
        assert float(run.loop.interlock.budget.fed_ml[0]) == pytest.approx(fed_ml, abs=1e-3), life
        list(run.run(run.clock.now() + 180.0))
        while not run.device.apps["M0"].data["Pump1"]["ON"]:
            run.loop.step()
    run.close()


def test_with_its_last_row_a_recording_has_what_its_journal_has_of_each_dose() -> None:
    journal, rows = list[dict[str, Any]](), Rows()
    for at, ml, written_ml in ((0.0, 1.2, 1.2), (60.0, 0.0, 1.2), (120.0, 0.0, 0.0)):
        rows.append(cells := dict.fromkeys(rows.names, 0.0) | {"time_min": at / 60.0, "volume_ml": written_ml})
        asked, end = {"on_s": at, "feed_ml": 1.2, "waste_ml": 0.0}, Ending(at, ml, 0.0).row()
        told = {"decision": {"row": cells}, "intent": asked, "feed_on": {}, "dose_end": end}
        journal += [{**told[kind], "reactor": "M0", "kind": kind, "n": len(journal) + k} for k, kind in enumerate(told)]
    last = at_end(journal, "M0", rows) or {}
    assert sum(rows.columns["volume_ml"][:-1]) + float(last.get("volume_ml") or 0.0) == pytest.approx(1.2)


def test_a_run_that_is_under_way_is_left_as_it_is(tmp_path: Path) -> None:
    """Nothing is cut, completed or begun in a folder that another program writes to."""
    record = Record(tmp_path, ("M0",), fsync=False)
    record.journal.append("sample", {"reactor": "M0", "time_s": 60.0, "od": 0.5, "temperature": 37.0})
    with open(record.journal.path, "ab") as f:
        f.write(b'{"n":1,"ha')  # just being written
    before = {path: path.read_bytes() for path in tmp_path.rglob("*.*")}
    with pytest.raises(JournalTaken):
        Record(tmp_path, ("M0",), fsync=False)
    assert {path: path.read_bytes() for path in before} == before
    record.close()
    Record(tmp_path, ("M0",), fsync=False).close()


@pytest.mark.parametrize("how", ["deleted", "moved"])
def test_a_recording_that_is_deleted_in_a_run_is_told_with_the_next_row_and_at_its_end(tmp_path, how, caplog):
    run = in_a_dose(tmp_path, "M0")
    (path,) = (tmp_path / "recordings").glob("*.csv")
    assert caplog.text == ""
    path.unlink() if how == "deleted" else path.rename(tmp_path / "elsewhere")
    for _ in run.run(run.clock.now() + 150.0):
        pass
    assert logged(caplog, RecordingGone) == [{"path": path}]
    run.reactors.stop()
    rows = len(run.record.rows[0])
    with pytest.raises(RecordingUnreadable):
        run.record.complete()
    assert len(run.record.rows[0]) == rows  # for figure and summary
    run.close()


def test_an_exception_in_a_dose_ends_the_run_with_its_pumps_off(tmp_path, monkeypatch):
    def steps() -> None:
        raise RuntimeError("a bug")

    run = in_a_dose(tmp_path, "M0")
    monkeypatch.setattr(run.loop, "run", steps)
    assert control._run(run.loop, run.record, lambda *_: None) == "failed: RuntimeError: a bug"
    assert not any(run.truth("M0")["motors"].values())
    run.close()


def said(caplog: pytest.LogCaptureFixture, notes: list[tuple[float, str]]) -> list[str]:
    """What of these notes, each with its run time, came to the screen."""
    log = ChangeLog.__new__(ChangeLog)
    log._noted = {}
    caplog.clear()
    caplog.set_level("INFO")
    for now_s, note in notes:
        log.notes(now_s, [note])
    return [note for _, note in notes if note in caplog.text]


def test_a_note_of_one_reactor_silences_no_other_and_what_has_doubled_is_told_again(caplog):
    same = "a dose of 1.05 mL was repeated up to {} times by the device"
    notes = [(0.0, f"M0: {same.format(1)}"), (1.0, f"M1: {same.format(1)}"), (2.0, f"M2: {same.format(1)}")]
    notes += [(60.0, f"M0: {same.format(9)}"), (61.0, "M0: pumps on: Pump1"), (62.0, "M0: pumps on: Pump3")]
    quiet = [(120.0, f"M0: {same.format(8)}"), (180.0, "M0: 0.01 mL kept"), (240.0, "M0: 0.011 mL kept")]
    heard = said(caplog, [*notes, *quiet])
    assert heard == [note for _, note in [*notes, quiet[1]]]
    assert said(caplog, [(0.0, "M0: 0.3 mL kept"), (3600.0, "M0: 0.2 mL kept")]) == [
        "M0: 0.3 mL kept", "M0: 0.2 mL kept",
    ]  # fmt: skip
