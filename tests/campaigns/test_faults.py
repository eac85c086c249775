"""The fault matrix on a few faults; its judge, the audit of rows, and those of soak and kills see what is planted."""

import csv
import json
import math
import textwrap
from array import array
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import cache, partial
from pathlib import Path

import numpy as np
import pytest

from envs.scenario import Scenario
from experiments.cli import frame
from hardware.chibio.overflow_pump import OverflowPumpConfig
from hardware.emulator.vial import Dose, StoredSample
from hardware.reactor import Command, Receipt
from hardware.safety.config import SafetyConfig
from tests.campaigns.audit import Served, audit_doses, audit_rows, rows_per_sample
from tests.campaigns.chibio_case import ChiBioCase
from tests.campaigns.chibio_faults import Act, both, post, run_device, set_
from tests.campaigns.fault import FAMILIES, REAL, VIRTUAL, Fault
from tests.campaigns.faults import FAULTS, FaultsConfig, all_cases, by_name, faults
from tests.campaigns.kills import KillConfig, errors_in_lives, kill_campaign, longest_out_min
from tests.campaigns.outcome import Outcome, allowed, declared, judged, table, totals
from tests.campaigns.rehearsal import Rehearsal, rehearsed
from tests.campaigns.soak import SoakConfig, soak
from tests.campaigns.tracking import Tracking, reachable, undosed

SCHEDULE = Scenario((0.6, 0.5), (20.0, 20.0), (37.0, 37.0), 0.6)


@cache
def of_table(name: str, moment: str = "steady", guarded: bool = False) -> Outcome:
    """What became of a fault of the table."""
    return run(by_name((name,))[0], moment, pump=FaultsConfig().overflow_pump if guarded else None)


def run(
    fault: Fault | None,
    moment: str = "steady",
    safety: SafetyConfig | None = None,
    pump: OverflowPumpConfig | None = None,
    controller: str = "dqn",
) -> Outcome:
    return ChiBioCase(fault, moment, rehearsed(("M0", "M1"), SCHEDULE, safety, controller, pump), 3).run()


@pytest.mark.slow
def test_a_healthy_run_says_nothing_and_holds_the_setpoints() -> None:
    outcome = run(None)
    assert outcome.ok, outcome
    assert outcome.kinds == {}
    assert outcome.outcome == "completed"
    assert outcome.peak_error < 0.06
    assert outcome.pumps_off


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "moment", "reason"),
    [
        ("spectrometer dead", "steady", "spectrometer"),
        ("link down 5 min", "dose", "link"),
        ("request hangs 45 s", "dose", "restarted"),
        ("reactor unplugged", "step", "link"),
        ("started without a reactor", "dose", "absent"),
        ("started without it in 3 s", "dose", "absent"),
        ("foreign blank", "recovery", "blank"),
        ("program killed 2 min", "dose", "end:killed"),
        ("computer loses power", "dose", "repair:Torn"),
    ],
)
def test_what_the_table_declares_happens(name: str, moment: str, reason: str) -> None:
    outcome = of_table(name, moment)
    assert outcome.ok, outcome
    assert outcome.reason == reason
    assert outcome.rows_lost == outcome.doses_doubled == 0
    assert not outcome.overflowed


@pytest.mark.slow
def test_a_fault_that_nobody_tells_of_is_found() -> None:
    mute = Fault("mute", "a weak pump that must be told", set_("pump_gain_factor", 0.6), ("no_dilution",))
    assert "not detected" in run(mute).wrong


@pytest.mark.slow
@pytest.mark.parametrize("after_s", [0.0, 2.0, 7.0, 12.0])
def test_a_device_back_without_a_reactor_before_anybody_misses_it_is_not_ended_by_the_end_of_a_dose(
    after_s: float,
) -> None:
    def begin(r: Rehearsal) -> None:
        back = both(run_device, set_("unplugged"), set_("crash"), set_("restart"))
        r.clock.at(r.clock.now() + after_s, lambda: back(r))

    outcome = run(Fault("back at once", "", begin, ("absent",), wide=True, blind=True, gone=True), "dose")
    assert outcome.exits == 1, outcome  # the one of the fault itself
    assert outcome.wrong == ["device ended"]
    assert outcome.reason == "absent"


