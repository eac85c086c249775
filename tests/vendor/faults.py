"""What befalls a run, and what must come of it. Every time is in device seconds, ten in a real second.

The criteria were written before the first result. Told: a line on the screen within TOLD_S of the fault. Back: at the
end every reactor is dosed again, warm, without an alarm, at the setpoint or on its way there. Volume: booked against
true within VOLUME_SHARE and VOLUME_ML, or between the least and the most where nobody saw it. Held: every reactor that
nothing befell stays within BAND of the setpoint. No falls, no_dilution or cannot_hold: no vial, tube or bottle is
touched here.
"""

from __future__ import annotations

import json
import re
import signal
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from tests.hardware.test_serial_transport import Cable
from tests.vendor import judge
from tests.vendor.bench import BENCHES, SPEED, START_OD, Agent, Client, weigh
from tests.vendor.link import Link, Rule

TOLD_S = 100.0
VOLUME_SHARE, VOLUME_ML = 0.05, 0.1
BAND = 0.06
SETPOINT, LOW = 0.5, 0.35
LARGE_ML = 1.0  # a dose that a step down asks for
WARM = 35.0  # degC; the device's own law holds these vials between 35.8 and 36.5
STEADY_ROWS = 9  # of every reactor, before a fault
ALL = ("M0", "M1", "M2")
EIGHT = tuple(f"M{k}" for k in range(8))


