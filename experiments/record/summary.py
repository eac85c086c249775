"""Log of a run's changes, and summary at its end: metrics of every window, totals of every reactor, a figure."""

import logging
import re
from collections.abc import Callable, Sequence
from dataclasses import asdict
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from envs.scenario import Scenario
from experiments.loop.loop import ClosedLoop, Step
from experiments.loop.messages import FilterAlarm
from experiments.loop.metrics import mean_errors, window_metrics
from experiments.loop.progress import Progress
from experiments.loop.signals import AIM
from experiments.record import messages
from experiments.record.record import Recordings
from experiments.record.recovery import Rows
from experiments.reporting import charts
from experiments.reporting.curves import CALLED, signals_in
from experiments.reporting.tables import span
from hardware.safety.interlock import kinds_of

log = logging.getLogger(__name__)

METRICS = ("ise", "itae", "ise_mean", "itae_mean", "settling_min", "steady_abs_error", "abs_error")  # of a window
AGAIN_S = 3600.0
NUMBER = re.compile(r"(?<![\w.])\d+(?:\.\d+)?")


class ChangeLog:
    """Logger of changes: phases, interlock alarms, hand-overs. It logs the notes of reactors at most once an hour.

    Args: loop: loop to watch. tell: function of event, text and reactor, also called for alarms and hand-overs.
    """

    def __init__(self, loop: ClosedLoop, tell: Callable[[str, str, str], None] | None = None) -> None:
        self._names, self._progress, self._reactors = loop.reactors.names, loop.progress, loop.reactors
        self._tell = tell or (lambda event, text, reactor: None)
        self._handed_over = loop.reactors.handed_over.copy()
        self._phase = [-2] * len(self._names)
        self._reason: list[str | None] = [None] * len(self._names)
        self._supervised = [False] * len(self._names)
        self._noted: dict[str, tuple[float, float]] = {}  # note -> time of its last log line, largest number in it
        self._error, self._samples = np.zeros(len(self._names)), np.zeros(len(self._names))  # of the window so far

    def __call__(self, step: Step) -> None:
        for n, name in enumerate(self._names):
            if step.ended is not None and step.ended[n]:
                log.info(self._ended(step, n))
            if step.rows[n] and int(step.phase[n]) != self._phase[n]:
                self._window(step, n)
                self._phase[n] = int(step.phase[n])
                what = "recovery" if self._phase[n] < 0 else f"setpoint {step.setpoint[n]:g}"
                for signal in signals_in([step.columns]):
                    asked = step.columns[f"{signal}_setpoint"][n]
                    what += f", {CALLED.get(signal, signal)} {asked:g}" if np.isfinite(asked) else ""
                log.info(messages.PhaseBegins(reactor=name, what=what, minute=step.minute[n], od=step.od[n]))
            if step.rows[n]:
                self._who_decides(step, n)
                if step.done[n]:
                    self._window(step, n)
                elif self._phase[n] >= 0 and np.isfinite(step.od[n]) and (step.believed is None or step.believed[n]):
                    self._error[n] += abs(step.od[n] - step.setpoint[n])
                    self._samples[n] += 1
            reason = step.reasons[n] or ""
            if not step.rows[n] and (not reason or reason.endswith("earlier in this run")):
                continue  # an alarm of the last sample lasts until there is a new sample
            named = kinds_of(reason)
            kinds = " ".join(k for k in named if k != FilterAlarm.kind) if named else reason
            if kinds != (self._reason[n] or ""):
                self._reason[n] = kinds
                said = step.reasons[n] or messages.WellAgain()
                log.warning("%s: %s", name, said)
                self._tell("alarm", str(said), name)
        for n in map(int, np.flatnonzero(self._reactors.handed_over & ~self._handed_over)):
            self._tell("hand_over", str(messages.LeftToDevice()), self._names[n])
        self._handed_over = self._reactors.handed_over.copy()
        self.notes(step.now_s, step.notes)

    def notes(self, now_s: float, notes: Sequence[str]) -> None:
        """Log notes; repeat a note, whatever its numbers, only after an hour or when its largest number has doubled."""
        for note in notes:
            kind, largest = NUMBER.sub("#", note), max(map(float, NUMBER.findall(note)), default=0.0)
            told_s, before = self._noted.get(kind, (-np.inf, 0.0))
            if now_s >= told_s + AGAIN_S or largest >= 2.0 * before > 0.0:
                self._noted[kind] = now_s, largest
                log.info(messages.NoteSeen(note=note))

    def _ended(self, step: Step, n: int) -> messages.StepEnded:
        k = int(self._progress.phase(step.elapsed)[n]) - (not step.done[n])
        start, end, _ = self._progress.steps(n)[k]
        why = self._progress.conditions.texts[n][k]
        return messages.StepEnded(reactor=self._names[n], step=k + 1, minutes=end - start, why=why, od=step.od[n])

    def _window(self, step: Step, n: int) -> None:
        if self._samples[n]:
            mean = self._error[n] / self._samples[n]
            log.info(messages.WindowEnds(reactor=self._names[n], minute=step.minute[n], error=mean))
        self._error[n] = self._samples[n] = 0.0

    def _who_decides(self, step: Step, n: int) -> None:
        """Log when the supervisor's controller replaces the policy, and when the policy acts again."""
        supervised = bool(step.explanation.get("supervised", np.zeros(len(self._names)))[n])
        if supervised != self._supervised[n]:
            self._supervised[n] = supervised
            acts = (messages.SupervisorActs if supervised else messages.PolicyActs)(minute=step.minute[n])
            log.info(acts.about(self._names[n]))
            self._tell("hand_over", str(acts), self._names[n])


