"""Conversion of a recording's cells to the columns of one reactor, in minutes, OD and mL/s."""

import math
from array import array
from collections.abc import Iterable, Sequence
from itertools import chain
from operator import itemgetter
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from envs.identification.screening import row_spans
from experiments.recordings import text
from experiments.recordings.layout import Asked, Layout, recognised
from hardware.errors import RecordingError

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]
Numbers = NDArray[np.int64]

EPOCHS = ((1e11, 6e4, "counts ms since 1970"), (1e9, 60.0, "is a date or counts s since 1970"))  # least, per min, note
MIN_ROWS = 10
LARGEST_ML = 50.0  # largest dose
LONGEST_S = 1e6  # longest total time of a pump in a file


class Cells(NamedTuple):
    """The n rows of one reactor, in file order; nan for a cell that is not a number. Shape (n,) each.

    time_min: a date or a time since 1970 counts from the first row. idle: mL/s of pumps that do not count as feed,
    (n, pumps). number: number of the row among the file's data rows. width: number of cells in the row.
    headers: number of repeated headers before the row. The other fields are those of `Recording`.
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
        """Return the rows that a mask or positions select."""
        return Cells._make(values[keep] for values in self)


def read_table(path: Path, doses: Path | None, asked: Asked, notes: list[str]) -> tuple[Layout, Cells]:
    """Read the layout of a file and its rows. Args: as of `read_recording`. Raises: RecordingError."""
    with text.readable(path):
        export = text.zipped(path)
    alone = doses is None and not export
    layout, read = _loaded(path, text.READ, asked, notes, alone=alone)
    n = len(read.width)
    keep = np.zeros(n, dtype=np.bool_)
    keep[slice(*asked.rows)] = True
    keep &= _chosen(path, layout, read, asked.reactor, notes)
    if (found := int(keep.sum())) < MIN_ROWS:
        span = ":".join("" if end is None else str(end) for end in asked.rows)
        of_rows = f"rows = {span}: selects {found} rows; the file has rows 0:{n}"
        found_all = f"only {found} data rows"
        raise RecordingError(
            f"{path}: {found_all if asked.rows == (0, None) else of_rows}; at least {MIN_ROWS} are needed"
        )
    if doses is not None and layout.feed:
        raise RecordingError(f"{path}: has doses or a pump rate already; drop doses={doses}")
    table, since_1970 = _in_house_units(path, layout, read, keep, notes)
    events = None
    if layout.timed and layout.feed != "rate" and (np.diff(table.time_min) >= 0.0).all():
        events = _spread(path, layout, table)
    if not layout.feed:
        events = _events(doses or path, asked, read.words(layout, "reactor", keep), since_1970, notes)
    if layout.feed != "rate":
        table = _with_rates(path, table, events)
    known = table.time_min[np.isfinite(table.time_min)]
    return layout, table._replace(time_min=table.time_min - (known[0] if since_1970 and len(known) else 0.0))


def _loaded(
    path: Path, tables: Sequence[str], asked: Asked, notes: list[str], doses: bool = False, alone: bool = False
) -> tuple[Layout, "_Read"]:
    """Read a file's layout and lines. Args: as of `recognised` and of `text.cells`. Raises: RecordingError."""
    with text.readable(path):
        cells = text.cells(path, tables, notes)
        first = next(cells, None)
        if first is None:
            raise RecordingError(f"{path}: is empty or has no data; expected time, OD and pump rate in every row")
        named = not all(cell.strip().lower() == "nan" or not math.isnan(text.number(cell)) for cell in first)
        layout = recognised(path, first, named, asked, doses, alone)
        read = _read(layout, cells if layout.header else chain([first], cells))
    if not len(read.width):
        raise RecordingError(f"{path}: has no complete data row; expected time, OD and pump rate in every row")
    return layout, read


class _Read(NamedTuple):
    """Content of n rows. column: number of the column -> its numbers, (n,). width: number of cells of each row, (n,).

    label: key (reactor, experiment, channel or event) -> index in `names` of each row's text, -1 if cut off, (n,).
    names: key -> its texts. headers: numbers of the rows before which the header is repeated.
    """

    column: dict[int, Array]
    width: Numbers
    label: dict[str, Numbers]
    names: dict[str, list[str]]
    headers: list[int]

    def words(self, layout: Layout, what: str, rows: Mask) -> str | None:
        """Return the first text of these rows in the column of `what`, e.g. reactor; None without such a column."""
        codes = self.label[what][rows] if what in layout.labels else np.empty(0, dtype=np.int64)
        return self.names[what][codes[codes >= 0][0]] if (codes >= 0).any() else None


