"""What a kill kept from being written is completed from the journal when the run is opened again."""

import csv
import json
from pathlib import Path

import pytest

from experiments.record.record import Record
from experiments.record.recovery import COLUMNS, load_state
from hardware.errors import RecordingError
from hardware.storage.doses import Ending


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
    assert [float(last[k]) for k in ("time_min", "elapsed_min", "od", "setpoint", "volume_ml")] == [
        3.0,
        2.0,
        0.51,
        0.4,
        0.0,
    ]
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
    with pytest.raises(RecordingError, match="no state to resume from"):
        load_state(tmp_path / "recordings" / "state.json")