class Case:
    """A bench, a cable, perhaps a board agent, and clients one after the other on the same run folder."""

    def __init__(self, kind: str, folder: Path, fault: Fault, unit: int = 0) -> None:
        reactors, agent = fault.reactors, fault.agent
        self.kind, self.folder, self.reactors = kind, folder, tuple(reactors)
        self.calibration = weigh(kind, folder.parent, self.reactors, unit)
        folder.mkdir(parents=True)
        self.bench = BENCHES[kind](folder / "device", self.reactors, unit, START_OD if fault.runs else 0.0)
        self.serial = Cable(folder) if agent == "serial" else None
        self.agent = Agent(self.bench, folder, str(self.serial.board) if self.serial else "") if agent else None
        near = self.agent.url if self.agent and not self.serial else self.bench.url
        self.link = Link(near, SPEED)
        self.cable = self.serial or self.link
        self.run = folder / "run"
        self.clients: list[Client] = []
        self.fault_s: float | None = None
        self.failures: list[str] = []
        self.facts: dict[str, Any] = {}
        self.setpoints, self.phases = [SETPOINT], [1000.0]

    @property
    def client(self) -> Client:
        return self.clients[-1]

    @property
    def lines(self) -> list[tuple[float, str]]:
        return [line for client in self.clients for line in client.lines]

    def command(self, name: str, *more: str, run: Path | None = None) -> Client:
        """A command of the project on this device, through the cable."""
        way = [f"backend.url={self.link.url}"]
        if self.serial:
            way = ["backend/transport=serial", f"backend.transport.port={self.serial.pc}"]
        elif self.agent:
            way.append(f"backend.transport.token_file={self.agent.token}")
        way += [f"backend.speed={SPEED:g}", f"backend.reactors=[{','.join(self.reactors)}]"]
        arguments = [f"experiments.{name}", *way, f"backend.calibration={self.calibration}", *more]
        return self.start(*arguments, f"hydra.run.dir={run or self.run}")

    def start(self, *arguments: str) -> Client:
        self.clients.append(Client(self.bench, self.folder / "console.txt", *arguments))
        return self.client

    def deploy(self, run: Path | None = None) -> Client:
        schedule = ["scenario=hold", f"scenario.setpoints={self.setpoints}", f"scenario.minutes={self.phases}"]
        schedule.append(f"scenario.temperatures={[37] * len(self.phases)}")
        return self.command("deploy", "backend=chibio", *schedule, run=run)

    def resume(self) -> Client:
        return self.start("experiments.deploy", f"resume={self.run}")

    def sleep(self, seconds: float) -> None:
        self.bench.sleep(seconds)

    def minutes(self, minutes: float) -> None:
        """Let a run go on; ends early if the client does."""
        end = self.bench.now() + 60 * minutes
        while self.bench.now() < end and self.client.running():
            self.sleep(5.0)

    def rows(self, m: str) -> int:
        path = self.run / "recordings" / f"{m}.csv"
        return max(len(path.read_text().splitlines()) - 1, 0) if path.exists() else 0

    def until_rows(self, more: int, patience: float) -> bool:
        """Wait for so many further rows of every reactor; whether they came."""
        wanted = {m: self.rows(m) + more for m in self.reactors}
        end = self.bench.now() + patience
        while any(self.rows(m) < n for m, n in wanted.items()):
            if self.bench.now() > end or not self.client.running():
                return False
            self.sleep(3.0)
        return True

    def steady(self) -> None:
        """A healthy run, in its ninth minute."""
        self.deploy()
        if not self.until_rows(STEADY_ROWS, 60 * (STEADY_ROWS + 8)):
            raise RuntimeError(f"no healthy run to begin with: {[line for _, line in self.lines][-3:]}")

    def befall(self) -> None:
        """The fault begins now."""
        self.fault_s = self.bench.now()

    def befall_in_measuring(self) -> None:
        """The fault of a healthy run begins in the middle of a measurement of M0."""
        self.steady()
        self.bench.until_measuring("M0")
        self.befall()

    def without_cable(self, mode: str, minutes: float, unseen: Callable[[Case], object] | None = None) -> None:
        """The fault begins now, and is over after so long. Args: unseen: what happens a minute before."""
        self.befall()
        self.cable.set(mode)
        self.minutes(minutes)
        if unseen:
            unseen(self)
            self.minutes(1.0)
        self.cable.set("pass")

    def until_dose(self, m: str, pump: str = "Pump1") -> None:
        """Wait until this motor has begun to turn."""
        self.bench.until(lambda: pump not in self.bench.motors(m))
        self.bench.until(lambda: pump in self.bench.motors(m), patience=900.0, step=0.02)

    def until_quiet(self) -> None:
        """Wait until no motor has turned for 6 s and the last dose is on record."""
        since = self.bench.now()
        end = since + 240.0
        while self.bench.now() - since < 6.0 and self.bench.now() < end:
            if any(self.bench.motors(m) for m in self.reactors):
                since = self.bench.now()
            self.sleep(0.3)

    def upon(self, pattern: str, act: Callable[[], None], ahead: bool = False, nth: int = 1) -> None:
        """Do something at the n-th coming request that matches: when it comes (ahead), or with its answer."""
        left = [nth]

        def count() -> None:
            left[0] -= 1
            if left[0] == 0:
                act()

        self.link.rules.append(Rule(pattern, times=nth, ahead=count if ahead else None, then=None if ahead else count))

    def fail(self, reason: str) -> None:
        self.failures.append(reason)

    def end(self, number: int = signal.SIGINT) -> None:
        """Ctrl-C, and what it says."""
        if self.clients and self.client.running():
            self.client.signal(number)
            status = self.client.wait(600.0)
            if status != 0:
                self.fail(f"exit status {status} after a signal")

    def close(self) -> None:
        if self.clients and self.client.running():
            self.client.process.kill()
            self.client.wait(60.0)
        self.link.close()
        if self.agent:
            self.agent.close()
        if self.serial:
            self.serial.close()
        self.bench.close()

    def kill_software(self) -> None:
        """The port of a dead software is closed."""
        self.bench.kill()
        if not self.agent:
            self.link.set("refuse")

    def restart_software(self) -> None:
        self.bench.restart()
        if not self.agent:
            self.link.set("pass")


@dataclass(frozen=True)
class Fault:
    """act: what befalls the run. told: words that must be said, None if nothing need be.

    befallen: reactors whose OD is not judged. after: minutes from its end to the end of the run. volume: false for
    eight reactors, which at ten times keep one another waiting on the bus: motors turn longer than weighed. between:
    reactors whose volume need only lie between the least and the most that are booked.
    """

    name: str
    item: int
    act: Callable[[Case], None]
    told: str | None = ""
    befallen: tuple[str, ...] = ALL
    after: float = 12.0
    reactors: tuple[str, ...] = ALL
    agent: str = ""
    ise: bool = False
    volume: bool = True
    between: tuple[str, ...] = ()
    runs: bool = True  # a run with a culture; False: clear medium and no recording


