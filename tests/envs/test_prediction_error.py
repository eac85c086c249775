"""mu and tau by the prediction-error method: against dense matrices, under feedback, and when it must refuse."""

from dataclasses import fields

import numpy as np
import pytest

from envs.identification.calibration import IdentifyConfig, calibrate
from envs.identification.free_run import fit
from envs.identification.model import NotIdentifiable
from envs.identification.noise_model import FULL, NoiseModel, average, effective
from envs.identification.open_loop import OpenLoop
from envs.identification.prediction_error import (
    Estimate,
    _batch,
    _deletion_residuals,
    _mean_growth,
    _solve,
    estimate,
    outliers,
)
from envs.identification.screening import Series
from experiments.calibration.config import CalibrateConfig
from experiments.calibration.study import simulated

pytestmark = pytest.mark.numeric

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


def dense(series: Series, z: NoiseModel, g: int) -> tuple[np.ndarray, np.ndarray]:
    """Covariance of ln y for sigma = 1 and the regressors 1, t, -(C - q l), from the model's sums: no filter."""
    p, d, om, memory, phi, late, mixing = (float(getattr(z, f.name)[0, g]) for f in fields(z))
    n = len(series.od)
    dt = np.append(np.diff(series.time), 0.0)
    dose = series.pump_rate * dt
    share = dose / np.sqrt(np.mean(dose**2))
    decay = np.exp(-dt / memory)
    wander = np.zeros((n, n))  # covariance of w_i, w_j: om^2 times the decays between them
    for i in range(n):
        for j in range(i, n):
            wander[i, j] = wander[j, i] = om**2 * np.prod(decay[i:j])
    total = np.tril(np.ones((n, n)), -1)  # s_i sums what rows j < i add
    slow = total @ (np.outer(dt, dt) * wander + np.diag((d * share) ** 2)) @ total.T
    padded = np.concatenate([[np.nan] * 2, series.od, [np.nan] * 2])
    level = np.array([np.nanmedian(padded[i : i + 5]) for i in range(n)])
    ratio = np.sqrt(p + (1.0 - p) * (level.mean() / level) ** 2)
    lag = np.abs(np.subtract.outer(np.arange(n), np.arange(n)))
    covariance = slow + np.outer(ratio, ratio) * phi**lag
    unseen = [sum(late * mixing**j * dose[i - 1 - j] for j in range(i)) for i in range(n)]
    return covariance, np.column_stack([np.ones(n), series.time - series.time[0], np.array(unseen) - total @ dose])


CELLS = NoiseModel.at(
    np.array(
        [
            [-2.0, 0.3, 0.5, -0.4, 0.2, -2.0, 0.0],  # noise alike at every OD, every dose seen at once
            [2.0, -0.8, -1.5, 0.7, -0.6, 0.3, -1.5],  # noise in proportion, late by one row
            [0.3, 1.1, 0.9, -1.2, 1.0, 0.6, 0.8],  # both noises, late, and mixing for longer
            [-1.0, -2.0, 1.4, 0.1, -1.3, 1.9, 0.1],
        ]
    )[None]
)


@pytest.fixture(scope="module")
def short() -> Series:
    """A hundred rows with holes and an uneven clock."""
    whole = regulated(1, hours=1.65)[0]
    rng = np.random.default_rng(3)
    time = np.cumsum(rng.uniform(0.8, 1.3, len(whole.od)))
    od = np.where(rng.random(len(time)) < 0.1, np.nan, whole.od)
    return Series(time, od, whole.pump_rate, whole.row)


def squares(series: Series, g: int) -> tuple[np.ndarray, np.ndarray, float, float]:
    """Coefficients, their covariance for sigma = 1, residual sum and restricted likelihood, from dense matrices."""
    seen = np.isfinite(series.od)
    covariance, x = dense(series, CELLS, g)
    v, x, y = covariance[np.ix_(seen, seen)], x[seen], np.log(series.od[seen])
    inverse = np.linalg.inv(v)
    normal = x.T @ inverse @ x
    best = np.linalg.solve(normal, x.T @ inverse @ y)
    rss = (y - x @ best) @ inverse @ (y - x @ best)
    score = np.linalg.slogdet(v)[1] + np.linalg.slogdet(normal)[1] + (len(y) - 3) * np.log(rss)
    return best, np.linalg.inv(normal), rss, -0.5 * score


