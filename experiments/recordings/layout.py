"""Recognition of a recording's columns and units from the names or the number of its columns."""

import math
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple

from hardware.errors import RecordingError

Rows = tuple[int, int | None]

UNITS = {"s": 1 / 60, "min": 1.0, "h": 60.0}  # min
SPELT = {"sec": "s", "secs": "s", "seconds": "s", "mins": "min", "minutes": "min", "hr": "h", "hrs": "h", "hours": "h"}
TIME = re.compile(r"((exp|elapsed|experiment)_)?time(_[a-z]+)?|(elapsed_)?(min|minutes|h|hours|seconds)|timestamp")
OD = ("od_measured", "od", "od_reading", "avg_od_reading")
PUMP = ("pump_rate_ml_s", "pump_rate")
DUTY = "pump_{}_rate"  # the Chi.Bio writes a fraction of full power, not a flow
PUMPS = (1, 2, 3, 4)
DOSE = ("dose_ml", "add_media_ml", "add_alt_media_ml", "sum_add_media_ml", "sum_add_alt_media_ml", "volume_change_ml")
FED = ("fed_ml",)
TEMPERATURE = ("media_temp", "temperature_degc", "temperature_c", "avg_temperature_c", "temperature")
REACTOR = ("reactor", "pioreactor_unit")
LIGHT = (("fluorescence",), ("fp1_base", "fp1_emit1"))  # counts; the Chi.Bio writes the emission over the base
COLUMNS = ("time", "od", "rate", "dose", "fed", "temperature", "reactor")  # columns that a user can name

CHIBIO_POSITIONS = (0, 1, 8)  # of exp_time, od_measured, media_temp
CHIBIO_FIRST_PUMP = 10  # position of pump_1_rate; the other three follow
CHIBIO_COMMON_COLUMNS = 16  # the first 16 columns are the same in every release; later ones were inserted after them
EVOLVER = "Experiment: "  # start of the line above the two columns of an eVOLVER's file


class Asked(NamedTuple):
    """User's description of a file: arguments of `read_recording`."""

    pump_ml_s: float
    pumps: Sequence[int]
    reactor: str | None
    rows: Rows
    columns: Mapping[str, str]
    time_unit: str | None


@dataclass(frozen=True)
class Layout:
    """Columns of a recording, each by its number from 0, and the factors that convert its numbers to min and mL.

    source: name of the layout. od: None in a table of doses. fed: columns of feed pumps or doses. feed: their content:
    "rate" (mL/s), "dose" (mL), "total" of all doses so far (mL), or "" without feed. minutes: factor of times, nan if
    the column's name has no unit. ml: factor of the feed. idle: pump -> column, for pumps that do not count as feed.
    labels: reactor, experiment, channel or event -> column of its names. light: columns whose product is fluorescence.
    timed: whether a dose is given as the seconds that the pump ran.
    """

    source: str
    time: int
    od: int | None
    temperature: int | None
    fed: tuple[int, ...]
    feed: str
    minutes: float
    ml: float
    header: list[str] | None
    idle: dict[int, int] = field(default_factory=dict)
    labels: dict[str, int] = field(default_factory=dict)
    light: tuple[int, ...] = ()
    timed: bool = False

    @property
    def numbers(self) -> list[int]:
        """Numbers of all columns to read as floats, each listed once."""
        some = [self.time, self.od, *self.fed, *self.idle.values(), *self.light, self.temperature]
        return [place for place in dict.fromkeys(some) if place is not None]


def recognised(path: Path, first: Sequence[str], named: bool, asked: Asked, doses: bool, alone: bool) -> Layout:
    """Recognise the columns from the first line.

    Args: named: whether this line has names. doses: whether the file is a table of doses for a file of readings.
      alone: whether there is no table of doses. Raises: RecordingError with the columns looked for and found.
    """
    if first[0].startswith(EVOLVER):
        if alone:
            raise RecordingError(f"{path}: OD of an eVOLVER without a pump log; give doses=.../vial0_pump_log.txt")
        fed: tuple[int, ...] = (1,) if doses else ()
        od, feed = (None, "dose") if doses else (1, "")
        return Layout("eVOLVER", 0, od, None, fed, feed, UNITS["h"], asked.pump_ml_s, list(first), timed=doses)
    if named:
        return _named(path, first, asked, doses, alone)
    if len(first) == 3:
        return Layout("three columns without header (min, OD, mL/s)", 0, 1, None, (2,), "rate", 1.0, 1.0, None)
    if len(first) >= CHIBIO_COMMON_COLUMNS:
        fed, idle = _feeding(path, {pump: CHIBIO_FIRST_PUMP + pump - 1 for pump in PUMPS}, asked.pumps)
        source = "Chi.Bio without header, columns by position"
        return Layout(source, *CHIBIO_POSITIONS, fed, "rate", UNITS["s"], asked.pump_ml_s, None, idle)
    raise RecordingError(
        f"{path}: has {len(first)} columns and no header; a file without header needs 3 columns (minutes, OD, mL/s) or "
        f"a Chi.Bio's {CHIBIO_COMMON_COLUMNS} or more; add a header such as time_min,od,pump_rate_ml_s"
    )