def pulled(mode: str, minutes: float, in_dose: bool = True) -> Callable[[Case], None]:
    """The cable of the whole device, from the moment the motor of M1 turns."""

    def act(case: Case) -> None:
        case.steady()
        if in_dose:
            case.until_dose("M1")
        else:
            case.until_quiet()
        case.without_cable(mode, minutes)

    return act


def pulled_in_step(
    mode: str, minutes: float, unanswered: bool = False, unseen: Callable[[Case], object] | None = None
) -> Callable[[Case], None]:
    """The cable, in a large dose: the second after a step down.

    unanswered: before the client knows that it runs. unseen: what ends the dose a minute before the cable is back.
    """

    def act(case: Case) -> None:
        case.setpoints, case.phases = [SETPOINT, LOW], [STEADY_ROWS + 1.0, 1000.0]
        case.steady()
        while [run.ml for run in case.bench.runs("M1") if run.pump == "Pump1"][-1] < LARGE_ML:
            case.until_dose("M1")
            case.sleep(5.0)
        if unanswered:
            case.upon(FEED_ON, lambda: case.link.set(mode))
        case.until_dose("M1")
        case.without_cable(mode, minutes, unseen)

    return act


def kept_answers(case: Case) -> None:
    """A proxy gives the first state that it sees from a feed command on again and again."""
    case.steady()
    case.upon(FEED_ON, lambda: case.link.rules.append(Rule("GET /getSysdata/", keeps=True)))
    case.until_dose("M1")
    case.befall()
    case.sleep(90.0)
    case.link.rules.clear()


def ruled(minutes: float, *rules: Rule) -> Callable[[Case], None]:
    """Requests that match are slow or swallowed for so long."""

    def act(case: Case) -> None:
        case.steady()
        case.until_quiet()
        case.link.rules += [Rule(rule.pattern, rule.before, rule.after, rule.times, rule.swallow) for rule in rules]
        case.befall()
        case.minutes(minutes)
        case.link.rules.clear()

    return act


def changed(minutes: float = 0.0, **changes: float) -> Callable[[Case], None]:
    """Something of M0's electronics is broken, for so many minutes or once."""

    def act(case: Case) -> None:
        case.steady()
        case.until_quiet()
        case.befall()
        case.bench.change("M0", **changes)
        case.minutes(minutes)
        for key in changes if minutes else ():
            case.bench.change("M0", **{key: 0})

    return act


def in_measuring(case: Case, what: str) -> None:
    """Somebody stops the experiment of M0 while it measures, or its thread dies there; nobody runs."""
    case.bench.post("/Experiment/1/M0")
    if what == "stopped":
        case.bench.until_measuring("M0")
        case.bench.post("/Experiment/0/M0")
    else:
        case.bench.change("M0", internal_zero=1)
        case.sleep(15.0)
    case.sleep(20.0)


def then_deploy(what: str) -> Callable[[Case], None]:
    def act(case: Case) -> None:
        in_measuring(case, what)
        begins(case, case.deploy())
        case.until_rows(1, 360.0)

    return act


def begins(case: Case, client: Client) -> None:
    """The fault of a start is counted from the client's first word: loading Python is no device time."""
    case.bench.until(lambda: bool(client.lines) or not client.running(), patience=600.0)
    case.befall()


def then_blank(what: str) -> Callable[[Case], None]:
    def act(case: Case) -> None:
        in_measuring(case, what)
        begins(case, case.command("blank", f"backend.calibration={case.folder / 'blanks'}", run=case.folder / "blank"))
        status = case.client.wait(60 * 25.0)
        blanks = sorted(path.name for path in (case.folder / "blanks").glob("*_blank.yaml"))
        case.facts["blank"] = f"exit {status}, {len(blanks)} blanks"
        if status != 0 or len(blanks) != len(case.reactors):
            case.fail(f"blank: exit status {status}, {len(blanks)} of {len(case.reactors)} blanks")

    return act