@pytest.mark.slow
def test_a_program_that_ends_the_device_or_leaves_a_neighbour_is_found() -> None:
    careless = Fault("careless", "", both(set_("unplugged"), set_("crash"), set_("restart")), ("absent",), gone=True,
                     end=post("/MeasureTemp/IR/M0"), minutes=2.0, wide=True, blind=True)  # fmt: skip
    assert {"device ended", "neighbour lost"} <= set(run(careless).wrong)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["feed stuck open", "waste blocked"])
def test_what_overflows_on_the_standard_rig_is_declared_and_does_not_with_an_overflow_pump(name: str) -> None:
    without, guarded = of_table(name), of_table(name, guarded=True)
    assert without.ok, without
    assert (without.overflowed, without.label) == (True, f"{name}, no overflow pump")
    assert judged(replace(without), replace(by_name((name,))[0], overflow="")).wrong == ["overflow"]
    assert guarded.ok, guarded
    assert (guarded.overflowed, guarded.label) == (False, name)
    assert guarded.peak_ml < 27.0


@pytest.mark.slow
def test_an_overflow_beside_an_overflow_pump_is_never_as_declared() -> None:
    too_weak = OverflowPumpConfig("Pump3", 0.95, 0.9)
    assert run(by_name(("feed stuck open",))[0], pump=too_weak).wrong == ["overflow"]


@pytest.mark.slow
@pytest.mark.parametrize("name", ["overflow pump blocked", "foreign overflow pump off"])
def test_faults_of_the_overflow_pump_itself(name: str) -> None:
    assert of_table(name, guarded=True).ok, of_table(name, guarded=True)


def test_rigs_with_and_without_overflow_pump_are_counted_apart() -> None:
    names = ("waste blocked", "overflow pump blocked", "feed blocked")
    config = FaultsConfig(faults=names, moments=("dose",), controls=1)
    assert [(case.fault, case.guarded) for case in all_cases(config)] == [
        ("", True), ("waste blocked", True), ("overflow pump blocked", True), ("feed blocked", True),
        ("waste blocked", False),
    ]  # fmt: skip
    bare = replace(config, overflow_pump=OverflowPumpConfig())
    assert [(case.fault, case.guarded) for case in all_cases(bare)] == [
        ("", False), ("waste blocked", False), ("feed blocked", False),
    ]  # fmt: skip
    assert "| a, no overflow pump |" in table([Outcome("a", "dose", False)])


@pytest.mark.slow
def test_a_word_in_a_healthy_run_is_a_false_alarm() -> None:
    nervous = SafetyConfig(jump=1e-4, jump_fraction=1e-4)
    assert "false alarm" in run(None, safety=nervous).wrong


def test_doses_are_audited_by_intent_and_sample() -> None:
    def intent(at: float, cycle: int) -> dict[str, object]:
        return {"kind": "intent", "reactor": "M0", "on_s": at, "sample": [60.0 * cycle, cycle], "feed_ml": 0.5}

    journal = [{"kind": "device", "reactor": "M0", "start_time": "a"}, intent(20.0, 1), intent(80.0, 2)]

    def dose(at: float, pump: str = "Pump1") -> Dose:
        return Dose(pump, 100.0 + at, 0.5, 1, 0.5)

    assert audit_doses(journal, [dose(21.0), dose(21.0, "Pump2"), dose(81.0)], "M0", 100.0) == (0, 0)
    assert audit_doses(journal, [dose(21.0), dose(30.0), dose(81.0)], "M0", 100.0) == (1, 0)
    assert audit_doses(journal, [dose(5.0), dose(21.0)], "M0", 100.0) == (1, 0)
    assert audit_doses(journal, [dose(81.0), dose(144.0), dose(207.0)], "M0", 100.0) == (0, 2)
    assert audit_doses([*journal, intent(85.0, 2)], [], "M0", 100.0) == (1, 0)
    assert audit_doses([*journal, journal[0] | {"start_time": "b"}, intent(200.0, 2)], [], "M0", 100.0) == (0, 0)


