"""A reader for the recordings of this project and for every file a Chi.Bio leaves behind.

`read_recording` refuses whatever is not a usable recording, and reports what it left out of one that is.
"""

import math
import re
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from hardware.errors import RecordingError

__all__ = ["Recording", "read_recording"]

Array = NDArray[np.float64]

TIME = {"exp_time": 1 / 60, "time_min": 1.0, "minutes": 1.0, "min": 1.0, "time_s": 1 / 60, "time_h": 60.0}
OD = ("od_measured", "od")
PUMP = ("pump_rate_ml_s", "pump_rate")
DUTY = "pump_{}_rate"  # the Chi.Bio writes the share of full power, not a flow
PUMPS = (1, 2, 3, 4)
WASTE_PUMP = 2  # of the Chi.Bio; it follows the feed pump and does not dilute
TEMPERATURE = ("media_temp", "temperature_degc", "temperature_c", "temperature")

LIGHT = (("fluorescence",), ("fp1_base", "fp1_emit1"))  # counts; the Chi.Bio writes the emission over the base

CHIBIO_POSITIONS = (0, 1, 8)  # of exp_time, od_measured, media_temp
CHIBIO_FIRST_PUMP = 10  # position of pump_1_rate; the other three follow
CHIBIO_COMMON_COLUMNS = 16  # the first 16 columns are the same in every release; later ones were inserted after them

LOWEST_OD = -0.05  # blank error and noise reach this far below zero; a culture does not
HIGHEST_OD = 10.0  # the device's own upper limit; a dead spectrometer reads 11 to 14 (docs/device.md, OD measurement)
RAW_COUNT_OD = 30.0  # a median above this is a photodetector count
HIGHEST_PUMP_RATE = 1.0  # mL/s, the Chi.Bio's pump at full power
RESTART_ROWS = 5  # so many rows in a row behind the clock are a new run, fewer are a glitch
MIN_READINGS = 10
BACKWARD_SHARE = 0.05  # more rows with a pump that runs backwards are another unit or another way of working
CONTROL = re.compile(r"[\x00-\x08\x0e-\x1f\x7f]")
TORN_LINES = 5  # so many lines with control characters are what power cuts leave; a file with more is binary


@dataclass(frozen=True, eq=False)
class Recording:
    """One run of one reactor, rows in time order.

    time_min: strictly increasing, shape (n,).
    od: optical density, nan where the reading was unusable, shape (n,).
    pump_rate: mL/s, held from each row to the next, shape (n,).
    temperature: degC, nan where there is none, shape (n,).
    row: number of each row in the file, counting data rows from 0, shape (n,).
    notes: what was excluded, assumed or repaired, one sentence each.
    source: which layout was recognised.
    runs: first and last row number of every run in the file.
    fluorescence: counts, nan where there are none, shape (n,).
    """

    time_min: Array
    od: Array
    pump_rate: Array
    temperature: Array
    row: NDArray[np.int64]
    notes: tuple[str, ...]
    source: str
    runs: tuple[tuple[int, int], ...]
    fluorescence: Array


@dataclass(frozen=True)
class _Layout:
    """Where time, OD, temperature and pump rates stand, and the factors of time and pump rates to house units.

    pumps: of the pumps that feed. idle: pump number -> column of those that are not counted. light: of the factors
    that make fluorescence.
    """

    source: str
    time: int
    od: int
    temperature: int | None
    pumps: tuple[int, ...]
    minutes: float
    ml_s: float
    header: tuple[str, ...] | None
    idle: dict[int, int] = field(default_factory=dict)
    reactor: int | None = None
    light: tuple[int, ...] = ()

    @property
    def last(self) -> int:
        """The rightmost column that is needed."""
        return max(self.time, self.od, self.temperature or 0, *self.pumps)