def _read(layout: Layout, rows: Iterable[list[str]]) -> _Read:
    columns, pick = layout.numbers, itemgetter(*layout.numbers)
    values, width = array("d"), array("q")
    label = {what: array("q") for what in layout.labels}
    names: dict[str, dict[str, int]] = {what: {} for what in layout.labels}
    headers: list[int] = []
    for cells in rows:
        if cells == layout.header:
            headers.append(len(width))
            continue
        try:
            values.fromlist(list(map(float, pick(cells))))
        except (ValueError, IndexError):
            values.fromlist([text.number(cells[i]) if i < len(cells) else math.nan for i in columns])
        width.append(len(cells))
        for what, place in layout.labels.items():
            known = names[what]
            label[what].append(known.setdefault(cells[place].strip(), len(known)) if place < len(cells) else -1)
    table = np.asarray(values).reshape(-1, len(columns))
    labels = {what: np.asarray(codes, dtype=np.int64) for what, codes in label.items()}
    listed = {what: list(known) for what, known in names.items()}
    return _Read(dict(zip(columns, table.T, strict=True)), np.asarray(width), labels, listed, headers)


def _chosen(path: Path, layout: Layout, read: _Read, reactor: str | None, notes: list[str]) -> Mask:
    """Return a mask, (n,), of the rows of one reactor, experiment and sensor, and of rows cut off before their names.

    Raises: RecordingError.
    """
    keep = np.ones(len(read.width), dtype=np.bool_)
    for what in ("reactor", "experiment", "channel"):
        if what not in layout.labels:
            continue
        names = read.names[what] or [""]
        here = sorted({*read.label[what][keep]} - {-1})
        name = reactor if what == "reactor" and reactor is not None else names[here[0] if here else 0]
        others = sorted({names[code] for code in here} - {name})
        if name not in names:
            raise RecordingError(
                f"{path}: reactor = {name}: allowed one of {', '.join(others)}, the reactors in the file"
            )
        if others and what == "experiment":
            raise RecordingError(f"{path}: has the experiments {name}, {', '.join(others)}; export only one of them")
        if others:
            notes.append(f"{what} {name} used; the file also has {', '.join(others)}")
        keep &= np.isin(read.label[what], (names.index(name), -1))
    return keep


def _in_house_units(path: Path, layout: Layout, read: _Read, keep: Mask, notes: list[str]) -> tuple[Cells, bool]:
    """Return the kept rows, with a feed in mL/s (a rate) or mL, and whether their times count from 1970."""
    column, n = read.column, len(read.width)
    light = np.prod([column[i] for i in layout.light], axis=0) if layout.light else np.full(n, np.nan)
    if len(layout.light) > 1:  # the Chi.Bio writes a base of 0 while its slot is off
        light[column[layout.light[0]] == 0.0] = np.nan
    fed = np.reshape([column[i] for i in layout.fed], (-1, n))
    cells = Cells(
        time_min=column[layout.time],
        od=np.full(n, np.nan) if layout.od is None else column[layout.od],
        pump_rate=layout.ml * (fed if layout.feed == "rate" else np.nan_to_num(fed)).sum(axis=0),
        temperature=np.full(n, np.nan) if layout.temperature is None else column[layout.temperature],
        fluorescence=light,
        idle=layout.ml * np.reshape([column[i] for i in layout.idle.values()], (-1, n)).T,
        number=np.arange(n),
        width=read.width,
        headers=np.searchsorted(read.headers, np.arange(n), side="right"),
    ).only(keep)
    if layout.feed == "total":
        total = np.stack([column[i] for i in layout.fed])[:, keep]
        cells = cells._replace(pump_rate=_given(path, layout.ml * total, cells))
    minutes, since_1970 = _minutes(path, layout, cells.time_min, notes)
    return cells._replace(time_min=minutes), since_1970


def _given(path: Path, total: Array, cells: Cells) -> Array:
    """Return the doses, (n,), from running totals, (columns, n). A blank cell is no dose. Raises: RecordingError."""
    at = np.maximum.accumulate(np.where(np.isfinite(total), np.arange(total.shape[1]), 0), axis=1)
    filled = np.nan_to_num(np.take_along_axis(total, at, axis=1))
    given = np.diff(filled, axis=1, prepend=filled[:, :1]).sum(axis=0)
    again = np.diff(cells.time_min, prepend=-np.inf) <= 0.0  # another run
    if (falls := (given < -1e-9) & ~again).any():
        raise RecordingError(
            f"{path}: row {cells.number[np.argmax(falls)]}: the total feed falls, which is impossible; name the column "
            "dose_ml if these are single doses, or choose one of two runs by rows=FIRST:END"
        )
    return np.where(again, 0.0, given)