def test_every_fault_has_a_name_moments_of_its_bench_and_says_what_is_expected() -> None:
    assert len({fault.name for fault in FAULTS}) == len(FAULTS)
    assert min(sum(fault.family == family for fault in FAULTS) for family in FAMILIES) >= 26
    for fault in FAULTS:
        assert set(fault.moments) <= set(VIRTUAL if fault.family == "chibio" else REAL), fault.name
        near = fault.error < 1.5 and fault.recovery_min <= 30.0
        assert fault.family == "pioreactor" or fault.unheld or fault.stops or near, fault.name
    for values in ({}, {"by": ("link",), "why_not": "so"}, {"by": ("link",), "unheld": "so", "stops": "so"}):
        with pytest.raises(ValueError, match="^fault x: "):
            Fault("x", "y", set_("bus_stuck"), **values)
    with pytest.raises(ValueError, match="^faults = nonsense: .* feed blocked.*client_killed"):
        by_name(("nonsense",))


def test_what_was_told_late_or_not_at_all_is_in_the_table() -> None:
    good = Outcome("feed blocked", "steady", detected_s=600.0, reason="no_dilution", response="hold", pumps_off=True)
    bad = Outcome("feed blocked", "step", pumps_off=True, wrong=["not detected"], rows_lost=2)
    cells = table([good, bad]).splitlines()[2].strip("| ").split(" | ")
    assert cells[:4] == ["feed blocked", "10.0 (1 of 2)", "no_dilution", "hold"]
    assert cells[-1] == "**no**: not detected"
    assert by_name(("feed stuck open",))[0].overflow in declared(by_name(("feed stuck open", "feed blocked")))


@pytest.mark.slow
def test_the_campaign_writes_cases_sums_and_a_figure(tmp_path: Path) -> None:
    named = {"faults": ("OD frozen", "disk full"), "moments": ("dose",), "scenario": SCHEDULE}
    faults(FaultsConfig(controls=1, workers=1, seed=3, **named), tmp_path)
    summary = json.loads((tmp_path / "summary.json").read_text())
    assert (summary["cases"], summary["undetected"], summary["not_as_declared"]) == (3, 0, 0)
    with open(tmp_path / "cases.csv", newline="") as f:
        assert [row["reason"] for row in csv.DictReader(f)] == ["", "frozen", "end:journal"]
    assert (tmp_path / "figures" / "fault_matrix.png").stat().st_size > 10_000


@pytest.mark.parametrize(
    ("config", "key", "value"),
    [
        (FaultsConfig, "moments", ("noon",)),
        (FaultsConfig, "reactors", ("M1",)),
        (FaultsConfig, "controller_kind", "oracle"),
        (FaultsConfig, "faults", ("nonsense",)),
        (KillConfig, "runs", 300),
        (KillConfig, "early", 2.0),
        (SoakConfig, "reactors", 9),
        (SoakConfig, "phase_min", 1.0),
    ],
)
def test_bad_values_of_a_campaign_are_named(config: type, key: str, value: object) -> None:
    with pytest.raises(ValueError, match=rf"^{key}.*allowed"):
        config(**{key: value})


Columns = dict[str, "array[float]"]


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Rehearsal:
    """Twenty minutes of two reactors, all samples recorded."""
    r = Rehearsal(tmp_path_factory.mktemp("run"), rehearsed(("M0", "M1"), Scenario((0.5,), (20.0,), (37.0,))))
    r.begin()
    list(r.run())
    r.reactors.stop()
    r.close()
    return r


@pytest.fixture
def r(whole: Rehearsal) -> Iterator[Rehearsal]:
    """The same, its second recording to be damaged at will."""
    rows = whole.record.rows[1]
    sound = {key: array("d", column) for key, column in rows.columns.items()}
    yield whole
    rows.columns = sound


def delete(columns: Columns, *at: int) -> None:
    for column in columns.values():
        for k in sorted(at, reverse=True):
            del column[k]


def double(columns: Columns, k: int, later_min: float) -> None:
    for key, column in columns.items():
        column.insert(k + 1, column[k] + (later_min if key == "time_min" else 0.0))


def shift(columns: Columns, k: int, minutes: float) -> None:
    columns["time_min"][k] += minutes


def of_another_minute(columns: Columns) -> None:
    columns["od"][10] = columns["od"][9]


