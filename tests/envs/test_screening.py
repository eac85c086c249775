"""Thresholds of the screening, each from both sides: a culture at rest, and one thing wrong with it."""

import numpy as np
import pytest

from envs.identification.screening import GAP_MIN, WEEK_MIN, Screened, Series, merged, row_spans, screen

ROWS = 200


def resting(noise: float, rows: int = ROWS) -> Series:
    """OD 0.5 without growth and pump, every minute."""
    od = 0.5 + noise * np.random.default_rng(5).standard_normal(rows)
    return Series(np.arange(float(rows)), od, np.zeros(rows), np.arange(rows))


def changed(series: Series, od: np.ndarray | None = None, time: np.ndarray | None = None) -> Screened:
    od = series.od if od is None else od
    return screen(Series(series.time if time is None else time, od, series.pump_rate, series.row))


def lost(found: Screened) -> dict[str, list[int]]:
    return {r.reason.split(":")[0]: r.rows.tolist() for r in found.rejections}


@pytest.mark.parametrize(
    ("noise", "deviation", "is_one"),
    [
        (0.001, 0.023, False), (0.001, -0.023, False), (0.001, 0.027, True), (0.001, -0.027, True),  # 5 % of 0.5
        (0.01, 0.045, False), (0.01, -0.045, False), (0.01, 0.085, True), (0.01, -0.085, True),  # six sd are 0.06
    ],
)  # fmt: skip
def test_an_outlier_is_six_sd_and_a_twentieth_of_the_reading(noise: float, deviation: float, is_one: bool) -> None:
    s = resting(noise)
    od = s.od.copy()
    od[100] = 0.5 + deviation
    assert lost(changed(s, od)) == ({"outlier": [100]} if is_one else {})


@pytest.mark.parametrize(("times", "frozen"), [(9, []), (10, list(range(61, 70)))])
def test_ten_equal_readings_are_a_frozen_sensor(times: int, frozen: list[int]) -> None:
    s = resting(0.002)
    od = s.od.copy()
    od[60 : 60 + times] = od[60]
    assert lost(changed(s, od)) == ({"sensor frozen": frozen} if frozen else {})


@pytest.mark.parametrize(("factor", "parted"), [(1.36, False), (0.735, False), (1.5, True), (0.667, True)])
def test_a_jump_is_a_factor_of_1_42(factor: float, parted: bool) -> None:
    s = resting(0.002)
    od = np.where(s.row < 120, s.od, s.od * factor)
    kept = np.isfinite(changed(s, od).series.od)
    assert kept[:119].all()
    assert kept[120:].any() != parted
    assert not kept[120:].any() or kept.all()


@pytest.mark.parametrize(("at", "parted"), [(80, True), (115, False)])
def test_a_jump_that_is_small_beside_the_recording_carries_no_weight(at: int, parted: bool) -> None:
    """OD falls from 1 by 2 % a minute, its 95th percentile is 0.82; the step is 0.12 at row 80, 0.06 at row 115."""
    s = resting(0.0003)
    od = 2.0 * s.od * np.exp(-0.02 * s.time) * np.where(s.row < at, 1.0, 1.6)
    assert bool(changed(s, od).rejections) == parted


@pytest.mark.parametrize(
    ("pause", "every", "parted"), [(5.0, 0.5, False), (5.1, 0.5, True), (10.0, 2.0, False), (10.1, 2.0, True)]
)
def test_a_pause_is_five_minutes_and_five_times_the_spacing(pause: float, every: float, parted: bool) -> None:
    s = resting(0.002)
    time = every * s.time
    time[90:] += pause - every
    found = changed(s, time=time)
    assert found.stretches == (((0, 90), (90, ROWS)) if parted else ((0, ROWS),))
    assert GAP_MIN == 5.0


@pytest.mark.parametrize(("left", "empty", "enough"), [(9, np.nan, False), (9, 0.0, False), (10, np.nan, True)])
def test_ten_readings_above_zero_are_needed(left: int, empty: float, enough: bool) -> None:
    s = resting(0.002, 40)
    od = np.where(np.arange(40) < left, s.od, empty)
    if enough:
        assert changed(s, od).stretches == ((0, 10),)
    else:
        with pytest.raises(ValueError, match="9 trustworthy readings above zero, at least 10"):
            changed(s, od)


@pytest.mark.parametrize(
    ("rows", "text"),
    [([], "none"), ([3], "3"), ([3, 7, 8, 9], "3, 7-9"), (range(0, 16, 2), "0, 2, 4, 6, 8, 10 and 2 more")],
)
def test_rows_as_text(rows: list[int], text: str) -> None:
    assert row_spans(np.array(list(rows), dtype=np.int64)) == text


@pytest.mark.parametrize(("per_minute", "lost"), [(3, 0.0), (3, 0.4), (5, 0.3), (8, 0.9)])
def test_a_merged_minute_holds_the_median_of_its_last_readings(per_minute: int, lost: float) -> None:
    """Of an even number the lower one of the two; no reading where there is none; volume and times are kept."""
    rng, n = np.random.default_rng(per_minute), 2 * WEEK_MIN - 1
    od = np.where(rng.random(n) < lost, np.nan, rng.uniform(0.1, 1.0, n))
    rate = rng.choice([0.0, 0.01, 0.02], n)
    found = merged(Series(90.0 + np.arange(n) / per_minute, od, rate, 11 + np.arange(n)))
    minutes = [slice(k, k + per_minute) for k in range(0, n, per_minute)]
    at = []
    for i, of_minute in enumerate(minutes):
        held = range(n)[of_minute]
        read = [k for k in held if np.isfinite(od[k])]
        at.append(read[-1] if read else held[-1])
        known = sorted(od[k] for k in read if (at[-1] - k) / per_minute < 0.3)
        np.testing.assert_equal(found.od[i], known[(len(known) - 1) // 2] if known else np.nan)
        assert (found.row[i], found.time[i]) == (11 + held[0], 90.0 + at[-1] / per_minute)
    first, last = at[0], at[-1]
    moved = np.sum(found.pump_rate[:-1] * np.diff(found.time))
    assert moved == pytest.approx(rate[first:last].sum() / per_minute)
