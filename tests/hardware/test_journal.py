"""The journal: rows survive what kills the process, a torn end is cut and told."""

import os
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from envs.bench import Bench
from envs.plant.plant import PlantConfig
from hardware.family import Opening
from hardware.storage.journal import Journal, read_journal
from hardware.storage.messages import NotOpened, NotWritten


def test_rows_come_back_in_order_with_number_and_time(tmp_path: Path) -> None:
    journal = Journal(tmp_path / "j", wall=lambda: 1000.25)
    journal.append("sample", {"od": np.float64(0.5), "blank": float("nan"), "sample": (60.0, 2), "a": np.arange(2)})
    journal.append("intent", {"reactor": "M0"})
    journal.close()
    rows, torn = read_journal(tmp_path / "j")
    assert torn == 0
    assert [row["n"] for row in rows] == [0, 1]
    assert (rows[0]["kind"], rows[0]["wall"], rows[0]["od"]) == ("sample", 1000.25, 0.5)
    assert (rows[0]["blank"], rows[0]["sample"], rows[0]["a"]) == (None, [60.0, 2], [0, 1])
    again = Journal(tmp_path / "j")
    assert again.rows == rows
    assert again.next_row == 2
    again.close()
    again.close()
    with pytest.raises(NotWritten):
        again.append("x", {})


@pytest.mark.parametrize(
    "torn", [b'{"n":2,"ki', b"\0" * 40, b"\0" * 40 + b"\n", b'{"n":2}', b"[1]\n", b"\xff\n", b"\n"]
)
def test_a_torn_end_is_cut_and_told(tmp_path: Path, torn: bytes) -> None:
    path = tmp_path / "j"
    journal = Journal(path)
    journal.append("a", {})
    journal.append("b", {})
    journal.close()
    whole = path.read_bytes()
    path.write_bytes(whole + torn)
    assert read_journal(path)[1] == len(torn)
    again = Journal(path)
    assert again.cut == len(torn)
    again.append("c", {})
    again.close()
    assert path.read_bytes().startswith(whole)
    assert [row["kind"] for row in read_journal(path)[0]] == ["a", "b", "c"]


@settings(max_examples=40, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(cut=st.integers(0, 400))
def test_a_file_cut_anywhere_keeps_every_whole_row(tmp_path: Path, cut: int) -> None:
    path = tmp_path / "j"
    path.unlink(missing_ok=True)
    journal = Journal(path, fsync=False)
    for k in range(5):
        journal.append("row", {"k": k, "text": "ä\n{"})
    journal.close()
    data = path.read_bytes()[:cut]
    path.write_bytes(data)
    again = Journal(path, fsync=False)
    assert [row["k"] for row in again.rows] == list(range(data.count(b"\n")))
    assert again.cut == len(data) - (data.rfind(b"\n") + 1)
    again.close()


def test_a_missing_folder_or_file_says_what_to_do(tmp_path: Path) -> None:
    with pytest.raises(NotOpened):
        Journal(tmp_path / "no" / "j")
    with pytest.raises(NotOpened):
        read_journal(tmp_path / "j")


@pytest.mark.parametrize("where", ["write", "fsync"])
def test_a_stop_in_a_row_cuts_and_doubles_none(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, where: str) -> None:
    """The stop comes when the row is written and not yet counted; the disk takes only a part of the row after it."""
    journal, call, write = Journal(tmp_path / "journal.jsonl"), getattr(os, where), os.write
    journal.append("first", {})

    def stopped(*arguments: Any) -> None:
        call(*arguments)
        raise KeyboardInterrupt

    with monkeypatch.context() as patched:
        patched.setattr(os, where, stopped)
        with pytest.raises(KeyboardInterrupt):
            journal.append("stopped", {})
    with monkeypatch.context() as patched:
        patched.setattr(os, "write", lambda file, line: write(file, line[:7]))
        with pytest.raises(NotWritten):
            journal.append("full disk", {})
    journal.append("last", {})
    journal.close()
    rows, torn = read_journal(journal.path)
    assert torn == 0
    assert [(row["n"], row["kind"]) for row in rows] == [(0, "first"), (1, "stopped"), (2, "last")]


def test_a_run_began_with_its_first_row_however_often_resumed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Rows at 1000 s and, of a second life, at 5000 s; looked at again at 8000 s."""
    monkeypatch.setattr("time.time", lambda: 8000.0)
    new = Journal(tmp_path / "j", fsync=False)
    assert Opening(None, Bench(), PlantConfig(), new, tmp_path, False).began == 8000.0
    assert Opening(None, Bench(), PlantConfig(), new, tmp_path, False).elapsed_s() == 0.0
    new.close()
    for wall in (1000.0, 5000.0):
        journal = Journal(tmp_path / "j", wall=lambda at=wall: at, fsync=False)
        journal.append("start", {})
        journal.append("sample", {})
        journal.close()
    resumed = Opening(None, Bench(), PlantConfig(), Journal(tmp_path / "j", fsync=False), tmp_path, True)
    assert (resumed.began, resumed.elapsed_s(), resumed.elapsed_s(60.0)) == (1000.0, 7000.0, 420_000.0)
    assert len(resumed.earlier()) == 4
    resumed.journal.close()
