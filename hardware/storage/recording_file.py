"""From the bytes of a recording to its columns in house units: text, cells, layout. Nothing is judged here."""

import csv
import gzip
import io
import math
import re
import zlib
from array import array
from codecs import BOM_UTF16_BE, BOM_UTF16_LE
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from datetime import UTC, datetime
from itertools import chain
from operator import itemgetter
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from hardware.errors import RecordingError

__all__ = ["MIN_ROWS", "Cells", "Layout", "Rows", "named_rows", "read_table"]

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]
Numbers = NDArray[np.int64]
Rows = tuple[int, int | None]

TIME = {"exp_time": 1 / 60, "time_min": 1.0, "minutes": 1.0, "min": 1.0, "time_s": 1 / 60, "time_h": 60.0}
TIME |= dict.fromkeys(("time", "timestamp"), math.nan)  # no unit: only dates and times since 1970 are understood
EPOCHS = ((1e11, 6e4, "counts ms since 1970"), (1e9, 60.0, "is a date or counts s since 1970"))  # from, per min, words
OD = ("od_measured", "od")
PUMP = ("pump_rate_ml_s", "pump_rate")
DUTY = "pump_{}_rate"  # the Chi.Bio writes the share of full power, not a flow
PUMPS = (1, 2, 3, 4)
TEMPERATURE = ("media_temp", "temperature_degc", "temperature_c", "temperature")

LIGHT = (("fluorescence",), ("fp1_base", "fp1_emit1"))  # counts; the Chi.Bio writes the emission over the base

CHIBIO_POSITIONS = (0, 1, 8)  # of exp_time, od_measured, media_temp
CHIBIO_FIRST_PUMP = 10  # position of pump_1_rate; the other three follow
CHIBIO_COMMON_COLUMNS = 16  # the first 16 columns are the same in every release; later ones were inserted after them

GZIP = b"\x1f\x8b"
CONTROL = re.compile(r"[\x00-\x08\x0e-\x1f\x7f]")
TORN_LINES = 5  # so many lines with control characters are what power cuts leave; a file with more is binary
MIN_ROWS = 10
SHOWN = 6  # stretches of rows that a note names


@dataclass(frozen=True)
class Layout:
    """Where time, OD, temperature and pump rates stand, and the factors of time and pump rates to house units.

    pumps: of the pumps that feed, by number. idle: of those that are not counted. light: of the factors that make
    fluorescence. minutes: nan where the column's name tells no unit.
    """

    source: str
    time: int
    od: int
    temperature: int | None
    pumps: tuple[int, ...]
    minutes: float
    ml_s: float
    header: list[str] | None
    idle: dict[int, int] = field(default_factory=dict)
    reactor: int | None = None
    light: tuple[int, ...] = ()

    @property
    def columns(self) -> list[int]:
        """All that hold numbers, each once."""
        some = [self.time, self.od, *self.pumps, *self.idle.values(), *self.light]
        return list(dict.fromkeys(some if self.temperature is None else [*some, self.temperature]))


class Cells(NamedTuple):
    """Rows of one reactor in file order and house units; nan where a cell is no number. All have the shape (n,).

    time_min: of dates and times since 1970 from the first row on. idle: shape (n, pumps not counted), mL/s.
    number: of the row among the file's data rows. width: cells in the row. headers: how many stand between the first
    row and this one. The others are those of `Recording`.
    """

    time_min: Array
    od: Array
    pump_rate: Array
    temperature: Array
    fluorescence: Array
    idle: Array
    number: Numbers
    width: Numbers
    headers: Numbers

    def only(self, keep: Mask | Numbers) -> "Cells":
        """Return the rows of a mask, or at positions."""
        return Cells._make(values[keep] for values in self)


def read_table(
    path: Path, pump_ml_s: float, pumps: Sequence[int], reactor: str | None, rows: Rows, notes: list[str]
) -> tuple[Layout, Cells]:
    """Read the layout of a file and its rows. Args as of `read_recording`. Raises: RecordingError."""
    cells = _cells(_lines(path, notes), notes)
    try:
        first = next(cells, None)
        if first is None:
            raise RecordingError(f"{path}: is empty or holds no data; expected time, OD and pump rate per row")
        layout = _layout(path, first, pump_ml_s, pumps)
        read = _read(layout, cells if layout.header else chain([first], cells))
    except (UnicodeError, csv.Error):
        raise RecordingError(f"{path}: is not a text file; expected a recording as CSV in UTF-8 or UTF-16") from None
    except (OSError, EOFError, zlib.error) as error:
        raise RecordingError(f"{path}: cannot be read: {getattr(error, 'strerror', None) or error}") from None
    n = len(read.width)
    if not n:
        raise RecordingError(f"{path}: holds no complete data row; expected time, OD and pump rate in every row")
    keep = np.zeros(n, dtype=np.bool_)
    keep[slice(*rows)] = True
    if layout.reactor is not None:
        keep &= _of_reactor(path, read, reactor, notes)
    if (found := int(keep.sum())) < MIN_ROWS:
        span = ":".join("" if end is None else str(end) for end in rows)
        asked = f"rows = {span}: {found} rows lie there; the file has rows 0:{n}"
        found_all = f"only {found} data rows"
        raise RecordingError(f"{path}: {found_all if rows == (0, None) else asked}; at least {MIN_ROWS} are needed")
    table = _in_house_units(layout, read).only(keep)
    return layout, table._replace(time_min=_minutes(path, layout, table.time_min, notes))


