"""Days of a run with all reactors in virtual time: does anything grow, drift or get lost? `tests.campaigns.soak`."""

import gc
import logging
import math
import time
from array import array
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from conf.schema import check, part, setting
from envs.bench import Bench
from envs.scenario import Scenario
from experiments.cli import files, frame
from experiments.laws.base import Mask
from experiments.laws.registry import on_device
from experiments.loop.loop import Step
from experiments.loop.messages import FilterAlarm
from hardware.chibio.protocol import POSITIONS
from hardware.emulator.vial import Dose
from hardware.safety.config import SafetyConfig
from hardware.safety.interlock import kinds_of
from hardware.storage.journal import read_journal
from tests.campaigns.audit import Served, audit_doses, audit_rows
from tests.campaigns.rehearsal import Rehearsal, rehearsed
from tests.campaigns.tracking import BAND_OD, Tracking
from tests.entry import command
from tests.studies.results import leave

__all__ = ["Day", "SoakConfig", "soak", "soak_run"]

log = logging.getLogger(__name__)

HELD_OD = 0.015  # five times what noise and dose spread leave of a sound loop
ASTRAY_MIN = 5.0  # an outlying reading costs a dose, two in a row cost two
MB = 1024.0 * 1024.0
SETTLING_MIN = 20.0  # ln(0.6 / 0.4) at the difference between full dilution and growth takes 12 min, upward 16 min
Times = dict[str, "array[float]"]  # per reactor, device s; a week of them must not look like a leak


@dataclass(frozen=True)
class SoakConfig:
    """How many reactors, how long and with which setpoints. Raises: ValueError naming key, value and allowed range."""

    reactors: int = setting(8, "M0 and up", within=(1, 8))
    days: float = setting(7.0, "length", within=(0.01, 100))
    setpoints: tuple[float, ...] = setting((0.5, 0.4, 0.6), "in turn", "OD", some=True)
    phase_min: float = setting(240.0, "each", "min", within=(10, 1e5))
    controller_kind: str = setting("dqn", "a controller that can run a device; dqn is the policy that ships")
    safety: SafetyConfig = part(lambda: SafetyConfig(ml_per_run=1e6), "limits of the interlock")
    seed: int = setting(0, "of all noise", at_least=0)

    def __post_init__(self) -> None:
        check(self)
        on_device(self.controller_kind)

    def schedule(self) -> Scenario:
        """The setpoints in turn until the days are over."""
        phases = max(int(np.ceil(self.days * 1440.0 / self.phase_min)), 1)
        setpoints = tuple(self.setpoints[k % len(self.setpoints)] for k in range(phases))
        return Scenario(setpoints, (self.phase_min,) * phases, (37.0,) * phases)


@dataclass(frozen=True)
class Day:
    """What one part of the run, a day as a rule, cost. Memory is the process's, sizes are of the run folder.

    error: mean distance of the true OD from the setpoint, phases' first 20 min left out; worst: of the worst reactor.
    out_min: longest time that a reactor was farther than `tracking.BAND_OD` from what growth and full dilution allow.
    """

    days: float
    samples: int
    memory_mb: float
    journal_mb: float
    csv_mb: float
    events_mb: float
    state_kb: float
    wall_s: float
    error: float
    worst: float
    out_min: float
    alarms: int


def _memory_mb() -> float:
    """Resident memory of this process, MB."""
    with open("/proc/self/statm", encoding="ascii") as f:
        return int(f.read().split()[1]) * 4096 / MB


def _size_mb(folder: Path, pattern: str) -> float:
    return sum(p.stat().st_size for p in folder.glob(pattern)) / MB


