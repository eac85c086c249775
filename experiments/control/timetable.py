"""Timetable of a dry run: steps with their times, expected medium, controllers, device and output folder."""

import math
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from datetime import datetime, timedelta
from pathlib import Path

from envs.scenario import Scenario, bounds, outputs_of
from experiments.cli import frame
from experiments.control import assemble
from experiments.control.assemble import Setup
from experiments.control.config import DeployConfig
from experiments.control.guests import GUESTS
from hardware.errors import ReactorError

HEAD = f"  {'step':>8} {'from':>12} {'to':>12} {'min':>7} {'at most':>8} {'OD':>6} {'degC':>6} {'mL':>7}  until"


@dataclass(frozen=True)
class Expected:
    """Expected course of a step. minutes: duration. ml: medium. od: at its end. longest_ml: of the longest course."""

    minutes: float
    ml: float
    od: float
    longest_ml: float


def _reaches(od: float, level: float, growth: float, dilution: float) -> float:
    """Return the minutes from OD `od` to OD `level` by undiluted growth or by full dilution; inf: never."""
    rate = growth if level > od else dilution - growth
    return 0.0 if level == od else math.log(max(level, od) / min(level, od)) / rate if rate > 0.0 else math.inf


def _fed_ml(minutes: float, reached: float, down: bool, growth: float, dilution: float, volume_ml: float) -> float:
    """Return the medium that a step of `minutes` needs, mL. reached: minutes to the setpoint. down: by dilution."""
    held = max(minutes - reached, 0.0) * growth
    return volume_ml * (held + (min(minutes, reached) * dilution if down else 0.0))


def expected(s: Scenario, k: int, od: float, growth: float, dilution: float, volume_ml: float) -> Expected:
    """Predict step k of a scenario from OD `od`: undiluted growth or full dilution to the setpoint, then constant OD.

    Args: growth, dilution: growth rate and largest dilution rate, 1/min. volume_ml: of the culture.
    """
    setpoint, longest = s.setpoints[k], s.minutes[k]
    reached = _reaches(od, setpoint, growth, dilution)
    minutes = min(longest, _ends(s, k, od, growth, dilution, reached))
    way = (min, growth) if od <= setpoint else (max, growth - dilution)
    near = way[0](od * math.exp(way[1] * minutes), setpoint)
    ml, most = (_fed_ml(t, reached, od > setpoint, growth, dilution, volume_ml) for t in (minutes, longest))
    return Expected(minutes, ml, near, max(ml, most))


def _ends(s: Scenario, k: int, od: float, growth: float, dilution: float, reached: float) -> float:
    """Return the minutes after which the condition that ends step k is expected to hold; inf: never."""
    text, setpoint = (s.until[k] if s.until else None), s.setpoints[k]
    if text == "settled":
        edge = setpoint * (1.0 + math.copysign(s.settled_band, od - setpoint))
        inside = abs(od - setpoint) <= s.settled_band * setpoint
        return s.settled_min + (0.0 if inside else _reaches(od, edge, growth, dilution))
    least, most = bounds(text)
    if od >= least or od <= most:
        return 1.0  # a step lasts at least one control period
    for level, passed in ((least, od < least <= setpoint), (most, od > most >= setpoint)):
        if passed:
            return min(_reaches(od, level, growth, dilution), reached)
    return math.inf


def timetable(config: DeployConfig, place: str, now: datetime) -> str:
    """Return the text that `dry_run=true` prints. It reads files, contacts no device and writes nothing.

    Args: place: output folder of the run. now: time at which the run would start.
    Raises: UserError for every error of the run that can be found without a device.
    """
    if config.resume is not None:
        raise frame.UserError("dry_run=true: a resumed run has no timetable; remove dry_run or resume")
    with tempfile.TemporaryDirectory() as scratch:
        setup = assemble.unpack(whole := assemble.completed(config), Path(scratch))
    lines = [_deciders(whole, setup), *_device(setup)]
    for name, role, scenario in zip(setup.backend.reactors, setup.roles, setup.scenarios, strict=True):
        lines += _reactor(setup, name, role, scenario, now)
    return "\n".join([*lines, f"would write to {place}; no device was contacted and no file written"])


