"""A program that dies in a dose, and the end of a run: what a device repeated is booked when it happened, once."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from conf.messages import Message
from envs.scenario import Scenario
from experiments.control import run as control
from experiments.laws.base import Array, Mask
from experiments.loop.loop import Step
from experiments.record.messages import RecordingGone, RecordingUnreadable
from experiments.record.record import Record
from experiments.record.recovery import Rows, at_end
from experiments.record.summary import ChangeLog
from hardware.chibio import messages
from hardware.emulator.faults import inject
from hardware.emulator.transport import EmulatorTransport
from hardware.errors import LinkError
from hardware.link.transport import SwitchedOff
from hardware.messages import OpenDose
from hardware.storage.doses import Ending
from hardware.storage.journal import read_journal
from hardware.storage.messages import JournalTaken
from tests.campaigns.rehearsal import Rehearsal, StandIn, rehearsed
from tests.hardware.emulator_lab import quiet
from tests.hardware.script import logged, noted

FEED_ON, FEED_OFF, WASTE_ON = "/SetOutputOn/Pump1/1/M0", "/SetOutputOn/Pump1/0/M0", "/SetOutputOn/Pump2/1/M0"
TARGET = "/SetOutputTarget/Pump1/M0/"


class Greedy(StandIn):
    """A controller that always asks for the largest rate."""

    def act(self, od: Array, setpoint: Array, minute: Array, rows: Mask) -> Array:
        return np.full(od.shape, 0.02)


class Full(Rehearsal):
    """A run whose controller always asks for the largest rate."""

    def __init__(self, folder: Path, *names: str) -> None:
        schedule = Scenario((0.5,), (600.0,), (37.0,))
        super().__init__(folder, rehearsed(names or ("M0",), schedule), quiet(mu=0.03), od=0.8)

    def begin(self) -> None:
        super().begin()
        self.loop.density.law = Greedy(self.loop.density.law)


class Cut(Full):
    """One reactor at full feed; the program ends at the first request of a kind after some minutes."""

    def __init__(self, folder: Path, request: str, stops: bool = False) -> None:
        super().__init__(folder)
        self.begin()
        list(self.run(300.0))
        self.kill_at(request, stops=stops)
        self.killed(900.0)
        self.died_s = self.clock.now()

    def resumed(self, minutes: float = 4.0) -> list[Step]:
        """Steps of the next life that bring a sample."""
        self.begin()
        return [step for step in self.run(self.clock.now() + 60.0 * minutes) if step.rows.any()]

    def journal(self, kind: str) -> list[dict[str, Any]]:
        return [row for row in read_journal(self.folder / "journal.jsonl")[0] if row["kind"] == kind]

    def noted(self, *kinds: type[Message]) -> list[dict[str, Any]]:
        """The values of these messages since the dose that was left open was told of, which is done once."""
        notes = self.journal("note")
        (at,) = [k for k, note in enumerate(notes) if note["name"] == "OpenDose"]
        return noted(notes[at:], *kinds)

    def off_by_ml(self) -> float:
        """What is booked beyond what really flowed, after the last dose has."""
        self.wait(5.0)
        return float(self.loop.interlock.budget.fed_ml[0]) - float(self.truth("M0")["feed_ml"])


def in_a_dose(folder: Path, *names: str) -> Rehearsal:
    """A run after some minutes at full feed, the feed pump of M0 on."""
    run = Full(folder, *names)
    run.begin()
    list(run.run(300.0))
    while not run.device.apps["M0"].data["Pump1"]["ON"]:
        run.loop.step()
    return run


def reasons(steps: list[Step]) -> str:
    return " ".join(step.reasons[0] or "" for step in steps)


def test_repeats_of_a_dead_program_are_booked_when_they_happened_and_alarm_nobody(tmp_path: Path) -> None:
    run = Cut(tmp_path, FEED_ON)
    run.wait(900.0)
    steps = run.resumed()
    assert "falls" not in reasons(steps)
    assert "budget" not in reasons(steps)
    assert steps[0].rate[0] == 0.02  # dosed with the very first sample
    times = 900 // 63
    [told] = run.noted(messages.DoseRepeated)  # its command had not been answered
    assert (told["times"], told["most_ml"]) == (times, pytest.approx(1.2 * (times + 1), abs=0.005))
    assert abs(run.off_by_ml()) < 0.1 * times  # a single dose varies
    (end,) = [row for row in run.journal("dose_end") if row["feed_times"]]
    assert end["repeated_ml"] == pytest.approx(1.2 * times, rel=1e-3)
    zero = run.spans[0][0]
    starts = [d.start_s for d in run.device.vials["M0"].doses if d.pump == "Pump1"]
    again = [at for at in starts if run.died_s + 5.0 < at < run.spans[1][0]]
    booked = [end["on_s"] + 63.0 * k + zero for k in range(1, times + 1)]
    assert len(again) == times
    np.testing.assert_allclose(booked, again, atol=0.6 * times)  # the device's period is a little longer
    volume = run.record.series("volume_ml")[0]
    assert volume.sum() == pytest.approx(float(run.loop.interlock.budget.fed_ml[0]))
    hour = run.loop.interlock.budget._hour[0]
    assert hour.max() < 2.5  # a minute holds two repetitions at most


@pytest.mark.slow
@pytest.mark.parametrize("decides", [False, True])
def test_they_are_booked_once_and_stand_in_one_row_however_often_the_program_dies(tmp_path, decides):
    """Again before its first sample, or when it has decided with the repeats booked and not yet saved that it has."""
    run = Cut(tmp_path, FEED_ON)
    run.wait(500.0)
    run.begin()
    if decides:
        run.kill_at(TARGET)
        run.killed(run.clock.now() + 300.0)
    else:
        run.close()
    run.wait(100.0)
    steps, budget = run.resumed(), run.loop.interlock.budget
    assert "overflow" not in reasons(steps)  # what the waste pump took out with each of them is booked too
    assert budget.volume_ml[0] < 20.0 + 1.3
    assert budget._hour[0].max() < 2.5  # each in the minute in which it was given
    assert abs(run.off_by_ml()) < 1.0
    assert noted(run.journal("note"), OpenDose)
    assert run.record.series("volume_ml")[0].sum() == pytest.approx(float(budget.fed_ml[0]))


@pytest.mark.parametrize("how", ["worker_wipe", "power_cut"])
@pytest.mark.parametrize("after_s", [3.0, 271.0])
def test_a_device_that_was_restarted_repeated_the_dose_until_then_and_nobody_knows_when(tmp_path, how, after_s):
    run = Cut(tmp_path, FEED_ON)
    run.wait(after_s)
    inject(run.device, how)
    run.wait(40.0)
    if how == "power_cut":
        inject(run.device, "restart")
    run.wait(860.0 - after_s)
    true = [d.seconds for d in run.device.vials["M0"].doses if d.pump == "Pump1" and d.start_s > run.died_s - 5.0]
    ended = len(run.journal("dose_end"))
    run.resumed()
    assert run.noted(messages.RestartedInDose)
    end = run.journal("dose_end")[ended]
    assert len(true) == 1 + after_s // 63.0
    more_ml = 0.05 * len(true)  # each dose by itself
    assert end["feed_low_ml"] <= sum(true) <= end["feed_ml"] * (1.0 + end["feed_times"]) + more_ml
    assert run.off_by_ml() > -more_ml


@pytest.mark.parametrize(
    ("request_", "none", "waste_times"), [(FEED_OFF, False, [14]), (TARGET, True, []), (WASTE_ON, True, [14])]
)
def test_killed_while_the_feed_pump_does_not_run_no_medium_followed(tmp_path, request_, none, waste_times):
    """In the waste tail, or before the feed pump was started."""
    run = Cut(tmp_path, request_)
    run.wait(900.0)
    run.resumed()
    assert len(run.noted(messages.DoseGaveNothing)) == none
    assert not run.noted(messages.DoseRepeated)
    assert abs(run.off_by_ml()) < 1.0
    assert run.record.series("volume_ml")[0].sum() == pytest.approx(float(run.loop.interlock.budget.fed_ml[0]))
    assert [row["waste_times"] for row in run.journal("dose_end") if row["waste_times"]] == waste_times


@pytest.mark.parametrize(("request_", "fed"), [(FEED_ON, True), (WASTE_ON, False), (TARGET, False)])
def test_a_clean_stop_leaves_no_dose_open_and_its_row_tells_what_was_given(tmp_path, request_, fed):
    run = Cut(tmp_path, request_, stops=True)
    end = run.journal("dose_end")[-1]
    true = [d for d in run.device.vials["M0"].doses if d.pump == "Pump1" and d.start_s > run.died_s - 5.0]
    assert len(true) == fed
    assert end["feed_ml"] == pytest.approx(sum(d.seconds for d in true), abs=0.6)  # the motor starts late
    assert (0.0 < end["feed_ml"] < 1.0) is fed  # cut short: 1.2 mL were planned
    run.wait(900.0)
    run.resumed()
    assert not noted(run.journal("note"), OpenDose)
    rows = run.record.series("volume_ml")[0]
    assert end["feed_ml"] in rows
    assert abs(run.off_by_ml()) < 1.0


def test_a_stop_after_the_row_was_written_puts_the_dose_right_in_it(tmp_path: Path) -> None:
    """The row comes with the feed pump's start, the end half a second later."""
    run = Full(tmp_path)
    run.begin()
    steps = [step for step in run.run(300.0) if step.rows[0]]
    assert run.device.apps["M0"].data["Pump1"]["ON"]
    run.clock.sleep(0.6)
    run.reactors.stop()
    run.record.complete()
    given = [row for row in run.record.journal.reread() if row["kind"] == "dose_end"][-1]
    assert given["feed_times"] == 0
    true = [d.seconds for d in run.device.vials["M0"].doses if d.pump == "Pump1"][-1]
    off_s = [row for row in run.record.journal.reread() if row.get("path") == FEED_OFF][-1]["time_s"]
    asked_s = off_s - given["on_s"]  # until its off was answered, and the bias of .06 s, at 1 mL/s
    assert given["feed_ml"] == pytest.approx(asked_s + 0.06, abs=1e-3)
    assert given["feed_low_ml"] <= true <= given["feed_ml"]
    volume = run.record.series("volume_ml")[0]
    np.testing.assert_allclose(volume, [*[step.volume_ml[0] for step in steps[:-1]], given["feed_ml"]])
    run.record.complete()  # nothing is left to do
    np.testing.assert_allclose(run.record.series("volume_ml")[0], volume)
    run.record.close()
    np.testing.assert_allclose(Record(tmp_path, ("M0",), fsync=False).series("volume_ml")[0], volume)


