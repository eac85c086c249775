"""mu and tau from recordings: against brute force, other integrators, simulated truth and independent fits."""

import numpy as np
import pytest
from scipy.optimize import minimize

from envs.identification.calibration import IdentifyConfig, calibrate
from envs.identification.curves import plateaus
from envs.identification.drift import Segment, choose_window, longest
from envs.identification.free_run import _sum_variance, fit
from envs.identification.model import NotIdentifiable, Parameter, pmse, trajectory
from envs.identification.open_loop import OpenLoop, open_loop, recordings
from envs.identification.screening import Screened, Series, noise_sd, pumped_volume, screen
from envs.integrators import rk4
from experiments.recordings.reader import read_recording
from tests.real_recording import DITHER, needs_dither

pytestmark = pytest.mark.numeric


def series(time: np.ndarray, od: np.ndarray, pump_rate: np.ndarray) -> Series:
    return Series(time, od, pump_rate, np.arange(len(time)))


def simulated(seed: int = 1, **changes: object) -> Series:
    time, od, pump_rate = open_loop(OpenLoop(**changes), np.random.default_rng(seed))  # type: ignore[arg-type]
    return series(time, od[0], pump_rate[0])


def dither(first: int = 0, end: int | None = None) -> Series:
    r = read_recording(DITHER)
    return Series(r.time_min, r.od, r.pump_rate, r.row).part(first, len(r.od) if end is None else end)


# ---------------------------------------------------------------- the model


def test_trajectory_agrees_with_the_integrated_growth_model() -> None:
    rng = np.random.default_rng(0)
    time = np.cumsum(rng.uniform(0.5, 1.5, (3, 40)), axis=1)
    pump_rate = rng.uniform(0.0, 0.02, (3, 40))
    mu, tau, start = np.array([0.01, 0.02, 0.03]), np.array([0.25, 0.3, 0.4]), np.array([0.2, 0.5, 0.9])
    batch = trajectory(time, pump_rate, mu, tau, start)
    for k in range(3):
        state = start[k : k + 1]
        for i in range(39):
            assert batch[k, i] == pytest.approx(state[0], rel=1e-9)
            net = mu[k] - pump_rate[k, i] / tau[k]
            state = rk4(lambda x, net=net: net * x, state, np.diff(time[k])[i], 20)


def test_pumped_volume_and_pmse_by_hand() -> None:
    time, rate = np.array([0.0, 1.0, 3.0, 4.0]), np.array([0.01, 0.02, 0.0, 5.0])
    np.testing.assert_allclose(pumped_volume(time, rate), [0.0, 0.01, 0.05, 0.05])
    assert pmse(np.array([1.0, 2.0, np.nan]), np.array([1.1, 1.8, 7.0])) == pytest.approx(100 * 0.05 / 5.0)


# ---------------------------------------------------------------- the fit


@pytest.mark.parametrize(("mu", "tau"), [(0.01, 0.25), (0.02, 1 / 3), (0.03, 0.45)])
def test_noise_free_recording_gives_its_parameters_back(mu: float, tau: float) -> None:
    found = fit(simulated(mu=mu, tau=tau, noise=0.0, keep_od=(0.05, 2.0)))
    assert found.tau is not None
    assert (found.mu.value, found.tau.value) == pytest.approx((mu, tau), rel=1e-7)
    assert found.pmse_pct < 1e-9


def test_fit_is_the_minimum_that_brute_force_finds() -> None:
    s = simulated(noise=0.03)

    def cost(p: np.ndarray) -> float:
        return float(np.sum((trajectory(s.time, s.pump_rate, p[0] / 30, 1 / p[1] / 3, p[2] / 8) - s.od) ** 2))

    brute = minimize(
        cost, [1.0, 1.0, 1.0], method="Nelder-Mead", options={"xatol": 1e-9, "fatol": 1e-14, "maxiter": 9000}
    )
    found = fit(s, robust=False)
    assert found.tau is not None
    assert [found.mu.value, found.tau.value, found.start_od] == pytest.approx(
        [brute.x[0] / 30, 1 / brute.x[1] / 3, brute.x[2] / 8], rel=1e-5
    )


