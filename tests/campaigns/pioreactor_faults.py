"""What can go wrong at a Pioreactor, and how it is brought about at the rig: the table `FAULTS`."""

import contextlib
import math
import signal
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

from tests.campaigns.fault import Fault
from tests.campaigns.pioreactor_trial import FAULTED, MEDIA_PIN, WASTE_PIN, WELL, Trial

__all__ = ["FAULTS"]

Act = Callable[[Trial], None]


def rig(
    name: str,
    what: str,
    begin: Act,
    end: Act | None = None,
    moments: tuple[str, ...] = ("between",),
    seconds: float = 25.0,
    *,
    within_s: float = 14.0,
    unheld: str = "",
    overflow: str = "",
    **declared: Any,
) -> Fault:
    """A fault of the sick unit of the rig, told within the time in which a request begins (`backend.start_s` = 12 s).

    A culture is judged by its end alone. Where nothing holds it, the vial may rise. Args: seconds: real time.
    """
    declared |= {"unheld": unheld, "overflow": overflow or unheld, "error": math.inf, "within_s": within_s}
    minutes = seconds / 60.0
    return Fault(name, what, begin, end=end, minutes=minutes, family="pioreactor", moments=moments, **declared)


def process(name: str) -> tuple[Act, Act]:
    """kill -9 of one of the rig's processes, and its start."""
    full = name if name == "broker" else f"{FAULTED} {name}"
    return lambda t: t.rig.kill(full), lambda t: t.rig.start(full)


def hangs(name: str) -> tuple[Act, Act]:
    """One of the rig's processes stands still, and goes on."""
    full = name if name == "broker" else f"{FAULTED} {name}"
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
    t.rig.vials.power_cut(FAULTED)  # of the pumps, by hand


def cannot_start(t: Trial) -> None:
    """The unit's own program is broken, as by a bad update: jobs are accepted and die."""
    path = Path(t.rig.folder / FAULTED / "pio")
    path.rename(path.with_name("pio.whole"))
    path.write_text("#!/bin/sh\nexit 1\n", encoding="utf-8")
    path.chmod(0o755)


def starts_again(t: Trial) -> None:
    """Undo `cannot_start`."""
    path = Path(t.rig.folder / FAULTED / "pio")
    path.with_name("pio.whole").replace(path)


def vial(**values: float) -> Act:
    """What the photodiode of the sick unit sees."""
    return lambda t: t.rig.vials.vials[FAULTED].__dict__.update(values)


def held(t: Trial) -> None:
    """The reading stands still."""
    seen = t.rig.vials.vials[FAULTED]
    seen.held_od = seen.seen_od


def plant(part: str, switch: str, value: float) -> Act:
    """A switch of the sick unit's plant."""

    def act(t: Trial) -> None:
        getattr(getattr(t.rig.vials.vials[FAULTED].plant, part), switch)[:] = value

    return act


def reboot(t: Trial) -> None:
    t.rig.cut(FAULTED)
    t.rig.boot(FAULTED)


def swapped(t: Trial) -> None:
    """The address of the sick unit leads to the other."""
    t.words.append(f"backend.units.{FAULTED}.address={t.rig.web[WELL]}")


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
    rig(
        "client_killed", "kill -9 of this program", lambda t: t.kill(), lambda t: t.start(), ("between", "in"), 2.0,
        by=("resumed at minute",), within_s=30.0, wide=True, blind=True,
    ),
    rig(
        "dose_killed", "kill -9 of the media pump's job: a chip drives its pump on", kill_job("add_media"),
        clear_lock(MEDIA_PIN), ("in",), 4.0, by=("run after add_media", "runs after add_media"),
        unheld="the pump that ran on diluted the culture",
    ),
    rig(
        "reader_killed", "kill -9 of od_reading, mended by a reboot", kill_job("od_reading"),
        reboot, ("between", "in"), 30.0,
        by=("takes no OD readings",), within_s=30.0, blind=True,
    ),
    rig("queue_killed", "kill -9 of the task queue", *process("tasks"), ("between", "in"),
             by=("has not begun", "does not respond")),
    rig("web_killed", "kill -9 of the unit's web server", *process("web"), ("between", "in"),
             by=("no dose", "not given", "web server failed", "has not begun")),
    rig("broker_killed", "kill -9 of the MQTT broker", *process("broker"), ("between", "in"),
             by=("MQTT broker",), wide=True, blind=True),
)  # fmt: skip

