"""mu and tau by the prediction-error method: against dense matrices, under feedback, and when it must refuse."""

import numpy as np
import pytest

from envs.identification.calibration import IdentifyConfig, calibrate
from envs.identification.free_run import fit
from envs.identification.model import NotIdentifiable
from envs.identification.open_loop import OpenLoop
from envs.identification.prediction_error import (
    GRID,
    LATE_SHARES,
    Estimate,
    _batch,
    _deletion_residuals,
    _solve,
    estimate,
    outliers,
)
from envs.identification.screening import Series
from experiments.calibration.config import CalibrateConfig
from experiments.calibration.study import simulated

MU, TAU = 0.03, 1.0 / 3.0


def regulated(n: int, law: str = "threshold", hours: float = 6.0, seed: int = 7, **changes: object) -> list[Series]:
    """n recordings of a culture that starts at its setpoint."""
    protocol = OpenLoop(mu=MU, tau=TAU, start_od=0.5, hours=hours, seed=seed, **changes)  # type: ignore[arg-type]
    time, od, pump_rate, _ = simulated(CalibrateConfig(law=law, protocol=protocol), n)
    return [Series(time, od[i], pump_rate[i], np.arange(len(time))) for i in range(n)]


def ratios(found: list[Estimate]) -> tuple[float, float]:
    """Median of mu and of 1/tau over their truth."""
    return (
        float(np.median([e.mu.value for e in found])) / MU,
        float(np.median([e.inverse_tau.value for e in found])) * TAU,
    )


# ---------------------------------------------------------------- the equations


def dense(series: Series, p: float, d: float, om: float, corr: float, phi: float) -> tuple[np.ndarray, np.ndarray]:
    """Covariance of ln y for sigma = 1 and the regressors 1, t, -C, c_{i-1}, from the model's sums: no filter."""
    n = len(series.od)
    dt = np.append(np.diff(series.time), 0.0)
    dose = series.pump_rate * dt
    share = dose / np.sqrt(np.mean(dose**2))
    decay = np.exp(-dt / corr)
    wander = np.zeros((n, n))  # covariance of w_i, w_j: om^2 times the decays between them
    for i in range(n):
        for j in range(i, n):
            wander[i, j] = wander[j, i] = om**2 * np.prod(decay[i:j])
    total = np.tril(np.ones((n, n)), -1)  # s_i sums what rows j < i add
    slow = total @ (np.outer(dt, dt) * wander + np.diag((d * share) ** 2)) @ total.T
    padded = np.concatenate([[np.nan] * 2, series.od, [np.nan] * 2])
    level = np.array([np.nanmedian(padded[i : i + 5]) for i in range(n)])
    ratio = (level / level.mean()) ** (p - 1.0)
    lag = np.abs(np.subtract.outer(np.arange(n), np.arange(n)))
    covariance = slow + np.outer(ratio, ratio) * phi**lag
    volume = np.concatenate([[0.0], np.cumsum(dose)[:-1]])
    late = np.concatenate([[0.0], dose[:-1]])
    return covariance, np.column_stack([np.ones(n), series.time - series.time[0], -volume, late])


CELLS = [40, 217, 398, 611]
SHARE = 3  # of the late shares: 0.75


@pytest.fixture(scope="module")
def short() -> Series:
    """A hundred rows with holes and an uneven clock."""
    whole = regulated(1, hours=1.65)[0]
    rng = np.random.default_rng(3)
    time = np.cumsum(rng.uniform(0.8, 1.3, len(whole.od)))
    od = np.where(rng.random(len(time)) < 0.1, np.nan, whole.od)
    return Series(time, od, whole.pump_rate, whole.row)


