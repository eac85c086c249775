"""How a dose ends that does not end by itself: every state that the one routine can leave, and the way back from it.

Judged by the simulated pump: what flowed lies within what is on record, nothing is given twice, and the unit is dosed
again within a stated time after what was wrong is over.
"""

import itertools
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
import pytest

from conf.messages import Message
from hardware.pioreactor import messages
from hardware.pioreactor.config import vial_ml
from hardware.pioreactor.pumps import Seen, is_off
from hardware.pioreactor.versions import TESTED
from tests.hardware.pioreactor_lab import BEGIN_S, FLOW, MEDIA_PIN, PINS, WASTE_PIN, Lab, World, sampled
from tests.hardware.script import noted

SLACK_ML = 0.1
BACK_S = 100.0  # after what was wrong is over, until a dose is possible again
UNIT_HAS = pytest.mark.parametrize("version", TESTED)
STIRRED = pytest.mark.parametrize("stirring", [True, False], ids=["stirred", "unstirred"])


@dataclass(frozen=True)
class Wrong:
    """What goes wrong in a dose of 1.4 mL; over after `lasts_s` by itself, or by a hand that does `mend`.

    told: one of these is the fault that is seen meanwhile or the dose's end, none where none must be. gives: mL that
    are on record and in the vial, None where they are bounds. back_s: after it is over, until a dose is possible again.
    """

    act: Callable[[Lab], None]
    lasts_s: float = 0.0
    mend: Callable[[Lab], None] | None = None
    told: tuple[type[Message], ...] = ()
    gives: float | None = None
    back_s: float = BACK_S


def world(**values: object) -> Callable[[Lab], None]:
    """Switches of the unit."""
    return lambda lab: vars(lab.world).update(values)


def killed(after_s: float, **values: object) -> Callable[[Lab], None]:
    return world(kill_after_s=after_s, **values)


def frozen(after_s: float, for_s: float, **values: object) -> Callable[[Lab], None]:
    return world(freeze_after_s=after_s, frozen_s=for_s, **values)


def in_the_dose(what: Callable[[Lab], None], after_s: float = 0.6, pin: int = MEDIA_PIN) -> Callable[[Lab], None]:
    def act(lab: Lab) -> None:
        lab.until(lambda: pin in lab.world.since, 10.0)
        lab.wait(after_s)
        what(lab)

    return act


def both(*acts: Callable[[Lab], None]) -> Callable[[Lab], None]:
    def act(lab: Lab) -> None:
        for one in acts:
            one(lab)

    return act


def unlock(lab: Lab) -> None:
    lab.world.locks.clear()


def cut(lab: Lab) -> None:
    lab.world.cut()


def cut_as_a_drain_begins(lab: Lab) -> None:
    """The unit has heard of a portion of waste, and its pump has not begun."""
    asked = len(lab.asked("remove_waste"))
    lab.until(lambda: len(lab.asked("remove_waste")) > asked, 60.0)
    lab.world.cut()


def power(lab: Lab) -> None:
    lab.world.power()


def revive(lab: Lab) -> None:
    lab.world.revive()


def forget(lab: Lab) -> None:
    """The unit boots, and what waited in its queue lay in memory."""
    lab.world.waiting.clear()
    lab.world.revive()


def theirs(lab: Lab) -> None:
    """Somebody else's request for the pump that runs, which is refused."""
    lab.world.later(0.3, lambda: lab.world.take("theirs", "add_media", {"ml": 0.5, "source-of-event": "UI"}))


