"""`dry_run=true`: the timetable by hand, no device asked, nothing left behind."""

import math
from datetime import datetime
from pathlib import Path

import pytest

from envs.scenario import Scenario
from experiments.cli import frame
from experiments.control.config import DeployConfig
from experiments.control.timetable import expected, timetable
from experiments.deploy import deploy, main
from tests.programs import run

NOON = datetime(2026, 3, 2, 12, 0)
GROWTH, DILUTION, VOLUME_ML = 0.03, 0.06, 20.0


def step(setpoint: float, minutes: float, od: float, until: str | None = None) -> tuple[float, float, float]:
    e = expected(Scenario((setpoint,), (minutes,), (37.0,), until=(until,)), 0, od, GROWTH, DILUTION, VOLUME_ML)
    return e.minutes, e.ml, e.od


def test_what_a_step_takes_by_hand() -> None:
    up, down = math.log(2.0) / 0.03, math.log(2.0) / (0.06 - 0.03)  # 0.4 to 0.8 and back
    assert step(0.8, 60.0, 0.4) == pytest.approx((60.0, (60.0 - up) * 0.03 * 20.0, 0.8))
    assert step(0.4, 60.0, 0.8) == pytest.approx((60.0, (down * 0.06 + (60.0 - down) * 0.03) * 20.0, 0.4))
    assert step(0.8, 600.0, 0.4, "od >= 0.8") == pytest.approx((up, 0.0, 0.8))
    assert step(0.3, 600.0, 0.8, "od <= 0.4") == pytest.approx((down, down * 0.06 * 20.0, 0.4))
    assert step(0.8, 600.0, 0.8, "settled") == pytest.approx((10.0, 10.0 * 0.03 * 20.0, 0.8))
    assert step(0.5, 60.0, 0.5, "od >= 0.8")[0] == 60.0  # held at 0.5 it never gets there
    assert step(0.5, 60.0, 0.9, "od >= 0.8")[0] == 1.0  # it is there already


def test_a_step_that_is_to_settle_takes_its_way_to_the_band_and_then_its_minutes() -> None:
    """0.5 +- 5 % begins at 0.525 from above and at 0.475 from below; another band and other minutes by the scenario."""
    assert step(0.5, 600.0, 0.8, "settled")[0] == pytest.approx(10.0 + math.log(0.8 / 0.525) / (0.06 - 0.03))
    assert step(0.5, 600.0, 0.4, "settled")[0] == pytest.approx(10.0 + math.log(0.475 / 0.4) / 0.03)
    assert step(0.5, 12.0, 0.4, "settled")[0] == 12.0  # its longest time comes first
    wide = Scenario((0.4, 0.5), (9.0, 600.0), (37.0,) * 2, until=(None, "settled"), settled_band=0.2, settled_min=25.0)
    found = expected(wide, 1, 0.8, GROWTH, DILUTION, VOLUME_ML)
    assert found.minutes == pytest.approx(25.0 + math.log(0.8 / 0.6) / (0.06 - 0.03))


def test_what_a_step_needs_that_takes_its_longest_is_reckoned_from_where_it_would_have_ended() -> None:
    """0.4 to 0.8 in 23 min needs nothing; held there for the rest of two hours it needs what grows."""
    up = math.log(2.0) / GROWTH
    grows = Scenario((0.8,), (120.0,), (37.0,), until=("od >= 0.8",))
    found = expected(grows, 0, 0.4, GROWTH, DILUTION, VOLUME_ML)
    assert (found.ml, found.longest_ml) == pytest.approx((0.0, (120.0 - up) * 0.03 * 20.0))
    assert step(0.4, 50.0, 0.35, "od <= 0.38")[0] == 1.0  # it is below already
    assert step(0.4, 50.0, 0.8, "od <= 0.3")[0] == 50.0  # held at 0.4 it never gets there


def test_a_culture_that_outgrows_the_pump_is_fed_at_full_rate_and_grows_on() -> None:
    found = expected(Scenario((0.4,), (50.0,), (37.0,)), 0, 0.8, 0.03, 0.02, 16.0)
    assert (found.minutes, found.ml, found.od) == pytest.approx((50.0, 16.0 * 0.02 * 50.0, 0.8 * math.exp(0.01 * 50.0)))


def told(*overrides: str) -> str:
    return timetable(main.config(["dry_run=true", *overrides]), "HERE", NOON)


