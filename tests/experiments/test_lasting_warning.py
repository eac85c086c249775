"""A pump too weak for its culture, from the emulator to the console, the journal and the summary."""

from pathlib import Path

import pytest

from envs.scenario import Scenario
from experiments.record.summary import ChangeLog, reasons_line, summarise
from hardware.emulator.faults import inject
from hardware.storage.journal import read_journal
from tests.campaigns.rehearsal import Rehearsal, rehearsed
from tests.hardware.emulator_lab import quiet


@pytest.mark.slow
def test_half_the_flow_is_told_at_its_beginning_at_its_end_and_in_every_row_between(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    scenario = Scenario((0.5,), (130.0,), (37.0,))
    run = Rehearsal(tmp_path, rehearsed(("M0",), scenario, controller="threshold"), quiet(mu=0.032), od=0.7)
    inject(run.device, "pump_gain_factor", "M0", 0.5)
    run.begin()
    log_changes = ChangeLog(run.loop)
    with caplog.at_level("WARNING"):
        for step in run.run():
            log_changes(step)
            if step.minute[0] > 70.0:
                inject(run.device, "pump_gain_factor", "M0", 1.0)
    assert [record.getMessage().split(";")[0] for record in caplog.records] == [
        "M0: cannot_hold: full feed does not bring OD down to 0.5",
        "M0: interlock: all well again",
    ]
    (reason,) = run.record.rows[0].reasons.items()
    assert reason[0] == "cannot_hold"
    assert reason[1].first_min < 40.0
    assert 70.0 < reason[1].last_min < 100.0
    assert reason[1].rows == pytest.approx(reason[1].last_min - reason[1].first_min + 1.0, abs=1.5)  # without a gap
    rows = [row for row in read_journal(tmp_path / "journal.jsonl")[0] if row["kind"] == "decision"]
    assert sum("cannot_hold" in row["row"]["interlock"] for row in rows) == reason[1].rows
    summary = summarise(run.record.table(), [scenario], ["replicate"], "completed")
    assert summary["reactors"]["M0"]["reasons"]["cannot_hold"]["rows"] == reason[1].rows
    assert reasons_line(run.record.rows[0]).startswith(f"cannot_hold in {reason[1].rows} of {len(rows)} rows, minute ")
