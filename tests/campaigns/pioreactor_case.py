"""One fault at one moment of a deployment at the Pioreactor rig, and its record against the truth of the vials."""

import bisect
import itertools
import math
import time
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

from hardware.errors import ReactorError
from tests.campaigns.fault import Fault
from tests.campaigns.outcome import Outcome, judged
from tests.campaigns.pioreactor_trial import FAULTED, SETPOINT, WELL, Seen, Trial

__all__ = ["PioreactorCase", "found_in"]

LATE_S = 240.0  # real seconds in which a run must dose again after a fault
PULSE_S = 0.15  # a shorter run of a pump is a pin that is switched on and off
SAME_S = 0.5  # device s by which a row's time and its sample's are apart
LAST_MIN = 3.0  # device minutes at the end
FULL_ML = 24.0  # of a vial of 20 mL after one dose whose waste is still to come, and a doubled one
GAP_MIN = 2.5


class PioreactorCase:
    """A fault at a moment, in a rig of its own: `run` gives its `Outcome`.

    Args:
      fault, moment: `start` is before the client, `between` and `in` are of its doses. folder: of the case.
      speed, seed, package: as of `Trial`. times: that the fault is brought about. settle: doses after the last of them.
      stopping: whether the case is to end early.
    """

    def __init__(
        self, fault: Fault, moment: str, folder: Path, speed: float, seed: int, package: str, times: int, settle: int,
        stopping: Callable[[], bool],
    ) -> None:  # fmt: skip
        self.fault, self.moment, self.folder, self.times, self.settle = fault, moment, folder, times, settle
        self._trial = partial(Trial, folder, speed, seed, package, stopping)
        self.struck: list[float] = []  # wall times

    def run(self) -> Outcome:
        """Bring it about, judge. Raises: nothing of what a rig that does not start brings about."""
        self.folder.mkdir(parents=True)
        trouble = ""
        try:
            with self._trial() as trial:
                status, trouble = self._tried(trial)
                time.sleep(1.2)  # the truth of the last second
                out = found_in(trial.seen(status), self.fault, self.moment, self.struck)
        except (ReactorError, OSError, RuntimeError) as error:
            out, trouble = Outcome(self.fault.name, self.moment), f"{type(error).__name__}: {error}"
        out.trouble = trouble or out.trouble
        return judged(out, self.fault)

    def _tried(self, trial: Trial) -> tuple[int | None, str]:
        """Status of the client, and what kept the fault from being brought about."""
        if self.moment == "start":
            self._begin(trial)
            trial.start()
            if self.fault.refused:
                return _ended(trial), ""
            trouble, times = "", 1
        else:
            trial.start()
            trouble, times = "" if trial.doses(2) else "no dose within the first minutes", self.times
        for _ in range(times):
            trouble = trouble or self._strike(trial)
        if not (trouble or trial.doses(self.settle, LATE_S)) and not trial.stopping():
            trouble = "no dose any more after it"
        return trial.end(), trouble

    def _begin(self, trial: Trial) -> None:
        self.struck.append(time.time())
        self.fault.begin(trial)

    def _strike(self, trial: Trial) -> str:
        """Bring the fault about at its moment and mend it; what kept it from being done."""
        if self.moment == "in" and not trial.until(trial.pumping):
            return "no dose to strike"
        if self.moment == "between" and not trial.until(lambda: not trial.pumping()):
            return "a dose without an end"
        if self.moment != "start":
            self._begin(trial)
        mended = time.monotonic() + 60.0 * self.fault.minutes
        while time.monotonic() < mended:
            if trial.stopping():
                return "stopped"
            time.sleep(0.02)
        if self.fault.end is not None:
            self.fault.end(trial)
        if not trial.doses(2, LATE_S):
            return "no dose any more after it"
        trial.until(trial.near, LATE_S)
        return ""


def _ended(trial: Trial) -> int | None:
    client = trial.client
    assert client is not None
    trial.until(lambda: False, 90.0)  # until it has ended
    return client.status if client.status is not None else trial.end()


def found_in(seen: Seen, fault: Fault, moment: str, struck: Sequence[float]) -> Outcome:
    """What a trial left, measured and not judged. Args: struck: wall time of every time the fault was brought about."""
    out = Outcome(fault.name, moment, False, "pioreactor", len(struck), status=seen.status)
    out.allowed_s = 60.0 / seen.speed + fault.within_s
    if fault.refused:
        return _refused(fault, seen, out)
    mine = [row for row in seen.journal if row.get("reactor") == FAULTED]
    if not mine:
        out.trouble = "nothing is on record"
        return out
    _told(fault, struck, seen, mine, out)
    _doses(mine, seen, out)
    _volumes(mine, seen, out)
    _rows(fault, seen, out)
    _cultures(seen, out)
    out.pumps_off = not any(seen.vials[unit][-1]["duty"][pin] for unit in (FAULTED, WELL) for pin in ("12", "13"))
    return out


