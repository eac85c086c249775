"""The audit of rows: one row deleted, doubled or shifted in the recording of a real rehearsal is seen."""

from array import array
from collections.abc import Callable, Iterator

import pytest

from envs.scenario import Scenario
from hardware.emulator.vial import StoredSample
from tests.campaigns.audit import Served, audit_rows, rows_per_sample
from tests.campaigns.rehearsal import Rehearsal, rehearsed

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
