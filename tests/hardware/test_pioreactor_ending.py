"""How a dose ends that does not end by itself: every state that the one routine can leave, and the way back from it.

Judged by the simulated pump: what flowed lies within what is on record, nothing is given twice, and the unit is dosed
again within a stated time after what was wrong is over.
"""

import itertools
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import pytest

from tests.hardware.pioreactor_lab import FLOW, MEDIA_PIN, PINS, WASTE_PIN, Lab, World

MEDIA_S, SLACK_ML = 1.4 / FLOW["add_media"], 0.1
BACK_S = 100.0  # after what was wrong is over, until a dose is possible again
UNIT_HAS = pytest.mark.parametrize("version", ["25.11.19", "26.7.2"])
STIRRED = pytest.mark.parametrize("stirring", [True, False], ids=["stirred", "unstirred"])


@dataclass(frozen=True)
class Wrong:
    """What goes wrong in a dose of 1.4 mL; over after `lasts_s` by itself, or by a hand that does `mend`.

    told: a word of the fault that is seen meanwhile, "" where none must be. spilled_ml: what may flow beyond the dose
    in the time that it lasts and is noticed in.
    """

    act: Callable[[Lab], None]
    lasts_s: float = 0.0
    mend: Callable[[Lab], None] | None = None
    told: str = ""


def killed(after_s: float, mute: bool = False, unkept: bool = False) -> Callable[[Lab], None]:
    def act(lab: Lab) -> None:
        lab.world.kill_after_s, lab.world.mute, lab.world.unkept = after_s, mute, unkept

    return act


def frozen(after_s: float, for_s: float) -> Callable[[Lab], None]:
    def act(lab: Lab) -> None:
        lab.world.freeze_after_s, lab.world.frozen_s = after_s, for_s

    return act


def in_the_dose(what: Callable[[Lab], None], after_s: float = 0.6) -> Callable[[Lab], None]:
    def act(lab: Lab) -> None:
        lab.until(lambda: bool(lab.world.since), 5.0)
        lab.wait(after_s)
        what(lab)

    return act


def unlock(lab: Lab) -> None:
    lab.world.locks.clear()


def power(lab: Lab) -> None:
    lab.world.power()


def killed_and_dead(what: str) -> Callable[[Lab], None]:
    """Its job is killed, and then the queue or the web server of its unit."""

    def act(lab: Lab) -> None:
        killed(0.2)(lab)
        in_the_dose(lambda lab: setattr(lab.world, what, False))(lab)

    return act


def revived(lab: Lab) -> None:
    unlock(lab)
    lab.world.revive()


def web_up(lab: Lab) -> None:
    unlock(lab)
    lab.world.web = True


WRONG = {
    "killed": Wrong(killed(0.2), 40.0, unlock, "pwm_locks 13"),
    "killed at once": Wrong(killed(0.0), 40.0, unlock, "pwm_locks 13"),
    "killed before it told its pin": Wrong(killed(0.01, mute=True), 70.0, unlock, "pwm_locks 13"),
    "killed before its unit knew": Wrong(killed(0.01, unkept=True), 70.0, unlock, "pwm_locks 13"),
    "killed before its unit knew, and rebooted": Wrong(
        killed(0.01, unkept=True), 70.0, lambda lab: (lab.world.cut(), power(lab))[0], "pwm_locks 13"
    ),
    "killed, and rebooted": Wrong(killed(0.2), 40.0, lambda lab: (lab.world.cut(), power(lab))[0], "pwm_locks 13"),
    "killed, queue dead": Wrong(killed_and_dead("queue"), 60.0, revived, "pwm_locks 13"),
    "killed, web server dead": Wrong(killed_and_dead("web"), 60.0, web_up, "pwm_locks 13"),
    **{f"frozen {s:g} s": Wrong(frozen(0.01, s), s, told="pin 13" if s > 8.0 else "") for s in (0.01, 1.0, 7.0, 14.0)},
    **{f"frozen {s:g} s in it": Wrong(frozen(0.6, s), s, told="pin 13") for s in (20.0, 60.0)},
    "broker lost": Wrong(in_the_dose(lambda lab: lab.world.lose_broker(3.0)), 3.0),
    "broker lost for an hour": Wrong(in_the_dose(lambda lab: lab.world.lose_broker(3600.0)), 3600.0, told="no MQTT"),
    "broker frozen": Wrong(in_the_dose(lambda lab: lab.world.freeze_broker(25.0)), 25.0, told="no MQTT"),
    "broker frozen before it": Wrong(lambda lab: lab.world.freeze_broker(25.0), 25.0, told="no MQTT"),
    "power cut of 90 s": Wrong(in_the_dose(lambda lab: lab.world.cut()), 90.0, power, "pin 13"),
    "power cut of a night": Wrong(in_the_dose(lambda lab: lab.world.cut()), 9 * 3600.0, power, "pin 13"),
    "stopped by somebody": Wrong(lambda lab: setattr(lab.world, "stop_after_s", 0.8)),
    "pumps off in between": Wrong(in_the_dose(lambda lab: lab.reactors.pumps_off(np.array([True])))),
    "a pump without a job": Wrong(lambda lab: lab.world.pin("add_media", True)),
    "its words were lost": Wrong(lambda lab: setattr(lab.world, "mute", True)),
}


