"""The audit of rows: one row deleted, doubled or shifted in the recording of a real rehearsal is seen."""

from array import array
from collections.abc import Iterator

import pytest

from envs.scenario import Scenario
from hardware.emulator.vial import Sample
from tests.campaigns.audit import Served, audit_rows, rows_per_sample
from tests.campaigns.rehearsal import Rehearsal, rehearsed

Columns = dict[str, "array[float]"]


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Rehearsal:
    """Twenty minutes of two reactors, all samples recorded."""
    r = Rehearsal(tmp_path_factory.mktemp("run"), rehearsed(("M0", "M1"), Scenario((0.5,), (20.0,), (37.0,))))
    r.begin()
    for _ in r.run():
        pass
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


def test_a_sound_recording_lacks_nothing(r: Rehearsal) -> None:
    assert all(len(rows) in (21, 22) for rows in r.record.rows)  # one a minute, both ends of 20 min
    assert audit_rows(r) == (0, 0, 0)


@pytest.mark.parametrize("k", [3, 10, 19])
def test_a_deleted_row_is_lost(r: Rehearsal, k: int) -> None:
    delete(r.record.rows[1].columns, k)
    assert audit_rows(r) == (0, 1, 0)


def test_every_second_row_deleted_is_lost(r: Rehearsal) -> None:
    delete(r.record.rows[1].columns, *range(1, 20, 2))
    assert audit_rows(r) == (0, 10, 0)


def test_the_last_rows_of_a_finished_schedule_are_owed_too(r: Rehearsal) -> None:
    delete(r.record.rows[1].columns, 16, 17, 18, 19, 20)
    missed, lost, doubled = audit_rows(r)
    assert (missed, doubled) == (0, 0)
    assert lost in (4, 5)  # the row that ends a schedule may show a sample that was made after its end


def test_deleted_while_nothing_could_be_read_is_missed(r: Rehearsal) -> None:
    delete(r.record.rows[1].columns, 10)
    assert audit_rows(r, dark=(600.0, 720.0)) == (1, 0, 0)


@pytest.mark.parametrize("later_min", [0.0, 0.05, 0.4])
def test_a_doubled_row_is_seen_also_if_it_is_a_little_later(r: Rehearsal, later_min: float) -> None:
    double(r.record.rows[1].columns, 10, later_min)
    assert audit_rows(r) == (0, 0, 1)


@pytest.mark.parametrize("minutes", [-1.0, -0.4, 0.4, 1.0])
def test_a_shifted_row_shows_no_sample_and_its_own_is_lost(r: Rehearsal, minutes: float) -> None:
    shift(r.record.rows[1].columns, 10, minutes)
    assert audit_rows(r) == (0, 1, 1)


def test_a_row_with_the_od_of_another_minute_is_of_no_sample(r: Rehearsal) -> None:
    od = r.record.rows[1].columns["od"]
    od[10] = od[9]
    assert audit_rows(r) == (0, 1, 1)


def test_rows_are_given_to_samples_by_the_read_before_them() -> None:
    samples = [Sample(at, at - 13.0, od, od) for at, od in ((60.0, 0.5), (120.0, 0.51), (180.0, 0.51))]
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
