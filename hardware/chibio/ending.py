"""Outcome of a dose as pure functions, also if the program did not see the end of the dose.

A pump that is on repeats its dose every 63 s until it is off (docs/device.md, Pumps). The times at which it went on and
off follow from answers, from reads, and from the dead-man switch of a board agent. A time that none of these gives
exactly lies between two bounds, and so does the volume.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace

from conf.messages import Message
from hardware.chibio.dosing import PumpCalibration
from hardware.chibio.messages import DoseGave, DoseGaveNothing, DoseRepeated
from hardware.chibio.protocol import FEED, PERIOD_S, PUMPS, WASTE, DeviceState
from hardware.chibio.resume import NEVER, ReactorHistory, Span
from hardware.storage.doses import Ending

SWITCH_S = 10.0  # an agent acts up to this long after the silence that the journal shows
SAME_S = 1e-3  # on-times that differ by less count as one target: a path carries six digits
MOTOR_S = 0.7  # a motor starts at most this long after the answer, and a period is at most this much longer

OFF = (  # a pump is found off: evidence, and the two times between which it went off; the first row that holds counts
    ("the device was restarted", "last answer", "now"),
    ("an agent says when", "agent", "agent"),
    ("an agent that does not say had the time", "on", "silence"),
    ("it was asked off without an answer", "tried", "now"),  # done at once, or when a tunnel delivered it
    ("the experiment was ended", "last answer", "now"),
    ("its program was killed, and its waste pump is on", "end", "end"),  # an agent would have ended both
    ("no answer says that it went on", "asked", "asked"),  # and it never did
    ("nothing", "on", "now"),  # somebody switched it off
)


@dataclass(frozen=True)
class _Pump:
    """One pump in an open dose.

    asked_s: run time of the on command, inf if none was sent. on, off: run times between which the pump went on and
    off, nan if unknown. tried_s: run time of the first off command that failed, nan if none did. dose_s: planned
    on-time, s. anew: run time since which somebody else may have switched the pump on, and its on-time then, s.
    """

    part: str
    name: str
    asked_s: float
    on: Span
    off: Span
    tried_s: float
    dose_s: float
    anew: Span

    def on_s(self, now_s: float) -> tuple[float, float, float]:
        """Return the least and the most seconds it was on, and how long it may have been on anew, until now_s."""
        first, last = (now_s, now_s) if math.isnan(self.off[1]) else self.off
        most, anew = max(last - self.asked_s, 0.0), 0.0
        if not math.isnan(since_s := self.anew[0]):
            first, anew = min(first, since_s), max(now_s - since_s, 0.0)
            most = min(most, max(since_s - self.asked_s, self.dose_s))
        least = 0.0 if math.isnan(self.on[1]) else max(first - self.on[1] - MOTOR_S, 0.0)
        return least, most, anew


def _pumps(known: ReactorHistory) -> tuple[_Pump, _Pump]:
    fed_s = known.on_s if known.fed else math.inf
    wasted_s = known.on_s if math.isnan(known.waste_on[0]) else known.waste_on[0]
    feed, waste = (
        tuple(getattr(known, f"{part}_{what}") for what in ("on", "off", "tried", "s", "anew"))
        for part in ("feed", "waste")
    )
    return (
        _Pump("feed", known.feed_pump, fed_s, *feed),
        _Pump("waste", WASTE, wasted_s if known.wasted else math.inf, *waste),
    )


def found(
    known: ReactorHistory, state: DeviceState, now_s: float, seen_s: float, silence_s: float,
    stopped: Mapping[str, float] | None, killed: bool = False,
) -> dict[str, Span | None]:  # fmt: skip
    """Find what a read adds to the `known` facts of an open dose: when its pumps went on or off.

    A value of None revokes an off time that the read contradicts: the pump may be on anew, or the read may be an old
    answer that arrived again. The smallest volume still counts up to the revoked time. The same holds if the read shows
    another target than was set. `OFF` gives the time at which a pump that is found off went off.

    Args: state: read at run time now_s. seen_s: run time of the last answer before. silence_s: silence of this program
      after which a board agent, if present, switches pumps off. stopped: by pump, run time at which an agent switched
      it off; None: no report. killed: the dose was open before a resume, and its last command is not on record.
    """
    added: dict[str, Span | None] = {}
    restarted = bool(known.experiment) and (state.start_time != known.experiment or not state.started)
    for pump in _pumps(known) if known.open else ():
        is_on, asked_s = state.pumps_on[PUMPS.index(pump.name)] and not restarted, min(pump.asked_s, known.on_s)
        on_heard, off_heard = not math.isnan(pump.on[1]), not math.isnan(pump.off[1])
        agent_s = (stopped or {}).get(pump.name, math.nan)
        if (is_on or not math.isnan(agent_s)) and not on_heard:
            heard_s = now_s if is_on else agent_s - silence_s + SWITCH_S  # an agent counts from the last request
            added[f"{pump.part}_on"] = (asked_s, min(max(asked_s, heard_s), now_s))
        if is_on and (off_heard or not math.isnan(pump.tried_s)):
            added[f"{pump.part}_off"] = None
        target_s = PERIOD_S * state.pump_targets[PUMPS.index(pump.name)]
        changed = pump.asked_s <= now_s and not restarted and not abs(target_s - pump.dose_s) <= SAME_S  # also nan
        if changed and not pump.anew[0] <= asked_s:
            added[f"{pump.part}_anew"] = asked_s, target_s if target_s > 0.0 else 0.0
        elif is_on and off_heard and math.isnan(pump.anew[0]):
            added[f"{pump.part}_anew"] = pump.off[0], pump.dose_s
        if is_on or off_heard:
            continue
        on_s = pump.on[1] if on_heard else asked_s
        at_s = {
            "now": now_s, "last answer": min(seen_s, now_s), "agent": agent_s, "tried": min(pump.tried_s, now_s),
            "asked": asked_s, "on": on_s, "end": on_s + pump.dose_s + MOTOR_S,
            "silence": max(on_s, min(now_s, seen_s + silence_s + SWITCH_S)),
        }  # fmt: skip
        waste_left = killed and pump.part == "feed" and state.pumps_on[PUMPS.index(WASTE)]
        speaks = (
            restarted, not math.isnan(agent_s), stopped is None and now_s >= seen_s + silence_s,
            not math.isnan(pump.tried_s), not state.running, on_heard and waste_left, not on_heard, True,
        )  # fmt: skip
        _, since, until = OFF[speaks.index(True)]
        added[f"{pump.part}_off"] = at_s[since], at_s[until]
    return added


def conclude(
    known: ReactorHistory, now_s: float, feed: PumpCalibration, waste: PumpCalibration
) -> tuple[Ending, Message | None]:
    """Conclude the open dose in `known`, verified off at run time now_s; return its end, and a note or None."""
    fed, wasted = _pumps(known)
    least_s, most_s, anew_s = fed.on_s(now_s)
    low_ml, low_times, low_last_ml = _runs(least_s, fed.dose_s, PERIOD_S + MOTOR_S, feed)
    feed_ml, feed_times, feed_last_ml = _runs(most_s, fed.dose_s, PERIOD_S, feed)
    if anew_s > 0.0:  # booked as further repetitions; the last one may be larger
        once_ml, times, last_ml = _runs(anew_s, fed.anew[1], PERIOD_S, feed)
        feed_times, feed_last_ml = feed_times + times + 1, max(once_ml * max(times, 1) + last_ml - feed_ml * times, 0.0)
    waste_s = min(wasted.dose_s, wasted.anew[1])  # min(x, nan) is x
    waste_ml, waste_times, waste_last_ml = _runs(replace(wasted, anew=NEVER).on_s(now_s)[1], waste_s, PERIOD_S, waste)
    number = 0 if known.feed_pump == FEED else PUMPS.index(known.feed_pump) + 1
    ending = Ending(
        known.on_s, feed_ml, waste_ml, feed_times, waste_times, number, feed_last_ml, waste_last_ml,
        low_ml * max(low_times, 1) + low_last_ml,
    )  # fmt: skip
    return ending, _words(ending, known)


def _runs(on_s: float, dose_s: float, period_s: float, pump: PumpCalibration) -> tuple[float, int, float]:
    """Return what a pump gives in on_s seconds: first dose, mL; number of repeats; volume of the last repeat, mL."""
    times = int(on_s // period_s)
    last_ml = pump.volume(min(dose_s, on_s - times * period_s)) if times else 0.0
    return pump.volume(min(dose_s, on_s)), times, last_ml


def _words(ending: Ending, known: ReactorHistory) -> Message | None:
    ml, low_ml, most_ml = known.feed_ml, ending.feed_low_ml, ending.feed_ml + ending.repeated_ml
    if (times := ending.feed_times) and math.isnan(known.feed_anew[0]):
        return DoseRepeated(ml=ml, times=times, low_ml=low_ml, most_ml=most_ml)
    if most_ml < 1e-3:
        return DoseGaveNothing(ml=ml)
    as_planned = not times and low_ml >= 0.95 * ml - 0.1
    return None if as_planned else DoseGave(ml=ml, low_ml=low_ml, most_ml=most_ml)
