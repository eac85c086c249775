"""Append-only journal of a run in JSON lines: each is on disk when `append` returns; reopening cuts a partial line."""

import fcntl
import json
import math
import os
import re
import time
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

from hardware.clock import uptime
from hardware.errors import RecordingError
from hardware.storage import messages
from hardware.storage.atomic import sync_folder

TAIL = 20_000_000  # bytes; about 16 h of eight reactors
BEGUN, ENDED, REACTOR = b'"kind":"intent"', b'"kind":"dose_end"', re.compile(rb'"reactor":"([^"]+)"')
LANDMARKS = tuple(
    f'"kind":"{kind}"'.encode()
    for kind in ("device", "temperature", "regulate", "overflow_pump", "level", "share", "bottle", "start")
)
"""Kinds of rows that stay valid for days: identities, targets, hand-overs, levels, counted shares, bottles, starts."""


def plain(value: Any) -> Any:
    """Convert a value to JSON's types: arrays and tuples to lists, keys to text, non-finite numbers to null."""
    if isinstance(value, Mapping):
        return {str(k): plain(v) for k, v in value.items()}
    if isinstance(value, list | tuple):
        if all(type(v) is float and math.isfinite(v) for v in value):
            return value
        return [plain(v) for v in value]
    if hasattr(value, "tolist"):
        return plain(value.tolist())
    return None if isinstance(value, float) and not math.isfinite(value) else value


def _complete(data: bytes) -> int:
    """Return the length of `data` up to the end of its last whole row: a JSON object with a newline."""
    end = data.rfind(b"\n") + 1
    while end > 0:
        start = data.rfind(b"\n", 0, end - 1) + 1
        try:
            if isinstance(json.loads(data[start:end]), dict):
                return end
        except ValueError:
            pass
        end = start  # a power cut can leave a line of zeros with its newline
    return 0


def _tail(path: Path, before: int) -> bytes:
    """Read the file from byte `before`, or, if that is not 0, from the next line."""
    with path.open("rb") as f:
        f.seek(before)
        if before:
            f.readline()
        return f.read()


def _landmarks(path: Path, before: int) -> Iterator[dict[str, Any]]:
    """Yield, from the first `before` bytes, the rows of LANDMARKS and, for a dose still open there, all its rows."""
    kept: dict[int, bytes] = {}  # by position
    dose: dict[bytes, dict[int, bytes]] = {}
    at = 0
    with path.open("rb") as f:
        while at < before:
            line = f.readline()
            head, name = line[:120], REACTOR.search(line[:200])
            if at == 0 or any(mark in head for mark in LANDMARKS):
                kept[at] = line
            elif name and BEGUN in head:
                dose[name[1]] = {at: line}
            elif name and ENDED in head:
                dose.pop(name[1], None)
            elif name and name[1] in dose:
                dose[name[1]][at] = line
            at += len(line)
    for rows in dose.values():
        kept |= rows
    for _, line in sorted(kept.items()):
        yield from _parse(line, path)


