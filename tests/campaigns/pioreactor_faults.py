"""What can go wrong at a Pioreactor, how it is brought about at the rig, and what is expected of the program then.

`RIG_FAULTS` is the declaration: for every fault either words of which one must be told (`by`), or why none need be or
can be told (`why_not`). Source: docs/pioreactor.md, What is odd in the vendor's software.
"""

import contextlib
import signal
import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path

from tests.campaigns.pioreactor_case import MEDIA_PIN, SICK, WASTE_PIN, WELL, Trial

__all__ = ["KILLS", "MOMENTS", "RIG_FAULTS", "RigFault", "rig_faults_named"]

Act = Callable[[Trial], None]
MOMENTS = ("start", "between", "in")


@dataclass(frozen=True)
class RigFault:
    """One fault of the sick unit and what is declared about it.

    name, what: for tables. act, mend: bring it about and undo it. moments: before the program starts, between two
    doses, in one. seconds: real time until it is mended. by: one of these words must be told, in a recording, a note
    or the program's output. why_not: why none must be. within_s: real time beyond one control period until it is
    told; a request has `backend.start_s` = 12 s to begin.
    refused: the program must not start, with one line and status 1.
    foreign: runs of a pump that somebody else or the vendor's software starts, of which the program need only tell.
    flow: what the pump moves is not what it is told, so volumes are not compared.
    wide: the well unit is struck, too. blind: no samples come meanwhile. unheld: why the culture is not held after it.
    spills: why the vial's volume rises.
    """

    name: str
    what: str
    act: Act
    mend: Act | None = None
    moments: tuple[str, ...] = ("between",)
    seconds: float = 25.0
    by: tuple[str, ...] = ()
    why_not: str = ""
    within_s: float = 14.0
    refused: bool = False
    foreign: int = 0
    flow: bool = False
    wide: bool = False
    blind: bool = False
    unheld: str = ""
    spills: str = ""

    def __post_init__(self) -> None:
        if bool(self.by) == bool(self.why_not):
            raise ValueError(f"fault {self.name}: needs either `by` or `why_not`")


def process(name: str) -> tuple[Act, Act]:
    """kill -9 of one of the rig's processes, and its start."""
    full = name if name == "broker" else f"{SICK} {name}"
    return lambda t: t.rig.kill(full), lambda t: t.rig.start(full)


def hangs(name: str) -> tuple[Act, Act]:
    """One of the rig's processes stands still, and goes on."""
    full = name if name == "broker" else f"{SICK} {name}"
    return (
        lambda t: t.rig.processes[full].send_signal(signal.SIGSTOP),
        lambda t: t.rig.processes[full].send_signal(signal.SIGCONT),
    )


def signals(job: str, number: int) -> Act:
    """A signal to one of the unit's jobs. Raises: RuntimeError if there is none."""

    def act(t: Trial) -> None:
        if not t.signal_job(job, number):
            raise RuntimeError(f"no {job} to send a signal to")

    return act


def kill_job(job: str) -> Act:
    """kill -9 of one of the unit's jobs."""
    return signals(job, signal.SIGKILL)


def vendors_turbidostat(target_od: float, wait_s: float = 0.0) -> Act:
    """Somebody starts the vendor's turbidostat."""

    def act(t: Trial) -> None:
        options = {t.known.target: target_od, "exchange-volume-ml": 0.5, **dict(t.known.signal)}
        t.run_job("dosing_automation", automation_name="turbidostat", **options)
        time.sleep(wait_s)

    return act


def kill_waste(t: Trial) -> None:
    """Of the waste pump's process, once it pumps."""
    t.until(lambda: t.pumping(WASTE_PIN), 20.0)
    kill_job("remove_waste")(t)


def clear_lock(pin: int) -> Act:
    """What the fault tells the operator to type."""
    return lambda t: t.pio(*t.known.purge.split()[1:], "pwm_locks", str(pin), "--as-int")


def left_lock(t: Trial) -> None:
    """A lock on the media pump's pin, as a process that was killed before this run left it."""
    t.run_job("add_media", ml=0.2, source_of_event="before")
    t.until(t.pumping, 20.0)
    kill_job("add_media")(t)
    t.rig.vials.power_cut(SICK)  # of the pumps, by hand


def cannot_start(t: Trial) -> None:
    """The unit's own program is broken, as by a bad update: jobs are accepted and die."""
    path = Path(t.rig.folder / SICK / "pio")
    path.rename(path.with_name("pio.whole"))
    path.write_text("#!/bin/sh\nexit 1\n", encoding="utf-8")
    path.chmod(0o755)


def starts_again(t: Trial) -> None:
    """Undo `cannot_start`."""
    path = Path(t.rig.folder / SICK / "pio")
    path.with_name("pio.whole").replace(path)