@pytest.mark.parametrize("answers", [True, False])
def test_repeats_before_a_board_agent_ended_them_are_booked(tmp_path, monkeypatch, answers):
    run = Cut(tmp_path, FEED_ON)
    run.wait(run.config.backend.deadman_s)
    ended_s, before = run.clock.now(), run.truth("M0")["feed_ml"]
    for pump in (1, 2):
        run.device.handle("POST", f"/SetOutputOn/Pump{pump}/0/M0")  # as the board agent does

    def said(link: EmulatorTransport) -> SwitchedOff:
        if not answers:
            raise LinkError("cut")
        ago_s = run.clock.now() - ended_s
        return {"M0": {"Pump1": ago_s, "Pump2": ago_s}}

    monkeypatch.setattr(EmulatorTransport, "switched_off", said)
    run.wait(3000.0)
    assert run.truth("M0")["feed_ml"] == pytest.approx(before, abs=0.01)
    run.resumed()
    if answers:
        assert run.noted(messages.AgentSwitchedOff) == [{"pumps": "Pump1, Pump2"}]
        assert abs(run.off_by_ml()) < 0.9  # eight doses vary, one more or less would be 1.2
    else:
        assert [told["times"] for told in run.noted(messages.DoseRepeated)] == [2]
        assert -0.6 < run.off_by_ml() < 1.8  # every repetition, and at most one that the agent was quicker than


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
    same = "the device repeated a dose of 1.05 mL up to {} times"
    notes = [(0.0, f"M0: {same.format(1)}"), (1.0, f"M1: {same.format(1)}"), (2.0, f"M2: {same.format(1)}")]
    notes += [(60.0, f"M0: {same.format(9)}"), (61.0, "M0: on: Pump1"), (62.0, "M0: on: Pump3")]
    quiet = [(120.0, f"M0: {same.format(8)}"), (180.0, "M0: 0.01 mL kept"), (240.0, "M0: 0.011 mL kept")]
    heard = said(caplog, [*notes, *quiet])
    assert heard == [note for _, note in [*notes, quiet[1]]]
    assert said(caplog, [(0.0, "M0: 0.3 mL kept"), (3600.0, "M0: 0.2 mL kept")]) == [
        "M0: 0.3 mL kept", "M0: 0.2 mL kept",
    ]  # fmt: skip