class Journal:
    """One row per event: {"n": number, "wall": s since 1970, "mono": s, "kind": ..., fields...}.

    Each row is written with one write call and one fsync: once `append` has returned, the row survives a kill, a power
    cut and a full disk. The callers define kinds and fields.

    Args: wall: wall clock, used only for the record and for the time of a resumed run. fsync: False leaves the flushing
      to the operating system: rows survive a kill, but no power cut (simulated runs).
    Attributes: cut: bytes of an incomplete last line, removed on opening. rows: the rows found on opening: all of a
      file up to 20 MB, else the first row, the rows of LANDMARKS, open doses, and the last 20 MB. next_row: number of
      the next row.
    Raises: RecordingError if the file cannot be opened, read or written, or another program writes to it.
    """

    def __init__(self, path: Path, wall: Callable[[], float] = time.time, fsync: bool = True) -> None:
        self.path, self._wall, self._fsync = path, wall, fsync
        self._file: int | None = None
        try:
            self._file = os.open(path, os.O_WRONLY | os.O_APPEND | os.O_CREAT, 0o644)
            fcntl.flock(self._file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            size = os.fstat(self._file).st_size
            before = max(size - TAIL, 0)
            old = _tail(path, before) if size else b""
            before = size - len(old)
            kept = before + _complete(old)
            self.cut = size - kept
            if self.cut:
                os.ftruncate(self._file, kept)
            os.fsync(self._file)
            sync_folder(path.parent)
        except OSError as error:
            self.close()
            if isinstance(error, BlockingIOError):
                raise messages.JournalTaken(path=path) from error
            raise messages.NotOpened(path=path, why=error.strerror or error) from error
        try:
            self.rows = [*_landmarks(path, before), *_parse(old[: kept - before], path)]
            _check(self.rows, path)
        except RecordingError:
            self.close()
            raise
        self.next_row = self.rows[-1]["n"] + 1 if self.rows else 0
        self._size = kept

    def append(self, kind: str, fields: Mapping[str, Any]) -> None:
        """Write one row. Raises: RecordingError if the row is not completely on disk; no partial row stays."""
        if self._file is None:
            raise messages.NotWritten(path=self.path, why="written to after it was closed")
        self._count_interrupted()
        row = {"n": self.next_row, "wall": round(self._wall(), 3), "mono": round(uptime(), 3), "kind": kind}
        line = json.dumps(plain({**row, **fields}), separators=(",", ":"), allow_nan=False).encode() + b"\n"
        try:
            written = os.write(self._file, line)
            if written != len(line):
                os.ftruncate(self._file, self._size)
                raise OSError(28, "No space left on device")
            self.next_row += 1
            self._size += written
            if self._fsync:
                os.fsync(self._file)
        except OSError as error:
            raise messages.NotWritten(path=self.path, why=error.strerror or error) from error

    def _count_interrupted(self) -> None:
        """Count a row whose `append` was interrupted after its write; cut a partial row."""
        assert self._file is not None
        if os.fstat(self._file).st_size > self._size:
            more = _tail(self.path, max(self._size - 1, 0))
            whole = more[: more.rfind(b"\n") + 1]
            self.next_row += whole.count(b"\n")
            self._size += len(whole)
            if more != whole:
                os.ftruncate(self._file, self._size)

    def reread(self) -> list[dict[str, Any]]:
        """Read the newest rows, up to 20 MB, from the disk. Raises: RecordingError."""
        try:
            newest = _tail(self.path, max(self.path.stat().st_size - TAIL, 0))
        except OSError as error:
            raise messages.NotOpened(path=self.path, why=error.strerror or error) from error
        return list(_parse(newest, self.path))

    def close(self) -> None:
        if self._file is not None:
            os.close(self._file)
            self._file = None


def _parse(data: bytes, path: Path) -> Iterator[dict[str, Any]]:
    for number, line in enumerate(data.splitlines(), 1):
        try:
            row = json.loads(line)
        except ValueError as error:
            raise messages.RowDamaged(path=path, what=f"line {number}: {error}") from error
        if not isinstance(row, dict):
            raise messages.RowDamaged(path=path, what=f"line {number}: not a row")
        yield row


def _check(rows: list[dict[str, Any]], path: Path) -> None:
    kinds: dict[str, Any] = {"n": int, "wall": (int, float), "kind": str}
    for row in rows:
        wrong = [key for key, kind in kinds.items() if not isinstance(row.get(key), kind)]
        if wrong or not math.isfinite(row["wall"]):
            wrong = wrong or ["wall"]
            raise messages.RowDamaged(path=path, what=f"a row without a usable {wrong[0]} ({str(row)[:60]})")


def read_journal(path: Path) -> tuple[list[dict[str, Any]], int]:
    """Read all whole rows, oldest first, and count the bytes of an incomplete last line. Raises: RecordingError."""
    try:
        data = path.read_bytes()
    except OSError as error:
        raise messages.NotOpened(path=path, why=error.strerror or error) from error
    kept = _complete(data)
    return list(_parse(data[:kept], path)), len(data) - kept