def vial(**values: float) -> Act:
    """What the photodiode of the sick unit sees."""
    return lambda t: t.rig.vials.vials[SICK].__dict__.update(values)


def held(t: Trial) -> None:
    """The reading stands still."""
    seen = t.rig.vials.vials[SICK]
    seen.held_od = seen.seen_od


def plant(part: str, switch: str, value: float) -> Act:
    """A switch of the sick unit's plant."""

    def act(t: Trial) -> None:
        getattr(getattr(t.rig.vials.vials[SICK].plant, part), switch)[:] = value

    return act


def swapped(t: Trial) -> None:
    """The address of the sick unit leads to the other."""
    t.words.append(f"backend.units.{SICK}.address={t.rig.web[WELL]}")


def flood(t: Trial) -> None:
    """Somebody's page asks for a harmless job four times a second."""
    for _ in range(60):
        with contextlib.suppress(OSError):  # turned away
            t.run_job("add_media", help=None)
        time.sleep(0.25)


def second(t: Trial) -> None:
    """Somebody starts the program once more for the same units; it must end by itself, and dose nothing."""
    if "already" not in (said := t.second()):
        raise RuntimeError(f"a second client was let in: {said[-300:]}")


KILLS = (
    RigFault(
        "client_killed", "kill -9 of this program", lambda t: t.kill(), lambda t: t.start(), ("between", "in"), 2.0,
        by=("resumed at minute",), within_s=30.0, wide=True, blind=True,
    ),
    RigFault(
        "dose_killed", "kill -9 of the media pump's job: a chip drives its pump on", kill_job("add_media"),
        clear_lock(MEDIA_PIN), ("in",), 4.0, by=("run on after add_media", "runs on after add_media"),
        unheld="the pump that ran on diluted the culture",
    ),
    RigFault(
        "reader_killed", "kill -9 of od_reading, mended by a reboot", kill_job("od_reading"),
        lambda t: t.rig.reboot(SICK), ("between", "in"), 30.0, by=("takes no OD readings",), within_s=30.0, blind=True,
    ),
    RigFault("queue_killed", "kill -9 of the task queue", *process("tasks"), ("between", "in"),
             by=("fate of a dose", "takes nothing")),
    RigFault("web_killed", "kill -9 of the unit's web server", *process("web"), ("between", "in"),
             by=("no dose", "not given", "does not list", "fate of a dose")),
    RigFault("broker_killed", "kill -9 of the MQTT broker", *process("broker"), ("between", "in"),
             by=("no MQTT broker",), wide=True, blind=True),
)  # fmt: skip

