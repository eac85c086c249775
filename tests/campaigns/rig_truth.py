"""A deployment on the Pioreactor rig judged by its truth: rows in, findings out; no clocks, no sockets, no files.

The rows are those of `journal.jsonl` and `truth.jsonl` of a run. Times are wall times, s since 1970, of one computer.
"""

import itertools
import math
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from conf.schema import check, setting

__all__ = ["Account", "Dose", "Limits", "UnitTruth", "account", "found_in", "trouble"]

Array = NDArray[np.float64]
Rows = Sequence[Mapping[str, Any]]

CLOCK_S = 0.05  # by which two times of one computer may be apart: of a row, and of what it speaks of
LAST_MIN = 10.0  # device minutes at the end of a window


@dataclass(frozen=True)
class Limits:
    """What a deployment on the rig has to keep. Raises: ValueError naming key, value and allowed range."""

    error_od: float = setting(
        0.01, "mean distance of the true OD from the setpoint in the last 10 min of a window", "OD", above=0.0
    )
    dose_ml: float = setting(
        0.05, "by which a dose may differ from what was asked, and lie outside of the driver's bound", "mL", above=0.0
    )
    total_pct: float = setting(5.0, "difference of the sum of all doses from the journal's", "%", above=0.0)
    volume_ml: float = setting(
        2.0, "largest volume in a vial beyond that up to the waste tube", "mL", above=0.0, note="a dose is 1.5 at most"
    )

    def __post_init__(self) -> None:
        check(self, "limits")


@dataclass(frozen=True)
class Dose:
    """A dose by the journal: its id, when it was intended and told as ended (inf: not), mL asked, least and most.

    whole: it went as asked; else the journal says why not, and that it may have given less.
    """

    id: str
    start: float
    end: float
    ml: float
    low_ml: float
    high_ml: float
    whole: bool


@dataclass(frozen=True)
class Account:
    """The journal's doses against the runs of the media pump.

    asked: doses of the journal. runs: of the pump. without_intent: runs in the time of no dose. twice: runs beyond the
    first in the time of a dose. missing: doses that gave something by the journal, without a run. cut: doses that by
    the journal ended early, as one does that the end of a run stops, and gave less than asked.
    error_mean_ml, error_max_ml: mean of given minus asked and its largest size, without those. outside_ml: largest
    distance of what was given from the driver's bound, with those. given_ml, booked_ml: sums by the truth and by the
    journal; total_pct: how much more was given, % of what was given. ids_repeated: ids of more than one dose.
    """

    asked: int
    runs: int
    without_intent: int
    twice: int
    missing: int
    cut: int
    error_mean_ml: float
    error_max_ml: float
    outside_ml: float
    given_ml: float
    booked_ml: float
    total_pct: float
    ids_repeated: int


@dataclass(frozen=True)
class UnitTruth:
    """All that is found of one unit.

    held: of each window its setpoint, and the mean distance of the true OD from it in its last `LAST_MIN`, OD; nan: not
    on record. peak_ml: largest volume in the vial. pumps_off: at last.
    """

    unit: str
    held: tuple[tuple[float, float], ...]
    peak_ml: float
    pumps_off: bool
    account: Account


# -- from rows to what they say ----------------------------------------------------------------------------------------


def of_unit(rows: Rows, unit: str, key: str = "unit") -> list[Mapping[str, Any]]:
    """The rows of one unit, oldest first."""
    return [row for row in rows if row.get(key) == unit]


def windows(journal: Rows, unit: str) -> list[tuple[float, float, float]]:
    """Setpoint, begin and end of each window of a unit's schedule by its decisions, without the recovery before them.

    The last one ends with the unit's rows.
    """
    mine = of_unit(journal, unit, "reactor")
    decided = [(row["wall"], row["row"]) for row in mine if row["kind"] == "decision" and row["row"]["phase"] >= 0]
    first = [next(group) for _, group in itertools.groupby(decided, key=lambda each: each[1]["phase"])]
    ends = [*(wall for wall, _ in first[1:]), mine[-1]["wall"] if mine else math.nan]
    return [(row["setpoint"], wall, end) for (wall, row), end in zip(first, ends, strict=False) if end > wall]


def media_runs(truth: Rows, unit: str) -> tuple[Array, Array]:
    """Start, wall s, and volume, mL, of every run of a unit's media pump, by its start."""
    runs = sorted((float(r["start"]), float(r["ml"])) for r in of_unit(truth, unit) if r.get("pump") == "media")
    starts, volumes = np.array(runs, dtype=np.float64).reshape(-1, 2).T
    return starts, volumes


def asked(journal: Rows, unit: str) -> list[Dose]:
    """Every dose that the journal has for a unit, oldest first; one without an end may have given all or nothing."""
    mine = of_unit(journal, unit, "reactor")
    ends = {row["id"]: row for row in mine if row["kind"] == "dose_end" and "id" in row}
    found = []
    for row in mine:
        if row["kind"] == "intent" and float(row["feed_ml"]) > 0.0:
            ml, end = float(row["feed_ml"]), ends.get(row["id"])
            bound = (0.0, ml) if end is None else (float(end["feed_low_ml"]), float(end["feed_ml"]))
            ended, whole = (math.inf, False) if end is None else (end["wall"], not end["end"])
            found.append(Dose(str(row["id"]), row["wall"], ended, ml, *bound, whole))
    return found


# -- judged by the truth -----------------------------------------------------------------------------------------------