class _Meter:
    """Adds up a part of the run."""

    def __init__(self, rehearsal: Rehearsal) -> None:
        self.r, self.days = rehearsal, 0.0
        self._tracking = Tracking(np.full(len(rehearsal.names), BAND_OD))
        self._reset()

    def _reset(self) -> None:
        self.samples = self.alarms = 0
        self.errors: list[list[float]] = [[] for _ in self.r.names]
        self.out_min = 0.0
        self._began = time.perf_counter()

    def step(self, step: Step, settled: Mask) -> None:
        """Take a pass of the loop. Args: settled: reactors whose phase is so old that they must be at its setpoint."""
        self.samples += int(step.rows.sum())
        self.alarms += sum(bool(set(kinds_of(reason or "")) - {FilterAlarm.kind}) for reason in step.reasons)
        vials = self.r.device.vials.values()
        od = np.array([vial.plant.culture.od[0] for vial in vials], dtype=np.float64)
        for n in np.flatnonzero(step.rows & settled):
            self.errors[n].append(abs(float(od[n] - step.setpoint[n])))
        self._tracking.look(step.now_s / 60.0, step.setpoint, od, np.ones(od.size, dtype=np.bool_))
        self.out_min = max(self.out_min, float(self._tracking.away_min.max()))

    def take(self, part_days: float) -> Day:
        """Close this part. Args: part_days: its length."""
        gc.collect()
        self.days += part_days
        folder = self.r.folder
        day = Day(
            days=round(self.days, 3),
            samples=self.samples,
            memory_mb=round(_memory_mb(), 1),
            journal_mb=round(_size_mb(folder, "journal.jsonl"), 2),
            csv_mb=round(_size_mb(folder, "recordings/*.csv"), 2),
            events_mb=round(_size_mb(folder, "**/events*"), 2),
            state_kb=round(_size_mb(folder, "state.json") * 1024.0, 1),
            wall_s=round(time.perf_counter() - self._began, 1),
            error=round(float(np.mean([e for errors in self.errors for e in errors] or [np.nan])), 4),
            worst=round(max((float(np.mean(errors)) for errors in self.errors if errors), default=math.nan), 4),
            out_min=round(self.out_min, 1),
            alarms=self.alarms,
        )
        self._reset()
        return day


def soak_run(config: SoakConfig, folder: Path, days: list[Day]) -> dict[str, Any]:
    """The run; appends to `days` as they pass; returns what the audit found. Raises: ReactorError."""
    names = POSITIONS[: config.reactors]
    filled = Bench(bottle_ml=1e6)  # by somebody
    run = rehearsed(names, config.schedule(), config.safety, config.controller_kind, bench=filled)
    r = Rehearsal(folder, run, seed=config.seed)
    doses, served = {name: array("d") for name in names}, {name: Served() for name in names}
    r.begin()
    meter, part = _Meter(r), min(1.0, config.days)
    end = r.clock.now() + 86400.0 * config.days
    mark = r.clock.now() + 86400.0 * part
    for step in r.run(end):
        meter.step(step, step.elapsed % config.phase_min > SETTLING_MIN)
        if r.clock.now() >= mark:
            _collect(r, doses, served)
            days.append(meter.take(part))
            log.info("%s", "  ".join(f"{k} {v}" for k, v in asdict(days[-1]).items()))
            mark += 86400.0 * part
    if meter.samples:
        _collect(r, doses, served)
        days.append(meter.take((r.clock.now() - mark) / 86400.0 + part))
    r.reactors.stop()
    off = not any(any(r.truth(name)["motors"].values()) for name in names)
    r.close()
    return {**_audit(r, doses, served), "pumps_off": off}


def _collect(r: Rehearsal, doses: Times, served: dict[str, Served]) -> None:
    """Move out of the emulator what it would forget: when the feed pump began, samples and when they were read."""
    for name, bench in r.device.vials.items():
        doses[name].extend(dose.start_s for dose in bench.doses if dose.pump == "Pump1")
        served[name].add(bench.samples, bench.reads)
        for kept in (bench.doses, bench.samples, bench.reads):
            kept.clear()