OTHERS = (
    RigFault(
        "waste_killed", "kill -9 of the waste pump's job: its pump runs on", kill_waste, clear_lock(WASTE_PIN), ("in",),
        4.0, by=("run on after remove_waste", "runs on after remove_waste"), within_s=20.0,
    ),
    RigFault("queue_hangs", "the task queue stands still for 25 s: requests run late", *hangs("tasks"),
             by=("fate of a dose", "takes nothing")),
    RigFault("web_hangs", "the web server stands still for 25 s", *hangs("web"),
             by=("no dose", "does not list", "unknown")),
    RigFault("broker_hangs", "the broker stands still for 25 s", *hangs("broker"), by=("no MQTT broker", "stale"),
             within_s=20.0, wide=True, blind=True),
    RigFault(
        "reader_hangs", "od_reading stands still: no readings, its state says ready",
        signals("od_reading", signal.SIGSTOP),
        signals("od_reading", signal.SIGCONT), seconds=60.0,
        by=("stale", "takes no OD readings", "no sample"), within_s=60.0, blind=True,
    ),
    RigFault(
        "dose_hangs", "the media pump's job stands still while its pump runs",
        signals("add_media", signal.SIGSTOP),
        signals("add_media", signal.SIGCONT), ("in",), 12.0, by=("run on after add_media", "runs on after add_media"),
        unheld="the pump that ran on diluted the culture",
    ),
    RigFault("reader_stopped", "somebody stops od_reading in the vendor's page",
             lambda t: t.stop_job("od_reading"), seconds=1.0,
             by=("takes no OD readings",), within_s=30.0, blind=True),
    RigFault("all_stopped", "somebody stops every job of the unit, in a dose", lambda t: t.post("/jobs/stop/all"),
             moments=("in",), seconds=1.0, by=("takes no OD readings", "ended early"), within_s=30.0, blind=True),
    RigFault(
        "foreign_dose", "somebody doses 0.5 mL by hand", lambda t: t.run_job("add_media", ml=0.5, source_of_event="UI"),
        seconds=1.0, by=("without our command",), foreign=1,
    ),
    RigFault(
        "foreign_automation", "somebody starts the vendor's turbidostat",
        vendors_turbidostat(0.4),
        lambda t: t.stop_job("dosing_automation"), seconds=30.0, by=("a dosing automation",),
        within_s=20.0, foreign=30, unheld="the vendor's turbidostat dosed to 0.4",
    ),
    RigFault("second_client", "the program is started once more for the same units", second, seconds=1.0,
             why_not="the second one is refused; the first goes on"),
    RigFault("flood", "somebody's page asks four times a second", flood, seconds=1.0,
             why_not="the vendor turns away what is too often; doses are asked for again with the next sample"),
    RigFault("cannot_start", "jobs are accepted and die", cannot_start, starts_again,
             by=("accepted and not carried out", "fate of a dose")),
    RigFault("uncalibrated", "the media pump's calibration is switched off",
             lambda t: t.post("/active_calibrations/media_pump", method="DELETE"),
             lambda t: t.post("/active_calibrations/media_pump/rig-media_pump", method="PATCH"),
             by=("accepted and not carried out", "fate of a dose")),
    RigFault("unit_rebooted", "the unit loses its power and boots", lambda t: t.rig.reboot(SICK), seconds=1.0,
             by=("takes no OD readings", "does not list", "no dose"), within_s=30.0, blind=True),
    RigFault("rebooted_in_a_dose", "the same in a dose", lambda t: t.rig.reboot(SICK), moments=("in",), seconds=1.0,
             by=("takes no OD readings", "counted whole", "ended early"), within_s=40.0, blind=True),
    RigFault("sensor_stuck", "the reading stands still", held, vial(held_od=float("nan")), seconds=75.0,
             why_not="the vendor's noise stays on it; the interlock knows it by what doses do not do",
             unheld="doses by a reading that does not move"),
    RigFault("sensor_jumps", "stray light: +1 OD", vial(offset_od=1.0), vial(offset_od=0.0), seconds=40.0,
             by=("jump:", "impossible:", "no_dilution:"), unheld="doses by stray light, if it lasts"),
    RigFault("sensor_dark", "the photodiode's plug is out", vial(held_od=0.0), vial(held_od=float("nan")), seconds=40.0,
             by=("jump:", "impossible:", "falls:", "spectrometer:"), unheld="no dose while nothing is seen"),
    RigFault("media_empty", "the media bottle is empty", plant("feed", "gain_factor", 0.0),
             plant("feed", "gain_factor", 1.0), seconds=100.0, by=("no_dilution:", "cannot_hold:"), within_s=100.0,
             flow=True, unheld="nothing dilutes"),
    RigFault("media_weak", "the media pump gives 60 %", plant("feed", "gain_factor", 0.6), seconds=60.0,
             why_not="the policy doses by what the culture answers", flow=True),
    RigFault("waste_blocked", "the waste tube is blocked", plant("vessel", "waste_gain_factor", 0.0),
             plant("vessel", "waste_gain_factor", 1.0), seconds=40.0,
             why_not="nothing of the vendor's measures the level; only the volume after it is seen",
             flow=True, spills="nothing is taken out for as long", unheld="a fuller vial is diluted less"),
    RigFault("renamed", "the address leads to another unit", swapped, moments=("start",),
             by=("identity",), refused=True),
    RigFault("automation_runs", "the vendor's turbidostat runs already", vendors_turbidostat(3.0, 8.0),
             moments=("start",), by=("dosing",), refused=True, foreign=30),
    RigFault("no_calibration", "no pump is calibrated",
             lambda t: t.post("/active_calibrations/media_pump", method="DELETE"), moments=("start",),
             by=("calibrat",), refused=True),
    RigFault("no_queue", "the task queue is dead", process("tasks")[0], moments=("start",),
             by=("task queue takes nothing",), refused=True),
    RigFault("no_broker", "the broker is dead", process("broker")[0], moments=("start",), by=("MQTT broker",),
             refused=True),
    RigFault("left_lock", "a media pump's job was killed before, and left a lock on its pin", left_lock,
             moments=("start",), by=("dosing: add_media",), refused=True),
)  # fmt: skip

RIG_FAULTS: tuple[RigFault, ...] = (*KILLS, *OTHERS)


def rig_faults_named(names: Iterable[str]) -> list[RigFault]:
    """Faults by name, all for none. Raises: ValueError naming one that does not exist."""
    known = {fault.name: fault for fault in RIG_FAULTS}
    wanted = tuple(names)
    for name in wanted:
        if name not in known:
            raise ValueError(f"faults = {name}: allowed {', '.join(known)}")
    return [known[name] for name in wanted or known]
