"""The paper's fit: least squares between readings and a simulated trajectory whose start is fitted, too.

The fit is for open-loop recordings. Its intervals allow for correlated errors of the readings. If the pump responds to
the readings, or doses and growth vary, estimates are too small and intervals too narrow (docs/calibration.md, Method).
All functions are pure functions of arrays.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from envs.identification.model import CONFIDENCE, WIDEST, WORST_CONDITION, NotIdentifiable, Parameter, pmse, trajectory
from envs.identification.screening import OD_FLOOR, Series, pumped_volume

Array = NDArray[np.float64]

HUBER_SD = 3.0


@dataclass(frozen=True, eq=False)
class Fit:
    """Fitted pair and the quality of its fit.

    mu: 1/min. tau: u/tau is the dilution rate in 1/min for u in mL/s; None if only mu was fitted.
    start_od: fitted OD at the first row.
    model: simulated OD, shape (n,). pmse_pct: see `pmse`. rms: root mean square of the residuals, OD.
    n_used: number of fitted readings. autocorrelation: that of the residuals at lag 1.
    """

    mu: Parameter
    tau: Parameter | None
    start_od: float
    model: Array
    pmse_pct: float
    rms: float
    n_used: int
    autocorrelation: float


def _basis(series: Series, used: NDArray[np.intp], with_tau: bool) -> Array:
    """Return the derivatives of ln x at the rows `used` by (mu, [1/tau], ln x_0), (m, p); ln x is linear in these."""
    elapsed, volume = series.time[used] - series.time[0], pumped_volume(series.time, series.pump_rate)[used]
    return np.column_stack([elapsed, *([-volume] if with_tau else []), np.ones(len(used))])


def _solve(y: Array, basis: Array, robust: bool) -> tuple[Array, Array, Array, NDArray[np.bool_]]:
    """Fit by Levenberg-Marquardt with exact derivatives; Huber's loss is applied by reweighting.

    A reading has full weight up to 3 robust sd. This sd is the larger of the residuals' sd and the relative residuals'
    sd times the model, so the noisier readings at a high OD are not outliers.

    Returns: parameters (p,), derivatives of the model (m, p), residuals model - y limited by the loss, whether limited.
    """
    from scipy.optimize import least_squares  # takes half a second, which a refused command must not cost

    size = np.maximum(y, OD_FLOOR)
    best = np.linalg.lstsq(basis * size[:, None], np.log(size) * size, rcond=None)[0]  # sd of ln y is sd(y) / y
    weight = np.ones(len(y))
    limit = np.full(len(y), np.inf)

    def simulated(p: Array) -> Array:
        return np.exp(np.clip(basis @ p, -50.0, 50.0))

    for _ in range(20):
        previous, root = best, np.sqrt(weight)

        def residual(p: Array, root: Array = root) -> Array:
            return root * (simulated(p) - y)

        def jacobian(p: Array, root: Array = root) -> Array:
            return (root * simulated(p))[:, None] * basis

        best = np.asarray(least_squares(residual, previous, jac=jacobian, method="lm", x_scale="jac").x)
        model = simulated(best)
        size = np.abs(model - y)
        if robust:
            scale = np.maximum(np.median(size), model * np.median(size / model))
            limit = HUBER_SD * 1.4826 * np.maximum(scale, 1e-9)
        weight = np.minimum(1.0, limit / np.maximum(size, 1e-300))
        if (weight == 1.0).all() or np.allclose(best, previous, rtol=1e-7, atol=1e-12):
            break
    model = simulated(best)
    return best, model[:, None] * basis, np.clip(model - y, -limit, limit), np.abs(model - y) > limit


def fit(series: Series, robust: bool = True) -> Fit:
    """Fit the simulated OD to the readings: minimise sum rho(x_i - y_i) over mu, 1/tau and ln x_0.

    rho is the square, and linear beyond 3 robust sd (Huber). Intervals come from the sandwich covariance H^-1 S H^-1.
    S is the long-run covariance of the scores (see `_sum_variance`), so correlated and uneven errors widen the
    intervals. Each residual is divided by 1 - leverage (jackknife correction, MacKinnon & White 1985, J. Econom.
    29:305). Quantiles are those of Student's t; its degrees of freedom follow from the effective number of readings.
    The interval of tau is the inverted interval of 1/tau.

    Args:
      series: readings may be nan; times and pump rates of all rows are used.
      robust: False: plain least squares.
    Returns: see `Fit`; tau is None if the pump never runs.
    Raises: NotIdentifiable if the readings are too few or the interval of 1/tau reaches zero.
    """
    with_tau = bool((series.pump_rate[:-1] > 0.0).any())
    used = np.flatnonzero(np.isfinite(series.od))
    if len(used) < 5:
        raise NotIdentifiable(f"rows {series.row[0]}-{series.row[-1]}: {len(used)} readings are too few for a fit")
    best, jacobian, error, clipped = _solve(series.od[used], _basis(series, used, with_tau), robust)
    normal = jacobian[~clipped].T @ jacobian[~clipped]
    if np.linalg.cond(normal / np.sqrt(np.outer(np.diag(normal), np.diag(normal)))) > WORST_CONDITION:
        raise NotIdentifiable(
            f"rows {series.row[0]}-{series.row[-1]}: growth and dilution cannot be distinguished, because the pump's "
            "rate never changes; use a recording in which the pump runs and stops"
        )
    inverse = np.linalg.inv(normal)
    leverage = np.minimum(np.einsum("ij,jk,ik->i", jacobian, inverse, jacobian), 0.5)
    score = jacobian * (error / (1.0 - leverage))[:, None]
    influence = inverse @ score.T  # (p, m): influence of each reading on a parameter
    mu = Parameter(*_interval(best[0], influence[0], len(best)))
    tau = _turned_over(series, _interval(best[1], influence[1], len(best))) if with_tau else None
    rate, start_od = 1.0 / best[1] if with_tau else np.inf, float(np.exp(best[-1]))
    model = trajectory(series.time, series.pump_rate, float(best[0]), rate, start_od)
    r = (series.od - model)[used]
    return Fit(
        mu=mu,
        tau=tau,
        start_od=start_od,
        model=model,
        pmse_pct=pmse(series.od, model),
        rms=float(np.sqrt(np.mean(r**2))),
        n_used=len(r),
        autocorrelation=float(np.sum(r[1:] * r[:-1]) / max(np.sum(r * r), 1e-300)),
    )


def _turned_over(series: Series, inverse: tuple[float, float, float]) -> Parameter:
    value, low, high = inverse
    if low <= 0.0 or (high - low) / 2 > WIDEST * value:
        raise NotIdentifiable(
            f"rows {series.row[0]}-{series.row[-1]}: 1/tau = {value:.3g} with the 95 % interval {low:.3g} to "
            f"{high:.3g}; allowed +-{100 * WIDEST:.0f} %, so these rows do not determine tau: too little dilution, too "
            "much noise, or a drifting culture; choose other rows"
        )
    return Parameter(1.0 / value, 1.0 / high, 1.0 / low)


def _interval(value: float, influence: Array, n_parameters: int) -> tuple[float, float, float]:
    """Return the value and its 95 % interval from the influence z of each reading, shape (m,), in order of time.

    The half width is t_{0.975, nu} sqrt(V). V is `_sum_variance`, but at least sum z^2, because a negative correlation
    is an accident of a short record. V is uncertain: a few readings at a high OD have most of the information, and
    correlated readings repeat each other. So nu = 1.5 (sum z^2)^2 / sum z^4 * sum z^2 / V - p, at least 4. For normal
    errors, Satterthwaite's effective number of readings is 3 (sum z^2)^2 / sum z^4; half of it is used because the
    correlation is estimated from the same readings. docs/records/calibration.md measures the coverage.
    """
    from scipy.special import stdtrit

    squares = influence**2
    independent = max(float(squares.sum()), 1e-300)
    variance = max(_sum_variance(influence), independent)
    effective = 1.5 * independent**2 / max(float((squares**2).sum()), 1e-300) * independent / variance
    half = float(stdtrit(max(effective - n_parameters, 4.0), 0.5 + CONFIDENCE / 2) * np.sqrt(variance))
    return float(value), float(value) - half, float(value) + half


def _sum_variance(z: Array) -> float:
    """Estimate the variance of sum z_i for a serially correlated z of mean 0, shape (m,).

    Newey-West type estimate: AR(1) prewhitening, quadratic spectral kernel, automatic bandwidth
    1.3221 (4 rho^2/(1 - rho)^4 m)^(1/5) (Andrews 1991, Econometrica 59:817; Andrews & Monahan 1992, 60:953).
    The AR(1) coefficient is corrected for its small-sample bias, (1 + 3 rho)/m (Kendall 1954).
    """
    m = len(z)

    def lag_one(v: Array) -> float:
        rho = float(v[1:] @ v[:-1]) / max(float(v[:-1] @ v[:-1]), 1e-300)
        return float(np.clip(rho + (1.0 + 3.0 * rho) / m, -0.95, 0.97))

    rho = lag_one(z)
    white = z[1:] - rho * z[:-1]
    again = lag_one(white)
    bandwidth = max(1.3221 * (4.0 * again**2 / (1.0 - again) ** 4 * m) ** 0.2, 1e-3)
    longest = min(m - 2, int(np.ceil(8.0 * bandwidth)))
    lags = np.arange(1, longest + 1)
    covariance = np.array([white[k:] @ white[:-k] for k in lags])
    angle = 1.2 * np.pi * lags / bandwidth
    kernel = 3.0 / angle**2 * (np.sin(angle) / angle - np.cos(angle))
    total = float(white @ white + 2.0 * kernel @ covariance)
    return total / (1.0 - rho) ** 2