@pytest.mark.parametrize("cell", range(4))
def test_filter_is_generalised_least_squares(short: Series, cell: int) -> None:
    """Estimate, its covariance, residual sum and restricted likelihood equal those of dense matrices."""
    solved = _solve(batch := _batch([short]), CELLS)
    best, spread, rss, score = squares(short, cell)
    scale = batch.scale[0]
    np.testing.assert_allclose(solved.best[0, cell, 1:] / scale[1:], best[1:], rtol=1e-6)
    np.testing.assert_allclose(solved.spread[0, cell] / np.outer(scale, scale), spread, rtol=1e-5)
    assert solved.rss[0, cell] == pytest.approx(rss, rel=1e-7)
    other = (cell + 1) % 4
    got = solved.score[0, cell] - solved.score[0, other]
    assert got == pytest.approx(score - squares(short, other)[3], abs=1e-5)


@pytest.mark.parametrize("cell", range(4))
def test_mean_growth_and_its_sd_are_those_of_the_wandering_growth_given_all_readings(short: Series, cell: int) -> None:
    """mu + S/L with S the sum of w dt: what least squares and the readings say of both, and how well they say it."""
    batch = _batch([short])
    value, sd = _mean_growth(batch, _solve(batch, CELLS), np.full((1, 4), 0.7))
    covariance, x = dense(short, CELLS, cell)
    om, memory = CELLS.wander[0, cell], CELLS.memory[0, cell]
    dt = np.append(np.diff(short.time), 0.0)
    moved = np.outer(dt, dt) * om**2 * np.exp(-np.abs(np.subtract.outer(short.time, short.time)) / memory)
    seen = np.isfinite(short.od)
    v, x = covariance[np.ix_(seen, seen)], x[seen]
    with_end = (np.tril(np.ones(moved.shape), -1) @ moved).sum(axis=1)[seen]  # covariance of the readings with S
    best, spread, *_ = squares(short, cell)
    weight, length = np.linalg.solve(v, with_end), short.time[-1] - short.time[0]
    towards = np.array([0.0, 1.0, 0.0]) - x.T @ weight / length
    expected = towards @ best + weight @ np.log(short.od[seen]) / length
    variance = towards @ spread @ towards + (moved.sum() - with_end @ weight) / length**2
    assert value[0, cell] == pytest.approx(expected, rel=1e-5)
    assert sd[0, cell] == pytest.approx(0.7 * np.sqrt(variance), rel=1e-5)


def test_deletion_residuals_are_those_of_the_inverse_covariance(short: Series) -> None:
    batch = _batch([short])
    cell = NoiseModel(*(getattr(CELLS, f.name)[:, 2:3] for f in fields(CELLS)))
    best = _solve(batch, cell).best[:, 0]
    covariance, x = dense(short, CELLS, 2)
    seen = np.isfinite(short.od)
    inverse = np.linalg.inv(covariance[np.ix_(seen, seen)])
    log_od = np.log(short.od[seen])
    error = log_od - log_od.mean() - (x[seen] / batch.scale[0]) @ best[0]
    wanted = (inverse @ error) / np.sqrt(np.diag(inverse))
    got = _deletion_residuals(batch, cell, best)[0, seen]
    np.testing.assert_allclose(got, wanted, rtol=1e-6, atol=1e-9)


@pytest.mark.parametrize("thin", [1.0, 0.05])
def test_average_is_that_of_the_posterior(thin: float) -> None:
    """A normal likelihood about a far point, for which the posterior under the normal prior is known; two series."""
    at, sd = np.array([[1.5] * 7, [-0.5] * 7]), np.array([thin, 3.0 * thin])
    score = lambda z: -0.5 * np.sum((z - at[:, None]) ** 2, axis=-1) / sd[:, None] ** 2  # noqa: E731
    z, weight = average(score, 2, FULL, 3)
    mean = np.sum(weight[..., None] * z, axis=1)
    variance = np.sum(weight[..., None] * (z - mean[:, None]) ** 2, axis=1)
    true = sd**2 / (1.0 + sd**2)
    assert (effective(weight) > 20).all()
    np.testing.assert_allclose(weight.sum(axis=1), 1.0)
    slack = 5.0 * np.sqrt(true / effective(weight))[:, None]
    assert (np.abs(mean - at / (1.0 + sd[:, None] ** 2)) < slack).all()
    np.testing.assert_allclose(variance.mean(axis=1), true, rtol=0.2)