def settle(lab: Lab) -> None:
    """What went wrong once does not go wrong again."""
    w = lab.world
    w.kill_after_s = w.freeze_after_s = w.stop_after_s = np.inf
    w.mute = False


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
    seen = [str(lab.fault)]
    for _ in range(int(min(wrong.lasts_s, 120.0) * 2)):
        lab.wait(0.5)
        seen.append(str(lab.fault))
    lab.world.sleep(max(wrong.lasts_s - 120.0, 0.0))
    assert wrong.told in " ".join(seen)
    if wrong.mend:
        wrong.mend(lab)
    lab.until(lambda: lab.fault is None and not lab.station.doses.running, BACK_S)
    settle(lab)
    assert not lab.world.since, "every pump is off"
    low, high = lab.given()
    assert np.isfinite([row["feed_ml"] for row in lab.rows if row["kind"] in ("dose_end", "given")]).all()
    assert np.isfinite([pin.ran_s for pin in lab.world.box.pins.values()]).all(), "the next dose is counted from it"
    assert low - SLACK_ML <= lab.world.truth["add_media"] <= high + SLACK_ML
    if name.startswith(("power cut", "broker")):
        assert high <= 1.5, "a job ends with its power or its broker, or in its time"
    extra = [receipt for _, receipt in lab.reactors.repeated()]
    level = 20.0
    for feed, waste in [(planned, 2.0 * planned), *((r.volume_ml[0], r.waste_ml[0]) for r in extra)]:
        level = max(level + feed - waste, 20.0) if waste else level + feed
    assert level <= 20.0 + 1.5, "by the interlock's ledger the vial is no higher than by a dose"
    assert planned + sum(r.volume_ml[0] for r in extra) == pytest.approx(high, abs=SLACK_ML)
    assert len(lab.asked("add_media")) == int(planned > 0.0), "never asked for again"
    shorts = [row["feed_ml"] for row in lab.of("given") if "to end with its pin off" in row["why"]]
    assert sum(shorts) <= 3.01 * 0.1 * FLOW["add_media"]
    beside = 4.1 + 4.0 * ("unit knew" in name)  # nobody says that it ended until a short run or a reboot is told
    assert lab.world.truth["remove_waste"] <= 2.0 * lab.world.truth["add_media"] + beside, "no waste without a dose"
    if lab.world.truth["add_media"] > 1.4 + 4.0 * FLOW["add_media"]:
        least = min(lab.world.truth["add_media"], 20.0)  # what came beyond ran over its rim
        assert lab.world.truth["remove_waste"] >= least - SLACK_ML, "back at its tube"
    before, fed = lab.world.truth["add_media"], len(lab.asked("add_media"))
    lab.sample(60)
    assert lab.dose(0.5) == 0.5
    lab.wait(10.0)
    assert lab.world.truth["add_media"] - before == pytest.approx(0.5, abs=0.02)
    assert len(lab.asked("add_media")) == fed + 1