@contextmanager
def _open(path: Path) -> Iterator[io.TextIOWrapper]:
    """Open a text file, gzipped or not, in UTF-8 or UTF-16."""
    with path.open("rb") as file:
        stream = gzip.GzipFile(fileobj=file) if file.peek(2).startswith(GZIP) else file
        wide = stream.peek(2).startswith((BOM_UTF16_LE, BOM_UTF16_BE))
        with io.TextIOWrapper(stream, "utf-16" if wide else "utf-8-sig") as text:
            yield text


def _lines(path: Path, notes: list[str]) -> Iterator[str]:
    """Yield the lines of a text file, without a last line that has no end: its last number may be cut.

    Raises: UnicodeError where the file is no text; OSError, EOFError and zlib.error.
    """
    i = torn = 0
    with _open(path) as text:
        for i, line in enumerate(text, 1):
            whole = line.rstrip("\0")
            if len(whole) < len(line):
                notes.append(f"the file ends in {len(line) - len(whole)} NUL bytes, as after a power cut: dropped")
            if CONTROL.search(whole):
                notes.append(f"line {i}: holds control characters, as after a power cut: dropped")
                torn += 1
            elif i > 1 and whole and not whole.endswith("\n"):
                notes.append(f"line {i}: has no line end, so it may be torn: dropped")
            else:
                yield whole
            if torn > TORN_LINES:
                break
    if torn > TORN_LINES or torn == i > 0:
        notes.clear()
        raise UnicodeError


def _cells(lines: Iterable[str], notes: list[str]) -> Iterator[list[str]]:
    """Cells of every line that is neither blank nor a comment; the first one shows what separates them.

    Each line is read alone, so that a stray quotation mark costs one row.
    """
    kept = (line for line in lines if line.strip() and not line.lstrip().startswith("#"))
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


def _layout(path: Path, first: Sequence[str], pump_ml_s: float, pumps: Sequence[int]) -> Layout:
    """Recognise the columns from the first line. Raises: RecordingError naming what was looked for and found."""
    if not all(cell.strip().lower() == "nan" or not math.isnan(_number(cell)) for cell in first):
        return _named_layout(path, first, pump_ml_s, pumps)
    if len(first) == 3:
        return Layout("three columns without header (min, OD, mL/s)", 0, 1, None, (2,), 1.0, 1.0, None)
    if len(first) >= CHIBIO_COMMON_COLUMNS:
        at = {pump: CHIBIO_FIRST_PUMP + pump - 1 for pump in PUMPS}
        fed, idle = _feeding(path, at, pumps)
        source = "Chi.Bio without header, columns by position"
        return Layout(source, *CHIBIO_POSITIONS, fed, 1 / 60, pump_ml_s, None, idle)
    raise RecordingError(
        f"{path}: has {len(first)} columns and no header; without a header only 3 columns (minutes, OD, mL/s) or the "
        f"Chi.Bio's own (at least {CHIBIO_COMMON_COLUMNS}) are known; add a header such as time_min,od,pump_rate_ml_s"
    )


def _named_layout(path: Path, first: Sequence[str], pump_ml_s: float, pumps: Sequence[int]) -> Layout:
    names = [re.sub(r"[^a-z0-9]+", "_", cell.lower()).strip("_") for cell in first]

    def find(what: str, known: Iterable[str]) -> str:
        if name := next((name for name in known if name in names), ""):
            return name
        raise RecordingError(
            f"{path}: no column for the {what}; looked for {', '.join(known)}; found {', '.join(first)[:120]}"
        )

    at, time, od = names.index, find("time", TIME), find("OD", OD)
    duties = {pump: at(DUTY.format(pump)) for pump in PUMPS if DUTY.format(pump) in names}
    if duties:
        fed, idle = _feeding(path, duties, pumps)
    else:
        fed, idle = (at(find("pump rate", (DUTY.format(1), *PUMP))),), {}
    return Layout(
        source="Chi.Bio CSV" if duties else "recording with header",
        time=at(time),
        od=at(od),
        temperature=next((at(name) for name in TEMPERATURE if name in names), None),
        pumps=fed,
        minutes=TIME[time],
        ml_s=pump_ml_s if duties else 1.0,
        header=list(first),
        idle=idle,
        reactor=at("reactor") if "reactor" in names else None,
        light=next((tuple(map(at, columns)) for columns in LIGHT if set(columns) <= set(names)), ()),
    )


def _feeding(path: Path, at: dict[int, int], pumps: Sequence[int]) -> tuple[tuple[int, ...], dict[int, int]]:
    """Columns of the pumps that feed, and pump number -> column of the others."""
    absent = [pump for pump in pumps if pump not in at]
    if absent or not pumps:
        known = ", ".join(map(str, at))
        raise RecordingError(f"{path}: pumps = {list(pumps)}: allowed is a selection of {known}, which the file holds")
    return tuple(at[pump] for pump in pumps), {pump: i for pump, i in at.items() if pump not in pumps}


