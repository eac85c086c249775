"""The second plant with two species does what its equations say."""

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from tests.studies.second_vials import (
    PROGRAMS,
    STEPS,
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
)

pytestmark = pytest.mark.slow  # of a yardstick, which no change of the program reaches
COLD = np.full(1, -100.0)  # a target that never heats


def rates(temperature: float) -> tuple[float, float]:
    """mu_e and mu_p of the paper, 1/h."""
    return 0.07727 * temperature - 1.66954, -0.02208 * temperature**2 + 1.3796 * temperature - 20.56996


def still(temperature: float, share: float = 0.5, **fixed: Any) -> Vials:
    """One vial that the room keeps at a temperature."""
    return Vials(Conditions(1, start_c=temperature, ambient_c=temperature, start_share=share, **fixed))


def wait(vials: Vials, minutes: int, target: np.ndarray = COLD, dose: float = 0.0) -> None:
    """Let minutes pass without noise."""
    for _ in range(minutes):
        vials.pass_minute(target, np.full(vials.c.n, dose), np.zeros((STEPS + 1, vials.c.n)))


def jump(vials: Vials, temperature: float) -> None:
    """Put the vial and its room at another temperature at once."""
    vials.c = replace(vials.c, ambient_c=temperature)
    vials.temperature = np.full(vials.c.n, temperature)


class Told:
    """An estimator and a law in one that hold a target and write down what they are told."""

    def __init__(self, target: float = 33.2) -> None:
        self.target = target

    def reset(self, n: int) -> None:
        self.n, self.tape = n, []

    def watch(self, od: Any, fluorescence: Any, temperature: Any, minute: Any, rows: Any) -> None:
        self.tape.append(("watch", float(minute[0])))
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


@pytest.mark.parametrize(("temperature", "dose"), [(27.0, 0.0), (33.2, 0.1), (36.0, 1.2), (38.0, 0.5)])
def test_one_species_grows_exponentially_and_is_washed_out(temperature: float, dose: float) -> None:
    for species, scale in enumerate((0.8, 1.1)):
        vials = still(temperature, float(species), scale_e=0.8, scale_p=1.1)
        wait(vials, 150, dose=dose)
        mu = scale * rates(np.clip(temperature, 29, 36))[species]
        np.testing.assert_allclose(vials.cells[species], 0.5 * np.exp(2.5 * mu - 150 * dose / 20), rtol=1e-10)
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


def test_pigment_is_made_late_in_balance_with_growth_and_down_to_a_floor() -> None:
    vials = still(32.0, 1.0)
    mu = rates(32.0)[1]
    wait(vials, 120)
    np.testing.assert_allclose(vials.pigment, production_steady(np.array(32.0)) * vials.cells[1] / mu, rtol=1e-5)
    curve = (44.49572512791427, 31.820479677943325, -917.5864128224449, -886.6854718162117, 6318.711894680335)
    for above in (0.0, 1.0, -1.5):
        assert production_steady(np.array(32.5 + above)) == pytest.approx(np.polyval(curve, above))
    vials = still(34.0)
    g0, g1 = production_steady(np.array([34.0, 33.0]))
    jump(vials, 33.0)
    wait(vials, 30)
    np.testing.assert_allclose(vials.production, g0 + 1.6 * 0.5 * (g1 - g0), rtol=1e-10)
    wait(vials, 30)
    late = g0 + 1.6 * (g1 - g0) - 1.6 * 1.6 * (g1 - g0) * 0.5**2 / 2
    np.testing.assert_allclose(vials.production, late, rtol=1e-10)
    jump(vials, 36.0)
    wait(vials, 120)
    assert vials.production == 20


PINNED = {  # mean and sd of every column that moves
    "share": (0.124725719, 0.21754624),
    "temperature": (34.8749745, 0.221407676),
    "thermometer": (34.9301474, 0.070622381),
    "od": (0.486589763, 0.0322700088),
    "counts": (452.066264, 321.80182),
    "told_ml": (0.288205128, 0.512624578),
    "true_ml": (0.316248983, 0.740961618),
}


def test_drawn_vials_are_those_of_the_results_on_the_pages() -> None:
    """A day and two hours at another target, with doses that spread until some are none, and light that walks."""
    drawn = draw(3, 4, calibrated=True, dose_spread=0.9, light_walk=0.1)
    trace, told = held(drawn, 26, 35.0, seed=5, samples=(3.0,))
    assert trace.true_ml[trace.told_ml > 0.0].min() == 0.0
    for name, (mean, sd) in PINNED.items():
        values = getattr(trace, name)
        assert (values.mean(), values.std()) == pytest.approx((mean, sd), rel=1e-6), name
    factor, factor_sd, offset, offset_sd = told.calibration
    np.testing.assert_allclose(factor, [0.906405694, 1.18127512, 1.12437304], rtol=1e-6)
    np.testing.assert_allclose(factor_sd, 0.02 * factor)
    np.testing.assert_allclose(offset, [189.332284, 266.357671, 288.548856], rtol=1e-6)
    np.testing.assert_allclose(told.sampled, [0.813913205, 0.318552851, 0.0800003066], rtol=1e-6)
    assert offset_sd == 5.0
    assert not hasattr(held(draw(4, 0), 0.1)[1], "calibration")
    np.testing.assert_allclose(coverage(trace).mean(1), [0.0229166667, 0], rtol=1e-6)
    np.testing.assert_allclose(estimate_error(trace).mean(1), [0.412424897, 0.497446449], rtol=1e-6)


