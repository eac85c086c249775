"""The fault matrix on a few faults, its judge, and the audit of rows: what they look for is seen."""

import csv
import json
from array import array
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import cache
from pathlib import Path

import pytest

from envs.scenario import Scenario
from hardware.chibio.overflow_pump import OverflowPumpConfig
from hardware.emulator.vial import Dose, StoredSample
from hardware.safety.config import SafetyConfig
from tests.campaigns.audit import Served, audit_doses, audit_rows, rows_per_sample
from tests.campaigns.chibio_case import ChiBioCase
from tests.campaigns.chibio_faults import both, post, run_device, set_
from tests.campaigns.fault import FAMILIES, REAL, VIRTUAL, Fault
from tests.campaigns.fault_table import FAULTS, by_name
from tests.campaigns.faults import FaultsConfig, all_cases, faults
from tests.campaigns.killed_run import KillConfig
from tests.campaigns.outcome import Outcome, declared, judged, table
from tests.campaigns.rehearsal import Rehearsal, rehearsed
from tests.campaigns.soak import SoakConfig

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
) -> Outcome:
    return ChiBioCase(fault, moment, rehearsed(("M0", "M1"), SCHEDULE, safety, overflow_pump=pump), 3).run()


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
        ("computer loses power", "dose", "repair:torn"),
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
