"""What became of a fault at the rig: the program's journal and recordings against the truth of the vials."""

import bisect
import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from typing import Any

from tests.campaigns.pioreactor_case import SETPOINT, SICK, WELL, Seen
from tests.campaigns.pioreactor_faults import RigFault

__all__ = ["RigOutcome", "judged"]

SHARE, SLACK_ML = 0.05, 0.1  # of a volume, and in all, by which a sound pump's timing is off
PULSE_S = 0.15  # a shorter run of a pump is a pin that is switched on and off
SAME_S = 0.5  # device s by which a row's time and its sample's are apart
HELD_OD, LAST_MIN, NEAR_OD = 0.05, 3.0, 0.06
FULL_ML = 24.0  # of a vial of 20 mL after one dose whose waste is still to come, and a doubled one
GAP_MIN = 2.5


@dataclass
class RigOutcome:
    """One fault, brought about `times` times in one run.

    told_s: real seconds from the fault until it was told, the longest; reason: by which words. doses: runs of the media
    pump. doubled: runs without a request of their own. asked_in_doubt: requests sent while the fate of one was open.
    low_ml, high_ml, true_ml: what the journal says was fed at least and at most, and what was. rows_lost: samples that
    are in no row. gap_min: longest time without a row, device min. peak_ml: of the vial. error_od: mean true distance
    from the setpoint at the end. well_error_od: largest of the other unit. wrong: what is not as declared.
    """

    fault: str
    moment: str
    times: int = 0
    told_s: float = math.nan
    reason: str = ""
    doses: int = 0
    doubled: int = 0
    asked_in_doubt: int = 0
    low_ml: float = 0.0
    high_ml: float = 0.0
    true_ml: float = 0.0
    rows: int = 0
    rows_lost: int = 0
    gap_min: float = 0.0
    peak_ml: float = 0.0
    error_od: float = math.nan
    well_error_od: float = 0.0
    wrong: list[str] = field(default_factory=list)

    @property
    def ok(self) -> bool:
        """Whether all is as declared."""
        return not self.wrong

    def as_dict(self) -> dict[str, Any]:
        """For summary.json."""
        return {key: None if value != value else value for key, value in asdict(self).items()} | {"ok": self.ok}


def judged(fault: RigFault, moment: str, struck: Sequence[float], seen: Seen) -> RigOutcome:
    """The outcome of a trial. Args: struck: wall time of every time that the fault was brought about."""
    found = RigOutcome(fault.name, moment, len(struck))
    if fault.refused:
        return _refused(fault, seen, found)
    mine = [row for row in seen.journal if row.get("reactor") == SICK]
    if not mine:
        found.wrong.append("nothing is on record")
        return found
    _told(fault, struck, seen, mine, found)
    _doses(fault, mine, seen, found)
    _volumes(fault, mine, seen, found)
    _rows(fault, mine, seen, found)
    _cultures(fault, seen, found)
    if seen.status != 0:
        found.wrong.append(f"the program ended with {seen.status}")
    if any(seen.vials[unit][-1]["duty"][pin] for unit in (SICK, WELL) for pin in ("12", "13")):
        found.wrong.append("a pump runs at the end")
    return found


def _refused(fault: RigFault, seen: Seen, found: RigOutcome) -> RigOutcome:
    """A program that must not start: one line that says why, and nothing dosed."""
    lines = seen.told.strip().splitlines()
    found.reason = lines[-1] if lines else ""
    errors = [line for line in lines if line.startswith("error: ")]
    if seen.status != 1 or len(errors) != 1 or "Traceback" in seen.told:
        found.wrong.append(f"not refused with one line but ended with {seen.status}")
    elif not any(word in seen.told for word in fault.by):
        found.wrong.append(f"the line does not name it: {errors[0]}")
    if any(row["kind"] == "feed_on" for row in seen.journal):
        found.wrong.append("dosed")
    return found


def _texts(row: Mapping[str, Any]) -> str:
    """What a row of the journal tells."""
    decided = row.get("row")
    inner = str(decided.get("interlock", "")) if isinstance(decided, Mapping) else ""
    return " ".join((str(row.get("note", "")), str(row.get("interlock", "")), str(row.get("end", "")), inner))


def _told(
    fault: RigFault, struck: Sequence[float], seen: Seen, mine: Sequence[Mapping[str, Any]], found: RigOutcome
) -> None:
    """Whether, by what word and how soon after each time it was told."""
    if not fault.by:
        return
    waits: list[float] = []
    for at, following in zip(struck, [*struck[1:], math.inf], strict=True):
        words = [(row["wall"], word) for row in mine for word in fault.by if word in _texts(row)]
        words += [
            (row["wall"], "started") for row in seen.journal if row["kind"] == "start" and "resumed" in fault.by[0]
        ]
        after = [(wall - at, word) for wall, word in words if at <= wall < following]
        if not after:
            found.wrong.append("not told" if len(struck) == 1 else f"not told at time {len(waits) + 1}")
            waits.append(math.nan)
            continue
        waits.append(after[0][0])
        found.reason = found.reason or after[0][1]
    found.told_s = max(waits)
    limit = 60.0 / seen.speed + fault.within_s
    if found.told_s > limit:
        found.wrong.append(f"told after {found.told_s:.0f} s, allowed {limit:.0f} s")