UNKEPT = killed(0.01, unkept=True)
PLUG = (messages.RunsOn, messages.MayRunOn)
GONE, UNDONE = (messages.NoBroker,), (messages.NotCarriedOut,)
PIN = (*PLUG, messages.BeingVerified)
WASTE = {"strikes": "remove_waste"}
WRONG = {
    "killed": Wrong(killed(0.2), 40.0, unlock, PLUG),
    "killed at once": Wrong(killed(0.0), 40.0, unlock, PLUG),
    "killed before it told its pin": Wrong(killed(0.01, mute=True), 70.0, unlock, PLUG),
    "killed before its unit knew": Wrong(UNKEPT, 70.0, unlock, PLUG),
    "killed before its unit knew, and rebooted": Wrong(UNKEPT, 70.0, both(cut, power), PLUG),
    "killed before its unit knew, not drained, and rebooted": Wrong(
        both(UNKEPT, lambda lab: lab.world.locks.add(WASTE_PIN)), 70.0, both(cut, power), PLUG
    ),
    "killed, and rebooted as a drain begins": Wrong(killed(0.2), 30.0, both(cut_as_a_drain_begins, power), PLUG),
    "killed, and rebooted": Wrong(killed(0.2), 40.0, both(cut, power), PLUG),
    "killed, queue dead": Wrong(both(killed(0.2), in_the_dose(world(queue=False))), 60.0, both(unlock, revive), PLUG),
    "killed, web server dead": Wrong(
        both(killed(0.2), in_the_dose(world(web=False))), 60.0, both(unlock, world(web=True)), PLUG
    ),
    **{f"frozen {s:g} s": Wrong(frozen(0.01, s), s, told=PIN if s > 8.0 else ()) for s in (0.01, 1.0, 7.0, 14.0)},
    **{f"frozen {s:g} s in it": Wrong(frozen(0.6, s), s, told=PIN) for s in (20.0, 60.0)},
    "frozen 60 s before its unit knew": Wrong(frozen(0.01, 60.0, unkept=True), 60.0, told=PIN),
    "frozen before its unit knew, and somebody's request refused": Wrong(
        both(frozen(0.01, 60.0, unkept=True), theirs), 60.0, told=PIN
    ),
    "broker lost": Wrong(in_the_dose(lambda lab: lab.world.lose_broker(3.0)), 3.0),
    "broker lost for an hour": Wrong(in_the_dose(lambda lab: lab.world.lose_broker(3600.0)), 3600.0, told=GONE),
    "broker frozen": Wrong(in_the_dose(lambda lab: lab.world.freeze_broker(25.0)), 25.0, told=GONE),
    "broker frozen before it": Wrong(lambda lab: lab.world.freeze_broker(25.0), 25.0, told=GONE),
    "power cut of 90 s": Wrong(in_the_dose(cut), 90.0, power, PIN),
    "power cut of a night": Wrong(in_the_dose(cut), 9 * 3600.0, power, PIN),
    "stopped by somebody": Wrong(world(stop_after_s=0.803), told=(messages.ToldLess,)),
    "pumps off in between": Wrong(in_the_dose(lambda lab: lab.reactors.pumps_off(np.array([True])))),
    "a pump without a job": Wrong(lambda lab: lab.world.pin("add_media", True)),
    "its words were lost": Wrong(world(mute=True)),
    # in its waste
    "waste killed": Wrong(killed(0.4, **WASTE), 20.0, unlock, PLUG, 1.4),
    "waste frozen 3 s": Wrong(frozen(0.4, 3.0, **WASTE), 3.0, gives=1.4),
    "waste stopped by somebody": Wrong(world(stop_after_s=0.803, **WASTE), gives=1.4),
    "waste, broker lost": Wrong(in_the_dose(lambda lab: lab.world.lose_broker(3.0), 0.2, WASTE_PIN), 3.0, gives=1.4),
    "waste, broker lost for an hour": Wrong(
        in_the_dose(lambda lab: lab.world.lose_broker(3600.0), 0.2, WASTE_PIN),
        3600.0,
        told=GONE,
        gives=1.4,
    ),
    "waste, power cut of 90 s": Wrong(in_the_dose(cut, 0.2, WASTE_PIN), 90.0, power, PIN, 1.4),
    # odd answers of the vendor's software
    "a lock left behind": Wrong(lambda lab: lab.world.locks.add(MEDIA_PIN), 25.0, unlock, UNDONE, 0.0),
    "accepted, and died at once": Wrong(world(dies=True), 20.0, told=UNDONE, gives=0.0),
    "a dead queue that runs it late": Wrong(world(queue=False), 60.0, revive, (messages.FateUnknown,), 1.4),
    "a dead queue that is forgotten": Wrong(world(queue=False), 20.0, forget, (messages.FateUnknown,), 0.0, 200.0),
    "begins late": Wrong(world(begin_s=25.0), 25.0, told=(messages.FateUnknown,), gives=1.4),
    "heard, its answer lost": Wrong(world(heard="lost answer"), gives=1.4),
    "not heard, its answer lost": Wrong(world(heard="nobody"), 20.0, told=(messages.FateUnknown,), gives=0.0),
    "too many requests": Wrong(world(heard="429"), gives=0.0, back_s=1.0),
    "an error of the server": Wrong(world(heard="500"), 20.0, told=(messages.FateUnknown,), gives=0.0),
    "web server dead": Wrong(world(web=False), 1.0, world(web=True), gives=0.0, back_s=1.0),
    "ends 1 s late": Wrong(world(late_s=1.0), gives=1.4 + FLOW["add_media"]),
    "somebody's request refused in it": Wrong(in_the_dose(theirs), gives=1.4),
}