DARK = (600.0, 720.0)  # nothing could be read
DAMAGED: dict[str, tuple[Callable[[Columns], None], tuple[float, float] | None, tuple[int, int, int]]] = {
    # what is done to the second recording, and rows missed, lost and doubled then
    "sound": (lambda c: None, None, (0, 0, 0)),
    **{f"without row {k}": (lambda c, k=k: delete(c, k), None, (0, 1, 0)) for k in (3, 10, 19)},  # type: ignore[misc]
    "without every second row": (lambda c: delete(c, *range(1, 20, 2)), None, (0, 10, 0)),
    "without a row in the dark": (lambda c: delete(c, 10), DARK, (1, 0, 0)),
    **{f"twice, {m} min later": (lambda c, m=m: double(c, 10, m), None, (0, 0, 1)) for m in (0.0, 0.05, 0.4)},  # type: ignore[misc]
    **{f"{m} min off": (lambda c, m=m: shift(c, 10, m), None, (0, 1, 1)) for m in (-1.0, -0.4, 0.4, 1.0)},  # type: ignore[misc]
    "with the OD of another minute": (of_another_minute, None, (0, 1, 1)),
}


@pytest.mark.parametrize("name", DAMAGED)
def test_a_row_that_is_gone_doubled_or_moved_is_seen(r: Rehearsal, name: str) -> None:
    damage, dark, found = DAMAGED[name]
    assert all(len(rows) in (21, 22) for rows in r.record.rows)  # one a minute, both ends of 20 min
    damage(r.record.rows[1].columns)
    assert audit_rows(r, dark=dark) == found


def test_the_last_rows_of_a_finished_schedule_are_owed_too(r: Rehearsal) -> None:
    delete(r.record.rows[1].columns, 16, 17, 18, 19, 20)
    missed, lost, doubled = audit_rows(r)
    assert (missed, doubled) == (0, 0)
    assert lost in (4, 5)  # the row that ends a schedule may show a sample that was made after its end


def test_rows_are_given_to_samples_by_the_read_before_them() -> None:
    samples = [StoredSample(at, at - 13.0, od, od) for at, od in ((60.0, 0.5), (120.0, 0.51), (180.0, 0.51))]
    served = Served().add(samples, [59.0, 61.0, 70.0, 119.0, 122.0, 190.0])

    def audit(*rows: tuple[float, float]) -> tuple[list[int], int]:
        count, strangers = rows_per_sample([at for at, _ in rows], [od for _, od in rows], served)
        return count.tolist(), strangers

    assert audit((61.0, 0.5), (122.0, 0.51), (190.2, 0.51)) == ([1, 1, 1], 0)
    assert audit((61.0, 0.5), (190.2, 0.51)) == ([1, 0, 1], 0)  # equal ODs, told apart by when they were read
    assert audit((61.0, 0.5), (70.0, 0.5), (122.0, 0.51)) == ([2, 1, 0], 0)
    assert audit((119.5, 0.5), (122.0, 0.51)) == ([0, 1, 0], 1)  # read then, but known for a minute
    assert audit((59.0, 0.5), (100.0, 0.5)) == ([0, 0, 0], 2)  # read before there was a sample; not read at all
    assert audit() == ([0, 0, 0], 0)


STUCK = SafetyConfig(cooldown=100_000.0)
NERVOUS = replace(STUCK, mu_max=0.001, drift=0.01, noise_od=0.0, noise_fraction=0.0)
"""Takes growth for a blocked pump, and never doses again."""


dosed = partial(run, moment="dose", controller="inverse")


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
    assert dosed(sticks).ok
    outcome = dosed(sticks, safety=STUCK)
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
    outcome = dosed(replace(fault, begin=both(fault.begin, mute(*silent))))
    assert ASTRAY & set(outcome.wrong) == wrong
    assert outcome.rows_lost == outcome.doses_doubled == 0


@pytest.mark.slow
def test_a_dose_where_none_is_right_is_found() -> None:
    jumps = by_name(("OD jumps once",))[0]
    stops = replace(jumps, stops="suppose that it could not be told from a dead sensor")
    assert judged(dosed(jumps), stops).wrong == ["dosed"]


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
