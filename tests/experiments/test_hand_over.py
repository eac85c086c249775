"""A reactor that was handed over to the on-board regulation is never without control, nor one that is done."""

from dataclasses import replace
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import numpy as np
import pytest

from envs.scenario import Scenario
from experiments.cli import frame
from experiments.control import assemble
from experiments.control import run as control
from experiments.laws.base import Array, Controller, Mask
from experiments.record.record import Record
from hardware.chibio.messages import HandOverFailed, NotTakenOver
from hardware.emulator.faults import inject
from hardware.safety.interlock import Response
from hardware.storage.journal import read_journal
from tests.campaigns.rehearsal import Killed, Rehearsal, StandIn, rehearsed
from tests.hardware.emulator_lab import quiet


class Losing(StandIn):
    """A sound controller that is lost for the first reactor after some samples, and says when it has been for five."""

    def __init__(self, inner: Controller, run: "Losable") -> None:
        super().__init__(inner)
        self.run = run

    def act(self, od: Array, setpoint: Array, minute: Array, rows: Mask) -> Array:
        rate = self.inner.act(od, setpoint, minute, rows)
        if self.run.sound:
            return rate
        self.run.unusable += bool(rows[0])
        return np.where(np.arange(rows.size) == 0, np.nan, rate)


class Losable(Rehearsal):
    """Two reactors of which the first loses its controller; the program dies at the n-th request after that."""

    def __init__(self, folder: Path, dies_at: int | None = None) -> None:
        super().__init__(folder, rehearsed(("M0", "M1"), Scenario((0.5,), (600.0,), (37.0,))), seed=3)
        self.sound, self.unusable, self.requests, self.dies_at = False, 0, 0, dies_at
        self._submit = self.device.submit
        self.device.submit = self._counted  # type: ignore[method-assign]

    def begin(self) -> None:
        super().begin()
        self.loop.density.law = Losing(self.loop.density.law, self)

    def _counted(self, method: str, path: str, *rest: Any) -> Any:
        exchange = self._submit(method, path, *rest)
        if self.unusable >= 5 and self.lives == 1:
            self.requests += 1
            if self.requests == self.dies_at:
                self.kill()  # the device carries it out, nobody waits for the answer
        return exchange

    def live(self, minutes: float) -> None:
        list(self.run(self.clock.now() + 60.0 * minutes))

    def data(self, name: str = "M0") -> dict[str, Any]:
        self.device.run_until(self.clock.now())
        return dict(self.device.apps[name].data)

    def journaled(self, kind: str, since: int = 0) -> list[dict[str, Any]]:
        rows, _ = read_journal(self.folder / "journal.jsonl")
        return [row for row in rows[since:] if row["kind"] == kind and row["reactor"] == "M0"]


def handed_over(folder: Path, dead_s: float = 300.0) -> Losable:
    """A run that handed over its first reactor, went on, and was killed."""
    run = Losable(folder)
    run.begin()
    run.live(10)
    assert run.reactors.handed_over.tolist() == [True, False]
    run.close()
    run.wait(dead_s)
    return run


def regulated_at(run: Losable, target: float = 0.5) -> None:
    """It regulates itself, was verified, is not dosed beside it, and the interlock knows."""
    since = len(run.record.journal.rows)
    run.live(12)
    data = run.data()
    assert (data["OD"]["ON"], data["OD"]["target"]) == (1, target)
    assert run.reactors.handed_over.tolist() == [True, False]
    assert run.reactors.stations[0].book.fault is None
    assert not run.journaled("intent", since)
    assert all("handed over" in row["row"]["interlock"] for row in run.journaled("decision", since))
    assert run.truth("M0")["od"] == pytest.approx(0.5, abs=0.1)
    assert run.truth("M1")["od"] == pytest.approx(0.5, abs=0.05)


def posted(run: Losable) -> list[str]:
    """Every POST to the first reactor from here on."""
    paths: list[str] = []
    before = run.device.submit

    def listening(method: str, path: str, *rest: Any) -> Any:
        if method == "POST" and "M0" in path and "changeDevice" not in path:
            paths.append(path)
        return before(method, path, *rest)

    run.device.submit = listening  # type: ignore[method-assign]
    return paths


