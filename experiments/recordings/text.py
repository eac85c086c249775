"""Reader of the cells of a file: plain, gzipped or a Pioreactor's export, in UTF-8 or UTF-16."""

import csv
import gzip
import io
import math
import re
import zipfile
import zlib
from codecs import BOM_UTF16_BE, BOM_UTF16_LE
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from datetime import UTC, datetime
from itertools import chain
from pathlib import Path
from typing import IO, cast

from hardware.errors import RecordingError

GZIP, ZIP = b"\x1f\x8b", b"PK"
CONTROL = re.compile(r"[\x00-\x08\x0e-\x1f\x7f]")
TORN_LINES = 5  # most lines with control characters after power cuts; a file with more is binary
READ = ("pioreactor_unit_activity_data", "pioreactor_unit_activity_data_rollup", "od_readings")  # preferred first
DOSED = ("dosing_events",)


@contextmanager
def readable(path: Path) -> Iterator[None]:
    """Raise a RecordingError with the file's name if reading the file fails in this context."""
    try:
        yield
    except (UnicodeError, csv.Error):
        raise RecordingError(f"{path}: is not a text file; expected a recording as CSV in UTF-8 or UTF-16") from None
    except (OSError, EOFError, zlib.error, zipfile.BadZipFile, RuntimeError) as error:
        raise RecordingError(f"{path}: cannot be read: {getattr(error, 'strerror', None) or error}") from None


def zipped(path: Path) -> bool:
    """Return whether a file is a zip archive, also a damaged one."""
    with path.open("rb") as file:
        return file.read(2) == ZIP


def _members(path: Path, names: Sequence[str], tables: Sequence[str]) -> list[str]:
    """List the files, one per unit, of the first of these tables in a Pioreactor's export. Raises: RecordingError."""
    for table in tables:
        if found := sorted(name for name in names if re.search(rf"(^|[/-]){table}[-.].*csv$", name)):
            return found
    held = sorted({name.partition("/")[0] for name in names if name.endswith(".csv")})
    raise RecordingError(
        f"{path}: has none of {', '.join(tables)}; found {', '.join(held)[:120] or 'no table'}; export one of them"
    )


def _texts(path: Path, tables: Sequence[str]) -> Iterator[io.TextIOWrapper]:
    """Yield the open texts of a file. Args: tables: of an export, the first of these tables that exists is read."""
    if zipped(path):
        with zipfile.ZipFile(path) as archive:
            for name in _members(path, archive.namelist(), tables):
                with archive.open(name) as member:
                    yield _text(member)
        return
    with path.open("rb") as file:
        yield _text(cast(IO[bytes], gzip.GzipFile(fileobj=file)) if file.peek(2).startswith(GZIP) else file)


def _text(stream: IO[bytes]) -> io.TextIOWrapper:
    wide = cast(io.BufferedReader, stream).peek(2).startswith((BOM_UTF16_LE, BOM_UTF16_BE))
    return io.TextIOWrapper(stream, "utf-16" if wide else "utf-8-sig")


def _lines(path: Path, tables: Sequence[str], notes: list[str]) -> Iterator[str]:
    """Yield the lines of a file, except a last line without line end, whose last number may be cut.

    Raises: UnicodeError if the file is not text; OSError, EOFError, zlib.error and zipfile.BadZipFile.
    """
    read = torn = 0
    for text in _texts(path, tables):
        for i, line in enumerate(text, 1):
            read += 1
            whole = line.rstrip("\0")
            if len(whole) < len(line):
                notes.append(f"the file ends in {len(line) - len(whole)} NUL bytes, as after a power cut: dropped")
            if CONTROL.search(whole):
                notes.append(f"line {i}: holds control characters, as after a power cut: dropped")
                torn += 1
            elif i > 1 and whole and not whole.endswith("\n"):
                notes.append(f"line {i}: has no line end, so it may be incomplete: dropped")
            else:
                yield whole
            if torn > TORN_LINES:
                break
    if torn > TORN_LINES or torn == read > 0:
        notes.clear()
        raise UnicodeError


def cells(path: Path, tables: Sequence[str], notes: list[str]) -> Iterator[list[str]]:
    """Yield the cells of every line that is neither blank nor a comment; the first line shows the separator.

    Each line is parsed alone, so that a stray quotation mark spoils one row. Args: as of `_texts`. Raises: as `_lines`.
    """
    kept = (line for line in _lines(path, tables, notes) if line.strip() and not line.lstrip().startswith("#"))
    first = next(kept, "")
    delimiter = next((d for d in ";,\t" if d in first), None)
    decimal = False
    for line in chain([first] if first else [], kept):
        if delimiter not in (",", None) and "," in line:
            decimal |= line is not first
            line = line.replace(",", ".")
        yield next(csv.reader([line], delimiter=delimiter, skipinitialspace=True)) if delimiter else line.split()
    if decimal:
        notes.append("commas are read as decimal points")


def number(cell: str) -> float:
    """Return the number in a cell, s since 1970 for a date (ISO 8601, in UTC if it has no time zone), else nan."""
    try:
        return float(cell)
    except ValueError:
        pass
    try:
        moment = datetime.fromisoformat(cell.strip())
    except ValueError:
        return math.nan
    return (moment if moment.tzinfo else moment.replace(tzinfo=UTC)).timestamp()