def _audit(r: Rehearsal, doses: Times, served: dict[str, Served]) -> dict[str, Any]:
    """Minutes, doses and volumes: what the run believes against what the plant knows, per reactor."""
    journal, _ = read_journal(r.folder / "journal.jsonl")
    ledger, fed = r.loop.interlock.budget.volume_ml, r.loop.interlock.budget.fed_ml
    reactors = {}
    for n, name in enumerate(r.names):
        truth = r.truth(name)
        runs = [Dose("Pump1", start, math.nan, 1, math.nan) for start in doses[name]]
        doubled, repeats = audit_doses(journal, runs, name, r.spans[0][0])
        reactors[name] = {
            "doses": len(runs),
            "doses_doubled": doubled + repeats,
            "booked_ml": float(fed[n]),
            "fed_ml": truth["feed_ml"],
            "fed_error_pct": 100.0 * (float(fed[n]) / truth["feed_ml"] - 1.0),
            "ledger_ml": float(ledger[n]),
            "volume_ml": truth["volume_ml"],
            "peak_ml": truth["peak_ml"],
        }
    missed, lost, twice = audit_rows(r, None, served)
    return {"rows_lost": missed + lost, "rows_doubled": twice, "reactors": reactors}


def growth(days: Sequence[Day], key: str) -> float:
    """Increase per day over the second half of the run, in the unit of `key`."""
    late = days[len(days) // 2 :]
    if len(late) < 2:
        return 0.0
    slope = np.polyfit([d.days for d in late], [getattr(d, key) for d in late], 1)[0]
    return float(slope)


def write_table(days: list[Day], folder: Path) -> None:
    """A line per day."""
    each = [asdict(day) for day in days]
    rows = [[f"{value:.4g}" if isinstance(value, float) else value for value in day.values()] for day in each]
    leave(folder, __file__, [key.replace("_", " ") for key in each[0]], rows)


def soak(config: SoakConfig, folder: Path) -> None:
    """Run, table, summary.json. Raises: UserError if something was lost, grew or drifted."""
    days: list[Day] = []
    began = time.monotonic()
    found = soak_run(config, folder, days)
    slopes = {key: round(growth(days, key), 2) for key in ("memory_mb", "journal_mb", "csv_mb", "events_mb")}
    wall = round(time.monotonic() - began, 1)
    summary = {**found, "growth_per_day": slopes, "wall_s": wall, "days": [asdict(d) for d in days]}
    files.write_json(folder / "summary.json", summary)
    write_table(days, folder)
    errors = [abs(v["fed_error_pct"]) for v in found["reactors"].values()]
    levels = [abs(v["ledger_ml"] - v["volume_ml"]) for v in found["reactors"].values()]
    log.info("growth per day %s; %d rows lost; feed booked within %.2f %%, level within %.2f mL; %.0f s", slopes,
             found["rows_lost"], max(errors), max(levels), wall)  # fmt: skip
    doubled = sum(v["doses_doubled"] for v in found["reactors"].values())
    worst = np.nanmax([d.worst for d in days])
    bad = {
        "rows lost or doubled": found["rows_lost"] + found["rows_doubled"] > 0,
        "doses doubled": doubled > 0,
        "feed not as booked (more than 2 %)": max(errors) > 2.0,
        "level not as booked (more than 1 mL)": max(levels) > 1.0,
        "memory grows (more than 5 MB a day)": slopes["memory_mb"] > 5.0,
        "pumps not off": not found["pumps_off"],
        f"a culture not held (mean error of a day above {HELD_OD:g} OD)": not worst <= HELD_OD,
        f"a culture astray (for more than {ASTRAY_MIN:g} min)": max(d.out_min for d in days) > ASTRAY_MIN,
    }
    if any(bad.values()):
        raise frame.UserError("; ".join(name for name, is_bad in bad.items() if is_bad))


main = command(__file__, SoakConfig(), soak)


if __name__ == "__main__":
    main()