@pytest.mark.parametrize("sound", [True, False])
def test_a_resumed_run_leaves_it_to_the_regulation_it_was_handed_over_to(tmp_path, sound, monkeypatch, caplog):
    run = handed_over(tmp_path)
    run.sound = sound
    paths = posted(run)
    run.begin()
    assert not [path for path in paths if "Pump" in path or "OD" in path]  # not even interrupted
    regulated_at(run)
    notes = [row["fields"] for row in run.journaled("note") if row["name"] == "StaysHandedOver"]
    assert {"setpoint": 0.5, "done": "unchanged"} in notes
    monkeypatch.setattr(run.loop, "run", lambda: ())
    with caplog.at_level("INFO"):
        assert control._run(run.loop, run.record, lambda *_: None) == "completed"
    assert "; M0: regulated by" in caplog.text
    assert run.data()["OD"]["ON"] == 1


@pytest.mark.slow
@pytest.mark.parametrize("what", ["/SetOutputOn/OD/0/M0", "/SetOutputTarget/OD/M0/1.2", "/Experiment/0/M0", "wipe"])
def test_a_resumed_run_hands_over_again_what_lost_its_regulation_meanwhile(tmp_path: Path, what: str) -> None:
    run = handed_over(tmp_path)
    run.sound = True
    if what == "wipe":
        inject(run.device, "worker_wipe", "all", 1)
    else:
        run.device.handle("POST", what)
    run.wait(100.0)
    run.begin()
    regulated_at(run)
    notes = [row["note"] for row in run.journaled("note")]
    assert len([note for note in notes if "handed over again, because its on-board OD regulation is" in note]) == 1


@pytest.mark.slow
def test_a_regulation_that_does_not_come_back_is_told_not_believed_and_tried_again(tmp_path, monkeypatch):
    run = handed_over(tmp_path)
    run.device.handle("POST", "/SetOutputOn/OD/0/M0")
    whole = run.device.submit
    monkeypatch.setattr(
        run.device, "submit", lambda m, p, *rest: whole(m, p.replace("/SetOutputOn/OD/1", "/SetOutputOn/OD/0"), *rest)
    )
    run.begin()
    run.live(3)
    fault = run.reactors.stations[0].book.fault
    assert isinstance(fault, NotTakenOver)
    assert isinstance(fault.fields["error"], HandOverFailed)
    assert not run.data()["OD"]["ON"]
    monkeypatch.undo()
    run.live(3)
    assert run.data()["OD"]["ON"]
    assert run.reactors.stations[0].book.fault is None


@pytest.mark.slow
@pytest.mark.parametrize("dies_at", range(1, 17))
def test_killed_in_the_middle_of_handing_over_it_is_dosed_or_regulated(tmp_path: Path, dies_at: int) -> None:
    run = Losable(tmp_path, dies_at)
    run.begin()
    with pytest.raises(Killed):
        run.live(20)
    run.close()
    run.wait(200.0)
    run.sound = True
    run.begin()
    resumed = len(run.record.journal.rows)
    run.live(20)
    regulated = bool(run.data()["OD"]["ON"])
    assert regulated == run.reactors.handed_over[0] == bool(run.journaled("regulate"))
    dosed = [row for row in run.journaled("intent", resumed) if row["feed_ml"] > 0.0]
    assert bool(dosed) != regulated
    decisions = run.journaled("decision", resumed)
    assert regulated == ("handed over" in decisions[-1]["row"]["interlock"])
    assert run.truth("M0")["od"] == pytest.approx(0.5, abs=0.1)


@pytest.mark.slow
def test_a_new_run_takes_control_back_and_says_so(tmp_path: Path) -> None:
    run = handed_over(tmp_path)
    (tmp_path / "new").mkdir()
    run.folder, run.lives, run.sound = tmp_path / "new", 0, True
    run.spans.clear()
    run.begin()
    run.live(10)
    assert run.data()["OD"]["ON"] == 0
    assert "RegulationFoundOn" in [row["name"] for row in run.journaled("note")]
    assert [row for row in run.journaled("intent") if row["feed_ml"] > 0.0]
    assert not run.reactors.handed_over.any()


