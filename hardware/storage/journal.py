"""Append-only journal of a run: JSON lines, each on disk before the call returns, a torn last line cut on reopening."""

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
"""Identities, blanks, targets, hand-overs, overflow pumps, levels, counted shares, bottles, starts: valid for days."""


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
    """Length of `data` up to the end of its last whole row: a line that ends and that is a JSON object."""
    end = data.rfind(b"\n") + 1
    while end > 0:
        start = data.rfind(b"\n", 0, end - 1) + 1
        try:
            if isinstance(json.loads(data[start:end]), dict):
                return end
        except ValueError:
            pass
        end = start  # a power cut can leave a whole line of zeros, too
    return 0


def _tail(path: Path, before: int) -> bytes:
    """Read the file from byte `before` on, from the next line on unless it is 0."""
    with path.open("rb") as f:
        f.seek(before)
        if before:
            f.readline()
        return f.read()


def _landmarks(path: Path, before: int) -> Iterator[dict[str, Any]]:
    """Yield LANDMARKS of the first `before` bytes and, of each reactor whose dose is open there, its rows since."""
    kept: dict[int, bytes] = {}  # by where they begin
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

    Rows are written with one write call and one fsync, so a row that `append` returned from survives a kill at once, a
    power cut, and a full disk. Kinds and fields belong to whoever writes them.

    Args: wall: clock of the day; only ever for the record and for the position of a resumed run. fsync: False leaves
      the flushing to the operating system: survives a kill, not a power cut (simulated runs).
    Attributes: cut, bytes of a torn last line that were removed on opening; rows, what was there before: all of it in a
      file of up to 20 MB, else its first row, those of the kinds in LANDMARKS, doses left open, and the last 20 MB;
      next_row, the number the next row will have.
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
        """Write one row. Raises: RecordingError if it is not wholly on disk; nothing half-written stays."""
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
        """Count a row that a stop interrupted after its write; cut what was written of one in part."""
        assert self._file is not None
        if os.fstat(self._file).st_size > self._size:
            more = _tail(self.path, max(self._size - 1, 0))
            whole = more[: more.rfind(b"\n") + 1]
            self.next_row += whole.count(b"\n")
            self._size += len(whole)
            if more != whole:
                os.ftruncate(self._file, self._size)

    def reread(self) -> list[dict[str, Any]]:
        """Its newest rows, 20 MB of them, as they are on the disk now. Raises: RecordingError."""
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
    """All whole rows, oldest first, and how many bytes of a torn last line follow them. Raises: RecordingError."""
    try:
        data = path.read_bytes()
    except OSError as error:
        raise messages.NotOpened(path=path, why=error.strerror or error) from error
    kept = _complete(data)
    return list(_parse(data[:kept], path)), len(data) - kept
