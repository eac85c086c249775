"""Reader of recordings of this project, of Chi.Bio, Pioreactor and eVOLVER, and of tables of readings.

`read_recording` refuses an unusable recording. It notes the rows that it drops from a usable one.
"""

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from conf.schema import check, require, setting
from experiments.recordings.layout import COLUMNS, UNITS, Asked, Layout, Rows
from experiments.recordings.table import MIN_ROWS, Cells, named_rows, read_table
from hardware.errors import RecordingError

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]
Numbers = NDArray[np.int64]

WASTE_PUMP = 2  # of the Chi.Bio; it follows the feed pump and does not dilute
LOWEST_OD = -0.05  # blank error and noise can make an OD as low as this
HIGHEST_OD = 10.0  # the device's own upper limit; a dead spectrometer reads 11 to 14 (docs/device.md, OD measurement)
DENSEST_OD = 6.0  # a median above this is OD times 100 ...
RAW_COUNT_OD = 500.0  # ... or, above this, counts of a photodetector
FINEST_MIN, COARSEST_MIN = 0.005, 30.0  # allowed time between rows
HIGHEST_PUMP_RATE = 1.0  # mL/s, the Chi.Bio's pump at full power
RESTART_ROWS = 5  # this many consecutive rows with earlier times are a new run, fewer are a glitch
LISTED_RUNS = 20
LOST_SHARE = 0.05  # largest fraction of rows without a pump rate, or with a negative one
Doubts = tuple[tuple[str, str], ...]


