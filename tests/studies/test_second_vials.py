"""The second plant with two species does what its equations say."""

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from experiments.laws.share.estimator import CompositionEstimator, CompositionEstimatorConfig
from experiments.laws.share.laws import Proportional, ProportionalConfig
from tests.studies.second_vials import (
    PROGRAMS,
    Conditions,
    Program,
    Trace,
    Vials,
    coverage,
    draw,
    estimate_error,
    nominal,
    production_steady,
    run,
    tracking_error,
)

pytestmark = pytest.mark.slow  # of a yardstick, which no change of the program reaches
COLD = np.full(1, -100.0)  # a target that never heats
NOTHING = np.zeros((13, 1))


def rates(temperature: float) -> tuple[float, float]:
    """mu_e and mu_p of the paper, 1/h."""
    return 0.07727 * temperature - 1.66954, -0.02208 * temperature**2 + 1.3796 * temperature - 20.56996


def still(temperature: float, share: float = 0.5, **fixed: Any) -> Vials:
    """One vial that the room keeps at a temperature."""
    return Vials(Conditions(1, start_c=temperature, ambient_c=temperature, start_share=share, **fixed))


def wait(vials: Vials, minutes: int, target: np.ndarray = COLD, dose: float = 0.0) -> None:
    """Let minutes pass without noise."""
    for _ in range(minutes):
        vials.pass_minute(target, np.full(vials.c.n, dose), np.zeros((vials.steps + 1, vials.c.n)))


def jump(vials: Vials, temperature: float) -> None:
    """Put the vial and its room at another temperature at once."""
    vials.c = replace(vials.c, ambient_c=temperature)
    vials.temperature = np.full(vials.c.n, temperature)


class Told:
    """An estimator and a law in one that hold a target and write down what they are told."""

    def __init__(self, target: float = 33.2) -> None:
        self.target, self.tape, self.seen = target, [], []

    def reset(self, n: int) -> None:
        self.n, self.tape, self.seen = n, [], []

    def watch(self, od: Any, fluorescence: Any, temperature: Any, minute: Any, rows: Any) -> None:
        self.tape.append(("watch", float(minute[0])))
        self.seen.append((od, fluorescence, temperature))
        assert rows.all()

    def dosed(self, volume_ml: Any) -> None:
        self.tape.append(("dosed", float(volume_ml[0])))

    def estimate(self) -> Any:
        return SimpleNamespace()

    def explain(self) -> dict[str, Any]:
        return {"ratio": np.full(self.n, 0.5), "ratio_low": np.full(self.n, 0.4), "ratio_high": np.full(self.n, 0.6)}

    def act(self, estimate: Any, wanted: Any, minute: Any, rows: Any) -> Any:
        self.tape.append(("act", float(wanted.setpoint[0])))
        return np.full(self.n, self.target)

    def sample(self, share: Any, sd: Any, minute: float, rows: Any) -> None:
        self.tape.append(("sample", minute))
        self.sampled = share

    def calibrate(self, factor: Any, factor_sd: Any, offset: Any, offset_sd: float) -> None:
        self.calibration = factor, factor_sd, offset, offset_sd


def held(conditions: Conditions, hours: float, target: float = 33.2, **options: Any) -> tuple[Trace, Told]:
    """Run with a constant target."""
    told = Told(target)
    return run(conditions, told, told, PROGRAMS["hold"], hours, **options), told


@pytest.mark.parametrize("temperature", [27.0, 29.0, 33.2, 36.0, 38.0])
@pytest.mark.parametrize("species", [0, 1])
def test_one_species_grows_exponentially(temperature: float, species: int) -> None:
    vials = still(temperature, float(species), scale_e=0.8, scale_p=1.1)
    wait(vials, 150)
    mu = (0.8, 1.1)[species] * rates(np.clip(temperature, 29, 36))[species]
    np.testing.assert_allclose(vials.cells[species], 0.5 * np.exp(2.5 * mu), rtol=1e-10)
    assert vials.cells[1 - species] == 0


