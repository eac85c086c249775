"""One dose request by request, on a line that does what it is told at times chosen here."""

import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from conf.messages import Message
from hardware.chibio import messages
from hardware.chibio.agenda import Agenda
from hardware.chibio.config import ChiBioConfig
from hardware.chibio.connection import Connection
from hardware.chibio.dose_sequence import DoseSequence
from hardware.chibio.dosing import DosePlan, PumpCalibration, ReactorCalibration, SupplyConfig
from hardware.chibio.protocol import Permitted
from hardware.chibio.resume import ReactorHistory
from hardware.clock import VirtualClock
from hardware.errors import DeviceStateError, LinkError, ProtocolError, ReactorError
from hardware.link.transport import Reply, Transport
from hardware.logbook import Logbook
from hardware.messages import DoseUnderWay, NoNewSample
from tests.hardware.script import DONE, answer, state, why

OFFS = [f"/SetOutputOn/Pump{k}/0/M0" for k in (1, 3, 4, 2)]
END = [*OFFS, "/MeasureTemp/IR/M0", "/changeDevice/M0"]
FEED_ON, WASTE_ON = "/SetOutputOn/Pump1/1/M0", "/SetOutputOn/Pump2/1/M0"
FEED_DUTY = 0.009523  # 0.6 mL at 1 mL/s in 63 s, cut to six places
FEED_S = 63.0 * FEED_DUTY
WASTE_DUTY = math.ceil((4.0 * FEED_S + 4.4) / 63.0 * 1e6) / 1e6
WASTE_S = 63.0 * WASTE_DUTY


class Line(Transport):
    """Transport and device in one: targets and pump flags as they were sent.

    Attributes: posts, (time, path); trouble, called with each path before it is carried out, may raise; lost, paths
      that are carried out and not answered; slow_s, what a read takes; shown, what a read shows otherwise.
    """

    def __init__(self, clock: VirtualClock) -> None:
        self.clock, self.posts = clock, []
        self.trouble: Callable[[str], None] = lambda path: None
        self.lost: set[str] = set()
        self.slow_s = 0.0
        self.shown: dict[str, Any] = {}
        self.flags: dict[str, Any] = {}

    def post(self, path: str) -> Reply:
        self.posts.append((round(self.clock.now(), 3), path))
        self.trouble(path)
        _, verb, item, *rest = path.split("/")
        if verb == "SetOutputTarget":
            self.flags[f"{item}__target"] = float(rest[1])
        elif verb == "SetOutputOn":
            self.flags[f"{item}__ON"] = int(rest[0])
        if path in self.lost:
            raise LinkError("no answer")
        return DONE

    def get(self, path: str) -> Reply:
        self.clock.sleep(self.slow_s)
        self.trouble(path)
        return answer(state(**{**self.flags, **self.shown}))

    def sent(self) -> list[str]:
        return [path for _, path in self.posts]


class Bench:
    """A dose sequence on a line; the clock stands at 1000 s, run time at 0."""

    def __init__(self, calibration: ReactorCalibration | None = None) -> None:
        self.clock = VirtualClock(1000.0)
        self.line, self.rows, self.agenda = Line(self.clock), [], Agenda(self.clock)
        self.known = ReactorHistory()
        self.connection = Connection("M0", Permitted(("M0",)), self.line, self.clock, self._log)
        self.book = Logbook("M0", self._log, self._log, lambda: self.clock.now() - 1000.0)
        calibration = calibration or ReactorCalibration()
        parts = self.connection, calibration, ChiBioConfig(), self.agenda, self.book, lambda: self.known
        self.doses = DoseSequence(*parts)
        start = self.connection.read().start_time
        self._log("device", {"start_time": start})
        self.line.posts.clear()

    def _log(self, kind: str, fields: Any) -> None:
        row = {"kind": kind, "time_s": self.clock.now() - 1000.0, **fields}
        self.known = self.known.after(row)
        self.rows.append({"posts": len(self.line.posts), **row})

    def begin(
        self, rate: float = 0.01, key: Any = (60.0, 2), past_s: float = 0.0, refusal: Message | None = None
    ) -> DosePlan:
        return self.doses.begin(rate, key, self.clock.now() - past_s, refusal)

    def run(self, seconds: float = math.inf) -> None:
        """Let the agenda's tasks run at their times."""
        until = self.clock.now() + seconds
        while self.agenda.next_due() <= until and self.agenda.next_due() < math.inf:
            self.clock.sleep(self.agenda.next_due() - self.clock.now())
            self.agenda.run_due()

    def of(self, kind: str) -> list[dict[str, Any]]:
        return [row for row in self.rows if row["kind"] == kind]