def somebody_starts(case: Case) -> None:
    """As a person does it, who looks first: a start of what runs would stop it."""
    if not case.bench.state("M0")["Experiment"]["ON"]:
        case.bench.post("/Experiment/1/M0")


def then_resume(case: Case) -> None:
    case.steady()
    case.bench.until_measuring("M0")
    case.bench.post("/Experiment/0/M0")
    case.client.process.kill()
    case.client.wait(60.0)
    begins(case, case.resume())
    case.minutes(6.0)
    somebody_starts(case)


def stopped_by_somebody(case: Case) -> None:
    case.befall_in_measuring()
    case.bench.post("/Experiment/0/M0")
    case.minutes(6.0)
    somebody_starts(case)


def worker_killed(case: Case) -> None:
    case.befall_in_measuring()
    case.bench.kill_worker()


def software_killed(case: Case) -> None:
    case.befall_in_measuring()
    case.kill_software()
    case.minutes(3.0)
    case.restart_software()


def thread_dies(restarts_ignored: int = 0) -> Callable[[Case], None]:
    """M0's thread dies at once, in the measurement; so many starts are then answered and not carried out."""

    def act(case: Case) -> None:
        case.steady()
        case.link.rules.append(Rule(r"POST /Experiment/1/M0", times=restarts_ignored, swallow=True))
        case.bench.until_measuring("M0")
        case.befall()
        case.bench.change("M0", internal_zero=1)
        case.minutes(4.0 + 3.0 * restarts_ignored)

    return act


# -- signals and kills: chains of moments on one device --------------------------------------------------------------

SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
FEED_ON, FEED_OFF = r"POST /SetOutputOn/Pump1/1/M1", r"POST /SetOutputOn/Pump1/0/M1"
WASTE_ON, WASTE_OFF = r"POST /SetOutputOn/Pump2/1/M1", r"POST /SetOutputOn/Pump2/0/M1"
TARGET = r"POST /SetOutputTarget/Pump1/M1"
AT_START: dict[str, tuple[str, bool, int]] = {  # request, before it reaches the device, which of them
    "at the first request": (r".", True, 1),
    "as an experiment is started": (r"POST /Experiment/1/M1", False, 1),
}
IN_A_RUN: dict[str, tuple[str, bool, int]] = {
    "feed target set": (TARGET, False, 1),
    "waste on, feed not yet": (WASTE_ON, False, 1),
    "feed-on on its way": (FEED_ON, True, 1),
    "feed running": (FEED_ON, False, 1),
    "feed-off on its way": (FEED_OFF, True, 1),
    "waste-off on its way": (WASTE_OFF, True, 1),
}


def strike(case: Case, what: tuple[str, bool, int], number: int, patience: float = 900.0) -> bool:
    """Send the signal at a request; whether it came to that."""
    pattern, ahead, nth = what
    struck: list[float] = []

    def act() -> None:
        struck.append(case.bench.now())  # first: a killed client ends the wait
        case.client.signal(number)

    case.upon(pattern, act, ahead, nth)
    end = case.bench.now() + patience
    while not struck and case.bench.now() < end and case.client.running():
        case.sleep(0.5)
    case.link.rules.clear()
    return bool(struck)


def ended_well(case: Case, moment: str, since: int) -> None:
    """After a signal: it ends, no motor turns for two periods, or the screen says that it could not be verified."""
    status = case.client.wait(1200.0)
    said = [line for _, line in case.lines[since:]]
    after = case.bench.now() + 2.0
    case.sleep(140.0)
    on = [
        f"{m} {run.pump} at {run.start_s - after:+.0f} s"
        for m in case.reactors
        for run in case.bench.runs(m)
        if run.start_s + run.seconds > after
    ]
    words = [line for line in said if re.search("verified|not verified|could not|switch the pump", line, re.IGNORECASE)]
    newest = (words or said or ["nothing said"])[-1]
    case.facts[moment] = f"exit {status}; {newest[-110:]}; motors after: {on or 'none'}"
    warned = any(re.search("not verified|could not|cannot|by hand", line, re.IGNORECASE) for line in said)
    if on and not warned:
        case.fail(f"{moment}: {len(on)} runs of motors after the end, and no word of it: {said[-1:]}")
    if not on and not words and not moment.startswith("loading"):
        case.fail(f"{moment}: ends without a word on the pumps: {said[-1:]}")
    if any("Traceback" in line for line in said):
        case.fail(f"{moment}: traceback")