def test_steps_clock_and_bottle_are_told() -> None:
    text = told("scenario=hold", "scenario.minutes=[1500]", "bench.bottle_ml=500", "backend.reactors=[M0,M1]")
    assert text.count("Mon 02 12:00 Tue 03 13:00    1500     1500") == 2
    assert text.count("900 mL of medium expected") == 2  # 1500 min x 0.03 1/min x 20 mL
    assert text.count("bench.bottle_ml=500 is NOT sufficient") == 2
    assert "controller dqn, policy shipped" in text
    budget = told("scenario=hold", "scenario.minutes=[100]", "bench.bottle_ml=500", "safety.ml_per_run=59")
    assert "safety.ml_per_run=59 is NOT sufficient: " in budget  # 60 mL expected
    assert "safety.ml_per_run=61 is sufficient" in told(
        "scenario=hold", "scenario.minutes=[100]", "safety.ml_per_run=61"
    )
    assert "would write to HERE" in text
    assert "bench.bottle_ml=2000 is sufficient" in told("scenario=hold")
    both = told("scenario=hold", "scenario.minutes=[90]", "scenario.outputs=['pump3 2 mL/h, pump4 1.5 mL']")
    assert "at most 3.0 mL by Pump3, at most 1.5 mL by Pump4" in both
    fed = told("scenario=hold", "scenario.minutes=[60]", "scenario.outputs=['pump3 20 mL/h, pump4 20 mL']")
    assert "40 mL of medium expected, 40 mL if" in fed  # more than growth asks for, 36 mL
    longer = told("scenario=hold", "scenario.minutes=[1500]", "scenario.until=[settled]", "bench.bottle_ml=500")
    assert "may not be sufficient" in longer


def test_each_step_begins_where_the_one_before_it_is_expected_to_end() -> None:
    """0.4 to 0.8 takes 10 ln 2 / 0.3 = 23 min; the clock counts from noon, or from the end of a recovery."""
    words = "setpoints=[0.8,0.8,0.8]", "minutes=[600,90,45]", "until=['od >= 0.8',null,null]", "recovery_od=0.4"
    text = told("scenario=grow_hold_dilute", "plant.start_od=0.3", *(f"scenario.{word}" for word in words))
    assert [line.split()[3:7:3] for line in text.splitlines() if line.split()[1:2] == ["Mon"]] == [
        ["12:00", "12:23"], ["12:23", "13:53"], ["13:53", "14:38"],
    ]  # fmt: skip
    assert "the times below assume that it takes no time" in text


def test_each_reactor_is_reckoned_by_its_own_volume_and_the_bench_s_fastest_pump() -> None:
    """From 0.8 to 0.4 at full rate, u / V - mu, then mu V to hold it; an hour at most, or until OD 0.5."""
    down = "plant.start_od=0.8", "scenario=hold", "scenario.setpoints=[0.4]", "scenario.minutes=[60]"
    down += "scenario.recovery_od=0", "bench.volume_ml=16", "bench.max_rate=0.015", "backend.reactors=[M0,M1]"
    for until, level, lasts in (("null", 0.4, 60.0), ("'od <= 0.5'", 0.5, 0.0)):
        text = told(*down, "bench.volumes_ml.M1=12", f"scenario.until=[{until}]")
        steps = [line.split() for line in text.splitlines() if line.split()[1:2] == ["Mon"]]
        for words, volume_ml in zip(steps, (16.0, 12.0), strict=True):
            full = 60.0 * 0.015 / volume_ml
            falls = math.log(0.8 / level) / (full - 0.03)
            ml = volume_ml * (falls * full + max(lasts - falls, 0.0) * 0.03)
            assert float(words[7]) == pytest.approx(max(falls, lasts), abs=0.5)
            assert float(words[11]) == pytest.approx(ml, abs=0.05)


def table(text: str) -> dict[str, list[str]]:
    """The lines of each reactor of a timetable."""
    found: dict[str, list[str]] = {}
    for line in text.splitlines():
        if " from OD " in line:
            found[line.split()[0]] = mine = []
        if found:
            mine.append(line)
    return found