def test_a_dose_is_written_down_set_read_back_and_ended_twice() -> None:
    bench = Bench()
    plan = bench.begin()
    assert (plan.feed_duty, plan.waste_duty) == (FEED_DUTY, WASTE_DUTY)
    assert bench.doses.running
    assert bench.line.posts == [
        (1000.0, f"/SetOutputTarget/Pump2/M0/{WASTE_DUTY:.6f}"), (1000.0, f"/SetOutputTarget/Pump1/M0/{FEED_DUTY:.6f}"),
        (1000.0, "/changeDevice/M0"), (1000.0, WASTE_ON), (1001.0, FEED_ON),
    ]  # fmt: skip
    [intent] = bench.of("intent")
    assert (intent.pop("posts"), intent.pop("time_s")) == (0, 0.0)  # before anything was sent
    assert intent == {
        "kind": "intent", "reactor": "M0", "sample": (60.0, 2), "rate": 0.01, "feed_duty": FEED_DUTY,
        "waste_duty": WASTE_DUTY, "feed_ml": pytest.approx(FEED_S), "waste_ml": pytest.approx(WASTE_S),
        "carry_ml": 0.0, "doses": 1, "on_s": 0.0,
    }  # fmt: skip
    bench.line.posts.clear()
    bench.run()
    due = round(1000.0 + WASTE_S + 2.0, 3)  # the device needs its settling time before it is read back
    assert bench.line.posts[:2] == [(round(1001.0 + FEED_S + 2.0, 3), path) for path in ("/changeDevice/M0", OFFS[0])]
    assert [path for _, path in bench.line.posts[2:]] == ["/changeDevice/M0", *END]
    assert {t for t, _ in bench.line.posts[2:7]} == {due}
    assert not bench.doses.running
    assert bench.of("dose_end")[0].items() >= {"verified_off": True, "repeated_ml": 0.0}.items()
    assert bench.book.notes == []


@pytest.mark.parametrize(
    ("lost", "sent", "fed_ml", "told"),
    [
        (WASTE_ON, [WASTE_ON], 0.0, LinkError),
        (FEED_ON, [WASTE_ON, FEED_ON], pytest.approx(FEED_S), messages.CommandLost),
    ],
)
def test_a_pump_command_without_an_answer_is_sent_once(lost: str, sent: list[str], fed_ml: float, told: Any) -> None:
    bench = Bench()
    bench.line.lost = {lost}
    assert bench.begin().feed_ml == fed_ml
    bench.run()
    assert [path for path in bench.line.sent() if path in (FEED_ON, WASTE_ON)] == sent
    assert ["/changeDevice/M0", *END] == bench.line.sent()[-7:]  # looked at before it is switched off
    assert why(bench.book.notes[0]) is told
    assert not bench.doses.running
    [end] = bench.of("dose_end")  # it was carried out, and it was the answer that was lost
    assert end["feed_ml"] == fed_ml
    assert end["feed_low_ml"] == 0.0  # from when on it ran is not known
    assert [given.feed_ml for given in bench.doses.extra] == ([0.0] if end["feed_ml"] else [])


