"""Whoever does not hold the cultures fails: planted in matrix, soak and kill campaign, and the sums they fail by."""

import json
import math
import textwrap
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from envs.scenario import Scenario
from experiments.cli import frame
from hardware.reactor import Command, Receipt
from hardware.safety.config import SafetyConfig
from tests.campaigns.chibio_case import ChiBioCase
from tests.campaigns.chibio_faults import Act, both, set_
from tests.campaigns.fault import Fault
from tests.campaigns.fault_table import by_name
from tests.campaigns.killed_run import KillConfig, errors_in_lives, longest_out_min
from tests.campaigns.kills import kill_campaign
from tests.campaigns.outcome import Outcome, allowed, judged, table, totals
from tests.campaigns.rehearsal import Rehearsal, rehearsed
from tests.campaigns.soak import SoakConfig, soak
from tests.campaigns.tracking import Tracking, reachable, undosed

SCHEDULE = Scenario((0.6, 0.5), (20.0, 20.0), (37.0, 37.0), 0.6)
STUCK = SafetyConfig(cooldown=100_000.0)
NERVOUS = replace(STUCK, mu_max=0.001, drift=0.01, noise_od=0.0, noise_fraction=0.0)
"""Takes growth for a blocked pump, and never doses again."""


def run(fault: Fault, safety: SafetyConfig | None = None) -> Outcome:
    return ChiBioCase(fault, "dose", rehearsed(("M0", "M1"), SCHEDULE, safety, "inverse"), 3).run()


def mute(*silent: int) -> Act:
    """From now on the driver doses nothing in these reactors, and says that it did nothing."""

    def act(r: Rehearsal) -> None:
        actuate = r.reactors.actuate

        def dosing_less(command: Command) -> Receipt:
            rate = command.pump_rate.copy()
            rate[list(silent)] = 0.0
            return actuate(replace(command, pump_rate=rate))

        r.reactors.actuate = dosing_less  # type: ignore[method-assign]

    return act


# ---------------------------------------------------------------------------------------------------------- matrix


@pytest.mark.slow
def test_a_cooldown_that_never_ends_is_not_back_after_the_fault() -> None:
    sticks = by_name(("feed sticks 8 s",))[0]
    assert run(sticks).ok
    outcome = run(sticks, STUCK)
    assert "not back" in outcome.wrong
    assert outcome.reason == "falls"


ASTRAY = {"strayed", "not back", "neighbour strayed", "neighbour not back"}


@pytest.mark.slow
@pytest.mark.parametrize(
    ("rate", "fault", "moment", "wrong"),
    [
        (0.004, None, "dose", {"strayed", "neighbour strayed"}),  # without any fault
        (0.0, "a request is lost", "recovery", ASTRAY),
    ],
)
def test_a_controller_that_pumps_a_constant_rate_is_found(
    rate: float, fault: str | None, moment: str, wrong: set[str]
) -> None:
    constant = rehearsed(("M0", "M1"), SCHEDULE, controller="hold")
    constant = replace(constant, controller=replace(constant.controller, rate=rate))
    declared = by_name((fault,))[0] if fault else None
    assert wrong <= set(ChiBioCase(declared, moment, constant, 3).run().wrong)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "silent", "wrong"),
    [("worker restarted", (0, 1), ASTRAY), ("OD jumps once", (1,), {"neighbour strayed", "neighbour not back"})],
)
def test_a_driver_that_doses_no_more_is_found(name: str, silent: tuple[int, ...], wrong: set[str]) -> None:
    [fault] = by_name((name,))
    outcome = run(replace(fault, begin=both(fault.begin, mute(*silent))))
    assert ASTRAY & set(outcome.wrong) == wrong
    assert outcome.rows_lost == outcome.doses_doubled == 0


@pytest.mark.slow
def test_a_dose_where_none_is_right_is_found() -> None:
    jumps = by_name(("OD jumps once",))[0]
    stops = replace(jumps, stops="suppose that it could not be told from a dead sensor")
    assert judged(run(jumps), stops).wrong == ["dosed"]