def read_recording(
    path: str | Path,
    *,
    pump_ml_s: float = 1.0,
    pumps: Sequence[int] = (1,),
    run: int | None = None,
    reactor: str | None = None,
    rows: tuple[int, int | None] = (0, None),
) -> Recording:
    """Read a recording from a Chi.Bio's own CSV, from `Recorder`'s, or from a tidy three-column file.

    Known layouts: the Chi.Bio's named columns (exp_time in s, od_measured, pump_1_rate as a share of full power), the
    same without header (known by position), any file with columns such as time_min, od, pump_rate_ml_s, and three bare
    columns minutes, OD, mL/s. Comma, semicolon, tab and blank separate.

    Args:
      path: of the file.
      pump_ml_s: flow of the Chi.Bio's feed pump at full power, mL/s, > 0; turns its duty into mL/s. Not used for
        files that hold mL/s.
      pumps: which of the Chi.Bio's pumps feed the vial, 1 to 4; their flows add up. Not used for other files.
      run: which of several concatenated runs, from 0; None takes the one with most rows.
      reactor: which reactor of a file with a column `reactor`; None takes the first.
      rows: data rows [first, end) to read, counted from 0; what lies outside is not looked at. None: to the end.
    Raises: RecordingError, one line, when the file is no recording; what can be left out is left out and noted.
    """
    path = Path(path)
    if not 0.0 < pump_ml_s < math.inf:
        raise RecordingError(f"pump_ml_s = {pump_ml_s}: allowed > 0 mL/s (flow of the feed pump at full power)")
    notes: list[str] = []
    table = list(_cells(path, _text(path, notes)))
    layout = _layout(path, table[0][1], pump_ml_s, pumps)
    values, number, starts = _chosen_rows(path, rows, *_numbers(path, table, layout, reactor, notes))
    _note_idle_pumps(layout, values, number, notes)
    bad = ~(np.isfinite(values[:, 0]) & np.isfinite(values[:, 2]))
    _note(notes, number[bad], "time or pump rate is not a finite number: dropped, the rate before it is taken to go on")
    values, number, starts = values[~bad], number[~bad], starts[~bad]
    if not len(values):
        raise RecordingError(f"{path}: no row has a finite time and pump rate; is it a recording?")
    backward = _backward(path, values[:, 2], number)
    _note(notes, number[backward], "pump runs backwards: dropped, the rate before it is taken to go on")
    values, number, starts = values[~backward], number[~backward], starts[~backward]
    runs = _runs(values[:, 0], starts)
    keep, stale = _choose_run(path, runs, number, run, notes)
    _note(notes, number[stale], "time does not advance (repeated or backward): dropped")
    od = _usable_od(path, values[keep, 1], number[keep], notes)
    return Recording(
        time_min=values[keep, 0],
        od=od,
        pump_rate=values[keep, 2],
        temperature=values[keep, 3],
        row=number[keep],
        notes=tuple(notes),
        source=layout.source,
        runs=tuple((int(number[r.rows[0]]), int(number[r.rows[-1]])) for r in runs),
        fluorescence=values[keep, -1],
    )


def _text(path: Path, notes: list[str]) -> list[str]:
    """The lines of a text file, without a last line that has no end: its last number may be cut."""
    try:
        content = path.read_bytes()
    except OSError as error:
        raise RecordingError(f"{path}: cannot be read: {error.strerror}") from None
    if not content.strip():
        raise RecordingError(f"{path}: is empty; expected a recording (time, OD and pump rate per row)")
    whole = content.rstrip(b"\0")
    if len(whole) < len(content):
        notes.append(f"the file ends in {len(content) - len(whole)} NUL bytes, as after a power cut: dropped")
    try:
        text = whole.decode("utf-8-sig")
    except UnicodeDecodeError:
        text = "\0"
    lines = re.split(r"\r\n|\n|\r", text.removesuffix("\n").removesuffix("\r"))
    torn = [i for i, line in enumerate(lines) if CONTROL.search(line)]
    if len(torn) > TORN_LINES or len(torn) == len(lines):
        raise RecordingError(f"{path}: is not a text file; expected a recording as CSV in UTF-8")
    for i in torn:
        notes.append(f"line {i + 1}: holds control characters, as after a power cut: dropped")
        lines[i] = ""
    if not text.endswith(("\n", "\r")) and len(lines) > 1:
        notes.append(f"line {len(lines)}: has no line end, so it may be torn: dropped")
        lines.pop()
    return lines


def _cells(path: Path, lines: Sequence[str]) -> Iterator[tuple[int, list[str]]]:
    """(line number, cells) of every line that is neither blank nor a comment."""
    kept = [(i, line) for i, line in enumerate(lines, 1) if line.strip() and not line.lstrip().startswith("#")]
    if not kept:
        raise RecordingError(f"{path}: holds no data; expected a recording (time, OD and pump rate per row)")
    delimiter = next((d for d in ",;\t" if d in kept[0][1]), None)
    for i, line in kept:
        yield i, [cell.strip().strip('"') for cell in line.split(delimiter)] if delimiter else line.split()