def test_each_reactor_has_its_own_steps_role_and_bottle() -> None:
    """M0 is held at 0.5 for an hour; M1 goes up to 0.7 in 11 min, and down to 0.4 in 19, and outlasts the bottle."""
    words = "backend.reactors=[M0,M1]", "scenario=hold", "plant.start_od=0.5", "bench.bottle_ml=60", "at_end=stop"
    words += "scenario.minutes=[60]", "scenario.setpoints=[0.5]", "scenario.recovery_od=0", "each.M1.role=control"
    words += "each.M1.setpoints=[0.7,0.4]", "each.M1.minutes=[90,30]", "each.M1.temperatures=[30,36.5]"
    text = told(*words, "each.M1.outputs=[null,'pump4 2 mL']")
    head = "controller dqn, policy shipped (regret 0.003 %); at_end stop\nbackend sim (in this computer)"
    assert text.startswith(head)
    of = table(text)
    assert [of[name][0] for name in ("M0", "M1")] == [
        "M0 (replicate), from OD 0.5, growth 0.03 1/min", "M1 (control), from OD 0.5, growth 0.03 1/min"
    ]  # fmt: skip
    steps = {name: [line.split()[7:12] for line in lines if "Mon 02" in line] for name, lines in of.items()}
    assert steps["M0"] == [["60", "60", "0.50", "37.0", "36.0"]]
    up, down = math.log(0.7 / 0.5) / 0.03, math.log(0.7 / 0.4) / 0.03
    ml = (90.0 - up) * 0.6, down * 1.2 + (30.0 - down) * 0.6
    assert steps["M1"] == [
        ["90", "90", "0.70", "30.0", f"{ml[0]:.1f}"], ["30", "30", "0.40", "36.5", f"{ml[1]:.1f}"]
    ]  # fmt: skip
    assert "36 mL if every step takes its longest; bench.bottle_ml=60 is sufficient" in of["M0"][-1]
    total = f"{sum(ml):.0f} mL of medium expected, {sum(ml):.0f} mL if every step takes its longest"
    assert f"  {total}; bench.bottle_ml=60 is NOT sufficient" in of["M1"][-2]
    assert of["M1"][4] == "           gives pump4 2 mL: at most 2.0 mL by Pump4"
    assert not any("gives" in line for line in of["M0"])


def test_a_device_s_culture_is_taken_to_begin_at_its_first_setpoint() -> None:
    """Nobody has measured it; its recovery, where there is one, ends it at another."""
    device = "backend=chibio", "backend.url=http://10.0.0.7:5000", "controller=pi", "scenario.setpoints=[0.6,0.7,0.3]"
    text = told(*device, "scenario.recovery_od=0", "backend.reactors=[M3,M5]")
    assert "backend chibio (http://10.0.0.7:5000), reactors M3, M5\n" in text
    assert "M5 (replicate), from OD 0.6, growth" in text
    text = told(*device, "scenario.recovery_od=0.45", "scenario.recovery_limit_min=75")
    assert "from OD 0.45, growth" in text
    assert "recovery grows undiluted to OD 0.45, at most 75 min; the times below assume that it takes no time" in text


def test_who_would_hold_the_share_is_told() -> None:
    text = told("backend=emulator", "scenario=ratio_steps", "composition=dqn_preview", "controller=pi")
    assert text.splitlines()[0] == "controller pi; share: dqn_preview; at_end hold"
    shares = [line.partition("its time")[2] for line in table(text)["M1"] if " its time" in line]
    assert shares == [
        "",
        *(f"; share {share}, whose controller decides the temperature" for share in ("0.3", "0.7", "0.3")),
    ]


def test_what_the_run_would_refuse_is_refused() -> None:
    with pytest.raises(frame.UserError, match="nowhere"):
        told("policy=nowhere.npz")
    with pytest.raises(frame.UserError, match="remove dry_run"):
        timetable(DeployConfig(resume="RUN"), "HERE", NOON)


@pytest.mark.parametrize("swept", [False, True])
def test_what_has_no_timetable_is_refused_and_does_not_run(swept, tmp_path, monkeypatch):
    """A job of a sweep comes here with its folder; it doses nothing."""
    monkeypatch.setattr(frame, "swept", lambda: swept)
    config = main.config(["dry_run=true", "controller=pi", "scenario.minutes=[2,2,2]"])
    with pytest.raises(frame.UserError, match="dry_run=true: a sweep has no timetable; drop --multirun"):
        deploy(config, tmp_path)
    assert list(tmp_path.iterdir()) == []


def test_no_device_is_asked_and_no_folder_left(tmp_path: Path) -> None:
    """The address answers nobody, so a run would fail."""
    words = "experiments.deploy", "backend=chibio", "backend.url=http://127.0.0.1:9", "dry_run=true"
    done = run(*words, cwd=tmp_path)
    assert (done.returncode, done.stderr) == (0, "")
    assert "pumps not weighed, taken as 1 mL/s: M0" in done.stdout
    assert list(tmp_path.iterdir()) == []
