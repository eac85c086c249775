"""What is seen of a rehearsed run from the moment of its fault on."""

from __future__ import annotations

import math
import re

import numpy as np

from envs.scenario import Scenario
from experiments.control.loop import Step
from experiments.reliability.faults import FAULTY, Fault
from experiments.reliability.outcome import Outcome
from experiments.reliability.rehearsal import Rehearsal
from hardware.safety.config import Response

__all__ = ["Watch"]

HEALTHY_MU, FULL_DILUTION = 0.025, 0.06  # 1/min: the emulator's healthy culture, and the largest feed rate over volume
OVERGROWN = 4.0  # OD; the plant would grow on, a real culture and its sensor do not


class Watch:
    """Follows a rehearsal from the moment of the fault on: who says what, and where the culture goes.

    Args: fault: None for a healthy run. result: what is seen goes into it.
    Attributes: struck_s, clock time of the fault; inf before it.
    """

    def __init__(self, fault: Fault | None, rehearsal: Rehearsal, result: Outcome) -> None:
        self.fault, self.r, self.result = fault, rehearsal, result
        self.struck_s = math.inf
        self._reference = math.nan
        self._at = 0.0
        rehearsal.clock.at(0.0, self._look)

    def _look(self) -> None:
        """Every 15 s: true OD of the faulty reactor against what is asked of it.

        The asked OD falls at most as fast as full dilution can make it: x' = (mu - D_max) x.
        """
        r, now = self.r, self.r.clock.now()
        r.device.run_until(now)
        minutes, self._at = (now - self._at) / 60.0, now
        if hasattr(r, "loop") and math.isfinite(r.loop.began[0]) and not r.loop.done[0]:
            schedule = r.loop.schedules[0]
            elapsed = np.array([(now - r.spans[0][0]) / 60.0 - r.loop.began[0]])
            asked = schedule.setpoints[int(max(Scenario.phase(schedule, elapsed)[0], 0))]
            od = float(r.device.vials[FAULTY].plant.culture.od[0])
            falling = self._reference * math.exp((HEALTHY_MU - FULL_DILUTION) * minutes)
            self._reference = max(asked, od if math.isnan(self._reference) else falling)
            if now >= self.struck_s and elapsed[0] < schedule.total_min:
                self.result.peak_error = max(self.result.peak_error, min(abs(od - self._reference), OVERGROWN))
        r.clock.at(now + 15.0, self._look)

    def step(self, step: Step) -> None:
        """What interlock and driver said in this pass."""
        struck = step.now_s + self.r.spans[0][0] >= self.struck_s
        for n, name in enumerate(self.r.names):
            mine = name == FAULTY or (self.fault is not None and self.fault.wide)
            for reason in (step.reasons[n] or "").split(" | "):
                kind = reason.split(":")[0]
                if not kind:
                    continue
                if not struck:
                    self.result.early_alarms += 1
                elif mine:
                    self.result.kinds[kind] = self.result.kinds.get(kind, 0) + 1
                    response = Response(int(step.response[n]))
                    self.detect(kind, "report" if response == Response.PASS else response.name.lower())
                else:
                    self.result.neighbour_alarms += 1
        for note in step.notes if struck else ():
            words = re.sub(r"[\d.]+", "#", note)
            self.result.notes[words] = self.result.notes.get(words, 0) + 1
            self.detect(f"note:{note}", "note")

    def detect(self, word: str, response: str) -> None:
        """Take a word of the program as the detection, if it is the first that is declared for this fault."""
        if self.fault is None or self.result.reason or not math.isfinite(self.struck_s):
            return
        for by in self.fault.by:
            kind, _, text = by.partition(":")
            if word == by or (text and word.startswith(f"{kind}:") and text in word):
                self.result.detected_s = round(self.r.clock.now() - self.struck_s, 1)
                self.result.reason, self.result.response = by, response
                return