def killed_in_dose(case: Case) -> None:
    """kill -9 while the feed motor of M1 turns; the device repeats the dose."""
    strike(case, (FEED_ON, False, 1), signal.SIGKILL)
    case.client.wait(60.0)


def signals(case: Case) -> None:
    """13 moments, three signals by turns."""
    kinds = iter(SIGNALS * 5)
    for k, name in enumerate(("loading", *AT_START)):
        number, since = next(kinds), len(case.lines)
        case.deploy(run=case.folder / f"start{k}")
        if name == "loading":
            time.sleep(0.4)
            case.client.signal(number)
        elif not strike(case, AT_START[name], number):
            case.fail(f"{name}: it never came to that")
        ended_well(case, f"{name}, start, {number.name}", since)
    case.steady()
    case.until_quiet()
    number, since = next(kinds), len(case.lines)
    case.client.signal(number)
    ended_well(case, f"between doses, {number.name}", since)
    for name, what in IN_A_RUN.items():
        case.resume()
        case.until_rows(2, 600.0)
        number, since = next(kinds), len(case.lines)
        if not strike(case, what, number):
            case.fail(f"{name}: it never came to that")
        ended_well(case, f"{name}, {number.name}", since)
    for name in ("loading", "at the first request", "at request 6"):
        case.resume()
        case.until_rows(1, 600.0)
        killed_in_dose(case)
        since = len(case.lines)
        case.resume()
        if name == "loading":
            time.sleep(0.4)
            case.client.signal(signal.SIGINT)
        elif not strike(case, (".", True, 6 if "6" in name else 1), signal.SIGINT):
            case.fail(f"{name}: it never came to that")
        ended_well(case, f"{name} of a resume after a kill in a dose, SIGINT", since)
    case.resume()
    case.befall()


def kills(case: Case) -> None:
    """9 moments, each resumed after two and a half minutes; volumes compared each time."""
    case.deploy(run=case.folder / "start0")
    if not strike(case, AT_START["at the first request"], signal.SIGKILL):
        case.fail("start: it never came to that")
    case.client.wait(60.0)
    case.steady()
    for name, what in [("between doses", None), *IN_A_RUN.items(), ("as it is resumed", (".", True, 4))]:
        if name == "as it is resumed":
            killed_in_dose(case)
            case.sleep(100.0)
            case.resume()
        if what is None:
            case.until_quiet()
            case.client.process.kill()
        elif not strike(case, what, signal.SIGKILL):  # type: ignore[arg-type]
            case.fail(f"{name}: it never came to that")
        case.client.wait(60.0)
        case.sleep(150.0)
        case.resume()
        if not case.until_rows(3, 900.0):
            case.fail(f"{name}: no rows after resume: {[line for _, line in case.lines][-1:]}")
        case.until_quiet()
        case.sleep(5.0)
        compare_volumes(case, f"killed {name}")
    case.befall()


def compare_volumes(case: Case, when: str) -> None:
    """Booked against true so far; a fact, and a failure beyond the allowance."""
    record = judge.Record(case.run)
    for m, vial in case.bench.truth().items():
        true, booked = vial["feed"], record.booked(m)
        case.facts.setdefault(when, "")
        case.facts[when] += f"{m} {booked:.2f}/{true:.2f} "
        if abs(booked - true) > VOLUME_SHARE * true + VOLUME_ML:
            case.fail(f"{when}: {m} booked {booked:.2f} mL, true {true:.2f}")


def nothing(case: Case) -> None:
    case.steady()
    case.befall()


def hand_dosed(case: Case) -> None:
    """For the judge: a dose that no program of ours gave."""
    case.steady()
    case.until_quiet()
    case.befall()
    case.bench.dose("M1", "Pump1", 0.05)