PIN, SHORT, WORD = ("on", "off", ""), ("", "asked", "ended"), ("", "ready", "disconnected", "lost")


def units() -> Iterator[tuple[Seen, bool]]:
    """What may be seen of every unit that there can be, and whether its pump runs.

    Its job has ended, stands still or was killed. The chip was told of its pin before anybody else. A short run that
    finds a lock says "disconnected", too, of the same job; a broker takes jobs that live for lost.
    """
    for pin, short, word in itertools.product(PIN, SHORT, WORD):
        yield Seen(True, pin, short, word), False
    words = {"over": {"", "disconnected", "lost"}, "stands": {"", "ready", "lost"}, "killed": {"", "lost"}}
    for (job, said), short in itertools.product(words.items(), SHORT):
        runs = job != "over" and short != "ended"
        for pin, word in itertools.product(PIN if runs else ("off", ""), said | ({"disconnected"} if short else set())):
            yield Seen(False, pin, short, word), runs


def test_no_state_proves_a_pump_off_that_may_run_and_every_other_leads_to_one_that_does() -> None:
    running, resting = ({seen for seen, runs in units() if runs is it} for it in (True, False))
    for seen in map(Seen._make, itertools.product((False, True), PIN, SHORT, WORD)):
        assert not (is_off(seen) and seen in running), seen
    for seen in resting - running:
        assert is_off(seen._replace(short="ended", pin="off")), seen
        assert is_off(seen._replace(boot=True)), seen
    assert is_off(Seen(False, "off", "", "disconnected")), "a dose that ended by itself needs no short run"


def settle(lab: Lab) -> None:
    """What went wrong once does not go wrong again."""
    never = dict.fromkeys(("kill_after_s", "freeze_after_s", "stop_after_s"), np.inf)
    world(**never, mute=False, dies=False, heard="yes", begin_s=BEGIN_S, late_s=0.0)(lab)


@UNIT_HAS
@STIRRED
@pytest.mark.parametrize("name", WRONG)
def test_every_way_back(monkeypatch, name, version, stirring):
    wrong, lab = WRONG[name], Lab(monkeypatch, World(version), stirring=stirring)
    lab.world.stirs = stirring
    lab.begin()
    lab.sample()
    planned = lab.dose(1.4) if name != "a pump without a job" else 0.0
    wrong.act(lab)
    lab.wait(5.0)
    seen = [lab.fault]
    for _ in range(int(min(wrong.lasts_s, 120.0) * 2)):
        lab.wait(0.5)
        seen.append(lab.fault)
    lab.world.sleep(max(wrong.lasts_s - 120.0, 0.0))
    if wrong.mend:
        wrong.mend(lab)
    lab.until(lambda: lab.fault is None and not lab.station.doses.running, wrong.back_s)
    assert not wrong.told or any(isinstance(fault, wrong.told) for fault in seen) or noted(lab.rows, *wrong.told)
    settle(lab)
    assert not lab.world.since, "every pump is off"
    low, high = lab.given()
    assert np.isfinite([row["feed_ml"] for row in lab.rows if row["kind"] in ("dose_end", "given")]).all()
    assert np.isfinite([pin.ran_s for pin in lab.world.box.pins.values()]).all(), "the next dose is counted from it"
    assert low - SLACK_ML <= lab.world.truth["add_media"] <= high + SLACK_ML
    if wrong.gives is not None:
        assert (high, lab.world.truth["add_media"]) == pytest.approx((wrong.gives, wrong.gives), abs=0.02)
    wasted = lab.world.truth["remove_waste"]
    assert sum(row["waste_ml"] for row in lab.of("dose_end")) <= wasted + SLACK_ML, "the least that was taken out"
    if "waste" in name:
        assert lab.of("dose_end")[-1]["waste_high_ml"] >= wasted - SLACK_ML, "the most"
    if name.startswith(("power cut", "broker")):
        assert high <= 1.5, "a job ends with its power or its broker, or in its time"
    ledger = lab.ledger(planned)
    level = float(ledger.volume_ml[0])
    assert level <= 20.0 + 1.5, "by the interlock's ledger the vial is no higher than by a dose"
    assert float(ledger.fed_ml[0]) == pytest.approx(high, abs=SLACK_ML)
    assert len(lab.asked("add_media")) <= int(planned > 0.0), "never asked for again"
    shorts = [row["feed_ml"] for row in lab.of("given") if "short run" in row["why"]]
    assert sum(shorts) <= 3.01 * 0.1 * FLOW["add_media"]
    beside = 7.0 + 4.0 * ("unit knew" in name)  # nobody says that it ended until a short run or a reboot is told
    if name != "waste killed":
        assert wasted <= 2.0 * lab.world.truth["add_media"] + beside, "no waste without a dose"
    if lab.world.truth["add_media"] > 1.4 + 4.0 * FLOW["add_media"]:
        least = min(lab.world.truth["add_media"], 20.0)  # what came beyond ran over its rim
        assert wasted >= least - SLACK_ML, "back at its tube"
    before, fed = lab.world.truth["add_media"], len(lab.asked("add_media"))
    lab.sample(60)
    assert lab.dose(0.5) == 0.5
    lab.wait(10.0)
    assert lab.world.truth["add_media"] - before == pytest.approx(0.5, abs=0.02)
    assert len(lab.asked("add_media")) == fed + 1