def test_missing_readings_change_nothing_but_the_precision() -> None:
    s = simulated(noise=0.0)
    holes = s.rejecting(np.random.default_rng(3).random(len(s.od)) < 0.5)
    found = fit(holes)
    assert found.tau is not None
    assert (found.mu.value, found.tau.value) == pytest.approx((0.028, 0.31), rel=1e-6)
    assert found.n_used == np.isfinite(holes.od).sum() < 0.6 * len(s.od)


def test_huber_loss_bounds_the_pull_of_one_wrong_reading() -> None:
    s = simulated(noise=0.01)
    od = s.od.copy()
    od[np.argmax(od)] *= 3.0
    wrong = series(s.time, od, s.pump_rate)
    off = [abs(fit(wrong, robust=r).mu.value - 0.028) for r in (True, False)]
    assert off[0] < 0.5 * off[1]


# ---------------------------------------------------------------- intervals


def test_variance_of_a_correlated_sum_against_its_formula() -> None:
    """For AR(1) noise Var(sum) -> n sigma^2 (1 + rho)/(1 - rho)."""
    rng = np.random.default_rng(5)
    n, rho = 600, 0.7
    estimates, sums = [], []
    for _ in range(300):
        z = np.empty(n)
        z[0] = rng.standard_normal()
        for i in range(1, n):
            z[i] = rho * z[i - 1] + np.sqrt(1 - rho**2) * rng.standard_normal()
        estimates.append(_sum_variance(z - z.mean()))
        sums.append(z.sum())
    exact = n * (1 + rho) / (1 - rho)
    assert np.mean(estimates) == pytest.approx(exact, rel=0.1)
    assert np.var(sums) == pytest.approx(exact, rel=0.25)  # the simulation itself is right


@pytest.mark.parametrize("dt", [0.5, 2.0])
def test_the_memory_of_growth_is_in_minutes_whatever_the_rows(dt: float) -> None:
    """Without pump and noise ln(OD) tells growth; after the correlation time 1/e of its fluctuation is left."""
    config = OpenLoop(noise=0.0, growth_cv=0.2, growth_memory_min=30.0, hours=1.0, control_min=dt)
    _, od, _, _ = recordings(config, lambda t, od: np.zeros(len(od)), np.random.default_rng(5), 4000)
    growth = np.diff(np.log(od), axis=1)[:, [5, 5 + round(30.0 / dt) - 1]]
    lag = config.growth_memory_min - dt
    assert np.corrcoef(growth.T)[0, 1] == pytest.approx(np.exp(-lag / 30.0), abs=0.06)


def coverage(config: OpenLoop, n: int, seed: int) -> tuple[float, float]:
    time, od, pump_rate = open_loop(config, np.random.default_rng(seed), n)
    found = [fit(series(time, od[i], pump_rate[i])) for i in range(n)]
    mu = np.mean([c.mu.low <= config.mu <= c.mu.high for c in found])
    tau = np.mean([c.tau is not None and c.tau.low <= config.tau <= c.tau.high for c in found])
    return float(mu), float(tau)


@pytest.mark.parametrize(("correlation", "n", "least"), [(0.0, 200, 0.90), (0.8, 150, 0.87)])
def test_intervals_hold_the_truth_also_under_correlated_noise(correlation: float, n: int, least: float) -> None:
    """Ignoring the correlation of 0.8 would cover some 43 %."""
    for share in coverage(OpenLoop(noise_correlation=correlation), n, seed=20 + (n == 150)):
        assert least <= share <= 0.99


# ---------------------------------------------------------------- identifiability