def _events(path: Path, asked: Asked, reactor: str | None, since_1970: bool, notes: list[str]) -> tuple[Array, Array]:
    """Read a table of doses; return minute (clock of the readings) and mL of each, by time. Raises: RecordingError."""
    layout, read = _loaded(path, text.DOSED, asked._replace(time_unit=None), notes, doses=True)
    keep = np.ones(len(read.width), dtype=np.bool_)
    if reactor is not None and "reactor" in layout.labels:
        names = read.names["reactor"]
        keep &= read.label["reactor"] == (names.index(reactor) if reactor in names else -1)
    if "event" in layout.labels:
        feeds = [code for code, name in enumerate(read.names["event"]) if name.startswith("add_")]
        keep &= np.isin(read.label["event"], feeds)
    table, dated = _in_house_units(path, layout, read, keep, [])
    if dated != since_1970 and len(table.od):
        raise RecordingError(f"{path}: doses and readings need the same clock; write dates in both files or in none")
    return _spread(path, layout, table)


def _spread(path: Path, layout: Layout, table: Cells) -> tuple[Array, Array]:
    """Return minutes and mL of doses in order of time; split a dose of a timed pump into parts of one second.

    Raises: RecordingError.
    """
    _check_doses(path, table.pump_rate)
    seconds = np.nan_to_num(np.ceil(table.pump_rate / layout.ml)) if layout.timed else np.zeros(len(table.od))
    parts = np.maximum(seconds if seconds.sum() < LONGEST_S else 1.0, np.ones(len(seconds))).astype(np.int64)
    later = (np.arange(parts.sum()) - np.repeat(np.cumsum(parts) - parts, parts)) / 60.0
    time, ml = np.repeat(table.time_min, parts) + later, np.repeat(table.pump_rate / parts, parts)
    order = np.argsort(time, kind="stable")
    return time[order], ml[order]


def _with_rates(path: Path, table: Cells, events: tuple[Array, Array] | None) -> Cells:
    """Turn doses into the mean rate from each reading to the next, and drop rows without a reading.

    A dose, or the growth of a total, in a row of a reading belongs to the time after this reading. The seconds that a
    pump ran begin at their row.
    """
    is_reading = np.isfinite(table.od) & np.isfinite(table.time_min)
    is_reading[1:] &= np.diff(table.time_min) != 0.0
    at, readings = np.cumsum(is_reading) - 1, table.only(is_reading)
    if len(readings.od) < MIN_ROWS:
        raise RecordingError(f"{path}: only {len(readings.od)} rows have a reading; at least {MIN_ROWS} are needed")
    dose = table.pump_rate
    if events is not None:
        at, dose = np.searchsorted(readings.time_min, events[0], side="right") - 1, events[1]
    else:
        _check_doses(path, dose)
    ml = np.bincount(at[at >= 0], dose[at >= 0], len(readings.od))
    lasts = np.append(np.diff(readings.time_min), -1.0)
    with np.errstate(divide="ignore"):
        rate = np.where(lasts > 0.0, ml / (60.0 * lasts), 0.0)
    warm = np.maximum.accumulate(np.where(np.isfinite(table.temperature), np.arange(len(table.od)), 0))
    return readings._replace(pump_rate=rate, temperature=table.temperature[warm][is_reading])


def _check_doses(path: Path, dose: Array) -> None:
    """Refuse volumes that cannot be doses. Raises: RecordingError."""
    given = dose[dose > 0.0]
    if len(given) and given.max() > LARGEST_ML:
        raise RecordingError(
            f"{path}: a dose of {given.max():g} mL: allowed up to {LARGEST_ML:g} mL; check the unit (uL?) and pump_ml_s"
        )
    if len(given) >= MIN_ROWS and (np.diff(given) >= 0.0).all() and given[-1] > 3.0 * given[0]:
        raise RecordingError(f"{path}: the doses never decrease, as if they were totals; name their column fed_ml")


def _minutes(path: Path, layout: Layout, time: Array, notes: list[str]) -> tuple[Array, bool]:
    """Return the times in min, and whether they count from 1970; a time that does not fit the others becomes nan."""
    known = time[np.isfinite(time)]
    middle = float(np.median(known)) if len(known) else 0.0
    for floor, per_minute, words in EPOCHS:
        if middle >= floor:
            notes.append(f"time {words}: read as minutes from the first row on")
            return np.where(time >= floor, time / per_minute, np.nan), True
    if len(known) and math.isnan(layout.minutes):
        assert layout.header is not None
        raise RecordingError(
            f"{path}: column {layout.header[layout.time]} has {known.min():g} to {known.max():g}, neither dates nor "
            "times since 1970; give time_unit=, or name the column time_min, time_s or time_h"
        )
    return np.where(time < EPOCHS[-1][0], layout.minutes * time, np.nan), False


def named_rows(rows: Numbers) -> str:
    """Return row numbers as text with ranges, e.g. '2 rows: 7-8'."""
    return f"{'row' if len(rows) == 1 else f'{len(rows)} rows:'} {row_spans(rows)}"
