"""What became of faults at moments of runs: each judged by its declaration, all in tables and sums."""

import math
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from experiments.reporting.tables import markdown
from tests.campaigns.fault import Fault
from tests.campaigns.tracking import BAND_OD
from tests.studies.results import write_csv

NOTHING_ML = 0.1  # less than the smallest dose
SHARE, SLACK_ML = 0.05, 0.1  # of a volume, and in all, by which a sound pump's timing is off in real time
HELD_OD = 0.05  # mean error at the end

__all__ = ["Outcome", "allowed", "declared", "judged", "table", "totals", "write_cases"]


@dataclass
class Outcome:
    """What happened. Times s after the fault, volumes mL; nan where there is nothing to tell.

    guarded: whether the rig has an overflow pump. times: that the fault was brought about.
    trouble: what kept it from being brought about, or the run from going on.
    detected_s, reason: first declared word on the fault, the longest wait of several; allowed_s: as declared.
      untold: times without a word. response: of the interlock to it. kinds: all reasons after it; notes: of the driver.
    peak_ml, overflowed: of the worst vial.
    peak_error: largest distance of the faulty reactor's true OD, after the fault, from what the schedule asks and the
      pump can do; 4 stands for anything above. recovery_min: from the end of the fault until it stays near what can
      be reached from there; inf if it was not near at the end of the schedule, watched_min after the fault.
      end_error: mean distance from the setpoint at the end.
    allowed_error, allowed_recovery_min: as declared, inf where it is not judged.
    neighbour_error, neighbour_recovery_min: the same of the worst neighbour.
    fed_after_ml: by the faulty reactor's pump from two minutes after the detection on.
    rows, rows_missed: samples nobody could read; rows_lost: samples that could have been read and are in no row;
      rows_doubled. gap_min: longest time without a row, and what is allowed.
    doses: runs of the faulty reactor's feed pump. doses_doubled: those beyond one per decision or request; repeats:
      those that are the device's own (every 63 s), while nobody could stop it. ids_doubled: ids given again.
      in_doubt: requests sent while the fate of one was open. unended: without an end on record.
    low_ml, high_ml, fed_ml: what the journal says was fed at least and at most, and what was.
    exits: how often the device's software ended itself although the fault was over, or was not of that kind: a command
      to an absent reactor does that. neighbours_lost: healthy neighbours whose schedule did not end.
    pumps_off: every motor at rest at the end, as the program claims. status, refusals: with which the client ended, and
      lines in which it said why it did not start.
    early_alarms, neighbour_alarms: reasons given before the fault, and for healthy neighbours.
    outcome: how the run ended. wrong: what is not as declared.
    """

    fault: str
    moment: str
    guarded: bool = True
    family: str = "chibio"
    times: int = 1
    trouble: str = ""
    at_min: float = math.nan
    detected_s: float = math.nan
    allowed_s: float = math.inf
    untold: int = 0
    reason: str = ""
    response: str = ""
    kinds: dict[str, int] = field(default_factory=dict)
    notes: dict[str, int] = field(default_factory=dict)
    peak_ml: float = math.nan
    overflowed: bool = False
    peak_error: float = 0.0
    recovery_min: float = 0.0
    watched_min: float = math.inf
    end_error: float = math.nan
    allowed_error: float = math.inf
    allowed_recovery_min: float = math.inf
    neighbour_error: float = 0.0
    neighbour_recovery_min: float = 0.0
    fed_after_ml: float = 0.0
    rows: int = 0
    rows_missed: int = 0
    rows_lost: int = 0
    rows_doubled: int = 0
    gap_min: float = 0.0
    allowed_gap_min: float = math.inf
    doses: int = 0
    doses_doubled: int = 0
    repeats: int = 0
    ids_doubled: int = 0
    in_doubt: int = 0
    unended: int = 0
    low_ml: float = math.nan
    high_ml: float = math.nan
    fed_ml: float = math.nan
    exits: int = 0
    neighbours_lost: int = 0
    pumps_off: bool = False
    status: int | None = 0
    refusals: int = 0
    early_alarms: int = 0
    neighbour_alarms: int = 0
    outcome: str = ""
    wrong: list[str] = field(default_factory=list)

    @property
    def ok(self) -> bool:
        """Nothing is wrong."""
        return not self.wrong

    @property
    def label(self) -> str:
        """The fault's name, and the rig if it is the standard one."""
        return self.fault if self.guarded or self.family != "chibio" else f"{self.fault}, no overflow pump"

    def as_dict(self) -> dict[str, Any]:
        """For summary.json."""
        return {**asdict(self), "ok": self.ok}