def test_recording_of_one_dose_says_that_it_cannot_give_tau() -> None:
    time = np.arange(200.0)
    pump_rate = np.where((time > 50) & (time < 52), 0.02, 0.0)
    od = trajectory(time, pump_rate, 0.012, 1 / 3, 0.05) * (1 + 0.01 * np.random.default_rng(0).standard_normal(200))
    with pytest.raises(NotIdentifiable, match="pump runs in 1 rows"):
        calibrate(series(time, od, pump_rate))


def test_tau_lost_in_noise_is_refused() -> None:
    rng = np.random.default_rng(2)
    time = np.arange(70.0)
    pump_rate = np.where(time % 2 < 1, 0.0, 0.0005)
    od = trajectory(time, pump_rate, 0.01, 1 / 3, 0.3) * (1 + 0.05 * rng.standard_normal(70))
    for method in ("prediction_error", "free_run"):
        with pytest.raises(NotIdentifiable, match="do not determine tau"):
            calibrate(series(time, od, pump_rate), IdentifyConfig(window="all", method=method))


def test_less_than_an_hour_is_no_calibration() -> None:
    s = simulated().part(100, 155)
    for method in ("prediction_error", "free_run"):
        with pytest.raises(NotIdentifiable, match="54 min; allowed at least 60 min; record for longer"):
            calibrate(s, IdentifyConfig(method=method))


def test_growth_alone_gives_mu_without_tau() -> None:
    time = np.arange(120.0)
    found = fit(series(time, 0.05 * np.exp(0.02 * time), np.zeros(120)))
    assert found.tau is None
    assert found.mu.value == pytest.approx(0.02, rel=1e-7)


# ---------------------------------------------------------------- screening


def test_clean_recordings_lose_next_to_nothing() -> None:
    time, od, pump_rate = open_loop(OpenLoop(noise=0.02), np.random.default_rng(9), 60)
    lost = [np.isnan(screen(series(time, od[i], pump_rate[i])).series.od).sum() for i in range(60)]
    assert np.mean(lost) < 0.001 * len(time)


WILD = np.random.default_rng(4).uniform(0.0, 3.0, 121)


@pytest.mark.parametrize(
    ("rows", "fault", "reason", "lost"),
    [
        (slice(150, 158), lambda y: y + 0.6, "burst", range(150, 158)),
        (slice(250, None), 6.0, "sensor broken or moved after a jump", range(249, 361)),
        (slice(250, None), 0.2, "different conditions after a jump", range(249, 361)),
        (slice(240, None), lambda y: WILD, "sensor noisy", None),
    ],
)
def test_a_fault_of_the_sensor_is_found_where_it_was_put(rows, fault, reason, lost) -> None:  # type: ignore[no-untyped-def]
    s = simulated()
    od = s.od.copy()
    od[rows] = fault(od[rows]) if callable(fault) else od[rows] * fault
    screened = screen(series(s.time, od, s.pump_rate))
    found = {r.reason.split(":")[0]: r.rows.tolist() for r in screened.rejections}
    assert reason in found
    if lost is not None:
        assert sorted(row for rows in found.values() for row in rows) == list(lost)
    kept = np.flatnonzero(np.isfinite(screened.series.od))
    assert len(kept) == 361 - sum(map(len, found.values()))
    assert reason != "sensor noisy" or kept[-1] < 250
    assert reason != "burst" or screened.stretches == ((0, 361),)