@pytest.mark.parametrize(
    ("sample", "past_s", "refusal", "told"),
    [
        (None, 0.0, None, NoNewSample),
        ((60.0, 2), math.inf, None, messages.UnknownAge),
        ((60.0, 2), 38.0 - WASTE_S + 0.01, None, messages.SampleTooOld),
        ((60.0, 2), 0.0, messages.BeingStarted(), messages.BeingStarted),
    ],
)
def test_what_stands_in_the_way_of_a_dose(sample: Any, past_s: float, refusal: Message | None, told: Any) -> None:
    bench = Bench()
    assert bench.begin(0.01, sample, past_s, refusal) == DosePlan()
    assert why(bench.book.notes[0]) is told
    assert bench.line.posts == []
    assert bench.of("intent") == []
    assert bench.begin(past_s=38.0 - WASTE_S).feed_ml > 0.0  # it is not remembered as acted on
    assert bench.begin(key=(120.0, 3)) == DosePlan()
    bench.run()
    assert bench.begin() == DosePlan()
    assert [why(note) for note in bench.book.notes[1:]] == [DoseUnderWay, NoNewSample]
    bench.doses.acted = None
    assert bench.begin().feed_ml > 0.0


@pytest.mark.parametrize("late_s", [-0.01, 0.01])
def test_a_read_back_that_takes_too_long_ends_the_dose_before_a_pump_is_on(late_s: float) -> None:
    bench = Bench()
    bench.line.slow_s = 38.0 - 20.0 - WASTE_S + late_s
    plan = bench.begin(past_s=20.0)
    begun = late_s < 0.0
    assert (plan.feed_ml > 0.0, bench.doses.running) == (begun, True)  # not before its pumps are verified off
    assert (FEED_ON in bench.line.sent()) == begun
    bench.line.slow_s = 0.0
    bench.run()
    assert bench.line.sent()[-6:] == END
    assert len(bench.of("dose_end")) == 1
    assert (messages.TooSlow in map(why, bench.book.notes)) != begun


@pytest.mark.parametrize(
    ("shown", "begun"),
    [
        ({}, True),
        ({"Pump1__target": FEED_DUTY + 0.9e-5}, True),
        ({"Pump1__target": FEED_DUTY + 1.1e-5}, False),
        ({"Pump2__target": WASTE_DUTY - 0.9e-5}, True),
        ({"Pump2__target": WASTE_DUTY - 1.1e-5}, False),
        ({"Pump3__ON": 1}, False),
        ({"OD__ON": 1}, False),
        ({"Experiment__ON": 0}, False),
    ],
)
def test_a_dose_begins_only_where_the_device_shows_what_was_set(shown: dict[str, Any], begun: bool) -> None:
    bench = Bench()
    bench.line.shown = shown
    assert (bench.begin().feed_ml > 0.0) == begun
    assert (WASTE_ON in bench.line.sent()) == begun
    bench.line.shown = {}
    bench.run()
    assert bench.line.sent()[-6:] == END
    assert begun or why(bench.book.notes[0]) is messages.NotAsSet


def test_a_pump_that_stays_on_is_told_and_its_experiment_ended_at_the_fourth_refusal() -> None:
    bench = Bench()
    bench.begin()
    bench.line.shown = {"Pump1__ON": 1}
    bench.run(WASTE_S + 15.0)
    assert bench.line.sent().count("/Experiment/0/M0") == 1
    before_end = bench.line.sent()[: bench.line.sent().index("/Experiment/0/M0")]
    assert before_end.count("/MeasureTemp/IR/M0") == 4
    assert "Pump1" in bench.doses.stuck
    assert bench.doses.running
    assert bench.doses.escalated
    bench.line.shown = {}
    bench.run()
    assert bench.doses.stuck == ""
    assert not bench.doses.running