LATE = r"POST /SetOutputOn/Pump1/1/"
ABOUT_M0 = r"/M0(/|$)"
LINK, REACTOR = "link|answer|slow|cable|agent", "M0"
NEIGHBOURS = ("M0",)
WIPED_UNSEEN = pulled_in_step("hole", 4.0, unseen=lambda case: case.bench.kill_worker())
OFF_UNSEEN = pulled_in_step("hole", 4.0, unseen=lambda case: case.bench.post("/SetOutputOn/Pump1/0/M1"))
FAULTS = [
    Fault("nothing", 0, nothing, None, (), 20.0),
    # 1: Measuring that is left 1, threads that die there
    Fault("stopped in measuring, then deploy", 1, then_deploy("stopped"), None, ()),
    Fault("thread dead in measuring, then deploy", 1, then_deploy("dead"), None, ()),
    Fault("stopped in measuring, then blank", 1, then_blank("stopped"), None, runs=False),
    Fault("thread dead in measuring, then blank", 1, then_blank("dead"), None, runs=False),
    Fault("stopped in measuring, then resume", 1, then_resume, REACTOR, NEIGHBOURS),
    Fault("stopped in measuring, in a run", 1, stopped_by_somebody, REACTOR, NEIGHBOURS),
    Fault("thread dead in measuring, in a run", 1, thread_dies(), REACTOR, NEIGHBOURS, 10.0),
    Fault("worker killed in measuring", 1, worker_killed),
    Fault("software dead for 3 min, killed in measuring", 1, software_killed),
    Fault("thread dead, restart ignored twice", 1, thread_dies(2), REACTOR, NEIGHBOURS, 14.0),
    Fault("thread dead, restart ignored six times", 1, thread_dies(6), REACTOR, NEIGHBOURS, 14.0),
    Fault("requests about M0 take 15 s", 1, ruled(10.0, Rule(ABOUT_M0, before=15.0)), REACTOR, NEIGHBOURS),
    Fault("requests about M0 are not answered", 1, ruled(10.0, Rule(ABOUT_M0, before=900.0)), REACTOR, NEIGHBOURS),
    # 2: the cable is pulled in a dose, the client lives, the board agent switches off
    Fault("cable out 3 min in a dose, agent", 2, pulled("hole", 3.0), LINK, agent="http"),
    Fault("cable out 21 min in a dose, agent", 2, pulled("hole", 21.0), LINK, after=30.0, agent="http"),
    Fault("cable out 5 min in a dose, serial agent", 2, pulled("hole", 5.0), LINK, after=15.0, agent="serial"),
    # 3: a slow link
    Fault("feed-on heard 2.65 s late", 3, ruled(12.0, Rule(LATE, before=2.65)), LINK, after=16.0),
    Fault("feed-on heard 4.5 s late", 3, ruled(12.0, Rule(LATE, before=4.5)), LINK, after=16.0),
    Fault("feed-on answered 4.5 s late", 3, ruled(12.0, Rule(LATE, after=4.5)), LINK, after=16.0),
    Fault("feed-on heard 26.5 s late", 3, ruled(12.0, Rule(LATE, before=26.5)), LINK, after=16.0),
    Fault("feed-on heard 45 s late", 3, ruled(12.0, Rule(LATE, before=45.0)), LINK, after=20.0),
    Fault("every request takes 3 s", 3, ruled(12.0, Rule(".", before=3.0)), LINK, after=16.0),
    # 4: the cable is pulled in a dose, nobody switches off
    Fault("cable out 6 min in a dose", 4, pulled("hole", 6.0), LINK, after=16.0),
    Fault("cable out 12 min in a dose", 4, pulled("hole", 12.0), LINK, after=25.0),
    Fault("cable out 12 min in a large dose", 4, pulled_in_step("hole", 12.0), LINK, after=20.0),
    Fault("cable out 4 min in a large dose, agent", 2, pulled_in_step("hole", 4.0), LINK, after=16.0, agent="http"),
    Fault("cable out 12 min, large dose unanswered", 4, pulled_in_step("hole", 12.0, True), LINK, after=20.0),
    Fault("accepts, never answers 12 min, from a large dose on", 4, pulled_in_step("mute", 12.0), LINK, after=20.0),
    Fault("refused 25 min in a large dose", 4, pulled_in_step("refuse", 25.0), LINK, after=25.0),
    Fault("connections refused 6 min in a dose", 4, pulled("refuse", 6.0), LINK, after=16.0),
    Fault("connections reset 6 min in a dose", 4, pulled("reset", 6.0), LINK, after=16.0),
    Fault("cable out 5 min in a large dose, restarted", 4, WIPED_UNSEEN, LINK, after=20.0, between=ALL),
    Fault("cable out 5 min in a large dose, off by hand", 4, OFF_UNSEEN, LINK, after=20.0, between=("M1",)),
    Fault("a proxy repeats an old answer for 90 s", 3, kept_answers, "pump", after=16.0, reactors=("M1",), between=ALL),
    # 5: readings that are refused
    Fault("one of four readings fails", 5, changed(glitch=2), REACTOR, (), ise=True),
    Fault("spectrometer dead 4 min", 5, changed(4.0, as7341=1), REACTOR, NEIGHBOURS, ise=True),
    # 6: accepts and never answers
    Fault("accepts, never answers, 8 min", 6, pulled("mute", 8.0, in_dose=False), LINK, after=18.0),
    Fault("accepts, never answers, 8 min, from a dose on", 6, pulled("mute", 8.0), LINK, after=18.0),
    Fault("accepts, never answers, 8 reactors", 6, pulled("mute", 8.0, False), LINK, EIGHT, 18.0, EIGHT, volume=False),
    Fault("the same, from a dose on", 6, pulled("mute", 8.0), LINK, EIGHT, 18.0, EIGHT, volume=False),
    Fault("answers a byte at a time, 8 min", 6, pulled("dribble", 8.0, in_dose=False), LINK, after=18.0),
    # 7: signals and kills
    Fault("13 signals", 7, signals, None),
    Fault("9 kills", 7, kills, None),
]
PLANTED = [  # the judge must find these: the bench is altered, not the program
    Fault("planted: feed tube blocked", -1, changed(12.0, feed=0.0), None),
    Fault("planted: a dose by hand", -1, hand_dosed, None),
    Fault("planted: growth of M0 trebled", -1, changed(12.0, mu=0.09), None, ()),
]