def judged(out: Outcome, fault: Fault | None) -> Outcome:
    """The outcome with what is not as declared; of a healthy run (None), every word is a false alarm."""
    checks = {
        out.trouble: bool(out.trouble),
        "overflow": out.overflowed and (out.guarded or not (fault and fault.overflow)),
        "rows lost": out.rows_lost > 0,
        "rows doubled": out.rows_doubled > 0,
        "doses doubled": out.doses_doubled > (fault.foreign * out.times if fault else 0),
        "device ended": out.exits > 0,
        "neighbour lost": out.neighbours_lost > 0,
        "pumps not off": not out.pumps_off and not (fault and fault.stuck),
        "not detected": fault is not None and bool(fault.by) and (not out.reason or out.untold > 0),
        "false alarm": out.early_alarms + out.neighbour_alarms > 0 or (fault is None and bool(out.kinds)),
        **_control(out, fault),
        **(_processes(out, fault) if fault is not None and fault.family == "pioreactor" else {}),
    }
    out.wrong = [name for name, is_wrong in checks.items() if is_wrong]
    return out


def allowed(fault: Fault | None) -> tuple[float, float]:
    """Largest error, OD, and longest recovery, min, of the faulty culture as declared; inf where it is not judged."""
    if fault is None:
        return BAND_OD, 0.0
    if fault.stops or fault.gone:
        return math.inf, math.inf
    return fault.error, math.inf if fault.unheld else fault.recovery_min


def _control(out: Outcome, fault: Fault | None) -> dict[str, bool]:
    """Whether true ODs went where they must not, stayed there, or were dosed although no dose was right."""
    error, recovery = allowed(fault)
    near, soon = BAND_OD, 0.0
    if fault is not None and fault.wide:
        near, soon = fault.error, math.inf if fault.unheld else fault.recovery_min
    return {
        "strayed": out.peak_error > error,
        "not back": out.recovery_min > recovery < out.watched_min,
        "not held": out.end_error > HELD_OD and not (fault and fault.unheld),
        "dosed": fault is not None and bool(fault.stops) and out.fed_after_ml > NOTHING_ML,
        "neighbour strayed": out.neighbour_error > near,
        "neighbour not back": out.neighbour_recovery_min > soon < out.watched_min,
    }


def _processes(out: Outcome, fault: Fault) -> dict[str, bool]:
    """What real processes, whose messages may be late, may do wrong besides."""
    low, high = out.low_ml * (1.0 - SHARE) - SLACK_ML, out.high_ml * (1.0 + SHARE) + SLACK_ML
    return {
        "detected late": out.detected_s > out.allowed_s,
        "volume not as booked": not fault.flow and (out.fed_ml < low or out.fed_ml > high),
        "an id twice": out.ids_doubled > 0,
        "dosed in doubt": out.in_doubt > 0,
        "dose without an end": out.unended > 0,
        "no rows": out.gap_min > out.allowed_gap_min and not fault.blind,
        "not refused": fault.refused and (out.status != 1 or out.refusals != 1),
        "dosed though refused": fault.refused and out.doses > 0,
        "client failed": not fault.refused and out.status != 0,
    }


def _span(values: Sequence[float], form: str) -> str:
    """Smallest to largest, one number if they look the same; a dash for what is not finite."""
    low, high = (format(v, form) if math.isfinite(v) else "–" for v in (min(values), max(values)))
    return low if low == high else f"{low} – {high}"


def _of(allowed: float, form: str) -> str:
    """How a cell goes on where a limit is declared."""
    return f" of {allowed:{form}}" if math.isfinite(allowed) else ""


def _back(minutes: Sequence[float]) -> str:
    """Recoveries, and how many never came."""
    came = [m for m in minutes if math.isfinite(m)]
    never = f"{len(minutes) - len(came)} never" if len(came) < len(minutes) else ""
    return ", ".join(text for text in (_span(came, ".0f") if came else "", never) if text)


def _real(outcomes: Sequence[Outcome]) -> dict[str, Callable[[list[Outcome]], str]]:
    """Columns of the Pioreactor's table that the Chi.Bio's lacks."""
    if not any(o.family == "pioreactor" for o in outcomes):
        return {}
    return {
        "times": lambda mine: str(sum(o.times for o in mine)),
        "reported after, s": lambda mine: _span([o.detected_s for o in mine], ".1f"),
        "doses": lambda mine: str(sum(o.doses for o in mine)),
        "fed on record, mL": lambda mine: _sums((sum(o.low_ml for o in mine), sum(o.high_ml for o in mine))),
        "true, mL": lambda mine: _span([sum(o.fed_ml for o in mine)], ".2f"),
        "error at the end, OD": lambda mine: _span([o.end_error for o in mine], ".3f"),
    }


def _sums(ends: tuple[float, float]) -> str:
    return " to ".join(f"{end:.2f}" for end in ends) if math.isfinite(ends[0]) else "–"