def _number(cell: str) -> float:
    """Convert a cell to a number, a date (ISO 8601, UTC unless it says otherwise) to s since 1970, else to nan."""
    try:
        return float(cell)
    except ValueError:
        pass
    try:
        moment = datetime.fromisoformat(cell.strip())
    except ValueError:
        return math.nan
    return (moment if moment.tzinfo else moment.replace(tzinfo=UTC)).timestamp()


class _Read(NamedTuple):
    """What the lines hold, n rows. column: place -> numbers, shape (n,). width: cells of each row, shape (n,).

    reactor: of each row, as a place in `reactors`, -1 where the row is cut off before it.
    headers: the rows before which the header is repeated.
    """

    column: dict[int, Array]
    width: Numbers
    reactor: Numbers
    reactors: list[str]
    headers: list[int]


def _read(layout: Layout, rows: Iterable[list[str]]) -> _Read:
    columns, pick = layout.columns, itemgetter(*layout.columns)
    values, width, reactor = array("d"), array("q"), array("q")
    reactors: dict[str, int] = {}
    headers: list[int] = []
    for cells in rows:
        if cells == layout.header:
            headers.append(len(width))
            continue
        try:
            values.fromlist(list(map(float, pick(cells))))
        except (ValueError, IndexError):
            values.fromlist([_number(cells[i]) if i < len(cells) else math.nan for i in columns])
        width.append(len(cells))
        if layout.reactor is not None:
            named = layout.reactor < len(cells)
            reactor.append(reactors.setdefault(cells[layout.reactor].strip(), len(reactors)) if named else -1)
    table = np.asarray(values).reshape(-1, len(columns))
    numbers = dict(zip(columns, table.T, strict=True))
    return _Read(numbers, np.asarray(width), np.asarray(reactor), list(reactors), headers)


def _of_reactor(path: Path, read: _Read, reactor: str | None, notes: list[str]) -> Mask:
    """Find the rows of one reactor and those that are cut off before its name, (n,). Raises: RecordingError."""
    names = read.reactors or [""]
    name = names[0] if reactor is None else reactor
    others = sorted({*names} - {name})
    if name not in names:
        raise RecordingError(f"{path}: reactor = {name}: allowed is one of {', '.join(others)}, which the file holds")
    if others:
        notes.append(f"reactor {name} taken; the file also holds {', '.join(others)}")
    return np.isin(read.reactor, (names.index(name), -1))


def _in_house_units(layout: Layout, read: _Read) -> Cells:
    column, n = read.column, len(read.width)
    light = np.prod([column[i] for i in layout.light], axis=0) if layout.light else np.full(n, np.nan)
    if len(layout.light) > 1:  # the Chi.Bio writes a base of 0 while its slot is off
        light[column[layout.light[0]] == 0.0] = np.nan
    return Cells(
        time_min=column[layout.time],
        od=column[layout.od],
        pump_rate=layout.ml_s * np.sum([column[i] for i in layout.pumps], axis=0),
        temperature=np.full(n, np.nan) if layout.temperature is None else column[layout.temperature],
        fluorescence=light,
        idle=layout.ml_s * np.reshape([column[i] for i in layout.idle.values()], (-1, n)).T,
        number=np.arange(n),
        width=read.width,
        headers=np.searchsorted(read.headers, np.arange(n), side="right"),
    )


def _minutes(path: Path, layout: Layout, time: Array, notes: list[str]) -> Array:
    """Convert times to min; dates and times since 1970 from the first row on. nan for a time of another kind."""
    known = time[np.isfinite(time)]
    middle = float(np.median(known)) if len(known) else 0.0
    for floor, per_minute, words in EPOCHS:
        if middle >= floor:
            time = np.where(time >= floor, time, np.nan)
            notes.append(f"time {words}: read as minutes from the first row on")
            return np.asarray((time - time[np.isfinite(time)][0]) / per_minute)
    if len(known) and math.isnan(layout.minutes):
        assert layout.header is not None
        raise RecordingError(
            f"{path}: column {layout.header[layout.time]} holds {known.min():g} to {known.max():g}, neither dates nor "
            "times since 1970; name its unit: time_min, time_s or time_h"
        )
    return np.where(time < EPOCHS[-1][0], layout.minutes * time, np.nan)


def named_rows(rows: Numbers) -> str:
    """Row numbers as text, as ranges: '2 rows: 7-8'."""
    parts = np.flatnonzero(np.diff(rows) > 1)
    first, last = rows[np.append(0, parts + 1)], rows[np.append(parts, len(rows) - 1)]
    spans = [f"{a}" if a == b else f"{a}-{b}" for a, b in zip(first[:SHOWN], last[:SHOWN], strict=True)]
    shown = ", ".join(spans) + (f" and {len(first) - SHOWN} more stretches" if len(first) > SHOWN else "")
    return f"{'row' if len(rows) == 1 else f'{len(rows)} rows:'} {shown}"