def _layout(path: Path, first: Sequence[str], pump_ml_s: float, pumps: Sequence[int]) -> _Layout:
    """Recognise the columns from the first line. Raises: RecordingError naming what was looked for and found."""
    if not all(_is_number(cell) for cell in first):
        return _named_layout(path, first, pump_ml_s, pumps)
    if len(first) == 3:
        return _Layout("three columns without header (min, OD, mL/s)", 0, 1, None, (2,), 1.0, 1.0, None)
    if len(first) >= CHIBIO_COMMON_COLUMNS:
        at = {pump: CHIBIO_FIRST_PUMP + pump - 1 for pump in PUMPS}
        fed, idle = _feeding(path, at, pumps)
        source = "Chi.Bio without header, columns by position"
        return _Layout(source, *CHIBIO_POSITIONS, fed, 1 / 60, pump_ml_s, None, idle)
    raise RecordingError(
        f"{path}: has {len(first)} columns and no header; without a header only 3 columns (minutes, OD, mL/s) or the "
        f"Chi.Bio's own (at least {CHIBIO_COMMON_COLUMNS}) are known; add a header such as time_min,od,pump_rate_ml_s"
    )


def _named_layout(path: Path, first: Sequence[str], pump_ml_s: float, pumps: Sequence[int]) -> _Layout:
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
    return _Layout(
        source="Chi.Bio CSV" if duties else "recording with header",
        time=at(time),
        od=at(od),
        temperature=next((at(name) for name in TEMPERATURE if name in names), None),
        pumps=fed,
        minutes=TIME[time],
        ml_s=pump_ml_s if duties else 1.0,
        header=tuple(first),
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


def _is_number(cell: str) -> bool:
    try:
        float(cell)
    except ValueError:
        return False
    return True


def _numbers(
    path: Path, table: Sequence[tuple[int, list[str]]], layout: _Layout, reactor: str | None, notes: list[str]
) -> tuple[Array, NDArray[np.int64], NDArray[np.bool_]]:
    """Values in house units, data row numbers (n,), and True where a new run is announced by a header.

    Values have shape (n, 5 + idle pumps): time, OD, pump rate, temperature, the rate of each pump not counted, and
    fluorescence.
    """
    header = layout.header
    width = int(np.median([len(cells) for _, cells in table if tuple(cells) != header] or [0]))
    values: list[list[float]] = []
    number: list[int] = []
    starts: list[bool] = []
    short: list[int] = []
    others: set[str] = set()
    announced, row = False, -1
    for _, cells in table:
        if header is not None and tuple(cells) == header:
            announced = True
            continue
        row += 1
        if len(cells) < width or len(cells) <= layout.last:
            short.append(row)
            continue
        if layout.reactor is not None:
            reactor = cells[layout.reactor] if reactor is None else reactor
            if cells[layout.reactor] != reactor:
                others.add(cells[layout.reactor])
                continue
        rate = layout.ml_s * sum(_cell(cells, i) for i in layout.pumps)
        picked = [layout.minutes * _cell(cells, layout.time), _cell(cells, layout.od), rate]
        idle = [layout.ml_s * _cell(cells, i) for i in layout.idle.values()]
        values.append([*picked, _cell(cells, layout.temperature), *idle, _light(cells, layout.light)])
        number.append(row)
        starts.append(announced)
        announced = False
    _note(notes, np.array(short, dtype=np.int64), f"fewer than {width} columns: dropped")
    if others:
        notes.append(f"reactor {reactor} taken; the file also holds {', '.join(sorted(others))}")
    if not values:
        raise RecordingError(f"{path}: holds no complete data row; expected time, OD and pump rate in every row")
    return np.array(values), np.array(number, dtype=np.int64), np.array(starts)


def _light(cells: Sequence[str], columns: Sequence[int]) -> float:
    """Fluorescence, counts; the Chi.Bio writes a base of 0 while its slot is off."""
    counts = math.prod(_cell(cells, i) for i in columns) if columns else math.nan
    return math.nan if len(columns) > 1 and _cell(cells, columns[0]) == 0.0 else counts


def _cell(cells: Sequence[str], column: int | None) -> float:
    return float(cells[column]) if column is not None and _is_number(cells[column]) else math.nan


def _chosen_rows(
    path: Path, rows: tuple[int, int | None], values: Array, number: NDArray[np.int64], starts: NDArray[np.bool_]
) -> tuple[Array, NDArray[np.int64], NDArray[np.bool_]]:
    first, end = rows[0], number[-1] + 1 if rows[1] is None else rows[1]
    keep = (number >= first) & (number < end)
    if keep.sum() < MIN_READINGS:
        raise RecordingError(
            f"{path}: rows = {first}:{end}: {int(keep.sum())} rows lie there; the file has rows {number[0]}:"
            f"{number[-1] + 1}; at least {MIN_READINGS} are needed"
        )
    return values[keep], number[keep], starts[keep]


def _note_idle_pumps(layout: _Layout, values: Array, number: NDArray[np.int64], notes: list[str]) -> None:
    """Say which other pump ran; the waste pump does beside the feed, and dilutes nothing."""
    fed = bool((values[:, 2] > 0.0).any())
    for column, pump in enumerate(layout.idle, start=4):
        ran = number[values[:, column] != 0.0]
        if len(ran) and not (pump == WASTE_PUMP and fed):
            _note(notes, ran, f"pump {pump} ran and is not counted; if it feeds the vial, name it in pumps=[...]")


class _Run(NamedTuple):
    """Positions of the rows of one run, and of those left out because time did not advance."""

    rows: list[int]
    stale: list[int]


def _runs(time: Array, starts: NDArray[np.bool_]) -> list[_Run]:
    """Split where a header is repeated or the clock starts again; single rows behind the clock are left out."""
    runs = [_Run([], [])]
    for i, t in enumerate(time):
        rows, stale = runs[-1]
        ahead = time[i : i + RESTART_ROWS]
        behind = bool(rows) and t <= time[rows[-1]]
        restarted = (
            behind and len(ahead) == RESTART_ROWS and bool((np.diff(ahead) > 0).all()) and ahead[-1] <= time[rows[-1]]
        )
        if restarted or (starts[i] and behind):
            runs.append(_Run([i], []))
        else:
            (stale if behind else rows).append(i)
    return runs


def _choose_run(path: Path, runs: Sequence[_Run], number: NDArray[np.int64], run: int | None, notes: list[str]) -> _Run:
    longest = max(range(len(runs)), key=lambda k: len(runs[k].rows))
    chosen = longest if run is None else run
    if not 0 <= chosen < len(runs):
        raise RecordingError(f"{path}: run = {run}: allowed 0 to {len(runs) - 1}, the runs in this file")
    if len(runs) > 1:
        spans = ", ".join(f"{k}: rows {number[r.rows[0]]}-{number[r.rows[-1]]}" for k, r in enumerate(runs))
        why = "the longest" if run is None else "as asked"
        notes.append(f"the file holds {len(runs)} runs ({spans}); run {chosen} is used ({why})")
    return runs[chosen]


def _backward(path: Path, pump_rate: Array, number: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Rows in which the pump ran backwards, (n,). Raises: RecordingError for many, and for any impossible rate."""
    backward = pump_rate < 0.0
    few = backward.mean() <= BACKWARD_SHARE
    wrong = (pump_rate > HIGHEST_PUMP_RATE) | (backward & ~few)
    if wrong.any():
        i = int(np.argmax(wrong))
        raise RecordingError(
            f"{path}: row {number[i]}: pump rate {pump_rate[i]:g} mL/s: allowed 0 to {HIGHEST_PUMP_RATE:g} mL/s; "
            "a pump run backwards, or another unit such as mL/min?"
        )
    return backward


def _usable_od(path: Path, od: Array, number: NDArray[np.int64], notes: list[str]) -> Array:
    """OD with nan for unusable readings, each kind noted. Raises: RecordingError when too few remain."""
    finite = np.isfinite(od)
    if finite.any() and float(np.median(od[finite])) > RAW_COUNT_OD:
        raise RecordingError(
            f"{path}: OD has the median {np.median(od[finite]):.0f}: these look like raw detector counts; expected an "
            f"optical density of 0 to {HIGHEST_OD:g}; convert counts by the blank first (OD ~ log10(blank / raw))"
        )
    low, high = finite & (od < LOWEST_OD), finite & (od > HIGHEST_OD)
    _note(notes, number[~finite], "OD is not a finite number: reading rejected")
    _note(notes, number[low], f"OD below {LOWEST_OD:g}, more negative than noise can make it: reading rejected")
    _note(notes, number[high], f"OD above {HIGHEST_OD:g}, beyond the device's range: reading rejected")
    usable = finite & ~low & ~high
    if usable.sum() < MIN_READINGS:
        raise RecordingError(
            f"{path}: only {int(usable.sum())} of {len(od)} rows hold a usable OD and an advancing time; at least "
            f"{MIN_READINGS} are needed" + (f" ({'; '.join(notes)})" if notes else "")
        )
    return np.where(usable, od, np.nan)


def _note(notes: list[str], rows: NDArray[np.int64], what: str) -> None:
    """Add one sentence that names the rows it concerns, as ranges."""
    if not len(rows):
        return
    parts = np.split(rows, np.flatnonzero(np.diff(rows) > 1) + 1)
    spans = [f"{p[0]}" if len(p) == 1 else f"{p[0]}-{p[-1]}" for p in parts]
    shown = ", ".join(spans[:6]) + (f" and {len(spans) - 6} more stretches" if len(spans) > 6 else "")
    notes.append(f"{'row' if len(rows) == 1 else f'{len(rows)} rows:'} {shown}: {what}")