def test_judge_compares_with_the_declaration() -> None:
    fault = Fault("x", "y", set_("bus_stuck"), ("link",), error=0.2, recovery_min=5.0)
    good = Outcome("x", "dose", reason="link", pumps_off=True, peak_error=0.19, recovery_min=5.0, watched_min=30.0)
    assert judged(good, fault).wrong == []
    assert judged(replace(good, peak_error=0.21), fault).wrong == ["strayed"]
    assert judged(replace(good, recovery_min=math.inf), fault).wrong == ["not back"]
    assert judged(replace(good, recovery_min=math.inf, watched_min=4.0), fault).wrong == []  # not due yet
    assert judged(replace(good, recovery_min=math.inf), replace(fault, unheld="so")).wrong == []
    assert judged(replace(good, peak_error=0.21), replace(fault, unheld="so")).wrong == ["strayed"]
    assert judged(replace(good, peak_error=4.0, recovery_min=math.inf), replace(fault, stops="so")).wrong == []
    assert judged(replace(good, fed_after_ml=0.5), replace(fault, stops="so")).wrong == ["dosed"]
    assert judged(replace(good, neighbour_error=0.1), fault).wrong == ["neighbour strayed"]
    assert judged(replace(good, neighbour_error=0.1), replace(fault, wide=True)).wrong == []
    assert judged(replace(good, neighbour_recovery_min=6.0), replace(fault, wide=True)).wrong == ["neighbour not back"]


def test_the_sums_of_a_matrix_that_fails_everywhere() -> None:
    bad = Outcome(
        "x", "dose", rows_lost=2, rows_doubled=3, doses_doubled=4, repeats=5, exits=6, neighbours_lost=1,
        overflowed=True, early_alarms=7, neighbour_alarms=8, neighbour_error=0.5,
        wrong=["overflow", "not detected", "pumps not off", "strayed", "not back", "dosed"],
    )  # fmt: skip
    healthy = Outcome("none", "steady", kinds={"jump": 2, "falls": 1}, peak_error=0.07, wrong=["false alarm"])
    other = Outcome("y", "dose", guarded=False, overflowed=True, rows_lost=10, wrong=["neighbour strayed"])
    expected = {
        "cases": 3, "faults": 2, "overflows": 1, "cases_without_guard": 1, "overflows_without_guard": 1,
        "rows_lost": 12, "rows_doubled": 3, "doses_doubled": 4, "doses_repeated_by_the_device": 5, "undetected": 1,
        "software_ended": 6, "neighbours_lost": 1, "pumps_not_off": 1, "strayed": 2, "not_back": 1,
        "dosed_though_stopped": 1, "worst_neighbour_error": 0.5, "false_alarms": 18, "healthy_runs": 1,
        "healthy_peak_error": 0.07, "not_as_declared": 3,
    }  # fmt: skip
    assert totals([bad, healthy, other]) == expected


def test_the_table_shows_error_and_recovery_beside_what_is_declared() -> None:
    first = Outcome("x", "dose", peak_error=0.12, recovery_min=3.0, allowed_error=0.2, allowed_recovery_min=10.0)
    second = replace(first, moment="step", peak_error=0.25, recovery_min=math.inf)
    cells = table([first, second]).splitlines()[2].split(" | ")
    assert (cells[5], cells[6]) == ("0.12 – 0.25 of 0.20", "3, 1 never of 10")
    loose = replace(first, allowed_error=math.inf, allowed_recovery_min=math.inf)
    cells = table([loose]).splitlines()[2].split(" | ")
    assert (cells[5], cells[6]) == ("0.12", "3")
    assert allowed(None) == (0.06, 0.0)
    assert allowed(by_name(("OD frozen",))[0]) == (math.inf, math.inf)
    assert allowed(by_name(("started without a reactor",))[0]) == (math.inf, math.inf)
    assert allowed(by_name(("growth stops",))[0]) == (0.2, math.inf)


# ---------------------------------------------------------------------------------------------------------- tracking


def test_the_reference_moves_as_fast_as_growth_and_full_dilution() -> None:
    start, asked = np.array([0.5, 0.8, 0.5]), np.array([0.8, 0.5, 0.51])
    after = reachable(start, asked, 10.0)
    assert after == pytest.approx([0.5 * math.exp(0.25), 0.8 * math.exp(-0.35), 0.51])
    assert undosed(10.0) == pytest.approx(0.8 * (math.exp(0.25) - 1.0) + 0.06)


def test_recovery_is_the_last_minute_outside_the_band() -> None:
    t, everyone = Tracking(np.array([0.06, 0.06])), np.array([True, True])
    asked = np.array([0.5, 0.5])
    t.counting = True
    t.restart(0.0)
    for minute, first in enumerate([0.5, 0.65, 0.6, 0.52, 0.5, 0.7, 0.52, 0.6, 0.51, 0.5]):
        t.look(float(minute), asked, np.array([first, 0.45]), everyone)
    assert t.recovery_min.tolist() == [7.0, 0.0]
    assert t.peak.tolist() == pytest.approx([0.2, 0.05])
    t.look(10.0, asked, np.array([0.57, 0.5]), everyone)
    assert t.recovery_min.tolist() == [math.inf, 0.0]
    t.look(11.0, asked, np.array([0.9, 0.9]), np.array([False, False]))  # their schedules are over
    assert t.peak.tolist() == pytest.approx([0.2, 0.05])