@pytest.mark.parametrize(("waste_ml_s", "bottle_ml", "least"), [(1.6, 30.0, 54.0), (FLOW["add_media"], 120.0, 100.0)])
def test_while_a_media_pump_runs_on_the_vial_is_drained_up_to_a_bound(monkeypatch, waste_ml_s, bottle_ml, least):
    monkeypatch.setitem(FLOW, "remove_waste", waste_ml_s)
    lab = sampled(monkeypatch, bottle_ml=bottle_ml)
    lab.world.kill_after_s = 0.2
    lab.dose(1.4)
    began = lab.world.since[MEDIA_PIN] if lab.until(lambda: MEDIA_PIN in lab.world.since, 5.0) >= 0.0 else 0.0
    while (lab.world.now() - began) * FLOW["add_media"] < bottle_ml - 2.0:
        lab.wait(0.1)
        flows = {MEDIA_PIN: FLOW["add_media"], WASTE_PIN: -waste_ml_s}
        rise_ml = sum(flows[pin] for pin in lab.world.since) * (lab.world.now() - lab.world._level_s)
        assert lab.world.level_ml + rise_ml < 28.0
    lab.wait(60.0)
    assert least < sum(o["ml"] for o in lab.asked("remove_waste")) <= 2.0 * bottle_ml + 4.0
    assert (type(lab.fault), lab.fault.fields["pin"]) == (messages.RunsOn, MEDIA_PIN)


@pytest.mark.parametrize("waste_ml_s", [1.6, FLOW["add_media"]])
@pytest.mark.parametrize("volume_ml", [14.0, 20.0])
def test_a_pump_that_runs_on_is_booked_as_it_flows_and_spills_no_more_than_a_dose(monkeypatch, waste_ml_s, volume_ml):
    """Up to 60 mL, also where the waste pump is no stronger than the media pump."""
    monkeypatch.setitem(FLOW, "remove_waste", waste_ml_s)
    lab = sampled(monkeypatch, volume_ml=volume_ml)
    lab.world.kill_after_s = 0.2
    ledger = lab.ledger(lab.dose(0.9))
    rates = {MEDIA_PIN: FLOW["add_media"], WASTE_PIN: -waste_ml_s}
    rise = spilled = fed = 0.0
    while fed < 60.0:
        for pin in lab.world.since:
            rise, fed = rise + 0.1 * rates[pin], fed + 0.1 * max(rates[pin], 0.0)
        room_ml = vial_ml(volume_ml) - volume_ml
        rise, spilled = min(max(rise, 0.0), room_ml), spilled + max(rise - room_ml, 0.0)
        lab.wait(0.1)
        lab.book(ledger)
        assert float(ledger.fed_ml[0]) >= fed - 2.0 * SLACK_ML
        assert float(ledger.volume_ml[0]) >= volume_ml + rise - 0.9 - 2.0 * SLACK_ML, "its waste was booked with it"
        assert spilled <= lab.station.unit.config.max_dose_ml
    lab.world.locks.clear()
    lab.well()
    lab.book(ledger)
    assert float(ledger.fed_ml[0]) == pytest.approx(lab.given()[1], abs=SLACK_ML)
    assert float(ledger.fed_ml[0]) == pytest.approx(lab.world.truth["add_media"], abs=1.0)
    assert float(ledger.volume_ml[0]) == pytest.approx(volume_ml, abs=SLACK_ML)


def test_a_media_pump_that_stands_on_past_its_dose_is_drained_at_once(monkeypatch):
    """Its process is frozen: the vial rises by the dose and by what flows until the waste pump has begun."""
    lab = sampled(monkeypatch)
    lab.world.freeze_after_s, lab.world.frozen_s = 0.6, 15.0
    lab.dose(1.4)
    lab.until(lambda: WASTE_PIN in lab.world.since, 10.0)
    assert lab.world.level_ml < 20.0 + 1.4 + 1.5 * FLOW["add_media"]
    lab.well()
    lab.check_given(SLACK_ML)