@pytest.mark.slow
def test_any_mutilated_recording_ends_in_a_result_or_in_a_reason() -> None:
    """Random cuts, holes, jumps, frozen and wild stretches; warnings are errors here, so NumPy may not even mutter."""
    time, od, pump_rate = open_loop(OpenLoop(), np.random.default_rng(0), 20)
    outcomes = set()
    for k in range(60):
        rng = np.random.default_rng(k)
        n = int(rng.integers(1, 362))
        t, y, u = time[:n].copy(), od[k % 20, :n].copy(), pump_rate[k % 20, :n].copy()
        for operation in rng.integers(0, 8, rng.integers(0, 4)):
            at = int(rng.integers(0, n))
            part = slice(at, at + int(rng.integers(1, n + 1)))
            if operation == 0:
                y[part] = np.nan
            elif operation == 1:
                y[part] *= rng.choice([0.0, -0.02, 3.0, 0.1])
            elif operation == 2:
                u[part] = rng.choice([0.0, 0.02, 1.0])
            elif operation == 3:
                u[:] = rng.choice([0.0, 0.01])
            elif operation == 4:
                y[part] = y[at]
            elif operation == 5:
                y[part] = rng.uniform(-0.05, 9.0, len(y[part]))
            elif operation == 6:
                t[at:] += rng.choice([10.0, 1000.0])
            else:
                y[rng.random(n) < 0.3] = np.nan
        try:
            result = calibrate(series(t, y, u))
        except ValueError:
            outcomes.add("refused")
        else:
            assert result.mu.low < result.mu.value < result.mu.high
            assert 0.0 < result.tau.low < result.tau.value < result.tau.high
            outcomes.add("fitted")
    assert outcomes == {"refused", "fitted"}


def test_pause_parts_the_recording_without_rejecting() -> None:
    s = simulated(hours=12.0)
    keep = (s.time < 200) | (s.time > 260)
    result = calibrate(series(s.time[keep], s.od[keep], s.pump_rate[keep]))
    assert len(result.screened.stretches) == 2
    assert sum(len(r.rows) for r in result.screened.rejections) <= 1
    assert (result.window, result.window_rows) == ((200, 660), (200, 660))
    later = Series(s.time[keep], s.od[keep], s.pump_rate[keep], s.row[keep] + 7)  # as a file has them, with the pause
    assert calibrate(later).window_rows == (268, 728)


def test_the_window_is_the_stretch_with_most_readings_not_with_most_rows() -> None:
    """Three hours of which every other row was rejected, a pause, and two hours without a gap."""
    time = np.concatenate([np.arange(181.0), np.arange(400.0, 521.0)])
    od = np.where((time < 200.0) & (time % 2 == 1.0), np.nan, 0.5)
    clean, known = Series(time, od, np.zeros(time.size), np.arange(time.size)), Parameter(0.03, 0.029, 0.031)
    along = tuple(
        Segment(a, b, time[a:b].mean(), known, known) for a, b in ((0, 90), (90, 181), (181, 241), (241, 302))
    )
    found, why = choose_window(Screened(clean, ((0, 181), (181, 302)), ()), along, 60.0)
    assert (found, why) == ((181, 302), "the longest part without a pause")
    assert longest(Screened(clean, ((0, 181), (181, 302)), ())) == (181, 302)


def test_noise_sd_is_measured_through_growth_and_dilution() -> None:
    time, od, pump_rate = open_loop(OpenLoop(noise=0.0), np.random.default_rng(3))
    noisy = od[0] + 0.004 * np.random.default_rng(4).standard_normal(len(time))
    assert noise_sd(series(time, noisy, pump_rate[0])) == pytest.approx(0.004, rel=0.2)


# ---------------------------------------------------------------- window, drift, validation


def test_drift_is_found_and_kept_out_of_the_window() -> None:
    """tau rises by 60 % in the second half; the first half alone is fitted."""
    rng = np.random.default_rng(8)
    time = np.arange(1200.0)
    pump_rate = np.where(time % 60 < 15, 0.015, 0.0)
    tau = np.interp(time, [0, 600, 1200], [0.3, 0.3, 0.48])
    rise = 0.012 - pump_rate / tau
    od = 0.4 * np.exp(np.concatenate([[0.0], np.cumsum(rise[:-1])])) * (1 + 0.01 * rng.standard_normal(1200))
    result = calibrate(series(time, od, pump_rate))
    assert result.drift_tau is not None
    assert result.drift_tau.significant
    assert result.drift_tau.change_pct == pytest.approx(45, abs=20)
    assert any("tau drifts" in w for w in result.warnings)
    assert 600 <= result.window_rows[1] <= 880
    assert result.tau.value == pytest.approx(0.3, rel=0.06)
    inside = slice(*result.window_rows)
    assert result.tau.low < tau[inside][pump_rate[inside] > 0].mean() < result.tau.high
    assert result.validation.outside_pct is not None
    with pytest.raises(NotIdentifiable, match="a drifting culture"):
        calibrate(series(time, od, pump_rate), IdentifyConfig(window="all", method="free_run"))