def judged(case: Case, fault: Fault) -> dict[str, Any]:
    """What came of it: figures, and in `failures` every criterion that does not hold."""
    bench, failures = case.bench, case.failures
    record = judge.Record(case.run)
    begin = case.fault_s or 0.0
    found: dict[str, Any] = {"name": fault.name, "item": fault.item, "bench": case.kind, "facts": case.facts}
    words = fault.told or ""
    first = judge.told(case.lines, begin, words)
    found["told_s"], found["words"] = (round(first[0], 1), first[1][9:]) if first else (None, "")
    found["on_page"] = judge.on_page(first[1]) if first else None
    found["all_words"] = [f"{at - begin:+.0f} {line[9:]}" for at, line in judge.alarms(case.lines, begin)][:40]
    if fault.told is not None and (first is None or first[0] > TOLD_S):
        failures.append(f"told after {first[0]:.0f} s" if first else "not told")
    if first and not found["on_page"]:
        failures.append("its words are not in 3 a.m.")
    if not fault.runs:
        return found | {"failures": failures}
    reactors: dict[str, Any] = {}
    for m in case.reactors:
        runs, true, booked = bench.runs(m), case.facts["feed"][m], record.booked(m)
        lost, doubled = record.lost_and_doubled(m)
        off = judge.worst(bench, m, SETPOINT, begin, case.facts["ended_s"])
        reactors[m] = {
            "booked": round(booked, 2), "true": round(true, 2), "motor": record.motor(m, runs), "lost": lost,
            "doubled": doubled, "worst_od": round(off, 3), "false": record.false_alarms(m), "rows": len(record.rows(m)),
        }  # fmt: skip
        summary = record.summary.get("reactors", {}).get(m, {}).get("volume_ml")
        slack = VOLUME_SHARE * true + VOLUME_ML
        low = record.least(m) if m in fault.between else booked
        reactors[m]["least"] = round(record.least(m), 2)
        if fault.volume and not low - slack <= true <= booked + slack:
            failures.append(f"{m} booked {booked:.2f} mL, true {true:.2f}")
        if summary is None or abs(summary - booked) > 0.02 + 0.001 * booked:
            failures.append(f"{m} summary says {summary} mL, the recording {booked:.2f}")
        unasked = reactors[m]["motor"]["runs"] - reactors[m]["motor"]["doses"] - reactors[m]["motor"]["repeats"]
        if unasked > 0:
            failures.append(f"{m} {unasked} runs of the feed motor that nobody asked for or booked")
        if lost or doubled:
            failures.append(f"{m} {lost} rows lost, {doubled} doubled")
        if reactors[m]["false"]:
            failures.append(f"{m} false {reactors[m]['false']}")
        if m not in fault.befallen and off > BAND:
            failures.append(f"{m} strays {off:.3f} OD, nothing befell it")
        if fault.ise:
            window = [w for w in record.summary.get("windows", []) if w["reactor"] == m]
            said = sum(w["ise"] for w in window)
            true_ise = judge.ise(bench, m, SETPOINT, case.facts["began_s"], case.facts["ended_s"])
            reactors[m]["ise"] = [round(said, 4), round(true_ise, 4)]
            if said > 2.0 * true_ise + 0.02:
                failures.append(f"{m} ISE {said:.3f}, by the truth {true_ise:.3f}")
        failures += [f"{m} {reason}" for reason in case.facts["not_back"].get(m, [])]
    if case.facts["on_at_end"]:
        failures.append(f"motors on at the end: {case.facts['on_at_end']}")
    if not any("verified off" in line for _, line in case.lines[-30:]):
        failures.append("the end says nothing of the pumps")
    return found | {"reactors": reactors, "failures": failures}