def test_logit_follows_the_rates_through_their_lags() -> None:
    vials = still(30.0, 0.2)
    jump(vials, 35.0)
    (e0, p0), (e1, p1), logit0 = rates(30.0), rates(35.0), np.log(0.2 / 0.8)
    for hour in range(1, 7):
        wait(vials, 60, dose=0.3)
        p = p1 * hour + (p0 - p1) * (1 - np.exp(-hour))
        e = e1 * hour + (e0 - e1) / 30 * (1 - np.exp(-30 * hour))
        logit = np.log(vials.share / (1 - vials.share))
        np.testing.assert_allclose(logit, logit0 + p - e, atol=1e-5)
    before = logit
    wait(vials, 300)
    wait(vials, 60)
    after = np.log(vials.share / (1 - vials.share))
    np.testing.assert_allclose((after - before) / 6, p1 - e1, atol=1e-3)


@pytest.mark.parametrize("dose", [0.1, 0.5, 1.2])
def test_washout(dose: float) -> None:
    vials = still(33.0, 0.0)
    vials.pigment = np.full(1, 1000.0)
    wait(vials, 60, dose=dose)
    np.testing.assert_allclose(vials.pigment, 1000 * np.exp(-60 * dose / 20), rtol=1e-10)
    np.testing.assert_allclose(vials.cells.sum(0), 0.5 * np.exp(rates(33.0)[0] - 60 * dose / 20), rtol=1e-10)


def test_pigment_in_balance_and_made_anew() -> None:
    vials = still(32.0, 1.0)
    mu = rates(32.0)[1]
    wait(vials, 120)
    np.testing.assert_allclose(vials.pigment, production_steady(np.array(32.0)) * vials.cells[1] / mu, rtol=1e-5)
    vials.pigment, cells = np.zeros(1), vials.cells[1].copy()
    wait(vials, 60)
    made = production_steady(np.array(32.0)) * cells * (np.exp(mu) - 1) / mu
    np.testing.assert_allclose(vials.pigment, made, rtol=1e-5)


def test_production_is_late_and_has_a_floor() -> None:
    assert production_steady(np.array(32.5)) == pytest.approx(6318.711894680335)
    assert production_steady(np.array(33.5)) == pytest.approx(44.49572512791427 + 31.820479677943325 - 917.5864128224449
                                                              - 886.6854718162117 + 6318.711894680335)  # fmt: skip
    assert production_steady(np.array(36.0)) == 20
    vials = still(34.0)
    g0, g1 = production_steady(np.array([34.0, 33.0]))
    jump(vials, 33.0)
    wait(vials, 30)
    np.testing.assert_allclose(vials.production, g0 + 1.6 * 0.5 * (g1 - g0), rtol=1e-10)
    wait(vials, 30)
    late = g0 + 1.6 * (g1 - g0) - 1.6 * 1.6 * (g1 - g0) * 0.5**2 / 2
    np.testing.assert_allclose(vials.production, late, rtol=1e-10)
    hot = still(33.0)
    jump(hot, 36.0)
    wait(hot, 120)
    assert hot.production == 20


def test_cooling_and_heating() -> None:
    vials = Vials(Conditions(3, start_c=36.0, cooling_min=[30, 39, 60], ambient_c=[18, 24, 26]))
    wait(vials, 34)
    tau, ambient = np.array([30, 39, 60]), np.array([18, 24, 26])
    np.testing.assert_allclose(vials.temperature, ambient + (36 - ambient) * np.exp(-34 / tau), rtol=1e-12)
    assert vials.temperature[1] == pytest.approx(29, abs=0.1)  # 36 to 29 degC takes 34 min
    before = vials.temperature
    wait(vials, 1, np.full(3, 45.0))
    end = ambient + 2 * tau
    np.testing.assert_allclose(vials.temperature, end + (before - end) * np.exp(-1 / tau), rtol=1e-12)
    assert np.all(vials.temperature - before < 2)


