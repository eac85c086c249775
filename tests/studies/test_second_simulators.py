"""The second simulators, of recordings and of two species: closed forms, and whole runs by their numbers."""

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from tests.studies import second_simulator
from tests.studies.second_simulator import LAWS, simulate
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
    run,
)

pytestmark = pytest.mark.slow

QUIET = second_simulator.Conditions(hours=2, wander=0, dose_spread=0, noise=0)
NEVER, ALWAYS = 1e9, 1e-9  # setpoints at which a threshold never or always pumps


def test_constant_rates_give_an_exponential() -> None:
    for setpoint, net in ((NEVER, 0.03), (ALWAYS, 0.03 - 0.02 * 3)):
        made = simulate(replace(QUIET, law="threshold", setpoint=setpoint), 2, 0)
        np.testing.assert_allclose(made.od[0], 0.5 * np.exp(net * made.time), rtol=1e-11)
        np.testing.assert_allclose(made.growth, 0.03, rtol=1e-12)


OTHER = second_simulator.Conditions(
    hours=10, mu=0.028, tau=0.4, wander=0.1, wander_min=20.0, dose_spread=0.2, noise=0.02, noise_correlation=0.4,
    late_share=0.25, setpoint=0.6,
)  # fmt: skip
RECORDINGS = {  # mean and sd of readings and of rates, of five recordings
    "pi": (0.601673429, 0.0178603918, 0.01098092, 0.00333530045),
    "tuned_pi": (0.601898998, 0.0196997753, 0.0109787657, 0.00236472403),
    "threshold": (0.602240993, 0.0176406061, 0.0109750416, 0.00995235117),
    "proportional": (0.609525078, 0.0187963599, 0.0109530147, 0.00187656274),
    "setpoint_steps": (0.653140043, 0.123196842, 0.0111002567, 0.00451431417),
    "open_loop": (0.605708275, 0.310501575, 0.0101946755, 0.0067418803),
    "random": (0.79937611, 0.24651744, 0.0106751619, 0.00539469388),
}


@pytest.mark.parametrize("law", sorted(LAWS))
def test_recordings_are_those_of_the_results_on_the_pages_and_rates_are_bounded(law: str) -> None:
    made = simulate(replace(OTHER, law=law), 5, 6)
    found = (made.od.mean(), made.od.std(), made.pump_rate.mean(), made.pump_rate.std())
    assert found == pytest.approx(RECORDINGS[law], rel=1e-6)
    assert made.od.shape == made.pump_rate.shape == (5, 601)
    assert made.pump_rate.min() >= 0
    assert made.pump_rate.max() <= 0.02
    assert (made.growth.mean(), made.growth.std()) == pytest.approx((0.0276239098, 0.000634965754), rel=1e-6)


def test_recordings_without_a_word_are_those_of_the_pages() -> None:
    made = simulate(second_simulator.Conditions(), 5, 6)
    found = (made.od.mean(), made.od.std(), made.pump_rate.mean(), made.pump_rate.std())
    assert found == pytest.approx((0.502748409, 0.0093504282, 0.00986099303, 0.00181733727), rel=1e-6)


def test_the_device_s_pi_holds_each_third_at_its_level() -> None:
    stepped = simulate(replace(QUIET, law="setpoint_steps", hours=9), 1, 0)
    np.testing.assert_allclose(stepped.od[0, [179, 359, 539]], [0.8, 0.65, 0.5], rtol=0.01)


class Told:
    """An estimator and a law in one that hold a target and write down what they are told."""

    def __init__(self, target: Any) -> None:
        self.target, self.tape = target, list[tuple[str, float]]()

    def reset(self, n: int) -> None:
        self.n = n

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
        self.tape.append(("act", float(minute[0])))
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
    valid = np.clip(temperature, 29, 36)
    paper = 0.07727 * valid - 1.66954, -0.02208 * valid**2 + 1.3796 * valid - 20.56996  # 1/h
    for species, scale in enumerate((0.8, 1.1)):
        vials = Vials(
            Conditions(1, start_c=temperature, ambient_c=temperature, start_share=species, scale_e=0.8, scale_p=1.1)
        )
        for _ in range(150):
            vials.pass_minute(np.full(1, -100.0), np.full(1, dose), np.zeros((STEPS + 1, 1)))
        growth = 2.5 * scale * paper[species] - 150 * dose / 20
        np.testing.assert_allclose(vials.cells[species], 0.5 * np.exp(growth), rtol=1e-10)
        assert vials.cells[1 - species] == 0


PINNED = {  # mean and sd of every column that moves
    "share": (0.294048, 0.346023845),
    "temperature": (33.567929, 4.17421614),
    "thermometer": (33.6231019, 3.97845826),
    "od": (0.48594126, 0.03271656),
    "counts": (950.381308, 854.632847),
    "setpoint": (0.480769231, 0.0734806661),
    "told_ml": (0.261282051, 0.495247566),
    "true_ml": (0.290294912, 0.711057446),
}


def test_drawn_vials_are_those_of_the_results_on_the_pages() -> None:
    """A day and two hours, two vials too warm for pigment and one too cold to grow well, other bottles in two of them,
    doses that spread until some are none, and light that walks."""
    drawn = draw(3, 4, calibrated=True, dose_spread=0.9, light_walk=0.1, bottle_swap=[np.nan, 5.0, 20.0])
    told = Told(np.array([36.5, 36.5, 28.0]))
    trace = run(drawn, told, told, PROGRAMS["quick"], 26, seed=5, samples=(3.0,))
    assert trace.true_ml[trace.told_ml > 0.0].min() == 0.0
    for name, (mean, sd) in PINNED.items():
        values = getattr(trace, name)
        assert (values.mean(), values.std()) == pytest.approx((mean, sd), rel=1e-6), name
    factor, factor_sd, offset, offset_sd = told.calibration
    np.testing.assert_allclose(factor, [0.906405694, 1.18127512, 1.12437304], rtol=1e-6)
    np.testing.assert_allclose(factor_sd, 0.02 * factor)
    np.testing.assert_allclose(offset, [189.332284, 266.357671, 288.548856], rtol=1e-6)
    np.testing.assert_allclose(told.sampled, [0.715611531, 0.214191577, 0.307977925], rtol=1e-6)
    assert offset_sd == 5.0
    assert not hasattr(held(draw(4, 0), 0.1)[1], "calibration")
    np.testing.assert_allclose(coverage(trace).mean(1), [0.0863425926, 0], rtol=1e-6)
    np.testing.assert_allclose(estimate_error(trace).mean(1), [0.363613954, 0.488380542], rtol=1e-6)


def test_draws_fill_their_ranges_and_fields_are_replaced() -> None:
    many = draw(20_000, 0)
    ranges = {"dose_spread": (0.1, 0.2), "light": (0.75, 1.19), "bias": (151, 339), "cooling_min": (30, 60),
              "ambient_c": (18, 26), "start_share": (0.02, 0.98)}  # fmt: skip
    ranges |= dict.fromkeys(("scale_e", "scale_p"), (0.7, 1.3))
    for name, ends in ranges.items():
        values = getattr(many, name)
        assert (values.min(), values.max()) == pytest.approx(ends, rel=2e-3), name
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
    warm, other = held(nominal(2), 1, 34.0)[0], held(nominal(2), 1, seed=1)[0]
    np.testing.assert_allclose(warm.thermometer - warm.temperature, trace.thermometer - trace.temperature, atol=1e-12)
    assert not np.array_equal(other.od, trace.od)