def _refused(fault: Fault, seen: Seen, out: Outcome) -> Outcome:
    """A program that must not start: one line that says why, and nothing dosed."""
    lines = [line for line in seen.told.splitlines() if line.startswith("error: ")]
    out.outcome, out.refusals = "; ".join(lines), 0 if "Traceback" in seen.told else len(lines)
    out.reason = next((word for word in fault.by if word in seen.told), "")
    out.doses = sum(row["kind"] == "feed_on" for row in seen.journal)
    out.pumps_off = True  # nothing of this client's moved
    return out


def _texts(row: Mapping[str, Any]) -> str:
    """What a row of the journal tells."""
    decided = row.get("row")
    inner = str(decided.get("interlock", "")) if isinstance(decided, Mapping) else ""
    return " ".join((str(row.get("note", "")), str(row.get("interlock", "")), str(row.get("end", "")), inner))


def _told(fault: Fault, struck: Sequence[float], seen: Seen, mine: Sequence[Mapping[str, Any]], out: Outcome) -> None:
    """Whether, by what word and how soon after each time it was told."""
    if not fault.by:
        return
    words = [(row["wall"], word) for row in mine for word in fault.by if word in _texts(row)]
    words += [(row["wall"], "started") for row in seen.journal if row["kind"] == "start" and "resumed" in fault.by[0]]
    waits: list[float] = []
    for at, following in zip(struck, [*struck[1:], math.inf], strict=True):
        after = [(wall - at, word) for wall, word in words if at <= wall < following]
        out.untold += not after
        waits += [after[0][0]] if after else []
        out.reason = out.reason or (after[0][1] if after else "")
    out.detected_s = max(waits, default=math.nan)


def _doses(mine: Sequence[Mapping[str, Any]], seen: Seen, out: Outcome) -> None:
    """Every run of the media pump has its request; none was sent while the fate of another was open."""
    pulses = [p for p in seen.pulses if p.unit == FAULTED and p.pump == "media" and p.seconds > PULSE_S]
    asked = [row for row in mine if row["kind"] == "feed_on"]
    at = [row["wall"] - 0.2 for row in asked]
    runs = [0] * (len(at) + 1)
    for pulse in pulses:
        runs[bisect.bisect(at, pulse.start)] += 1
    out.doses = len(pulses)
    out.doses_doubled = runs[0] + sum(max(0, n - 1) for n in runs[1:])
    out.ids_doubled = len(asked) - len({row["id"] for row in asked})
    open_id = ""
    for row in mine:
        if row["kind"] == "feed_on":
            out.in_doubt += bool(open_id)
            open_id = row["id"]
        elif row["kind"] == "dose_end" and row.get("id") == open_id:
            open_id = ""
    out.unended = int(bool(open_id))


def _volumes(mine: Sequence[Mapping[str, Any]], seen: Seen, out: Outcome) -> None:
    """What was fed by the journal, at least and at most, and in truth; how full the vial was."""
    ends = [row for row in mine if row["kind"] in ("dose_end", "given")]  # given: what somebody else asked for
    out.low_ml = sum(row.get("feed_low_ml", row["feed_ml"]) for row in ends)
    out.high_ml = sum(row["feed_ml"] for row in ends)
    vials = seen.vials[FAULTED]
    began = seen.journal[0]["wall"]
    before = max((row["fed_ml"] for row in vials if row["wall"] <= began), default=0.0)
    out.fed_ml, out.peak_ml = vials[-1]["fed_ml"] - before, vials[-1]["peak_ml"]
    out.overflowed = out.peak_ml > FULL_ML


def _rows(fault: Fault, seen: Seen, out: Outcome) -> None:
    """Every sample of both units is in one row."""
    for unit in (FAULTED, WELL):
        samples = [r["sample_s"] for r in seen.journal if r["kind"] == "sample" and r["reactor"] == unit]
        rows = [minute * 60.0 for minute, _ in seen.rows[unit]]
        out.rows_lost += sum(not any(abs(s - row) <= SAME_S for row in rows) for s in samples)
        out.rows_doubled += max(len(rows) - len(samples), 0)
    minutes = [minute for minute, _ in seen.rows[FAULTED]]
    out.rows = len(minutes)
    out.gap_min = max((b - a for a, b in itertools.pairwise(minutes)), default=math.inf)
    out.allowed_gap_min = GAP_MIN + fault.minutes * seen.speed


def _cultures(seen: Seen, out: Outcome) -> None:
    """Where the sick culture is at the end, and how far the well one ever was."""
    last = seen.vials[FAULTED][-1]["wall"] - LAST_MIN * 60.0 / seen.speed
    errors = [abs(row["od"] - SETPOINT) for row in seen.vials[FAULTED] if row["wall"] >= last]
    out.end_error = sum(errors) / len(errors)
    out.neighbour_error = max(abs(row["od"] - SETPOINT) for row in seen.vials[WELL])