@pytest.mark.parametrize("band", [0.0, 0.5])
def test_the_thermostat_holds_the_thermometer(band: float) -> None:
    shifted = Conditions(3, offset_c=[-0.5, 0.0, 0.5])
    trace, _ = held(shifted, 4, 34.0, band_c=band)
    late = trace.temperature[60:]
    np.testing.assert_allclose(late.mean(0) - late[:, 1].mean(), [0.5, 0.0, -0.5], atol=0.01)
    np.testing.assert_allclose(trace.thermometer[60:].mean(0), 34.0, atol=0.12)
    assert (trace.thermometer - trace.temperature).std(0) == pytest.approx(0.05, rel=0.2)


def test_readings() -> None:
    vials = Vials(Conditions(2, light=[0.8, 1.1], bias=[200, 300], offset_c=0.3))
    od, counts, thermometer = vials.read(np.zeros((3, 2)))
    g, f = production_steady(np.array(33.2)), 0.25 / (np.mean(rates(33.2)))
    np.testing.assert_allclose(od, 0.5)
    np.testing.assert_allclose(counts, np.array([0.8, 1.1]) * (g * f + 75) + [200, 300], rtol=1e-6)
    np.testing.assert_allclose(thermometer, 33.5)
    off = np.subtract(vials.read(np.ones((3, 2))), vials.read(np.zeros((3, 2))))
    np.testing.assert_allclose(off, np.array([[np.hypot(0.005, 0.005)], [30.0], [0.05]]) * np.ones(2), rtol=1e-9)


def test_light_walks_by_its_sd_in_a_day() -> None:
    vials, rng = Vials(Conditions(400, light_walk=0.02), step_s=60), np.random.default_rng(0)
    for _ in range(1440):
        vials.pass_minute(np.full(400, 33.2), np.full(400, 0.3), rng.standard_normal((2, 400)))
    assert np.log(vials.light).std() == pytest.approx(0.02, rel=0.1)


def test_doses_spread_about_the_true_flow() -> None:
    trace, told = held(Conditions(20, flow=1.1, dose_spread=0.15), 12, density="hold")
    on = trace.told_ml > 0.05
    factor = trace.true_ml[on] / trace.told_ml[on]
    assert factor.mean() == pytest.approx(1.1, abs=0.005)
    assert factor.std() == pytest.approx(1.1 * 0.15, rel=0.03)
    np.testing.assert_array_equal([v for k, v in told.tape if k == "dosed"], trace.told_ml[:, 0])
    wild, _ = held(Conditions(20, dose_spread=2.0), 2, density="hold")
    assert wild.true_ml.min() == 0


def test_the_vials_hold_what_went_in() -> None:
    """ln OD changes by growth less true doses / 20 mL."""
    trace, _ = held(Conditions(50, start_share=0.5, dose_spread=0.2, flow=0.95), 6)
    grown = np.log(trace.od[-60:].mean()) - np.log(trace.od[:60].mean())
    mu = np.mean(rates(33.14))
    assert trace.true_ml[30:330].sum(0).mean() / 20 == pytest.approx(5 * mu - grown, rel=0.02)


@pytest.mark.parametrize("density", ["dither", "hold"])
def test_the_density_is_held(density: Any) -> None:
    trace, _ = held(nominal(20), 6, density=density)
    late = trace.od[60:]
    if density == "hold":
        assert late.mean() == pytest.approx(0.5, abs=0.005)
        assert late.std() < 0.02
    else:
        assert set(np.unique(trace.told_ml)) == {0.0, 1.2}
        assert 0.42 < np.quantile(late, 0.01) < 0.46
        assert 0.53 < np.quantile(late, 0.99) < 0.56
    assert trace.told_ml.max() <= 1.2