@pytest.mark.slow
def test_giving_a_reactor_up_ends_its_regulation_too(tmp_path: Path) -> None:
    """Pumps that are switched off under a regulation that is on would run again with its next cycle."""
    run = handed_over(tmp_path)
    run.begin()
    run.live(5)
    assert run.data()["OD"]["ON"] == 1
    run.loop.interlock.latch(Response.STOP, np.array([True, False]))
    run.live(5)
    assert run.loop.stopped.tolist() == [True, False]
    fed = run.device.vials["M0"].on_s["Pump1"]
    assert run.data()["OD"]["ON"] == 0
    assert not run.reactors.handed_over.any()
    run.close()
    run.sound = True
    run.begin()
    run.live(10)
    assert run.data()["OD"]["ON"] == 0
    assert run.device.vials["M0"].on_s["Pump1"] == fed
    assert run.device.vials["M1"].on_s["Pump1"] > 0.0


def over_at(folder: Path, total_min: float, *names: str, **own: Any) -> Rehearsal:
    """Reactors that grow with 0.03 1/min, of which M0 may have a schedule and an end of its own."""
    config = replace(rehearsed(names, Scenario((0.4,), (total_min,), (37.0,))), each={"M0": own})
    run = Rehearsal(folder, config, quiet(mu=0.03), od=0.4)
    run.begin()
    return run


@pytest.mark.slow
def test_it_is_handed_over_to_the_device_and_stays_so(tmp_path: Path) -> None:
    run = over_at(tmp_path, 70.0, "M0", "M1", minutes=[10.0], at_end="regulate")
    list(run.run())
    assert run.loop.done.all()
    assert run.reactors.handed_over.tolist() == [True, False]
    run.reactors.stop()
    run.wait(1800.0)
    data = run.device.apps["M0"].data
    assert (data["OD"]["ON"], data["OD"]["target"]) == (1, 0.4)
    assert run.truth("M0")["od"] == pytest.approx(0.4, abs=0.1)
    assert run.truth("M1")["od"] > 0.6  # nobody doses it after the run
    assert "falls" not in run.record.rows[0].reasons


def test_it_is_not_handed_over_by_a_sensor_that_is_not_believed(tmp_path: Path) -> None:
    run = over_at(tmp_path, 12.0, "M0", "M1", minutes=[4.0], at_end="regulate")
    list(run.run(190.0))
    inject(run.device, "spectrometer_dead", "M0", 1)
    for _ in run.run(480.0):
        assert not run.reactors.handed_over[0]
    assert run.loop.done[0]
    inject(run.device, "spectrometer_dead", "M0", 0)
    list(run.run())
    assert run.reactors.handed_over.tolist() == [True, False]


def test_the_last_reactor_is_handed_over_too_before_the_run_ends(tmp_path: Path) -> None:
    run = over_at(tmp_path, 5.0, "M0", at_end="regulate")
    list(run.run())
    assert run.reactors.handed_over.tolist() == [True]


@pytest.mark.parametrize("stopped", [True, False])
def test_a_run_that_is_over_is_not_taken_to_the_device_again_once_its_pumps_were_verified_off(
    tmp_path: Path, stopped: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    run = over_at(tmp_path, 5.0, "M0")
    list(run.run())
    if stopped:
        run.reactors.stop()
    run.close()
    setup = assemble.unpack(replace(run.config, resume=str(tmp_path)), tmp_path)
    record = Record(tmp_path, run.names, setup.fsync, setup.columns)
    tried = ConnectionError("the device was asked")
    monkeypatch.setattr(setup.family, "open", Mock(side_effect=tried))
    with pytest.raises(frame.UserError if stopped else ConnectionError, match="has ended" if stopped else "was asked"):
        assemble.opened(setup, record).__enter__()
    record.close()
