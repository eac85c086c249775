"""Journal, recording and atomic file: rows survive what kills the process, and the calls to the operating system.

A power cut keeps what was synced, and a new name only if its folder was synced after it."""

import os
import re
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from envs.bench import Bench
from envs.plant.plant import PlantConfig
from hardware.errors import RecordingError
from hardware.family import Opening
from hardware.storage import atomic
from hardware.storage.journal import Journal, read_journal
from hardware.storage.messages import NotOpened, NotRecording, NotWritten
from hardware.storage.recorder import Recorder


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


Tape = list[tuple[Any, ...]]


@pytest.fixture
def tape(monkeypatch: pytest.MonkeyPatch) -> Tape:
    """Calls in order: a sync with the size that is synced, a folder by the name "."."""
    calls: Tape = []

    def record(name: str, say: Callable[..., tuple[Any, ...]]) -> None:
        real = getattr(os, name)
        monkeypatch.setattr(os, name, lambda *given: (calls.append((name, *say(*given))), real(*given))[1])

    def of(fd: int) -> str:
        path = Path(f"/proc/self/fd/{fd}").resolve()
        return "." if path.is_dir() else re.sub(r"\.\w{8}\.part$", ".part", path.name)

    record("write", lambda fd, data: (of(fd), data.count(b"\n")))
    record("ftruncate", lambda fd, size: (of(fd), size))
    record("fsync", lambda fd: (of(fd), *([] if of(fd) == "." else [os.fstat(fd).st_size])))
    record("replace", lambda old, new: (re.sub(r"\.\w{8}\.part$", ".part", old.name), new.name))
    return calls


@pytest.fixture(autouse=True)
def _no_descriptor_is_left() -> Iterator[None]:
    before = set(os.listdir("/proc/self/fd"))
    yield
    assert set(os.listdir("/proc/self/fd")) <= before


@pytest.mark.parametrize("data", ["µ = 0.04\n", b"\x00\xff", ""])
def test_an_atomic_file_is_whole_or_none(tmp_path: Path, data: bytes | str, monkeypatch: pytest.MonkeyPatch) -> None:
    path, whole = tmp_path / "s", data.encode() if isinstance(data, str) else data
    path.write_text("old")
    atomic.write(path, data, fsync=False)
    assert path.read_bytes() == whole

    def full(_: int) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("os.fsync", full)
    with pytest.raises(OSError, match="No space left"):
        atomic.write(path, "new")
    assert path.read_bytes() == whole
    assert list(tmp_path.iterdir()) == [path]


def test_an_atomic_file_is_synced_before_it_takes_its_place_and_its_name_after(tmp_path: Path, tape: Tape) -> None:
    atomic.write(tmp_path / "s", "µm", fsync=False)
    assert tape == [("replace", "s.part", "s")]
    tape.clear()
    atomic.write(tmp_path / "s", "µm")
    assert tape == [("fsync", "s.part", 3), ("replace", "s.part", "s"), ("fsync", ".")]