def found_in(journal: Rows, truth: Rows, unit: str, speed: float) -> UnitTruth:
    """One unit. Args: journal, truth: rows of all units. speed: device seconds per real second."""
    seen = np.array([(r["wall"], r["od"]) for r in of_unit(truth, unit) if "od" in r], dtype=np.float64)
    wall, od = seen.reshape(-1, 2).T
    held = []
    for setpoint, start, end in windows(journal, unit):
        last = (wall >= max(start, end - LAST_MIN * 60.0 / speed)) & (wall < end)
        held.append((setpoint, _mean(np.abs(od[last] - setpoint))))
    vial = [row for row in of_unit(truth, unit) if "volume_ml" in row]
    peak_ml = max((float(row["peak_ml"]) for row in vial), default=math.nan)
    off = bool(vial) and not any(vial[-1]["duty"].values())
    return UnitTruth(unit, tuple(held), peak_ml, off, account(journal, truth, unit))


def _mean(values: Array) -> float:
    return float(values.mean()) if values.size else math.nan


def account(journal: Rows, truth: Rows, unit: str) -> Account:
    """The doses of a unit one to one. Args: journal, truth: rows of all units."""
    doses, (starts, volumes) = asked(journal, unit), media_runs(truth, unit)
    known = starts < _handed_over(journal, unit)  # what the vendor's turbidostat gives after that is its own
    starts, volumes = starts[known], volumes[known]
    owner = _owners(doses, starts)
    first = {int(k): run for run, k in reversed(list(enumerate(owner))) if k >= 0}
    given = [(doses[k], float(volumes[run])) for k, run in sorted(first.items())]
    errors = np.array([ml - dose.ml for dose, ml in given if dose.whole or ml > dose.ml])
    outside = [max(dose.low_ml - ml, ml - dose.high_ml, 0.0) for dose, ml in given]
    given_ml, booked_ml = float(volumes.sum()), _booked(journal, doses, unit)
    count = Counter(dose.id for dose in doses)
    return Account(
        asked=len(doses), runs=starts.size, without_intent=int((owner < 0).sum()),
        twice=int((owner >= 0).sum()) - len(first),
        missing=sum(dose.low_ml > 0.0 and k not in first for k, dose in enumerate(doses)),
        cut=len(given) - errors.size, error_mean_ml=_mean(errors), error_max_ml=float(np.abs(errors).max(initial=0.0)),
        outside_ml=max(outside, default=0.0), given_ml=given_ml, booked_ml=booked_ml,
        total_pct=100.0 * (given_ml - booked_ml) / given_ml if given_ml > 0.0 else (math.inf if booked_ml else 0.0),
        ids_repeated=sum(n > 1 for n in count.values()),
    )  # fmt: skip


def _handed_over(journal: Rows, unit: str) -> float:
    """Wall time from which the unit regulated itself, inf if it never did."""
    mine = of_unit(journal, unit, "reactor")
    return min((float(row["wall"]) for row in mine if row["kind"] == "regulate"), default=math.inf)


def _owners(doses: Sequence[Dose], starts: Array) -> NDArray[np.intp]:
    """The dose in whose time each run of the pump began, -1 for none."""
    if not doses:
        return np.full(starts.size, -1, dtype=np.intp)
    begun = np.searchsorted([dose.start for dose in doses], starts + CLOCK_S, side="right") - 1
    ended = np.array([dose.end for dose in doses])[begun]
    return np.where((begun >= 0) & (starts <= ended + CLOCK_S), begun, -1)


def _booked(journal: Rows, doses: Sequence[Dose], unit: str) -> float:
    """mL that the journal counts: of every end, also of what nobody commanded, and whole of a dose without an end."""
    kinds = ("dose_end", "given")
    ends = [float(r["feed_ml"]) for r in of_unit(journal, unit, "reactor") if r["kind"] in kinds]
    return sum(ends) + sum(dose.ml for dose in doses if math.isinf(dose.end))


# -- against the limits ------------------------------------------------------------------------------------------------


def trouble(found: UnitTruth, limits: Limits, volume_ml: float) -> list[str]:
    """What a unit did not keep, one line each. Args: volume_ml: up to the waste tube."""
    lines = [] if found.held else ["no window of its schedule is on record"]
    for setpoint, error in found.held:
        if not error <= limits.error_od:
            said = f"mean |OD - setpoint| of the last {LAST_MIN:.0f} min at {setpoint:g} is"
            lines.append(f"{said} {error:.4f} (allowed {limits.error_od:g})")
    if not found.peak_ml - volume_ml <= limits.volume_ml:
        lines.append(f"{found.peak_ml:.2f} mL in the vial (allowed {volume_ml:g} + {limits.volume_ml:g})")
    if not found.pumps_off:
        lines.append("a pump is on at the end")
    return [f"{found.unit}: {line}" for line in lines + _accounted(found.account, limits)]


def _accounted(a: Account, limits: Limits) -> list[str]:
    """What is wrong with the doses."""
    counts = {
        "runs of the media pump without an intent": a.without_intent,
        "doses given twice": a.twice,
        "doses of the journal without a run of the pump": a.missing,
        "ids given to more than one dose": a.ids_repeated,
    }
    lines = [f"{what}: {number}" for what, number in counts.items() if number]
    if not a.asked:
        lines.append("no dose is on record")
    if not a.error_max_ml <= limits.dose_ml:
        lines.append(f"a dose is {a.error_max_ml:.3f} mL off (allowed {limits.dose_ml:g})")
    if not a.outside_ml <= limits.dose_ml:
        lines.append(f"a dose is {a.outside_ml:.3f} mL outside of the driver's bound (allowed {limits.dose_ml:g})")
    if not abs(a.total_pct) <= limits.total_pct:
        said = f"{a.given_ml:.2f} mL were given and {a.booked_ml:.2f} mL booked,"
        lines.append(f"{said} {a.total_pct:+.1f} % (allowed {limits.total_pct:g})")
    return lines