def reasons_line(rows: Rows) -> str:
    """List the interlock's alarms in a run, most frequent first; "" if there were none."""
    often = sorted(rows.reasons.items(), key=lambda item: -item[1].rows)
    return "; ".join(f"{kind} in {t.rows} of {len(rows)} rows, {span(t.first_min, t.last_min)}" for kind, t in often)


def summarise(
    table: Recordings, scenarios: Sequence[Scenario], roles: Sequence[str], outcome: str, progress: Progress
) -> dict[str, Any]:
    """Return the content of summary.json.

    Args: scenarios, roles: one per reactor. outcome: how the run ended. progress: times at which the steps ended.
    """
    volume, minute = np.nansum(table.columns["volume_ml"], axis=1), table.columns["time_min"]
    reactors = {
        name: {
            "role": role,
            "volume_ml": float(ml),
            "rows": len(rows),
            "interlock": rows.alarms,
            "reasons": {kind: asdict(reason) for kind, reason in rows.reasons.items()},
        }
        for name, role, ml, rows in zip(table.names, roles, volume, table.rows, strict=True)
    }
    return {
        "outcome": outcome,
        "minutes": float(np.nanmax(minute)) if np.isfinite(minute).any() else 0.0,
        "windows": _windows(table, scenarios, progress),
        "volume_ml": float(volume.sum()),
        "reactors": reactors,
        "repairs": [str(repair) for repair in table.repairs],
        "marks": [asdict(mark) for mark in table.marks],
    }


def _windows(table: Recordings, scenarios: Sequence[Scenario], progress: Progress) -> list[dict[str, Any]]:
    """Return the metrics of every phase of every reactor; `ended` is the reason of the phase's end, or null."""
    elapsed, od = table.columns["elapsed_min"], table.od()
    rows = []
    for n, (name, scenario) in enumerate(zip(table.names, scenarios, strict=True)):
        latest = float(np.nanmax(elapsed[n], initial=-1.0))
        for phase, (setpoint, step) in enumerate(zip(scenario.setpoints, progress.steps(n), strict=True)):
            start, end = round(step[0], 4), round(step[1], 4)  # as the recording has its minutes
            m = window_metrics(elapsed[n : n + 1], od[n : n + 1], setpoint, start, end)
            window = {"reactor": name, "phase": phase, "setpoint": setpoint, "start_min": start, "end_min": end}
            window["ended"] = step[2] if latest >= end - 1e-6 else None
            window["temperature"] = scenario.temperatures[phase]
            window |= {key: float(getattr(m, key)[0]) for key in METRICS}
            window |= _further(table, n, start, end)
            rows.append(window)
    return rows


def _further(table: Recordings, n: int, start: float, end: float) -> dict[str, Any]:
    """Return the errors of reactor n's OD and further signals: of the estimate, and of the true value if known.

    A signal has the columns NAME, NAME_setpoint and perhaps true_NAME. A setpoint that changed is None.
    """
    own = {key: values[n : n + 1] for key, values in table.columns.items()}
    minute = own["elapsed_min"]
    found: dict[str, Any] = {}
    for name in (key.removesuffix("_setpoint") for key in own if key.endswith("_setpoint")):
        asked = own[f"{name}_setpoint"]
        values = np.unique(asked[(minute >= start - 1e-6) & (minute < end - 1e-6) & np.isfinite(asked)])
        found[f"{name}_setpoint"] = float(values[0]) if values.size == 1 else None
        for key in (name, f"true_{name}"):
            if key in own:
                whole, late = mean_errors(minute, own[key], asked, start, end)
                found |= {f"{key}_abs_error_mean": float(whole[0]), f"{key}_abs_error_last2h": float(late[0])}
    if found:
        density, _ = mean_errors(minute, table.od()[n : n + 1], own["setpoint"], start, end)
        found["od_abs_error_mean"] = float(density[0])
    return found


def figure_of(table: Recordings, scenarios: Sequence[Scenario], title: str) -> Figure:
    """Draw the OD, setpoint, pump rate and, if a scenario changes it, temperature of all reactors."""
    c = table.columns
    switched = any(len(set(s.temperatures)) > 1 for s in scenarios)
    temperature = c["temperature_degc"].T if switched else None
    series = (c["time_min"].T, table.od().T, table.setpoints().T, c["pump_rate_ml_s"].T)
    aim = c[AIM].T if AIM in c else None
    marks = [(m.time_min, f"{m.reactor} {m.text}".strip()) for m in table.marks if m.share is None]
    return charts.closed_loop(*series, table.names, temperature, title, marks, table.od(refused=True).T, aim)