def test_all_rows_on_request_with_a_warning() -> None:
    """The second half grows 5 % faster: more than the limit forgives, not enough to be refused."""
    s = simulated(noise=0.005)
    faster = s.od * np.exp(0.0015 * np.maximum(s.time - 180, 0.0))
    config = IdentifyConfig(window="all", pmse_limit=0.01, method="free_run")
    result = calibrate(series(s.time, faster, s.pump_rate), config)
    assert result.window == (0, 361)
    assert any("exceeds" in w for w in result.warnings)


def test_constant_culture_shows_no_drift() -> None:
    result = calibrate(simulated(hours=20.0))
    assert result.drift_mu is not None
    assert result.drift_tau is not None
    assert not any("drifts" in w for w in result.warnings)
    assert result.validation.holdout_pct is not None
    assert result.validation.holdout_pct < 0.1
    assert result.validation.outside_pct is None


def test_a_pump_that_cannot_outrun_growth_is_refused() -> None:
    assert OpenLoop(mu=0.02, tau=0.999).fastest == pytest.approx(1.0)
    with pytest.raises(ValueError, match=r"protocol\.tau = 1\.0: allowed .*below 0\.02/mu"):
        OpenLoop(mu=0.02, tau=1.0)


def test_generator_follows_the_protocol() -> None:
    time, od, pump_rate = open_loop(OpenLoop(noise=0.0), np.random.default_rng(2), 20)
    assert (pump_rate[:, time < 60] == 0.0).all()
    for y, u in zip(od, pump_rate, strict=True):
        below = int(np.argmax((time >= 60) & (y < 0.3)))
        assert (u[60:below] == 0.02).all()
        changes = time[below:][1:][np.diff(u[below:]) != 0] - time[below]
        regular = changes[changes % 30 == 0] if y[below:].min() > 0.08 and y[below:].max() < 1.2 else changes
        assert len(regular) == len(changes)
        assert np.isin(np.round(u / 0.00125, 9) % 1, [0.0]).all()
    assert len({tuple(u) for u in pump_rate}) == 20
    y, u = od[0], pump_rate[0]
    np.testing.assert_allclose(trajectory(time, u, 0.028, 0.31, 0.12), y, rtol=1e-8)


def test_a_simulated_recording_of_other_rows_is_the_model_s_too() -> None:
    """Every two minutes for six hours: fed from an hour on, then with rates that hold for half an hour each."""
    config = OpenLoop(noise=0.0, control_min=2.0, hours=6.0, keep_od=(0.001, 2.0))
    time, od, rate = open_loop(config, np.random.default_rng(3))
    assert (time[0], time[1], time[-1], od.shape) == (0.0, 2.0, 360.0, (1, 181))
    fed, drawn, *others = time[1:][np.diff(rate[0]) != 0.0]
    assert fed == 60.0
    assert np.diff([drawn, *others]).tolist() == [30.0] * len(others)
    assert len(others) > 4
    np.testing.assert_allclose(trajectory(time, rate[0], 0.028, 0.31, 0.12), od[0], rtol=1e-9)