@pytest.mark.parametrize("cell", CELLS)
def test_filter_is_generalised_least_squares(short: Series, cell: int) -> None:
    """Estimate, its covariance, residual sum and restricted likelihood equal those of dense matrices."""
    solved = _solve(batch := _batch([short]), GRID)
    axes = (GRID.p, GRID.dose, GRID.wander, GRID.correlation, GRID.phi)
    seen = np.isfinite(short.od)
    merge = np.array([[1.0, 0, 0], [0, 1.0, 0], [0, 0, 1.0], [0, 0, LATE_SHARES[SHARE]]])
    covariance, x = dense(short, *(float(a[cell]) for a in axes))
    v, x, y = covariance[np.ix_(seen, seen)], x[seen] @ merge, np.log(short.od[seen])
    inverse = np.linalg.inv(v)
    normal = x.T @ inverse @ x
    best = np.linalg.solve(normal, x.T @ inverse @ y)
    error = y - x @ best
    rss = error @ inverse @ error
    scale, row = batch.scale[0], SHARE * len(GRID.p) + cell
    np.testing.assert_allclose(solved.best[0, row, 1:] / scale[1:], (merge @ best)[1:], rtol=1e-6)
    wanted = merge @ np.linalg.inv(normal) @ merge.T
    np.testing.assert_allclose(solved.spread[0, row] / np.outer(scale, scale), wanted, rtol=1e-5)
    assert solved.rss[0, row] == pytest.approx(rss, rel=1e-7)
    other = CELLS[0] if cell != CELLS[0] else CELLS[1]

    def score(c: int) -> float:
        cov, columns = dense(short, *(float(a[c]) for a in axes))
        cov, columns = cov[np.ix_(seen, seen)], columns[seen] @ merge
        inv = np.linalg.inv(cov)
        n_matrix = columns.T @ inv @ columns
        residual = y - columns @ np.linalg.solve(n_matrix, columns.T @ inv @ y)
        return float(
            -0.5 * np.linalg.slogdet(cov)[1]
            - 0.5 * np.linalg.slogdet(n_matrix)[1]
            - 0.5 * (len(y) - 3) * np.log(residual @ inv @ residual)
        )

    got = solved.score[0, row] - solved.score[0, SHARE * len(GRID.p) + other]
    assert got == pytest.approx(score(cell) - score(other), abs=1e-5)


def test_deletion_residuals_are_those_of_the_inverse_covariance(short: Series) -> None:
    batch = _batch([short])
    cell = 217
    best = _solve(batch, GRID).best[:, cell]
    axes = (GRID.p, GRID.dose, GRID.wander, GRID.correlation, GRID.phi)
    covariance, x = dense(short, *(float(a[cell]) for a in axes))
    seen = np.isfinite(short.od)
    inverse = np.linalg.inv(covariance[np.ix_(seen, seen)])
    log_od = np.log(short.od[seen])
    error = log_od - log_od.mean() - (x[seen] / batch.scale[0]) @ best[0]
    wanted = (inverse @ error) / np.sqrt(np.diag(inverse))
    got = _deletion_residuals(batch, GRID.chosen(np.array([cell])), best)[0, seen]
    np.testing.assert_allclose(got, wanted, rtol=1e-6, atol=1e-9)


def test_series_in_one_batch_are_independent() -> None:
    parts = [s.part(0, 200 - 37 * i) for i, s in enumerate(regulated(3))]
    together, alone = estimate(parts), [estimate([p])[0] for p in parts]
    for a, b in zip(together, alone, strict=True):
        assert (a.mu.value, a.inverse_tau.low) == pytest.approx((b.mu.value, b.inverse_tau.low), rel=1e-9)
        np.testing.assert_allclose(a.innovation, b.innovation, rtol=1e-7, atol=1e-9)


def test_noise_free_recording_gives_its_parameters_back() -> None:
    found = estimate(regulated(1, noise=1e-6))[0]
    assert (found.mu.value, 1.0 / found.inverse_tau.value) == pytest.approx((MU, TAU), rel=1e-3)


# ---------------------------------------------------------------- feedback and disturbances


@pytest.mark.parametrize(
    ("law", "changes", "slack"),
    [
        ("threshold", {"dose_cv": 0.1, "growth_cv": 0.05}, 0.06),
        ("pi", {"dose_cv": 0.1}, 0.12),
        ("open_loop", {"dose_cv": 0.1, "growth_cv": 0.05}, 0.02),
    ],
)
def test_a_regulated_culture_of_a_real_pump_gives_its_parameters(
    law: str, changes: dict[str, float], slack: float
) -> None:
    """Free-run least squares is wrong by a factor of two and more under feedback. Slack: 3 sd of a median of 16."""
    draws = regulated(16, law, **changes)
    found = estimate(draws)
    assert ratios(found) == pytest.approx((1.0, 1.0), abs=slack)
    held = [e.inverse_tau.low <= 1.0 / TAU <= e.inverse_tau.high for e in found]
    assert sum(held) >= 13
    assert abs(np.median([e.quality.variance for e in found]) - 1.0) < 0.05
    answering = sum(e.quality.answers for e in found)
    if law == "open_loop":
        assert answering <= 4
        return
    assert answering >= 13
    free = []
    for draw in draws[:6]:
        try:
            free.append(fit(draw).mu.value / MU)
        except NotIdentifiable:
            continue
    assert np.median(free) < 0.75