def test_another_bottle() -> None:
    vials = Vials(Conditions(2, start_c=33.0, ambient_c=33.0, start_share=[0.0, 1.0], bottle_swap=[1.0, np.nan]))
    wait(vials, 120, np.full(2, -100.0))
    e, p = rates(33.0)
    np.testing.assert_allclose(vials.cells[0, 0], 0.5 * np.exp(1.9 * e + 0.1 * e / 30), rtol=1e-4)
    np.testing.assert_allclose(vials.cells[1, 1], 0.5 * np.exp(2 * p), rtol=1e-10)
    both = still(33.0, 1.0, bottle_swap=1.0)
    wait(both, 120)
    np.testing.assert_allclose(both.cells[1], 0.5 * np.exp(p * (2.1 - 0.1 * (1 - np.exp(-1)))), rtol=1e-5)


def test_draws_have_their_moments_and_fields_are_replaced() -> None:
    many = draw(20_000, 0)
    normal = {"offset_c": (0, 0.2), "scale_e": (1, 0.1), "scale_p": (1, 0.1), "flow": (1, 0.05),
              "factor_error": (0, 1), "bias_error": (0, 1)}  # fmt: skip
    flat = {"dose_spread": (0.1, 0.2), "light": (0.75, 1.19), "bias": (151, 339), "cooling_min": (30, 60),
            "ambient_c": (18, 26), "start_share": (0.02, 0.98)}  # fmt: skip
    moments = normal | {name: ((low + high) / 2, (high - low) / np.sqrt(12)) for name, (low, high) in flat.items()}
    for name, (mean, sd) in moments.items():
        assert getattr(many, name).mean() == pytest.approx(mean, abs=4 * sd / 141), name
        assert getattr(many, name).std() == pytest.approx(sd, rel=0.03), name
    for name, (low, high) in {**flat, "scale_e": (0.7, 1.3), "scale_p": (0.7, 1.3)}.items():
        assert low <= getattr(many, name).min() < getattr(many, name).max() <= high, name
    drawn = np.stack([getattr(many, name) for name in moments])
    assert np.abs(np.corrcoef(drawn) - np.eye(len(drawn))).max() < 0.03
    fixed = draw(20_000, 0, offset_c=0.5)
    assert np.all(fixed.offset_c == 0.5)
    np.testing.assert_array_equal(many.scale_p, fixed.scale_p)


def test_programs_announce_changes() -> None:
    ahead = {
        0: (0.5, 0.3, 60),
        59: (0.5, 0.3, 1),
        60: (0.3, 0.7, 360),
        420: (0.7, 0.7, 0),
        660: (0.7, 0.3, 360),
        1259: (0.3, 0.3, 0),
        1260: (0.3, 0.5, 360),
        1620: (0.5, 0.3, 60),
    }
    assert {minute: PROGRAMS["ratio_steps"].ahead(minute) for minute in ahead} == ahead
    assert PROGRAMS["hold"].ahead(1234) == (0.5, 0.5, 0)
    assert PROGRAMS["quick"].ahead(779) == (0.6, 0.4, 1)
    assert Program(((100, 0.4), (50, 0.4), (50, 0.6))).ahead(20) == (0.4, 0.6, 130)
    wanted = PROGRAMS["small_steps"].wanted(230, 3)
    for values, value in ((wanted.setpoint, 0.5), (wanted.following, 0.55), (wanted.minutes, 10)):
        np.testing.assert_array_equal(values, [value] * 3)


def test_the_order_of_a_minute_and_its_luck() -> None:
    trace, told = held(nominal(2), 1, samples=(0.5,), sample_sd=0.0)
    kinds = [kind for kind, _ in told.tape if kind != "sample"]
    assert kinds == ["watch", "act", "dosed"] * 60
    assert told.tape.index(("sample", 30.0)) == 30 * 3 + 1
    np.testing.assert_array_equal(told.sampled, trace.share[30])
    fall = np.flatnonzero(trace.true_ml[:, 0])[0]  # the dose after a row shows in the next one
    assert np.log(trace.od[fall + 1, 0] / trace.od[fall, 0]) == pytest.approx(0.015 - 0.06, abs=0.06)
    counts = trace.counts[:, 0]
    assert counts[fall + 1] - counts[fall] == pytest.approx(-0.045 * (counts[fall] - 214), abs=150)
    warm, other = held(nominal(2), 1, 34.0)[0], held(nominal(2), 1, seed=1)[0]
    np.testing.assert_allclose(warm.thermometer - warm.temperature, trace.thermometer - trace.temperature, atol=1e-12)
    assert not np.array_equal(other.od, trace.od)