def not_back(case: Case) -> dict[str, list[str]]:
    """What every reactor still lacks, looked at before the run is ended."""
    bench, now = case.bench, case.bench.now()
    truth, found = bench.truth(), {}
    record = judge.Record(case.run)
    for m in case.reactors:
        lacks = []
        dosed = [run for run in bench.runs(m) if run.pump == "Pump1" and run.start_s > now - 300.0]
        rows = record.rows(m)
        high = truth[m]["x"] - case.setpoints[-1]
        if not dosed and high > -0.02:
            lacks.append("is not dosed")
        if abs(high) > BAND and not (high > 0 and sum(run.ml for run in dosed) > 2.0) and not high < -BAND:
            lacks.append(f"is at OD {truth[m]['x']:.2f}")
        if truth[m]["T"] < WARM:
            lacks.append(f"is at {truth[m]['T']:.1f} degC")
        if not rows or rows[-1]["interlock"]:
            lacks.append(f"says {rows[-1]['interlock'][:90] if rows else 'nothing'}")
        if lacks:
            found[m] = lacks
    return found


def play(kind: str, fault: Fault, work: Path, unit: int = 0) -> dict[str, Any]:
    """Run one fault from its begin to the verdict; writes outcome.json."""
    folder = work / re.sub(r"[^a-z0-9]+", "_", fault.name.lower())
    case = Case(kind, folder, fault, unit)
    try:
        fault.act(case)
        if fault.runs:
            case.minutes(fault.after)
            case.facts["not_back"] = not_back(case)
            if not case.client.running():
                case.fail(f"the run ended by itself: {[line for _, line in case.lines][-1:]}")
            case.facts["began_s"] = case.clients[0].began_s
            case.end()
            case.facts["ended_s"] = case.bench.now()
            case.sleep(3.0)
            case.facts["on_at_end"] = {m: sorted(on) for m in case.reactors if (on := case.bench.motors(m))}
    except Exception as problem:  # the verdict on this fault, not the end of the campaign
        case.fail(f"{type(problem).__name__}: {problem}")
        case.facts = {"not_back": {}, "on_at_end": {}, "ended_s": case.bench.now(), "began_s": 0.0} | case.facts
    finally:
        runs = {m: case.bench.runs(m) for m in case.reactors}
        case.facts["feed"] = {m: vial["feed"] for m, vial in case.bench.truth().items()}
        case.close()
    case.bench.runs = runs.__getitem__  # type: ignore[method-assign]
    outcome = judged(case, fault)
    (folder / "outcome.json").write_text(json.dumps(outcome, indent=1))
    return outcome