def test_a_reactor_that_is_gone_is_looked_for_every_half_minute() -> None:
    bench = Bench()
    bench.begin()
    bench.line.shown = {"presentDevices": {"M0": 0}}
    bench.connection.state = None
    bench.run(100.0)
    looks = {t for t, path in bench.line.posts if path == "/changeDevice/M0" and t > 1000.0}
    assert np.diff(sorted(looks)).tolist() == pytest.approx([30.0, 30.0, 30.0])
    assert bench.doses.running
    assert bench.doses.stuck == ""


def test_what_is_kept_for_later_or_cut_off_is_told() -> None:
    small = Bench()
    assert small.begin(0.004) == DosePlan()
    assert [(type(n), n.fields) for n in small.book.notes] == [(messages.KeptForNextDose, {"ml": pytest.approx(0.24)})]
    assert small.line.posts == []
    assert small.begin(0.0, (120.0, 3)) == DosePlan()
    assert len(small.book.notes) == 1  # nothing was asked for
    assert small.begin(0.004, (180.0, 4)).feed_ml == pytest.approx(0.48, abs=1e-4)
    assert [row["doses"] for row in small.of("intent")] == [0, 0, 1]
    weak = Bench(ReactorCalibration(PumpCalibration(flow_ml_s=0.2)))
    assert weak.begin(0.02).feed_ml == pytest.approx(0.63)
    assert [note.fields for note in weak.book.notes] == [{"ml": pytest.approx(0.57)}]


@pytest.mark.parametrize("error", [LinkError("no answer"), ProtocolError("502"), DeviceStateError("gone")])
def test_the_feed_is_switched_off_every_two_seconds_until_the_device_has_heard_it(error: ReactorError) -> None:
    bench = Bench()
    bench.begin()
    off_s = bench.clock.now() + FEED_S + 2.0
    tried: list[float] = []

    def deaf(path: str) -> None:
        if off_s - 0.1 < bench.clock.now() < off_s + 3.0:
            tried.append(round(bench.clock.now() - off_s, 3))
            raise error

    bench.line.trouble = deaf
    bench.run(off_s + 4.1 - bench.clock.now())
    assert sorted(set(tried)) == [0.0, 2.0]
    assert bench.line.posts[-1] == (round(off_s + 4.0, 3), OFFS[0])
    assert (bench.book.fault is not None) == (not isinstance(error, DeviceStateError))
    bench.run()
    assert bench.line.sent()[-6:] == END


def ended(bench: Bench) -> dict[str, Any]:
    """The row of the end, with numbers of the order of milliseconds and microlitres."""
    [end] = bench.of("dose_end")
    keys = ("feed_ml", "waste_ml", "feed_times", "waste_times", "on_s")
    return {key: round(end[key], 3) for key in keys}


ELSEWHEN = {"Experiment__startTime": "2026-01-01 01:00:00"}


@pytest.mark.parametrize(
    ("deaf", "deaf_s", "shown", "until_then", "times"),
    [
        *(("/", deaf_s, {}, {}, (k, k)) for deaf_s, k in ((60.0, 0), (65.0, 1), (123.0, 1), (128.0, 2))),
        (OFFS[1], 130.0, {}, {}, (0, 2)),  # the feed pump was heard to be off
        ("-", 0.0, {}, {"Pump1__ON": 1}, (3, 2)),  # it answers off and goes on, or anew; the waste pump beside it
        ("-", 0.0, ELSEWHEN, {"Pump1__ON": 1}, (0, 0)),  # restarted in the dose
    ],
)
def test_what_the_device_repeats_until_the_end_is_heard_and_seen_is_told(
    deaf: str, deaf_s: float, shown: dict[str, Any], until_then: dict[str, Any], times: tuple[int, int]
) -> None:
    """The pumps start at run time 1; some requests are not heard for so long, or a pump is seen on for 130 s."""
    bench = Bench()
    bench.begin()

    def trouble(path: str) -> None:
        if path.startswith(deaf) and bench.clock.now() < 1000.0 + deaf_s:
            raise LinkError("no answer")

    bench.line.trouble, bench.line.shown = trouble, shown | until_then
    bench.run(60.0)
    assert (bench.book.fault is not None and bench.book.fault.kind == "link") == (deaf_s >= 60.0)
    bench.run(70.0)
    bench.line.shown = shown
    bench.run()
    end = ended(bench)
    assert (end["feed_times"], end["waste_times"]) == times
    if not shown:
        assert (end["feed_ml"], end["waste_ml"], end["on_s"]) == (round(FEED_S, 3), round(WASTE_S, 3), 1.0)
    again = [(given.at_s, given.feed_ml) for given in bench.doses.extra if given.feed_ml > 0.0]
    assert again == [(1.0 + 63.0 * k, pytest.approx(FEED_S)) for k in range(1, times[0] + 1)]
    kinds = {type(note) for note in bench.book.notes}
    assert ((messages.ChangedInDose if until_then else messages.DoseRepeated) in kinds) == (times[0] > 0)
    assert (messages.RestartedInDose in kinds) == bool(shown)