def test_a_file_that_two_write_at_once_is_whole_without_rests(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A second writer comes and goes between the data of the first and its name; then one whose disk refuses."""
    real = os.replace

    def meanwhile(old: Path, new: Path) -> None:
        monkeypatch.setattr(os, "replace", real)
        atomic.write(new, "second", fsync=False)
        assert new.read_text() == "second"
        real(old, new)

    def full(old: Path, new: Path) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "replace", meanwhile)
    atomic.write(tmp_path / "s", "first", fsync=False)
    monkeypatch.setattr(os, "replace", full)
    with pytest.raises(OSError, match="No space"):
        atomic.write(tmp_path / "s", "third", fsync=False)
    assert [(p.name, p.read_text()) for p in tmp_path.iterdir()] == [("s", "first")]


def test_a_journal_is_synced_row_by_row(tmp_path: Path, tape: Tape) -> None:
    journal = Journal(tmp_path / "j")
    assert tape == [("fsync", "j", 0), ("fsync", ".")]
    tape.clear()
    for k in (1, 2):
        journal.append("a", {})
        assert tape == [("write", "j", 1), ("fsync", "j", journal.path.stat().st_size)] * k or k == 2
    assert [call[:2] for call in tape] == [("write", "j"), ("fsync", "j")] * 2
    journal.close()
    whole = journal.path.stat().st_size
    journal.path.write_bytes(journal.path.read_bytes() + b'{"n":2')
    tape.clear()
    again = Journal(tmp_path / "j", fsync=False)
    assert tape == [("ftruncate", "j", whole), ("fsync", "j", whole), ("fsync", ".")]
    tape.clear()
    again.append("b", {})
    again.close()
    assert tape == [("write", "j", 1)]
    assert journal.path.stat().st_mode & 0o133 == 0


def test_a_recording_is_synced_row_by_row(tmp_path: Path, tape: Tape) -> None:
    row = {"time_min": 1.0}
    with Recorder(tmp_path / "r", list(row)) as recorder:
        assert tape == [("write", "r", 1), ("fsync", "r", 9), ("fsync", ".")]
        recorder.write(row)
    assert tape[3:] == [("write", "r", 1), ("fsync", "r", 13)]
    tape.clear()
    with Recorder(tmp_path / "r", list(row)):
        assert tape == []
    with Recorder(tmp_path / "unsynced", list(row), fsync=False) as recorder:
        recorder.write(row)
    assert tape == [("write", "unsynced", 1)] * 2
    assert recorder.path.stat().st_mode & 0o133 == 0


def test_a_recording_on_a_full_disk_says_so(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(fd: int, data: bytes) -> int:
        raise OSError(28, "No space left on device")

    real = os.write
    with Recorder(tmp_path / "r", ["time_min", "od"]) as recorder:
        for write in (lambda fd, data: real(fd, data[:3]), refuse):
            with monkeypatch.context() as m:
                m.setattr(os, "write", write)
                with pytest.raises(NotWritten):
                    recorder.write({"time_min": 1.0, "od": 0.5})
            assert (tmp_path / "r").read_bytes() == b"time_min,od\n"  # no half of a row before the next one


@pytest.mark.parametrize("content", ["time_min,od\n1,2\n", "my shopping list"])
def test_a_foreign_file_is_refused_left_alone_and_closed(tmp_path: Path, content: str) -> None:
    (tmp_path / "r").write_text(content)
    with pytest.raises(NotRecording):
        Recorder(tmp_path / "r", ["time_min"])
    assert (tmp_path / "r").read_text() == content


def test_the_newest_rows_are_read_again_from_the_disk(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    journal = Journal(tmp_path / "j", fsync=False)
    for k in range(9):
        journal.append("sample", {"k": k})
    journal.close()
    assert journal.rows == []
    assert [row["k"] for row in journal.reread()] == list(range(9))
    size = journal.path.stat().st_size
    monkeypatch.setattr("hardware.storage.journal.TAIL", size - 1)
    assert [row["k"] for row in journal.reread()] == list(range(1, 9))
    journal.path.unlink()
    with pytest.raises(NotOpened):
        journal.reread()


def test_the_cells_of_a_recording(tmp_path: Path) -> None:
    row = {"a": 1, "b": True, "c": None, "d": np.nan, "e": np.float64(0.1), "f": 'x,"y"', "g": 1e-7, "h": "ä"}
    with Recorder(tmp_path / "r", list(row)) as recorder:
        recorder.write(row)
    assert recorder.path.read_text().splitlines()[1] == '1,True,,,0.1,"x,""y""",1e-07,ä'


def test_the_head_of_a_journal_row(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("hardware.storage.journal.uptime", lambda: 5.4321987)
    journal = Journal(tmp_path / "j", wall=lambda: 1000.123456)
    journal.append("device", {"od": [np.nan, 0.5]})
    journal.close()
    assert journal.path.read_bytes() == b'{"n":0,"wall":1000.123,"mono":5.432,"kind":"device","od":[null,0.5]}\n'


@pytest.mark.parametrize(
    ("line", "words"),
    [
        (b'{"wall":1,"kind":"a"}', "without a usable n"),
        (b'{"n":0,"kind":"a"}', "without a usable wall"),
        (b'{"n":0,"wall":NaN,"kind":"a"}', "without a usable wall"),
        (b'{"n":0,"wall":1}', "without a usable kind"),
        (b"[1]", "line 2: not a row"),
        (b"hello", "line 2"),
    ],
)
def test_a_row_that_lacks_what_all_rows_have_is_named(tmp_path: Path, line: bytes, words: str) -> None:
    sound = b'{"n":0,"wall":1.5,"kind":"a"}\n'
    (tmp_path / "j").write_bytes(sound + line + b"\n" + sound)
    with pytest.raises(RecordingError, match=words):
        Journal(tmp_path / "j")


KEPT = ("start", "device", "temperature", "regulate", "overflow_pump", "level", "share", "bottle")


def test_a_long_journal_keeps_what_a_naive_reader_keeps(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The first row, landmarks and open doses before the tail, each row that begins in it; for every tail."""
    path, rng = tmp_path / "j", np.random.default_rng(0)
    kinds = ["sample", *rng.permutation([*KEPT, *rng.choice(["sample", "command", "intent", "dose_end"], 40)]).tolist()]
    reactors = rng.choice(["M0", "M3"], len(kinds)).tolist()
    journal = Journal(path, wall=lambda: 1.0, fsync=False)
    for k, (kind, reactor) in enumerate(zip(kinds, reactors, strict=True)):
        journal.append(kind, {"reactor": reactor, "k": k, "pad": "x" * (k % 5)})
    journal.close()
    lines = path.read_bytes().splitlines(keepends=True)
    begins, torn = np.cumsum([0, *map(len, lines)]), b'{"n":49,"ki'
    for tail in range(len(lines[-1]) + len(torn) + 1, begins[-1] + 40, 5):
        monkeypatch.setattr("hardware.storage.journal.TAIL", tail)
        path.write_bytes(b"".join(lines) + torn)
        cut = max(begins[-1] + len(torn) - tail, 0)
        late = [k for k in range(len(kinds)) if begins[k] > cut or cut == 0]
        doses: dict[str, list[int]] = {}
        for k in sorted(set(range(len(kinds))) - set(late)):
            if kinds[k] in ("intent", "dose_end"):
                doses[reactors[k]] = []
            if kinds[k] == "intent" or doses.get(reactors[k]):
                doses[reactors[k]].append(k)
        kept = {0, *late, *(k for k, kind in enumerate(kinds) if kind in KEPT)}.union(*doses.values())
        reader = Journal(path, fsync=False)
        reader.close()
        assert [row["k"] for row in reader.rows] == sorted(kept)
        assert (reader.cut, reader.next_row) == (len(torn), 49)
