"""Writer of the project's only recording format.

A recording is a CSV: one row per control period, units in the header, OD measured at the row's time, pump rate held
from that row to the next. Neither a crash nor a power cut costs more than the row being written.
"""

import csv
import io
import os
from collections.abc import Mapping, Sequence
from contextlib import AbstractContextManager
from pathlib import Path

from hardware.storage.atomic import sync_folder
from hardware.storage.messages import NotOpened, NotRecording, NotWritten, TornLine, WrongRow

Value = float | int | str | bool | None


class Recorder(AbstractContextManager["Recorder"]):
    """Append-only CSV writer: a row is on the disk when `write` returns.

    Each row is one `write` on an O_APPEND descriptor, then fsync. An existing file is continued: an incomplete last
    line after a crash is cut off and reported in `repaired`.

    Args: columns: unique names with their unit. fsync: False leaves rows in the operating system's cache (simulations
      that can be repeated). remedy: the remedy in the error for an existing file that is not this recording.
    Raises: RecordingError if the file cannot be opened or has another header; ValueError for unusable column names.
    """

    def __init__(
        self, path: str | Path, columns: Sequence[str], fsync: bool = True, remedy: str = "choose another file"
    ) -> None:
        self.path = Path(path)
        self.columns = tuple(columns)
        self.repaired: TornLine | None = None
        self._fsync, self._remedy = fsync, remedy
        if not self.columns or len(set(self.columns)) != len(self.columns):
            raise ValueError(f"columns {self.columns}: allowed are unique names, at least one")
        try:
            self._fd = os.open(self.path, os.O_RDWR | os.O_APPEND | os.O_CREAT, 0o644)
        except OSError as error:
            raise NotOpened(path=self.path, why=error.strerror) from None
        try:
            self._continue_or_begin()
        except BaseException:
            os.close(self._fd)
            raise

    def write(self, row: Mapping[str, Value]) -> None:
        """Append one row, a value for each column, to the disk; None and nan are empty. Raises: RecordingError."""
        if row.keys() != set(self.columns):
            missing = [c for c in self.columns if c not in row]
            unknown = [c for c in row if c not in self.columns]
            raise WrongRow(path=self.path, missing=missing, unknown=unknown)
        self._append(_csv_line([_cell(row[c]) for c in self.columns]))

    def amend(self, row: Mapping[str, Value]) -> None:
        """Replace the last row by `row`. A crash during this loses the row. Raises: as `write`."""
        content = self.path.read_bytes()
        os.ftruncate(self._fd, content.rstrip(b"\n").rfind(b"\n") + 1)
        self.write(row)

    @property
    def gone(self) -> bool:
        """Whether the file was deleted or moved since it was opened."""
        return not (self.path.exists() and os.path.samestat(self.path.stat(), os.fstat(self._fd)))

    def close(self) -> None:
        if self._fd >= 0:
            os.close(self._fd)
            self._fd = -1

    def __exit__(self, *raised: object) -> None:
        self.close()

    def _continue_or_begin(self) -> None:
        content = self.path.read_bytes()
        header = _csv_line(self.columns)
        whole = content[: content.rfind(b"\n") + 1]
        if torn := content[len(whole) :]:
            if not whole and not header.startswith(torn):
                raise NotRecording(path=self.path, why="exists and is not a recording", help=self._remedy)
            os.ftruncate(self._fd, len(whole))
            self.repaired = TornLine(path=self.path, length=len(torn))
        if not whole:
            self._append(header)
            if self._fsync:
                sync_folder(self.path.parent)
        elif (found := whole[: whole.index(b"\n") + 1]) != header:
            why = f"has the header {found.decode(errors='replace').strip()!r}, expected {header.decode().strip()!r}"
            raise NotRecording(path=self.path, why=why, help=self._remedy)

    def _append(self, line: bytes) -> None:
        if self._fd < 0:
            raise NotWritten(path=self.path, why="is closed")
        try:
            before = os.fstat(self._fd).st_size
            written = os.write(self._fd, line)
            if written != len(line):
                os.ftruncate(self._fd, before)
                raise NotWritten(path=self.path, why=f"only {written} of {len(line)} bytes written")
            if self._fsync:
                os.fsync(self._fd)
        except OSError as error:
            raise NotWritten(path=self.path, why=error.strerror) from None


def _cell(value: Value) -> str:
    if value is None or value != value:
        return ""
    return repr(float(value)) if isinstance(value, float) else str(value)  # a float is read back as the same number


def _csv_line(cells: Sequence[str]) -> bytes:
    buffer = io.StringIO()
    csv.writer(buffer, lineterminator="\n").writerow(cells)
    return buffer.getvalue().encode()