def _named(path: Path, first: Sequence[str], asked: Asked, doses: bool, alone: bool) -> Layout:
    names = [_plain(cell) for cell in first]
    own = {key: _plain(name) for key, name in asked.columns.items()}

    def found(key: str, known: Iterable[str]) -> list[str]:
        if key not in own or (doses and key != "dose"):
            return [name for name in known if name in names]
        if own[key] not in names:
            raise RecordingError(f"{path}: columns.{key} = {asked.columns[key]}: no such column; {_there(first)}")
        return [own[key]]

    def needed(key: str, what: str, known: Sequence[str]) -> str:
        if some := found(key, known):
            return some[0]
        raise RecordingError(f"{path}: no column for the {what}; looked for {', '.join(known)}; {_there(first)}")

    at, times = names.index, [name for name in names if TIME.fullmatch(name)]
    time = needed("time", "time", sorted(times, key=lambda name: not _unit(name)) or ["time_min", "time_s", "time_h"])
    od = None if doses else needed("od", "OD", OD)
    fed, feed, unit, idle = _feed(path, names, found, asked, own)
    if not fed and (doses or alone):
        needed("rate", "pump rate or doses", (DUTY.format(1), *PUMP, *DOSE, *FED))
    temperature, reactor = found("temperature", TEMPERATURE), found("reactor", REACTOR)
    labels = {key: at(key) for key in ("experiment", "channel", "event") if key in names}
    return Layout(
        source="Chi.Bio CSV" if DUTY.format(1) in names else "recording with header",
        time=at(time),
        od=None if od is None else at(od),
        temperature=at(temperature[0]) if temperature else None,
        fed=fed,
        feed=feed,
        minutes=UNITS.get(asked.time_unit or _unit(time), math.nan),
        ml={"ul": 1e-3, "s": asked.pump_ml_s}.get(unit, 1.0),
        header=list(first),
        idle=idle,
        timed=unit == "s",
        labels=labels | ({"reactor": at(reactor[0])} if reactor else {}),
        light=next((tuple(map(at, columns)) for columns in LIGHT if set(columns) <= set(names)), ()),
    )


def _feed(
    path: Path, names: Sequence[str], found: Callable[[str, Iterable[str]], list[str]], asked: Asked, own: Iterable[str]
) -> tuple[tuple[int, ...], str, str, dict[int, int]]:
    """Return the columns of the feed, its kind and unit, and pump -> column for pumps that do not count as feed."""
    duties = {pump: names.index(DUTY.format(pump)) for pump in PUMPS if DUTY.format(pump) in names}
    if duties and not {"rate", "dose", "fed"} & {*own}:
        fed, idle = _feeding(path, duties, asked.pumps)
        return fed, "rate", "s", idle
    known = (("rate", "rate", (DUTY.format(1), *PUMP)), ("dose", "dose", DOSE), ("fed", "total", FED))
    for key, feed, usual in sorted(known, key=lambda one: one[0] not in own):
        if some := found(key, usual):
            unit = "" if feed == "rate" else some[0].rpartition("_")[2]
            places = tuple(names.index(name) for name in some[: 1 if feed == "rate" else None])
            return places, feed, SPELT.get(unit, unit), {}
    return (), "", "", {}


def _feeding(path: Path, at: dict[int, int], pumps: Sequence[int]) -> tuple[tuple[int, ...], dict[int, int]]:
    """Return the columns of the pumps that feed, and pump -> column of the other pumps."""
    absent = [pump for pump in pumps if pump not in at]
    if absent or not pumps:
        known = ", ".join(map(str, at))
        raise RecordingError(f"{path}: pumps = {list(pumps)}: allowed one or more of {known}, the pumps in the file")
    return tuple(at[pump] for pump in pumps), {pump: i for pump, i in at.items() if pump not in pumps}


def _plain(name: str) -> str:
    return re.sub(r"[^a-z0-9]+", "_", name.lower()).strip("_")


def _unit(name: str) -> str:
    """Return the unit of time in a column's name, "" without one."""
    words = [SPELT.get(word, word) for word in name.split("_")]
    return "s" if name == "exp_time" else next((word for word in reversed(words) if word in UNITS), "")


def _there(first: Sequence[str]) -> str:
    return (
        f"found {', '.join(first)[:2000]}; give its name as columns.KEY=NAME, KEY one of {', '.join(COLUMNS)} (dose: "
        "of each row, fed: the total so far, both in mL, uL or pump seconds)"
    )