def test_a_dose_that_is_cut_short_gave_less() -> None:
    bench = Bench()
    bench.begin()
    bench.clock.sleep(0.25)
    bench.doses.settle()
    assert ended(bench) == {"feed_ml": 0.25, "waste_ml": 1.25, "feed_times": 0, "waste_times": 0, "on_s": 1.0}
    [less] = bench.doses.extra
    assert less.at_s == 1.0
    assert (less.feed_ml, less.low_ml) == pytest.approx((0.25 - FEED_S, -FEED_S), abs=1e-3)
    bench.doses.settle()
    assert len(bench.of("dose_end")) == 1


def test_after_targets_that_could_not_be_set_no_dose_begins_before_the_pumps_are_verified_off() -> None:
    bench = Bench()

    def dead(path: str) -> None:
        raise LinkError("no answer")

    bench.line.trouble = dead
    assert bench.begin() == DosePlan()
    bench.run(5.0)
    assert bench.begin(key=(120.0, 3)) == DosePlan()
    assert why(bench.book.notes[-1]) is DoseUnderWay
    bench.line.trouble = lambda path: None
    bench.run()
    assert (ended(bench)["feed_ml"], ended(bench)["waste_ml"]) == (0.0, 0.0)
    assert bench.begin(key=(120.0, 3)).feed_ml > 0.0


@pytest.fixture
def supplied() -> Bench:
    """With a supply pump of another flow."""
    bench = Bench()
    bench.doses._config = replace(ChiBioConfig(), supply=SupplyConfig(pump3_ml_s=0.7))
    bench.connection._permitted = Permitted(("M0",), supply_pumps=("Pump3",))
    return bench


def test_what_the_feed_put_off_is_not_given_by_a_supply_pump(supplied):
    assert supplied.begin(0.2 / 60.0).feed_ml == 0.0
    supplied.clock.sleep(60.0)
    plan = supplied.doses.begin(0.5 / 60.0, (120.0, 3), supplied.clock.now(), None, "Pump3")
    assert plan.feed_ml == pytest.approx(0.5, abs=1e-3)
    assert supplied.doses.carry_ml == pytest.approx(0.2)


def test_of_two_commands_that_were_given_up_each_is_looked_for(supplied):
    def lose(path: str) -> None:
        if path.startswith("/SetOutputOn") and "/1/" in path and "Pump2" not in path:
            raise LinkError("no answer")

    supplied.line.trouble = lose
    supplied.begin(0.5 / 60.0)
    supplied.run(60.0)
    supplied.clock.sleep(60.0)
    supplied.doses.begin(0.5 / 60.0, (120.0, 3), supplied.clock.now(), None, "Pump3")
    supplied.run(60.0)
    assert [pump in supplied.doses._given_up for pump in ("Pump1", "Pump3", "Pump4")] == [True, True, False]