def test_noise_model_of_the_prior() -> None:
    """Atoms of the late share, one in six each; the medians of the others; mixing never beyond the late share."""
    z = NoiseModel.at(np.random.default_rng(5).standard_normal((1, 40000, 7)))
    for atom in (0.0, 1.0):
        assert np.mean(z.late == atom) == pytest.approx(1 / 6, abs=0.01)
        assert np.mean(z.p == atom) == pytest.approx(1 / 6, abs=0.01)
    medians = [float(np.median(v)) for v in (z.dose, z.wander, z.memory, z.phi)]
    assert medians == pytest.approx([0.3, 0.1, 40.0, 0.45], rel=0.03)
    assert (z.mixing <= np.minimum(z.late, 0.7)).all()


@pytest.mark.parametrize(
    ("law", "hours"),
    [
        ("threshold", 6.0),
        *(pytest.param(*long, marks=pytest.mark.slow) for long in (("pi", 24.0), ("threshold", 72.0))),
    ],
)
def test_points_carry_the_average_at_any_length(law: str, hours: float) -> None:
    """A second seed moves the ends by a quarter of a half width at most."""
    draw = regulated(1, law, hours, dose_cv=0.1, growth_cv=0.1)
    first, second = (estimate(draw, seed=seed)[0] for seed in (0, 1))
    assert min(first.quality.effective, second.quality.effective) >= 20.0
    for end in ("low", "high"):
        moved = abs(getattr(first.inverse_tau, end) - getattr(second.inverse_tau, end))
        assert moved < 0.25 * first.inverse_tau.half_width


def test_series_in_one_batch_are_independent() -> None:
    parts = [s.part(0, 200 - 37 * i) for i, s in enumerate(regulated(3))]
    together, alone = estimate(parts), [estimate([p])[0] for p in parts]
    for a, b in zip(together, alone, strict=True):
        assert (a.mu.value, a.inverse_tau.low) == pytest.approx((b.mu.value, b.inverse_tau.low), rel=1e-9)
        np.testing.assert_allclose(a.innovation, b.innovation, rtol=1e-7, atol=1e-9)


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
    assert np.median([e.quality.late_share.value for e in found]) == pytest.approx(share, abs=0.15)


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


@pytest.mark.slow
def test_a_proportional_law_is_refused_with_the_remedy() -> None:
    """Dose response and correlation of the readings are one here: mu would be several times too high."""
    refused = 0
    for draw in regulated(8, "proportional"):
        with pytest.raises(NotIdentifiable, match="stopped for 10 min every hour"):
            calibrate(draw)
        refused += 1
    assert refused == 8


@pytest.mark.slow
def test_stopping_the_pump_for_ten_minutes_every_hour_is_a_remedy() -> None:
    protocol = OpenLoop(mu=MU, tau=TAU, start_od=0.5, dose_cv=0.1, growth_cv=0.05, seed=9)
    time, od, pump_rate, _ = simulated(CalibrateConfig(law="proportional", rest_min=10.0, protocol=protocol), 10)
    assert (pump_rate[:, time % 60 < 10] == 0.0).all()
    found = [calibrate(Series(time, od[i], pump_rate[i], np.arange(len(time)))) for i in range(10)]
    assert np.median([c.mu.value for c in found]) == pytest.approx(MU, rel=0.06)
    assert np.median([c.mu.half_width / c.mu.value for c in found]) < 0.1


def test_feedback_speaks_against_a_free_run_alone() -> None:
    draw = regulated(1, dose_cv=0.1, growth_cv=0.05)[0]
    result = calibrate(draw)
    assert not any("responds to the readings" in w for w in result.warnings)
    assert result.mu.low <= MU <= result.mu.high
    paper = calibrate(draw, IdentifyConfig(method="free_run"))
    assert paper.mu.high < 0.8 * MU
    assert paper.verdict.word == "use with care"
    assert "use identify.method=prediction_error" in paper.verdict.then
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
    assert any("last 30 % are predicted" in w for w in result.warnings)