def _doses(fault: RigFault, mine: Sequence[Mapping[str, Any]], seen: Seen, found: RigOutcome) -> None:
    """Every run of the media pump has its request; none was sent while the fate of another was open."""
    pulses = [p for p in seen.pulses if p.unit == SICK and p.pump == "media" and p.seconds > PULSE_S]
    asked = [row for row in mine if row["kind"] == "feed_on"]
    at = [row["wall"] - 0.2 for row in asked]
    runs = [0] * (len(at) + 1)
    for pulse in pulses:
        runs[bisect.bisect(at, pulse.start)] += 1
    found.doses = len(pulses)
    found.doubled = runs[0] + sum(max(0, n - 1) for n in runs[1:])
    ids = [row["id"] for row in asked]
    if found.doubled > fault.foreign * found.times:
        found.wrong.append(f"{found.doubled} runs of the media pump without a request of their own")
    if len(set(ids)) != len(ids):
        found.wrong.append("an id was given twice")
    open_id = ""
    for row in mine:
        if row["kind"] == "feed_on":
            found.asked_in_doubt += bool(open_id)
            open_id = row["id"]
        elif row["kind"] == "dose_end" and row.get("id") == open_id:
            open_id = ""
    if found.asked_in_doubt:
        found.wrong.append("a dose was sent while the fate of another was open")
    if open_id:
        found.wrong.append(f"{open_id} has no end on record")


def _volumes(fault: RigFault, mine: Sequence[Mapping[str, Any]], seen: Seen, found: RigOutcome) -> None:
    """The truth lies between the least and the most on record; the vial does not fill."""
    ends = [row for row in mine if row["kind"] == "dose_end"]
    found.low_ml = sum(row.get("feed_low_ml", row["feed_ml"]) for row in ends)
    found.high_ml = sum(row["feed_ml"] for row in ends)
    vials = seen.vials[SICK]
    began = seen.journal[0]["wall"]
    before = max((row["fed_ml"] for row in vials if row["wall"] <= began), default=0.0)
    found.true_ml, found.peak_ml = vials[-1]["fed_ml"] - before, vials[-1]["peak_ml"]
    bounds = found.low_ml * (1.0 - SHARE) - SLACK_ML, found.high_ml * (1.0 + SHARE) + SLACK_ML
    if not (fault.flow or bounds[0] <= found.true_ml <= bounds[1]):
        found.wrong.append(f"fed {found.true_ml:.2f} mL, on record {found.low_ml:.2f} to {found.high_ml:.2f} mL")
    if found.peak_ml > FULL_ML and not fault.spills and not fault.unheld:
        found.wrong.append(f"the vial rose to {found.peak_ml:.1f} mL")


def _rows(fault: RigFault, mine: Sequence[Mapping[str, Any]], seen: Seen, found: RigOutcome) -> None:
    """Every sample of both units is in one row."""
    for unit in (SICK, WELL):
        samples = [r["sample_s"] for r in seen.journal if r["kind"] == "sample" and r["reactor"] == unit]
        rows = [minute * 60.0 for minute, _ in seen.rows[unit]]
        lost = [s for s in samples if not any(abs(s - row) <= SAME_S for row in rows)]
        found.rows_lost += len(lost)
        if len(rows) > len(samples):
            found.wrong.append(f"{len(rows) - len(samples)} rows of {unit} without a sample")
    found.rows = len(seen.rows[SICK])
    minutes = [minute for minute, _ in seen.rows[SICK]]
    found.gap_min = max((b - a for a, b in itertools.pairwise(minutes)), default=math.inf)
    if found.rows_lost:
        found.wrong.append(f"{found.rows_lost} samples are in no row")
    if found.gap_min > GAP_MIN + fault.seconds * seen.speed / 60.0 and not fault.blind:
        found.wrong.append(f"{found.gap_min:.1f} min without a row")


def _cultures(fault: RigFault, seen: Seen, found: RigOutcome) -> None:
    """The sick culture is back at the end; the well one never left."""
    last = seen.vials[SICK][-1]["wall"] - LAST_MIN * 60.0 / seen.speed
    errors = [abs(row["od"] - SETPOINT) for row in seen.vials[SICK] if row["wall"] >= last]
    found.error_od = sum(errors) / len(errors)
    found.well_error_od = max(abs(row["od"] - SETPOINT) for row in seen.vials[WELL])
    if not fault.unheld and found.error_od > HELD_OD:
        found.wrong.append(f"the culture is {found.error_od:.3f} OD from its setpoint at the end")
    if not fault.wide and found.well_error_od > NEAR_OD:
        found.wrong.append(f"the other culture was {found.well_error_od:.3f} OD away")