@dataclass(frozen=True, eq=False)
class Recording:
    """One run of one reactor, rows in time order.

    time_min: strictly increasing, shape (n,).
    od: optical density, nan where the reading was unusable, shape (n,).
    pump_rate: mL/s, held from each row to the next, shape (n,).
    temperature: degC, nan without a reading, shape (n,).
    row: number of each row in the file, counting data rows from 0, shape (n,).
    notes: sentences on what was excluded, assumed or repaired.
    doubts: pairs of a fault that probably makes mu and tau wrong, and its remedy.
    source: name of the recognised layout.
    runs: numbers of the first and last row of every run in the file.
    fluorescence: counts, nan without a reading, shape (n,).
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
    doubts: Doubts = ()


def read_recording(
    path: str | Path,
    *,
    pump_ml_s: float = 1.0,
    pumps: Sequence[int] = (1,),
    run: int | None = None,
    reactor: str | None = None,
    rows: Rows = (0, None),
    doses: str | Path | None = None,
    columns: Mapping[str, str] = MappingProxyType({}),
    time_unit: str | None = None,
) -> Recording:
    """Read a recording from a device's own file, from a file of `Recorder`, or from a table.

    docs/calibration.md has the layouts. In a file with doses a row is a reading, a dose or both, and blank cells are
    allowed. A dose changes the next reading.

    Args:
      path: path of the file.
      pump_ml_s: flow of the feed pump at full power, mL/s, > 0; converts a Chi.Bio's duty to mL/s, and the seconds that
        a pump ran to mL. Not used for files in mL or mL/s.
      pumps: the Chi.Bio's pumps that feed the vial, 1 to 4; their flows are added. Not used for other files.
      run: number of the run in a file of several runs, from 0; None: the run with most rows.
      reactor: reactor in a file with a column `reactor`; None: the first one.
      rows: data rows [first, end) to read, counted from 0; the others are ignored. end None: to the last row.
      doses: a second file with the doses: an eVOLVER's pump log, a Pioreactor's dosing events, or a table.
      columns: entry of `COLUMNS` -> name in the file. time_unit: s, min or h, if the column's name has no unit.
    Raises: RecordingError, one line with the notes so far, if the file is no usable recording. A few unusable rows are
      only dropped and noted.
    """
    path = Path(path)
    if not 0.0 < pump_ml_s < math.inf:
        raise RecordingError(f"pump_ml_s = {pump_ml_s}: allowed > 0 mL/s (flow of the feed pump at full power)")
    notes: list[str] = []
    try:
        with np.errstate(all="ignore"):  # a number that overflows is not finite, so its row is dropped
            asked = Asked(pump_ml_s, pumps, reactor, rows, columns, time_unit)
            layout, table = read_table(path, None if doses is None else Path(doses), asked, notes)
            doubts = _idle_pumps(layout, table, pumps, notes)
            table = _with_times_and_rates(path, table, notes)
            backward = _backward(path, table, HIGHEST_PUMP_RATE if layout.feed == "rate" else math.inf)
            _note(notes, table.number[backward], "pump ran backwards: dropped; the rate before is assumed to continue")
            table = table.only(~backward)
            runs = _runs(table.time_min, np.diff(table.headers, prepend=table.headers[0]) > 0)
            keep, stale = _choose_run(path, runs, table.number, run, notes)
            _check_spacing(path, table.time_min[keep])
            _note(notes, table.number[stale], "time does not advance (repeated or backward): dropped")
            ends = tuple((int(table.number[r.rows[0]]), int(table.number[r.rows[-1]])) for r in runs)
            table = table.only(keep)
            od = _usable_od(path, table.od, table.number, notes)
    except RecordingError as error:
        raise RecordingError(f"{error} ({'; '.join(notes)})" if notes else str(error)) from None
    t, said = table, tuple(notes)
    return Recording(
        t.time_min, od, t.pump_rate, t.temperature, t.number, said, layout.source, ends, t.fluorescence, doubts
    )


def _with_times_and_rates(path: Path, table: Cells, notes: list[str]) -> Cells:
    """Keep the rows with a time and a pump rate. Raises: RecordingError if too many have no rate, or none has both."""
    width = int(np.median(table.width))
    short = table.width < width
    lost = short | ~np.isfinite(table.pump_rate)
    if lost.mean() > LOST_SHARE:
        raise RecordingError(
            f"{path}: {named_rows(table.number[lost])}: cut off or without a pump rate: "
            f"{100 * lost.mean():.3g} % of the rows, allowed {100 * LOST_SHARE:g} %; write the rate into every row, 0 "
            "while the pump rests"
        )
    _note(notes, table.number[short], f"fewer than {width} columns: dropped")
    table = table.only(~short)
    good = np.isfinite(table.time_min) & np.isfinite(table.pump_rate)
    what = "time or pump rate is not a finite number: dropped; the rate before is assumed to continue"
    _note(notes, table.number[~good], what)
    if not good.any():
        raise RecordingError(f"{path}: no row has a finite time and pump rate; check that the file is a recording")
    return table.only(good)


def _idle_pumps(layout: Layout, table: Cells, pumps: Sequence[int], notes: list[str]) -> Doubts:
    """Return a doubt if a pump ran that is not counted, except a waste pump that moved as much as the others."""
    fed = float(np.nansum(table.pump_rate))
    moved = {pump: abs(float(np.nansum(rate))) for pump, rate in zip(layout.idle, table.idle.T, strict=True)}
    ran = [pump for pump, rate in zip(layout.idle, table.idle.T, strict=True) if (np.abs(rate) > 0.0).any()]
    feeds = [pump for pump in ran if pump != WASTE_PUMP]
    brought = fed + sum(moved[pump] for pump in feeds)
    if WASTE_PUMP in ran and not 0.0 < brought <= moved[WASTE_PUMP]:
        feeds = [*feeds, WASTE_PUMP]
    if not feeds:
        return ()
    counted = ",".join(map(str, sorted({*pumps, *feeds} if fed > 0.0 else feeds)))
    for pump, rate in zip(layout.idle, table.idle.T, strict=True):
        if pump in feeds:
            _note(notes, table.number[np.abs(rate) > 0.0], f"pump {pump} ran and is not counted")
    names = " and ".join(map(str, feeds))
    return ((f"pump {names} ran and {'is' if len(feeds) == 1 else 'are'} not counted", f"set pumps=[{counted}]"),)


class _Run(NamedTuple):
    """One run. rows: positions of its rows. stale: positions of dropped rows, whose time did not advance."""

    rows: Numbers
    stale: Numbers


def _runs(time: Array, starts: Mask) -> list[_Run]:
    """Split rows into runs at repeated headers and where the clock restarts.

    The clock restarts where time falls and then rises for RESTART_ROWS rows, unless these rows go beyond the latest
    time of the run before. Other rows with an earlier time are dropped.
    """
    ahead = np.pad(time, (0, RESTART_ROWS - 1), constant_values=np.nan)
    rising = sliding_window_view(np.diff(ahead) > 0.0, RESTART_ROWS - 1).all(axis=1)
    reach = np.where(starts, time, np.where(rising, ahead[RESTART_ROWS - 1 :], np.inf))
    falls = np.diff(time, prepend=-np.inf) <= 0.0
    places = np.flatnonzero(np.isfinite(reach) & (falls | starts))
    begins, latest = [0], -np.inf
    for i, peak in zip(places, np.maximum.reduceat(time, np.append(0, places))[: len(places)], strict=True):
        latest = max(latest, peak)
        if reach[i] <= latest:
            begins.append(int(i))
            latest = -np.inf
    return [_run(time, a, b) for a, b in pairwise([*begins, len(time)])]


def _run(time: Array, first: int, end: int) -> _Run:
    so_far = np.maximum.accumulate(time[first:end])
    ahead = np.diff(so_far, prepend=-np.inf) > 0.0
    return _Run(first + np.flatnonzero(ahead), first + np.flatnonzero(~ahead))


def _choose_run(path: Path, runs: Sequence[_Run], number: Numbers, run: int | None, notes: list[str]) -> _Run:
    longest = max(range(len(runs)), key=lambda k: len(runs[k].rows))
    chosen = longest if run is None else run
    if not 0 <= chosen < len(runs):
        raise RecordingError(f"{path}: run = {run}: allowed 0 to {len(runs) - 1}, the runs in this file")
    if len(runs) > 1:
        listed = enumerate(runs[:LISTED_RUNS])
        spans = ", ".join(f"{k}: rows {number[r.rows[0]]}-{number[r.rows[-1]]}" for k, r in listed)
        spans += f" and {len(runs) - LISTED_RUNS} more" if len(runs) > LISTED_RUNS else ""
        why = "the longest" if run is None else "as requested"
        notes.append(f"the file has {len(runs)} runs ({spans}); run {chosen} is used ({why})")
    return runs[chosen]


def _backward(path: Path, table: Cells, highest: float) -> Mask:
    """Return a mask, (n,), of rows whose pump ran backwards. Raises: RecordingError: too many, or impossible rates."""
    pump_rate, backward = table.pump_rate, table.pump_rate < 0.0
    few = backward.mean() <= LOST_SHARE
    wrong = (pump_rate > highest) | (backward & ~few)
    if wrong.any():
        i = int(np.argmax(wrong))
        raise RecordingError(
            f"{path}: row {table.number[i]}: pump rate {pump_rate[i]:g} mL/s: allowed 0 to {HIGHEST_PUMP_RATE:g} mL/s; "
            "did the pump run backwards, or is the unit another one, such as mL/min (divide by 60)?"
        )
    return backward


def _check_spacing(path: Path, time: Array) -> None:
    """Refuse times in a wrong unit. Raises: RecordingError."""
    apart = float(np.median(np.diff(time))) if len(time) > 1 else 1.0
    if not FINEST_MIN <= apart <= COARSEST_MIN:
        raise RecordingError(
            f"{path}: rows are {apart:.3g} min apart: allowed {FINEST_MIN:g} to {COARSEST_MIN:g} min; "
            f"is the time in {'s or min' if apart > COARSEST_MIN else 'min or h'} (time_unit=)?"
        )


def _usable_od(path: Path, od: Array, number: Numbers, notes: list[str]) -> Array:
    """Return the OD with nan for unusable readings, and note each kind. Raises: RecordingError if too few remain."""
    finite = np.isfinite(od)
    middle = float(np.median(od[finite])) if finite.any() else 0.0
    if middle > DENSEST_OD:
        likely = "raw detector counts" if middle > RAW_COUNT_OD else "OD times 100"
        raise RecordingError(
            f"{path}: the median OD is {middle:.3g}: these look like {likely}; expected an optical density of 0 to "
            f"{HIGHEST_OD:g}; divide by 100 or 1000, or convert counts with the blank (OD ~ log10(blank / raw))"
        )
    low, high = finite & (od < LOWEST_OD), finite & (od > HIGHEST_OD)
    _note(notes, number[~finite], "OD is not a finite number: reading rejected")
    _note(notes, number[low], f"OD below {LOWEST_OD:g}, more negative than noise can make it: reading rejected")
    _note(notes, number[high], f"OD above {HIGHEST_OD:g}, beyond the device's range: reading rejected")
    usable = finite & ~low & ~high
    if usable.sum() < MIN_ROWS:
        raise RecordingError(
            f"{path}: only {int(usable.sum())} of {len(od)} rows hold a usable OD and an advancing time; at least "
            f"{MIN_ROWS} are needed"
        )
    return np.where(usable, od, np.nan)


def _note(notes: list[str], rows: Numbers, what: str) -> None:
    """Add a note on these rows, if there are any."""
    if len(rows):
        notes.append(f"{named_rows(rows)}: {what}")


@dataclass(frozen=True)
class Source:
    """Location of a recording, and the user's options for reading it."""

    data: str | None = setting(
        None,
        "recording: CSV of a Chi.Bio, of this project or of a lab, a Pioreactor's export (zip) or one of its tables, "
        "an eVOLVER's OD; null: the simulated recording of the project",
    )
    doses: str | None = setting(
        None, "second file, with the doses: an eVOLVER's pump log, a Pioreactor's dosing_events"
    )
    columns: dict[str, Any] = setting(
        {}, f"names of columns that the program does not recognise: columns.KEY=NAME, KEY one of {', '.join(COLUMNS)}"
    )
    time_unit: str | None = setting(
        None, "unit of times that are not dates, if the column's name has none or a wrong one", choices=tuple(UNITS)
    )
    rows: str | None = setting(None, "FIRST:END: data rows to read, counted from 0, END excluded; null: all")
    run: int | None = setting(None, "run in a file of several concatenated runs, from 0; null: the longest")
    reactor: str | None = setting(None, "reactor in a file with several of them; null: the first")
    pump_ml_s: float = setting(
        1.0,
        "flow of the feed pump at full power, for a file with a Chi.Bio's duties or the seconds that a pump ran",
        "mL/s",
        above=0.0,
        at_most=10.0,
    )
    pumps: tuple[int, ...] = setting(
        (1,), "pumps in the Chi.Bio's CSV that feed the vial (1 to 4); their flows are added", within=(1, 4), some=True
    )

    def __post_init__(self) -> None:
        check(self)
        spans = self.rows is None or re.fullmatch(r"\d*:\d*", self.rows)
        require(bool(spans), "rows", self.rows, "FIRST:END, e.g. 0:700 (data rows from 0, END excluded)")
        for key in self.columns:
            require(key in COLUMNS, f"columns.{key}", self.columns[key], ", ".join(f"columns.{one}" for one in COLUMNS))

    def read(self, path: str) -> Recording:
        """Read a file with these options. Raises: RecordingError."""
        first, end = (self.rows or ":").split(":")
        return read_recording(
            path,
            pump_ml_s=self.pump_ml_s,
            pumps=self.pumps,
            run=self.run,
            reactor=self.reactor,
            rows=(int(first or 0), int(end) if end else None),
            doses=self.doses,
            columns={key: str(name) for key, name in self.columns.items()},
            time_unit=self.time_unit,
        )