def table(outcomes: Sequence[Outcome]) -> str:
    """Markdown: one row per fault over all moments; single cases are in cases.csv."""
    real = _real(outcomes)
    head = (
        "fault", "reported after, min", "by", "response", "peak mL", "peak OD error", "back after, min", "rows missed",
        "rows lost", "doses doubled", "pumps off", *real, "as declared",
    )  # fmt: skip
    rows = []
    for name in dict.fromkeys(o.label for o in outcomes):
        mine = [o for o in outcomes if o.label == name]
        wrong = dict.fromkeys(w for o in mine for w in o.wrong)
        reported = [o.detected_s / 60.0 for o in mine if o.reason]
        some = f" ({len(reported)} of {len(mine)})" if len(reported) < len(mine) else ""
        cells = [
            name if mine[0].fault != "none" else f"{name} ({len(mine)} healthy runs)",
            _span(reported, ".1f") + some if reported else "–",
            ", ".join(dict.fromkeys(o.reason for o in mine if o.reason)) or "–",
            ", ".join(dict.fromkeys(o.response for o in mine if o.response)) or "–",
            _span([o.peak_ml for o in mine], ".1f"),
            _span([o.peak_error for o in mine], ".2f") + _of(mine[0].allowed_error, ".2f"),
            _back([o.recovery_min for o in mine]) + _of(mine[0].allowed_recovery_min, ".0f"),
            str(sum(o.rows_missed for o in mine)),
            str(sum(o.rows_lost + o.rows_doubled for o in mine)),
            str(sum(o.doses_doubled for o in mine)),
            f"{sum(o.pumps_off for o in mine)} of {len(mine)}",
            *(cell(mine) for cell in real.values()),
            f"**no**: {', '.join(wrong)}" if wrong else "yes",
        ]
        rows.append(cells)
    return markdown(head, rows)


def declared(faults: Sequence[Fault]) -> str:
    """Markdown: what is not detected, or overflows without an overflow pump, and why."""
    head = ("fault", "what happens", "not detected because", "without an overflow pump it overflows because")
    shown = [f for f in faults if f.why_not or f.overflow]
    return markdown(head, ((f.name, f.what, f.why_not or "(detected)", f.overflow or "–") for f in shown))


def totals(outcomes: Sequence[Outcome]) -> dict[str, Any]:
    """The sums by which the matrix passes or fails."""
    healthy = [o for o in outcomes if o.fault == "none"]
    bare = [o for o in outcomes if not o.guarded and o.family == "chibio"]
    kills = sum(o.times for o in outcomes if o.times > 1)
    return {
        "cases": len(outcomes),
        "faults": len({o.fault for o in outcomes} - {"none"}),
        "overflows": sum(o.overflowed for o in outcomes if o.guarded),
        "cases_without_guard": len(bare),
        "overflows_without_guard": sum(o.overflowed for o in bare),
        **({"kills": kills} if kills else {}),
        "rows_lost": sum(o.rows_lost for o in outcomes),
        "rows_doubled": sum(o.rows_doubled for o in outcomes),
        "doses_doubled": sum(o.doses_doubled for o in outcomes),
        "doses_repeated_by_the_device": sum(o.repeats for o in outcomes),
        "undetected": sum("not detected" in o.wrong for o in outcomes),
        "software_ended": sum(o.exits for o in outcomes),
        "neighbours_lost": sum(o.neighbours_lost for o in outcomes),
        "pumps_not_off": sum("pumps not off" in o.wrong for o in outcomes),
        "strayed": sum(not {"strayed", "neighbour strayed"}.isdisjoint(o.wrong) for o in outcomes),
        "not_back": sum(not {"not back", "neighbour not back"}.isdisjoint(o.wrong) for o in outcomes),
        "dosed_though_stopped": sum("dosed" in o.wrong for o in outcomes),
        "worst_neighbour_error": max((o.neighbour_error for o in outcomes), default=math.nan),
        "false_alarms": sum(o.early_alarms + o.neighbour_alarms for o in outcomes)
        + sum(sum(o.kinds.values()) for o in healthy),
        "healthy_runs": len(healthy),
        "healthy_peak_error": max((o.peak_error for o in healthy), default=math.nan),
        "not_as_declared": sum(not o.ok for o in outcomes),
    }


def write_cases(path: Path, outcomes: Sequence[Outcome]) -> None:
    """cases.csv: one row per case."""
    rows = []
    for row in (o.as_dict() for o in outcomes):
        counts = {k: " ".join(f"{name} x{n}" for name, n in row[k].items()) for k in ("kinds", "notes")}
        rows.append({**row, **counts, "wrong": ", ".join(row["wrong"])})
    write_csv(path, rows)
