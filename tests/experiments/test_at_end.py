"""What a reactor does once its own schedule is over and its neighbour's is not."""

from dataclasses import replace
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import pytest

from envs.scenario import Scenario
from experiments.cli import frame
from experiments.control import assemble
from experiments.control.config import DeployConfig
from experiments.record.record import Record
from hardware.emulator.faults import inject
from tests.campaigns.rehearsal import Rehearsal, rehearsed
from tests.hardware.emulator_lab import quiet


def begun(folder: Path, total_min: float, *names: str, **own: Any) -> Rehearsal:
    """Reactors that grow with 0.03 1/min, of which M0 may have a schedule and an end of its own."""
    config = replace(rehearsed(names, Scenario((0.4,), (total_min,), (37.0,))), each={"M0": own})
    run = Rehearsal(folder, config, quiet(mu=0.03), od=0.4)
    run.begin()
    return run


@pytest.mark.slow
def test_it_is_handed_over_to_the_device_and_stays_so(tmp_path: Path) -> None:
    run = begun(tmp_path, 70.0, "M0", "M1", minutes=[10.0], at_end="regulate")
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
    run = begun(tmp_path, 12.0, "M0", "M1", minutes=[4.0], at_end="regulate")
    list(run.run(190.0))
    inject(run.device, "spectrometer_dead", "M0", 1)
    for _ in run.run(480.0):
        assert not run.reactors.handed_over[0]
    assert run.loop.done[0]
    inject(run.device, "spectrometer_dead", "M0", 0)
    list(run.run())
    assert run.reactors.handed_over.tolist() == [True, False]


def test_the_last_reactor_is_handed_over_too_before_the_run_ends(tmp_path: Path) -> None:
    run = begun(tmp_path, 5.0, "M0", at_end="regulate")
    list(run.run())
    assert run.reactors.handed_over.tolist() == [True]


@pytest.mark.parametrize("stopped", [True, False])
def test_a_run_that_is_over_is_not_taken_to_the_device_again_once_its_pumps_were_verified_off(
    tmp_path: Path, stopped: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    run = begun(tmp_path, 5.0, "M0")
    list(run.run())
    if stopped:
        run.reactors.stop()
    run.close()
    setup = assemble.unpack(replace(run.config, resume=str(tmp_path)), tmp_path)
    record = Record(tmp_path, run.names, setup.fsync, setup.columns)
    tried = ConnectionError("the device was asked")
    monkeypatch.setattr(setup.family, "open", Mock(side_effect=tried))
    with pytest.raises(frame.UserError if stopped else ConnectionError, match="is over" if stopped else "was asked"):
        assemble.opened(setup, record).__enter__()
    record.close()


def test_a_word_that_is_none_of_them_is_refused() -> None:
    with pytest.raises(ValueError, match=r"each\.M0\.at_end = sleep: allowed hold, stop, regulate"):
        DeployConfig(each={"M0": {"at_end": "sleep"}}).ends()
    assert DeployConfig(each={"M0": {}, "M1": {"at_end": "stop"}}).at_end == "hold"