@pytest.mark.parametrize("share", [0.25, 1.0])
def test_a_dose_seen_one_row_late_moves_nothing(share: float) -> None:
    found = estimate(regulated(10, late_share=share, growth_cv=0.05))
    assert ratios(found) == pytest.approx((1.0, 1.0), abs=0.06)
    assert np.median([e.quality.late_share for e in found]) == pytest.approx(share, abs=0.15)


def test_outliers_are_found_and_nothing_else() -> None:
    draws = regulated(4, growth_cv=0.05)
    rng = np.random.default_rng(2)
    for draw in draws:
        rows = rng.choice(np.arange(10, 350, 6), 7, replace=False)
        od = draw.od.copy()
        od[rows] *= 1.0 + rng.choice([-1.0, 1.0], 7) * rng.uniform(0.1, 0.5, 7)
        found = np.flatnonzero(outliers([Series(draw.time, od, draw.pump_rate, draw.row)])[0])
        assert set(rows) <= set(found.tolist())
        assert len(found) <= 8


def test_mean_growth_is_that_of_the_rows() -> None:
    """Growth that wanders by 10 % over two hours: what is reported is what grew, not the process's own mean."""
    protocol = OpenLoop(mu=MU, tau=TAU, growth_cv=0.1, growth_memory_min=120.0, hours=6.0, seed=4)
    time, od, pump_rate, growth = simulated(CalibrateConfig(protocol=protocol), 12)
    found = estimate([Series(time, od[i], pump_rate[i], np.arange(len(time))) for i in range(12)])
    assert np.std(growth) > 0.03 * MU
    assert sum(e.mu.low <= g <= e.mu.high for e, g in zip(found, growth, strict=True)) >= 10
    np.testing.assert_allclose([e.mu.value for e in found], growth, rtol=0.06)


# ---------------------------------------------------------------- refusals and warnings


def test_a_proportional_law_is_refused_with_the_remedy() -> None:
    """Dose response and correlation of the readings are one here: mu would be several times too high."""
    refused = 0
    for draw in regulated(8, "proportional"):
        with pytest.raises(NotIdentifiable, match="stopped for 10 min every hour"):
            calibrate(draw)
        refused += 1
    assert refused == 8


def test_stopping_the_pump_for_ten_minutes_every_hour_is_a_remedy() -> None:
    protocol = OpenLoop(mu=MU, tau=TAU, start_od=0.5, dose_cv=0.1, growth_cv=0.05, seed=9)
    time, od, pump_rate, _ = simulated(CalibrateConfig(law="proportional", rest_min=10.0, protocol=protocol), 10)
    assert (pump_rate[:, time % 60 < 10] == 0.0).all()
    found = [calibrate(Series(time, od[i], pump_rate[i], np.arange(len(time)))) for i in range(10)]
    assert np.median([c.mu.value for c in found]) == pytest.approx(MU, rel=0.06)
    assert np.median([c.mu.half_width / c.mu.value for c in found]) < 0.1


def test_feedback_and_a_free_run_beside_it_are_warned_of() -> None:
    draw = regulated(1, dose_cv=0.1, growth_cv=0.05)[0]
    result = calibrate(draw)
    assert any("the pump answers the readings" in w for w in result.warnings)
    assert any("free-run least squares gives mu" in w for w in result.warnings)
    assert result.mu.low <= MU <= result.mu.high
    paper = calibrate(draw, IdentifyConfig(method="free_run"))
    assert paper.mu.high < 0.8 * MU
    assert any("use identify.method=prediction_error" in w for w in paper.warnings)
    assert paper.estimate is not None
    assert paper.estimate.mu.low <= MU <= paper.estimate.mu.high


def test_a_held_out_check_that_fails_warns() -> None:
    """The pump delivers half from the last third on: the early pair cannot predict it."""
    draw = regulated(1, hours=6.0, noise=0.005)[0]
    time = draw.time
    pump = np.where(time % 40 < 15, 0.02, 0.0)
    rise = MU * 0.5 - pump / TAU * np.where(time > 250, 0.45, 1.0)
    noise = 1.0 + 0.005 * np.random.default_rng(1).standard_normal(len(time))
    od = 0.5 * np.exp(np.concatenate([[0.0], np.cumsum(rise[:-1])])) * noise
    result = calibrate(Series(time, od, pump, draw.row), IdentifyConfig(window="all"))
    assert any("held-out check failed" in w for w in result.warnings)