OTHERS = (
    rig(
        "waste_killed", "kill -9 of the waste pump's job: its pump runs on", kill_waste, clear_lock(WASTE_PIN), ("in",),
        4.0, by=("run after remove_waste", "runs after remove_waste"), within_s=20.0,
    ),
    rig("queue_hangs", "the task queue stands still for 25 s: requests run late", *hangs("tasks"),
             by=("has not begun", "does not respond")),
    rig("web_hangs", "the web server stands still for 25 s", *hangs("web"),
             by=("no dose", "web server failed", "unknown")),
    rig("broker_hangs", "the broker stands still for 25 s", *hangs("broker"), by=("MQTT broker", "stale"),
             within_s=20.0, wide=True, blind=True),
    rig(
        "reader_hangs", "od_reading stands still: no readings, its state says ready",
        signals("od_reading", signal.SIGSTOP),
        signals("od_reading", signal.SIGCONT), seconds=60.0,
        by=("stale", "takes no OD readings", "no sample"), within_s=60.0, blind=True,
    ),
    rig(
        "dose_hangs", "the media pump's job stands still while its pump runs",
        signals("add_media", signal.SIGSTOP),
        signals("add_media", signal.SIGCONT), ("in",), 12.0, by=("run after add_media", "runs after add_media"),
        unheld="the pump that ran on diluted the culture",
    ),
    rig("reader_stopped", "somebody stops od_reading in the vendor's page",
             lambda t: t.stop_job("od_reading"), seconds=1.0,
             by=("takes no OD readings",), within_s=30.0, blind=True),
    rig("all_stopped", "somebody stops every job of the unit, in a dose", lambda t: t.post("/jobs/stop/all"),
             moments=("in",), seconds=1.0, by=("takes no OD readings", "ended early"), within_s=30.0, blind=True),
    rig(
        "foreign_dose", "somebody doses 0.5 mL by hand", lambda t: t.run_job("add_media", ml=0.5, source_of_event="UI"),
        seconds=1.0, by=("not commanded",), foreign=1,
    ),
    rig(
        "foreign_automation", "somebody starts the vendor's turbidostat",
        vendors_turbidostat(0.4),
        lambda t: t.stop_job("dosing_automation"), seconds=30.0, by=("a dosing automation",),
        within_s=20.0, foreign=30, unheld="the vendor's turbidostat dosed to 0.4",
    ),
    rig("second_client", "the program is started once more for the same units", second, seconds=1.0,
             why_not="the second one is refused; the first goes on"),
    rig("flood", "somebody's page asks four times a second", flood, seconds=1.0,
             why_not="the vendor turns away what is too often; doses are asked for again with the next sample"),
    rig("cannot_start", "jobs are accepted and die", cannot_start, starts_again,
             by=("did not carry it out", "has not begun")),
    rig("uncalibrated", "the media pump's calibration is switched off",
             lambda t: t.post("/active_calibrations/media_pump", method="DELETE"),
             lambda t: t.post("/active_calibrations/media_pump/rig-media_pump", method="PATCH"),
             by=("did not carry it out", "has not begun")),
    rig("unit_rebooted", "the unit loses its power and boots", reboot, seconds=1.0,
             by=("takes no OD readings", "web server failed", "no dose"), within_s=30.0, blind=True),
    rig("rebooted_in_a_dose", "the same in a dose", reboot, moments=("in",), seconds=1.0,
             by=("takes no OD readings", "at most the requested volume", "ended early"), within_s=40.0, blind=True),
    rig("sensor_stuck", "the reading stands still", held, vial(held_od=float("nan")), seconds=75.0,
             why_not="the vendor's noise stays on it; the interlock knows it by what doses do not do",
             unheld="doses by a reading that does not move"),
    rig("sensor_jumps", "stray light: +1 OD", vial(offset_od=1.0), vial(offset_od=0.0), seconds=40.0,
             by=("jump:", "impossible:", "no_dilution:"), unheld="doses by stray light, if it lasts"),
    rig("sensor_dark", "the photodiode's plug is out", vial(held_od=0.0), vial(held_od=float("nan")), seconds=40.0,
             by=("jump:", "impossible:", "falls:", "spectrometer:"), unheld="no dose while nothing is seen"),
    rig("media_empty", "the media bottle is empty", plant("feed", "gain_factor", 0.0),
             plant("feed", "gain_factor", 1.0), seconds=100.0, by=("no_dilution:", "cannot_hold:"), within_s=100.0,
             flow=True, unheld="nothing dilutes"),
    rig("media_weak", "the media pump gives 60 %", plant("feed", "gain_factor", 0.6), seconds=60.0,
             why_not="the policy doses by what the culture answers", flow=True),
    rig("waste_blocked", "the waste tube is blocked", plant("vessel", "waste_gain_factor", 0.0),
             plant("vessel", "waste_gain_factor", 1.0), seconds=40.0,
             why_not="nothing of the vendor's measures the level; only the volume after it is seen",
             flow=True, overflow="nothing is taken out for as long", unheld="a fuller vial is diluted less"),
    rig("renamed", "the address leads to another unit", swapped, moments=("start",),
             by=("identity",), refused=True),
    rig("automation_runs", "the vendor's turbidostat runs already", vendors_turbidostat(3.0, 8.0),
             moments=("start",), by=("dosing",), refused=True, foreign=30),
    rig("no_calibration", "no pump is calibrated",
             lambda t: t.post("/active_calibrations/media_pump", method="DELETE"), moments=("start",),
             by=("calibrat",), refused=True),
    rig("no_queue", "the task queue is dead", process("tasks")[0], moments=("start",),
             by=("task queue",), refused=True),
    rig("no_broker", "the broker is dead", process("broker")[0], moments=("start",), by=("MQTT broker",),
             refused=True),
    rig("left_lock", "a media pump's job was killed before, and left a lock on its pin", left_lock,
             moments=("start",), by=("dosing: add_media",), refused=True),
)  # fmt: skip

FAULTS: tuple[Fault, ...] = (*(replace(fault, often=True) for fault in KILLS), *OTHERS)