def test_a_pump_that_told_what_it_is_about_to_give_and_no_end_is_drained_beside(monkeypatch):
    """Its process stands still before it says its pin, and nobody else says pins."""
    lab = Lab(monkeypatch, stirring=False)
    lab.world.stirs = False
    lab.begin()
    lab.sample()
    lab.world.freeze_after_s, lab.world.frozen_s = 0.005, 20.0
    lab.dose(1.4)
    lab.wait(18.0)
    level = (lab.world.now() - lab.world.since[MEDIA_PIN]) * FLOW["add_media"] - lab.world.truth["remove_waste"]
    assert level < 6.0
    lab.well()
    lab.check_given(SLACK_ML)


@pytest.mark.parametrize("broken", ["lose_broker", "freeze_broker"])
def test_nobody_is_told_to_pull_a_plug_where_only_the_broker_was_gone(monkeypatch, broken):
    """A job ends with its broker."""
    lab = sampled(monkeypatch)
    lab.dose(1.4)
    in_the_dose(lambda lab: getattr(lab.world, broken)(20.0))(lab)
    seen = set()
    while lab.station.doses.running or lab.fault:
        seen |= {type(lab.fault)}
        told = lab.reactors.pumps_off(np.array([True])) if lab.world.broker else ()
        assert not [line for line in told if "plug" in line]
        lab.wait(0.1)
    assert messages.NoBroker in seen
    assert not seen & set(PLUG)


def test_short_runs_of_a_pump_do_not_pile_up_in_a_queue_that_is_dead(monkeypatch):
    lab = sampled(monkeypatch)
    lab.world.kill_after_s = 0.2
    lab.dose(0.5)
    lab.wait(2.0)
    lab.world.queue = False
    lab.world.locks.clear()
    lab.wait(300.0)
    assert len([o for _, o in lab.world.asked if "duration" in o]) <= 1
    lab.world.revive()
    lab.until(lambda: lab.fault is None, BACK_S)
    lab.check_given(SLACK_ML)


def test_a_killed_job_of_an_earlier_run_is_proven_off_before_the_first_dose(monkeypatch):
    lab = Lab(monkeypatch)
    lab.world.retained["pioreactor/pio01/turbidostat/remove_waste/$state"] = "lost"
    lab.reactors.mqtt.__init__(lab.reactors.config, lab.reactors.mqtt.boxes, "", lab.world)
    lab.begin()
    lab.sample()
    assert lab.dose(0.5) in (0.0, 0.5)
    lab.well()


@pytest.mark.parametrize("seed", range(16))
def test_faults_at_random_moments_leave_a_ledger_that_holds(monkeypatch, seed):
    """One after the other in one run, at moments and for times that nobody chose."""
    rng = np.random.default_rng(seed)
    lab = Lab(monkeypatch, World(str(rng.choice(TESTED))), period_s=60.0)
    lab.begin()
    booked = 0.0
    for k in range(12):
        lab.sample(80)
        booked += lab.dose(float(rng.uniform(0.1, 1.5)))
        kind = rng.choice(["none", "kill", "freeze", "broker", "cut", "stop", "stands"])
        after, lasts = float(rng.uniform(0.0, 1.5)), float(10.0 ** rng.uniform(-2.0, 1.8))
        if kind == "kill":
            lab.world.kill_after_s = after
        elif kind == "freeze":
            lab.world.freeze_after_s, lab.world.frozen_s = after, lasts
        elif kind == "stop":
            lab.world.stop_after_s = after
        lab.wait(after + 0.3)
        if kind == "broker":
            lab.world.lose_broker(lasts)
        elif kind == "stands":
            lab.world.freeze_broker(lasts)
        elif kind == "cut":
            lab.world.cut()
        lab.wait(lasts + 1.0)
        if kind == "cut":
            lab.world.power()
        lab.world.locks -= {pin for job, pin in PINS.items() if job not in lab.world.run_now}
        lab.well()
        settle(lab)
        low, high = lab.given()
        assert low - SLACK_ML * (k + 1) <= lab.world.truth["add_media"] <= high + SLACK_ML * (k + 1), kind
    booked += sum(float(r.volume_ml[0]) for _, r in lab.reactors.repeated())
    assert booked == pytest.approx(lab.given()[1], abs=0.1 * 12)