def _deciders(c: DeployConfig, setup: Setup) -> str:
    policy = ""
    if setup.policy is not None:
        policy = f", policy {c.policy} (regret {float(setup.policy.metadata.get('regret_pct', math.nan)):.2g} %)"
    further = "".join(f"; {what}: {kind}" for guest in GUESTS for what, kind in guest.deciders(c))
    own = "".join(f"; {name}: {law.kind}" for name, law in c.signals.items())
    return f"controller {c.controller.kind}{policy}{further}{own}; at_end {c.at_end}"


def _device(setup: Setup) -> Iterator[str]:
    family, backend = setup.family, setup.backend
    yield f"backend {backend.kind} ({family.address(backend)}), reactors {', '.join(backend.reactors)}"
    with frame.refusing(ReactorError):
        unmeasured = family.unmeasured(backend)
    if unmeasured:
        yield unmeasured


def _reactor(setup: Setup, name: str, role: str, scenario: Scenario, now: datetime) -> Iterator[str]:
    """Yield the lines of one reactor: its steps, and whether the medium is sufficient."""
    growth, volume_ml = setup.model.mu, setup.bench.volume_of(name)
    dilution = setup.model.max_pump_rate / setup.model.tau * (setup.bench.volume_ml / volume_ml)
    known = max(setup.family.start_od(setup.backend, setup.plant), scenario.recovery_od)
    od, at, ml, most = max(known or scenario.setpoints[0], 1e-3), 0.0, 0.0, 0.0
    yield f"{name} ({role}), from OD {od:g}, growth {growth:g} 1/min"
    yield HEAD
    if scenario.recovery_od:
        longest = f"at most {scenario.recovery_limit_min:g} min; the times below assume that it takes no time"
        beyond = "" if scenario.recovery == "grow" else "beyond and is diluted to "
        yield f"  {'recovery':>8} grows undiluted {beyond or 'to '}OD {scenario.recovery_od:g}, {longest}"
    for k, (setpoint, most_min, degc) in enumerate(
        zip(scenario.setpoints, scenario.minutes, scenario.temperatures, strict=True)
    ):
        step = expected(scenario, k, od, growth, dilution, volume_ml)
        until = (scenario.until[k] if scenario.until else None) or "its time"
        said = "; ".join([until, *filter(None, (guest.asked(scenario, k) for guest in GUESTS))])
        yield (
            f"  {k + 1:>8} {_clock(now, at)} {_clock(now, at + step.minutes)} {step.minutes:7.0f} {most_min:8.0f} "
            f"{setpoint:6.2f} {degc:6.1f} {step.ml:7.1f}  {said}"
        )
        if longest_spare := _spare(scenario, k, most_min):
            given = ", ".join(f"at most {spare:.1f} mL by Pump{pump}" for pump, spare in longest_spare.items())
            yield f"  {'':>8} gives {scenario.outputs[k]}: {given}"
        # The volume of a spare pump also dilutes the culture; the feed is reduced by this volume.
        ml += max(step.ml, sum(_spare(scenario, k, step.minutes).values()))
        most += max(step.longest_ml, sum(longest_spare.values()))
        at, od = at + step.minutes, step.od
    yield f"  {ml:.0f} mL of medium expected, {most:.0f} mL if every step takes its longest; {_lasts(setup, ml, most)}"


def _spare(scenario: Scenario, k: int, minutes: float) -> dict[int, float]:
    """Return pump -> volume, mL, that each spare pump delivers in `minutes` of a step."""
    outputs = outputs_of(scenario.outputs[k]) if scenario.outputs else ()
    return {o.pump: o.ml + o.ml_h * minutes / 60.0 for o in outputs}


def _lasts(setup: Setup, ml: float, most: float) -> str:
    limit, key = min((setup.bench.bottle_ml, "bench.bottle_ml"), (setup.safety.ml_per_run, "safety.ml_per_run"))
    if most <= limit:
        return f"{key}={limit:g} is sufficient"
    word = "is NOT sufficient" if ml > limit else "may not be sufficient"
    return f"{key}={limit:g} {word}: at this volume the interlock stops feeding; provide more"


def _clock(now: datetime, minutes: float) -> str:
    return f"{now + timedelta(minutes=minutes):%a %d %H:%M}".rjust(12)
