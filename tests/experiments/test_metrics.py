"""Window metrics against integrals that can be done by hand."""

import numpy as np
import pytest

from experiments.loop.metrics import mean_errors, window_metrics


def test_settling_is_the_first_moment_after_which_the_band_is_kept():
    t = np.arange(0.0, 31.0)[None]
    od = np.where(t < 10, 0.8, 0.5)
    od[0, 14] = 0.53  # outside 5 % of 0.5 once more
    m = window_metrics(t, od, 0.5, 0.0, 30.0)
    assert m.settling_min[0] == 15.0
    assert m.steady_abs_error[0] == 0.0


def test_two_samples_make_a_metric_one_makes_none_and_the_end_needs_a_sample_of_its_own():
    """e = 0.1 over 30 min: ISE 0.3, ITAE 45; time counts from the window, not from the run."""
    t = np.array([[0.0, 30.0, np.nan], [29.0, np.nan, np.nan], [0.0, 1.0, 19.9], [0.0, 1.0, 20.0]]) + 30.0
    m = window_metrics(t, np.where(np.isfinite(t), 0.6, np.nan), 0.5, 30.0, 60.0)
    np.testing.assert_allclose(m.ise, [0.3, np.nan, 0.199, 0.2])
    np.testing.assert_allclose(m.itae, [45.0, np.nan, 19.8005, 20.0])
    np.testing.assert_allclose(m.steady_abs_error, [0.1, np.nan, np.nan, 0.1])
    assert np.isnan(m.settling_min).all()


def test_missing_samples_are_bridged():
    """A linear error is integrated exactly by trapezia, however many samples are missing between."""
    t = np.arange(0.0, 31.0)
    od = 0.5 + 0.01 * t
    full = window_metrics(t[None], od[None], 0.5, 0.0, 30.0)
    holes_t, holes_od = t.copy(), od.copy()
    holes_t[[3, 4]], holes_od[[7, 20]] = np.nan, np.nan
    holes = window_metrics(holes_t[None], holes_od[None], 0.5, 0.0, 30.0)
    assert full.ise[0] == pytest.approx(1e-4 * 30**3 / 3, rel=2e-3)
    assert holes.ise[0] == pytest.approx(full.ise[0], rel=5e-3)


def test_a_run_without_a_sample_has_no_metrics():
    metrics = window_metrics(np.empty((2, 0)), np.empty((2, 0)), 0.5, 0.0, 30.0)
    for key in ("ise", "itae", "ise_mean", "itae_mean", "settling_min", "steady_abs_error"):
        np.testing.assert_array_equal(getattr(metrics, key), [np.nan, np.nan])


def test_the_last_two_hours_begin_no_earlier_than_the_window():
    """300 min at 0.2 from the setpoint, then 90 min at 0.03: all of these are its last two hours. Then 200 min, of
    which the first 80 are 0.2 away and the last 120 0.05."""
    minute = np.arange(591.0)[None]
    error = np.select([minute < 300, minute < 390, minute < 470], [0.2, 0.03, 0.2], 0.05)
    found = [mean_errors(minute, 0.5 - error, np.full_like(minute, 0.5), *w) for w in ((300.0, 390.0), (390.0, 590.0))]
    assert [value[0] for value in found[0]] == pytest.approx([0.03, 0.03])
    assert [value[0] for value in found[1]] == pytest.approx([(80 * 0.2 + 120 * 0.05) / 200, 0.05])


def test_a_later_window_counts_from_its_own_start_on_either_side_of_its_setpoint() -> None:
    """From minute 30 on: 20 % too high for 12 min, then 4 % too low; the other 4 % too high after 20 min of too low."""
    minute = np.tile(np.arange(0.0, 91.0), (2, 1))
    t = minute[0] - 30.0
    od = 0.5 + np.stack([np.where(t < 12.0, 0.1, -0.02), np.where(t < 20.0, -0.1, 0.02)])
    m = window_metrics(minute, od, 0.5, 30.0, 60.0)
    assert m.settling_min.tolist() == [12.0, 20.0]
    whole = [(11 * 0.1 + 0.06 + 18 * 0.02) / 30.0, (19 * 0.1 + 0.06 + 10 * 0.02) / 30.0]  # trapezia of |e|
    np.testing.assert_allclose(m.abs_error, whole)
    ise = np.array([11 * 0.01 + 0.0052 + 18 * 0.0004, 19 * 0.01 + 0.0052 + 10 * 0.0004])
    np.testing.assert_allclose(m.ise, ise)
    np.testing.assert_allclose(m.ise_mean, ise / 30.0)
    np.testing.assert_allclose(m.itae_mean, m.itae / 30.0)


def test_the_steady_error_is_that_of_the_last_ten_minutes_with_both_their_ends() -> None:
    """Minutes 20 to 30 of 30: the sample at 19 is not one of them, those at 20 and at 30 are."""
    minute = np.tile(np.arange(0.0, 31.0), (2, 1))
    od = np.full((2, 31), 0.52)
    od[0, 19], od[0, 20], od[1, 30] = 0.9, 0.63, 0.41
    m = window_metrics(minute, od, 0.5, 0.0, 30.0)
    np.testing.assert_allclose(m.steady_abs_error, [(0.13 + 10 * 0.02) / 11, (0.09 + 10 * 0.02) / 11])


def test_a_window_whose_first_sample_is_missing_is_integrated_from_the_next_one() -> None:
    """e = 0.1 from minute 2 on of 30, and to minute 28; |e| by time is half of 28^2 - 2^2, times 0.1."""
    minute = np.arange(0.0, 31.0)[None]
    od = np.full((1, 31), 0.6)
    od[0, [0, 1, 29, 30]] = np.nan
    m = window_metrics(minute, od, 0.5, 0.0, 30.0)
    assert m.ise[0] == pytest.approx(26 * 0.01)
    assert m.itae[0] == pytest.approx(0.1 * (28.0**2 - 2.0**2) / 2)
    assert m.abs_error[0] == pytest.approx(26 * 0.1 / 30.0)