def test_a_dose_of_which_half_is_seen_late_is_in_the_reading_after_the_next() -> None:
    config = OpenLoop(mu=0.02, tau=0.4, start_od=0.5, noise=0.0, late_share=0.5, hours=1.0)
    _, od, rate, growth = recordings(
        config, lambda t, y: np.full(1, 0.02 if t == 10.0 else 0.0), np.random.default_rng(1)
    )
    plain = 0.5 * np.exp(0.02 * np.arange(61.0))
    assert rate[0, 10] == 0.02
    np.testing.assert_allclose(od[0, [10, 11, 12]] / plain[[10, 11, 12]], np.exp([0.0, -0.025, -0.05]))
    assert growth[0] == pytest.approx(0.02)


def test_growth_and_light_are_those_of_each_temperature_that_was_held() -> None:
    """0.3 1/h at 30 degC for 300 min, 0.6 at 34 for 240, then 40 min at 36, a row every 2 min; light of the first:
    214 counts, and 2000 more of an OD of 1, but for a reading at full scale."""
    time = np.arange(0.0, 580.0, 2.0)
    phase = np.searchsorted([300.0, 540.0], time, side="right")
    degc, mu = np.array([30.0, 34.0, 36.0])[phase], np.array([0.3, 0.6, 0.3])[phase] / 60.0
    rate = np.where(time % 40.0 < 20.0, 0.01, 0.002)
    log_od = np.concatenate([[0.0], np.cumsum((mu - rate / 0.8)[:-1] * 2.0)])
    od = 0.5 * np.exp(log_od) * (1.0 + 0.002 * np.random.default_rng(6).standard_normal(time.size))
    light = np.where(phase == 0, 214.0 + 2000.0 * od, np.nan)
    light[140] = 65535.0
    found, left = plateaus(series(time, od, rate), degc, light, 0.8, 60.0, 120.0, 214.0)
    assert [(p.first, p.end, p.temperature) for p in found] == [(30, 150, 30.0), (180, 270, 34.0)]
    assert [p.growth.value for p in found] == pytest.approx([0.3, 0.6], rel=0.02)
    assert all(p.growth.low < p.growth.value < p.growth.high for p in found)
    assert found[0].light is not None
    assert found[0].light.value == pytest.approx(2000.0)
    assert found[1].light is None
    assert left == ["36.0 degC from minute 540 on: constant for 40 min, at least 180 are needed"]


# ---------------------------------------------------------------- the real recording


@needs_dither
@pytest.mark.parametrize(
    ("rows", "mu", "tau", "rms", "error"),
    [((0, 700), 0.0102, 0.304, 0.0213, 0.43), ((270, 700), 0.0104, 0.301, 0.0257, 0.45)],
)
def test_real_recording_against_independent_fits(
    rows: tuple[int, int], mu: float, tau: float, rms: float, error: float
) -> None:
    found = fit(dither(*rows), robust=False)
    assert found.tau is not None
    assert found.mu.value == pytest.approx(mu, abs=2e-4)
    assert found.tau.value == pytest.approx(tau, rel=0.02)
    assert found.rms == pytest.approx(rms, rel=0.02)
    assert found.pmse_pct == pytest.approx(error, abs=0.02)


@needs_dither
def test_free_run_through_the_drift_is_refused() -> None:
    with pytest.raises(NotIdentifiable, match="1/tau = 0.32"):  # tau 3.1, nonsense
        fit(dither(270, 1156), robust=False)


@needs_dither
def test_whole_real_recording() -> None:
    result = calibrate(dither())
    broken = next(r for r in result.screened.rejections if "sensor broken" in r.reason)
    assert broken.rows.tolist() == list(range(1157, 1209))
    first, end = result.window_rows
    assert end <= 780
    assert 0.0098 <= result.mu.value <= 0.0108
    assert 0.28 <= result.tau.value <= 0.33
    assert result.pmse_pct <= 0.6
    assert result.drift_mu is not None
    assert result.drift_mu.change_pct == pytest.approx(40, abs=15)
    assert result.drift_tau is not None
    assert result.drift_tau.significant
    assert result.drift_tau.last == pytest.approx(0.42, abs=0.04)
    assert first < 20