def test_an_overgrown_culture_is_back_once_it_falls_as_fast_as_it_can() -> None:
    one, asked = np.array([True]), np.array([0.5])
    for rate, recovered in ((0.035, 0.0), (0.0, math.inf)):  # full dilution from the fourth minute on; none at all
        t = Tracking(np.array([0.06]))
        t.restart(0.0)
        for minute in range(20):
            od = 1.5 * math.exp(0.025 * min(minute, 4) - rate * max(minute - 4, 0))
            t.look(float(minute), asked, np.array([od]), one)
        assert t.recovery_min.tolist() == [recovered]


# ---------------------------------------------------------------------------------------------------------- soak


@pytest.mark.slow
@pytest.mark.parametrize(
    ("config", "why"),
    [
        (SoakConfig(reactors=2, days=0.05, phase_min=30.0, controller_kind="hold"), "culture not held"),
        (SoakConfig(reactors=1, days=0.05, phase_min=30.0, safety=NERVOUS), "culture astray"),
    ],
)
def test_a_soak_that_does_not_hold_its_cultures_fails(tmp_path: Path, config: SoakConfig, why: str) -> None:
    with pytest.raises(frame.UserError, match=why):
        soak(config, tmp_path)
    summary = json.loads((tmp_path / "summary.json").read_text())
    assert summary["rows_lost"] == summary["rows_doubled"] == 0
    assert max(day["out_min"] for day in summary["days"]) > 10.0


# ---------------------------------------------------------------------------------------------------------- kills

MUTE = """
    import sys
    if any(word.startswith("resume=") for word in sys.argv):
        from dataclasses import replace
        from hardware.chibio.reactors import ChiBioReactors
        actuate = ChiBioReactors.actuate
        ChiBioReactors.actuate = lambda self, c: actuate(self, replace(c, pump_rate=0.0 * c.pump_rate))
"""


@pytest.mark.slow
def test_a_client_that_doses_no_more_once_it_was_resumed_fails(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "sitecustomize.py").write_text(textwrap.dedent(MUTE))
    monkeypatch.setenv("PYTHONPATH", f"{tmp_path}:{Path(__file__).parents[2]}")
    campaign = tmp_path / "campaign"
    campaign.mkdir()
    config = KillConfig(kills=1, runs=1, workers=1, speed=90.0, longest_s=1.0, reactors=("M0",))
    with pytest.raises(frame.UserError, match="or not held"):
        kill_campaign(config, campaign)
    summary = json.loads((campaign / "summary.json").read_text())
    assert summary["mean_error"] > 0.05
    assert any("not held" in line for line in summary["runs"][0]["trouble"])


def test_a_dose_that_comes_late_weighs_the_same_in_a_dense_culture() -> None:
    life = (0.0, 600.0)
    for found in (0.6, 1.4):  # two minutes of growth, then full dilution: 17 % above what was possible
        ods = [found * math.exp(0.025 * min(k, 2) - 0.035 * max(k - 2, 0)) for k in range(6)]
        errors = errors_in_lives([(60.0 * k, od, life) for k, od in enumerate(ods)])
        assert errors[2] == pytest.approx(0.5 * math.expm1(0.12), rel=1e-9)
    assert errors_in_lives([(0.0, 0.3, life), (60.0, 0.2, life)])[1] == pytest.approx(0.3 * math.exp(0.025) - 0.2)


def test_errors_are_counted_from_where_a_client_found_the_culture() -> None:
    first, second = (0.0, 100.0), (400.0, 900.0)
    seen = [(60.0, 0.5, first), (460.0, 0.6, second), (520.0, 0.6 * math.exp(-0.035), second), (580.0, 0.7, second)]
    possible = 0.6 * math.exp(-0.07)  # still above the setpoint of .5
    expected = [0.0, 0.0, 0.0, 0.5 * (0.7 / possible - 1.0)]
    assert errors_in_lives(seen) == pytest.approx(expected, abs=1e-12)
    assert longest_out_min([0.2, 0.05, 0.2, 0.3, 0.11, 0.1, 0.2]) == 3.0