def test_finer_steps_change_nothing() -> None:
    ends = []
    for step in (5.0, 1.0):
        vials = Vials(Conditions(2, start_share=[0.1, 0.9]), step_s=step)
        for minute in range(600):
            target = np.full(2, 30.0 + 5 * (minute // 150 % 2))
            vials.pass_minute(target, np.full(2, 0.3), np.zeros((vials.steps + 1, 2)))
        ends.append(np.concatenate([vials.share, vials.pigment / 1000, vials.temperature]))
    np.testing.assert_allclose(ends[0], ends[1], atol=0.004)


def test_another_bottle() -> None:
    vials = Vials(Conditions(2, start_c=33.0, ambient_c=33.0, start_share=[0.0, 1.0], bottle_swap=[1.0, np.nan]))
    wait(vials, 120, np.full(2, -100.0))
    e, p = rates(33.0)
    lag = 1 / 30
    np.testing.assert_allclose(vials.cells[0, 0], 0.5 * np.exp(1.9 * e + 0.1 * e * lag), rtol=1e-4)
    np.testing.assert_allclose(vials.cells[1, 1], 0.5 * np.exp(2 * p), rtol=1e-10)
    both = still(33.0, 1.0, bottle_swap=1.0)
    wait(both, 120)
    np.testing.assert_allclose(both.cells[1], 0.5 * np.exp(p * (2.1 - 0.1 * (1 - np.exp(-1)))), rtol=1e-5)


def test_draws_have_their_moments() -> None:
    many = draw(20_000, 0)
    normal = {"offset_c": (0, 0.2), "scale_e": (1, 0.1), "scale_p": (1, 0.1), "flow": (1, 0.05),
              "factor_error": (0, 1), "bias_error": (0, 1)}  # fmt: skip
    for name, (mean, sd) in normal.items():
        assert getattr(many, name).mean() == pytest.approx(mean, abs=4 * sd / 141), name
        assert getattr(many, name).std() == pytest.approx(sd, rel=0.03), name
    flat = {"dose_spread": (0.1, 0.2), "light": (0.75, 1.19), "bias": (151, 339), "cooling_min": (30, 60),
            "ambient_c": (18, 26), "start_share": (0.02, 0.98)}  # fmt: skip
    for name, (low, high) in flat.items():
        values = getattr(many, name)
        assert low <= values.min() < values.max() <= high, name
        assert values.mean() == pytest.approx((low + high) / 2, abs=0.01 * (high - low)), name
        assert values.std() == pytest.approx((high - low) / np.sqrt(12), rel=0.02), name
    assert min(many.scale_e.min(), many.scale_p.min()) >= 0.7
    assert max(many.scale_e.max(), many.scale_p.max()) <= 1.3
    drawn = np.stack([getattr(many, name) for name in (*normal, *flat)])
    assert np.abs(np.corrcoef(drawn) - np.eye(len(drawn))).max() < 0.03


def test_draws_are_repeated_and_fields_replaced() -> None:
    first, fixed = draw(5, 3), draw(5, 3, offset_c=0.5, calibrated=True)
    assert np.all(fixed.offset_c == 0.5)
    np.testing.assert_array_equal(first.scale_p, fixed.scale_p)
    assert not np.array_equal(first.scale_p, draw(5, 4).scale_p)
    np.testing.assert_array_equal(replace(nominal(3), scale_e=0.8).scale_e, [0.8] * 3)


def test_calibration_is_told_with_its_error() -> None:
    _, told = held(draw(4, 0, calibrated=True, factor_error=1.0, bias_error=-1.0, light=0.9, bias=250.0), 0.1)
    factor, factor_sd, offset, offset_sd = told.calibration
    np.testing.assert_allclose(factor, 0.9 * 1.02)
    np.testing.assert_allclose(factor_sd, 0.02 * factor)
    np.testing.assert_allclose(offset, 245.0)
    assert offset_sd == 5.0
    assert not hasattr(held(draw(4, 0), 0.1)[1], "calibration")


def test_programs_announce_changes() -> None:
    steps = PROGRAMS["ratio_steps"]
    assert steps.ahead(0) == (0.5, 0.3, 60)
    assert steps.ahead(59) == (0.5, 0.3, 1)
    assert steps.ahead(60) == (0.3, 0.7, 360)
    assert steps.ahead(420) == (0.7, 0.7, 0)
    assert steps.ahead(660) == (0.7, 0.3, 360)
    assert steps.ahead(1020 + 239) == (0.3, 0.3, 0)
    assert steps.ahead(1020 + 240) == (0.3, 0.5, 360)
    assert steps.ahead(1620) == (0.5, 0.3, 60)
    once = replace(steps, repeats=False)
    assert once.ahead(1500) == once.ahead(5000) == (0.3, 0.3, 0)
    assert PROGRAMS["hold"].ahead(1234) == (0.5, 0.5, 0)
    assert PROGRAMS["quick"].ahead(470) == (0.5, 0.3, 10)
    assert PROGRAMS["quick"].ahead(779) == (0.6, 0.4, 1)
    assert Program(((100, 0.4), (50, 0.4), (50, 0.6))).ahead(20) == (0.4, 0.6, 130)
    wanted = PROGRAMS["small_steps"].wanted(230, 3)
    for values, value in ((wanted.setpoint, 0.5), (wanted.following, 0.55), (wanted.minutes, 10)):
        np.testing.assert_array_equal(values, [value] * 3)


def test_the_order_of_a_minute() -> None:
    trace, told = held(nominal(2), 1, samples=(0.5,), sample_sd=0.0)
    kinds = [kind for kind, _ in told.tape if kind != "sample"]
    assert kinds == ["watch", "act", "dosed"] * 60
    assert told.tape.index(("sample", 30.0)) == 30 * 3 + 1
    np.testing.assert_array_equal(told.sampled, trace.share[30])
    fall = np.flatnonzero(trace.true_ml[:, 0])[0]  # the dose after a row shows in the next one
    assert np.log(trace.od[fall + 1, 0] / trace.od[fall, 0]) == pytest.approx(0.015 - 0.06, abs=0.06)
    counts = trace.counts[:, 0]
    assert counts[fall + 1] - counts[fall] == pytest.approx(-0.045 * (counts[fall] - 214), abs=150)


def test_laws_share_their_luck() -> None:
    warm, cold = held(nominal(3), 1, 34.0)[0], held(nominal(3), 1, 30.0)[0]
    np.testing.assert_allclose(warm.thermometer - warm.temperature, cold.thermometer - cold.temperature, atol=1e-12)
    again, other = held(nominal(3), 1, 34.0)[0], held(nominal(3), 1, 34.0, seed=1)[0]
    np.testing.assert_array_equal(again.od, warm.od)
    assert not np.array_equal(other.od, warm.od)


def test_figures_of_merit() -> None:
    trace, _ = held(Conditions(2, start_share=[0.5, 0.9]), 36)
    assert coverage(trace).shape == (2, 2)
    inside = np.abs(trace.share - 0.5) <= 0.1
    np.testing.assert_allclose(coverage(trace)[0], inside[:1440].mean(0))
    np.testing.assert_allclose(coverage(trace)[1], inside[1440:].mean(0))
    np.testing.assert_allclose(tracking_error(trace)[1], np.abs(trace.share[1440:] - 0.5).mean(0))
    np.testing.assert_allclose(estimate_error(trace), tracking_error(trace))


def test_the_loop_with_the_package_s_estimator() -> None:
    estimator = CompositionEstimator(CompositionEstimatorConfig())
    trace = run(nominal(8), estimator, Proportional(ProportionalConfig()), PROGRAMS["ratio_steps"], 12)
    assert np.isfinite(trace.estimate).all()
    assert estimate_error(trace).mean() < 0.05
