"""What a closed loop says on the console: changes while it runs, and its metrics as a table."""

from __future__ import annotations

import logging
import re
from collections.abc import Mapping, Sequence
from typing import Any

from experiments.control.loop import ClosedLoop, Step

__all__ = ["ChangeLog", "metrics_table"]

log = logging.getLogger(__name__)

FORMATS = {
    "ise": "8.4f",
    "itae": "8.2f",
    "ise_mean": "8.5f",
    "itae_mean": "8.3f",
    "settling_min": "8.1f",
    "steady_abs_error": "8.4f",
}


class ChangeLog:
    """Logs what changes, once: phases, words of the interlock, notes of the reactors."""

    def __init__(self, loop: ClosedLoop) -> None:
        self._names = loop.reactors.names
        self._phase = [-2] * len(self._names)
        self._reason: list[str | None] = [None] * len(self._names)
        self._noted: set[str] = set()

    def __call__(self, step: Step) -> None:
        """Log what is new in this step."""
        for n, name in enumerate(self._names):
            if step.rows[n] and int(step.phase[n]) != self._phase[n]:
                self._phase[n] = int(step.phase[n])
                what = "recovery" if self._phase[n] < 0 else f"setpoint {step.setpoint[n]:g}"
                log.info("%s: %s from minute %.0f, OD %.3f", name, what, step.minute[n], step.od[n])
            reason = step.reasons[n] or ""
            if not step.rows[n] and (not reason or reason.endswith("earlier in this run")):
                continue  # what a sample was refused for is not over because there is no new one yet
            kinds = reason.split(":")[0]
            if kinds != (self._reason[n] or ""):
                self._reason[n] = kinds
                log.warning("%s: %s", name, step.reasons[n] or "interlock: all well again")
        for note in step.notes:
            kind = re.sub(r"[\d.]+", "#", note)
            if kind not in self._noted:  # the journal has every one of them
                self._noted.add(kind)
                log.info("%s (noted once here, every time in the journal)", note)


def metrics_table(windows: Sequence[Mapping[str, Any]]) -> str:
    """A head and one line per window of a summary."""
    heads = ("setpoint", "ISE", "ITAE", "ISE/T", "ITAE/T", "settled", "steady")
    lines = [f"{'reactor':8} " + " ".join(f"{head:>8}" for head in heads)]
    for w in windows:
        cells = [f"{w[key]:{form}}" if w[key] == w[key] else f"{'–':>8}" for key, form in FORMATS.items()]
        lines.append(f"{w['reactor']:8} {w['setpoint']:8.2f} " + " ".join(cells))
    return "\n".join(lines)