def test_while_a_media_pump_cannot_be_stopped_the_vial_is_drained_up_to_a_bound(monkeypatch):
    lab = Lab(monkeypatch, bottle_ml=30.0)
    lab.begin()
    lab.sample()
    lab.world.kill_after_s = 0.2
    lab.dose(1.4)
    worst = 0.0
    for _ in range(900):
        lab.wait(0.1)
        level = lab.world.truth["add_media"] + sum(
            (lab.world.now() - since) * FLOW["add_media"] for pin, since in lab.world.since.items() if pin == MEDIA_PIN
        )
        if level < 28.0:
            worst = max(worst, level - lab.world.truth["remove_waste"])
    assert worst < 8.0
    assert 54.0 < sum(o["ml"] for o in lab.asked("remove_waste")) <= 2.0 * 30.0 + 4.0
    assert "pull the pump's plug" in str(lab.fault)


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
    lab.until(lambda: lab.fault is None and not lab.station.doses.running, BACK_S)
    low, high = lab.given()
    assert low - SLACK_ML <= lab.world.truth["add_media"] <= high + SLACK_ML


def test_short_runs_of_a_pump_do_not_pile_up_in_a_queue_that_is_dead(monkeypatch):
    lab = Lab(monkeypatch)
    lab.begin()
    lab.sample()
    lab.world.kill_after_s = 0.2
    lab.dose(0.5)
    lab.wait(2.0)
    lab.world.queue = False
    lab.world.locks.clear()
    lab.wait(300.0)
    assert len([o for _, o in lab.world.asked if "duration" in o]) <= 1
    lab.world.revive()
    lab.until(lambda: lab.fault is None, BACK_S)
    low, high = lab.given()
    assert low - SLACK_ML <= lab.world.truth["add_media"] <= high + SLACK_ML


def test_a_killed_waste_pump_is_ended_and_the_dose_goes_on_record(monkeypatch):
    lab = Lab(monkeypatch)
    lab.begin()
    lab.sample()
    lab.dose(1.4)
    lab.until(lambda: WASTE_PIN in lab.world.since, 10.0)
    lab.world.killed("remove_waste")
    lab.wait(20.0)
    assert "pwm_locks 12" in str(lab.fault)
    lab.world.locks.clear()
    lab.until(lambda: lab.fault is None and not lab.station.doses.running, BACK_S)
    (end,) = lab.of("dose_end")
    assert end["feed_ml"] == pytest.approx(1.4)
    assert end["waste_high_ml"] >= lab.world.truth["remove_waste"] - SLACK_ML


def test_a_killed_job_of_an_earlier_run_is_proven_off_before_the_first_dose(monkeypatch):
    lab = Lab(monkeypatch)
    lab.world.retained["pioreactor/pio01/turbidostat/remove_waste/$state"] = "lost"
    lab.reactors.mqtt.__init__(lab.reactors.config, lab.reactors.mqtt.boxes, "", lab.world)
    lab.begin()
    lab.sample()
    assert lab.dose(0.5) in (0.0, 0.5)
    lab.until(lambda: lab.fault is None and not lab.station.doses.running, BACK_S)


@pytest.mark.parametrize("seed", range(16))
def test_faults_at_random_moments_leave_a_ledger_that_holds(monkeypatch, seed):
    """One after the other in one run, at moments and for times that nobody chose."""
    rng = np.random.default_rng(seed)
    lab = Lab(monkeypatch, World(str(rng.choice(["25.11.19", "26.7.2"]))), period_s=60.0)
    lab.begin()
    booked = 0.0
    for k in itertools.count():
        if k == 12:
            break
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
        lab.until(lambda: lab.fault is None and not lab.station.doses.running, BACK_S)
        settle(lab)
        low, high = lab.given()
        assert low - SLACK_ML * (k + 1) <= lab.world.truth["add_media"] <= high + SLACK_ML * (k + 1), kind
    booked += sum(float(r.volume_ml[0]) for _, r in lab.reactors.repeated())
    assert booked == pytest.approx(lab.given()[1], abs=0.1 * 12)
