"""The window of a calibration in recordings as other labs have them: failing feeds, odd rows, growth without doses."""

import numpy as np
import pytest

from envs.identification.calibration import IdentifyConfig, calibrate
from envs.identification.model import NotIdentifiable
from envs.identification.screening import WEEK_MIN, Series, merged

pytestmark = pytest.mark.numeric

MU, TAU = 0.009, 0.27


def culture(
    rate: np.ndarray, mu: np.ndarray | float = MU, works: np.ndarray | float = 1.0, noise: float = 0.01
) -> Series:
    """A culture by the minute under recorded pump rates, of which the share `works` reaches the vial."""
    rise = mu * np.ones(rate.size) - works * rate / TAU
    log_od = np.log(0.4) + np.concatenate([[0.0], np.cumsum(rise[:-1])])
    od = np.exp(log_od) * (1.0 + noise * np.random.default_rng(5).standard_normal(rate.size))
    return Series(np.arange(float(rate.size)), od, rate, np.arange(rate.size))


def doses(minutes: int, every: int = 50, share: float = 0.2) -> np.ndarray:
    """Pulses that balance growth on average."""
    return np.where(np.arange(minutes) % every < share * every, MU * TAU / share, 0.0)


def test_a_window_ends_where_the_feed_fails() -> None:
    """From row 960 on the pump is recorded at twice its mean, but nothing reaches the vial, and cells die."""
    rate = np.concatenate([doses(960), np.full(360, 2.0 * MU * TAU)])
    minute = np.arange(rate.size)
    mu = np.select([minute < 960, minute < 1100], [MU, 0.0], -0.002)
    raw = culture(rate, mu, np.where(minute < 960, 1.0, 0.0))
    found = calibrate(raw)
    assert found.window[1] <= 960
    assert found.tau.value == pytest.approx(TAU, rel=0.05)
    with pytest.raises(NotIdentifiable):
        calibrate(raw, IdentifyConfig(window="all"))


def test_a_window_holds_doses() -> None:
    """Growth alone lasts longer; an hour's pause parts it from the dosed rows."""
    grown = culture(np.zeros(500), 0.001)
    dosed = culture(doses(330))
    whole = Series(
        np.concatenate([grown.time, 560.0 + dosed.time]),
        np.concatenate([grown.od, dosed.od]),
        np.concatenate([grown.pump_rate, dosed.pump_rate]),
        np.arange(830),
    )
    found = calibrate(whole)
    assert found.window == (500, 830)
    assert found.tau.value == pytest.approx(TAU, rel=0.05)


@pytest.mark.parametrize("odd", [0.9, 0.0])
def test_two_odd_rates_refuse_no_recording_and_tell_no_tau(odd: float) -> None:
    rate = doses(330)
    rate[[7, 209]] = odd
    works = np.ones(330)
    works[[7, 209]] = 0.003 if odd else 1.0
    assert calibrate(culture(rate, works=works)).tau.value == pytest.approx(TAU, rel=0.2)
    level = np.full(330, 0.003)
    level[[7, 209]] = odd
    with pytest.raises(NotIdentifiable):
        calibrate(culture(level))


def test_a_merged_minute_keeps_the_order_of_reading_and_dose() -> None:
    """One reading a minute, at second 6 or 54, and a dose of 3 s at second 30: x is the model's at every row."""
    n = 3 * WEEK_MIN
    time, second = np.arange(n) / 20.0, np.arange(n) % 20 * 3
    rate = np.where(second == 30, 0.05, 0.0)
    log_od = 0.3 * MU * time - np.concatenate([[0.0], np.cumsum(rate[:-1] / 20.0)]) / TAU
    early = (time // 1.0) % 7 < 3
    od = np.where(second == np.where(early, 6, 54), np.exp(log_od), np.nan)
    found = merged(Series(time, od, rate, np.arange(n)))
    volume = np.concatenate([[0.0], np.cumsum(found.pump_rate[:-1] * np.diff(found.time))])
    left = np.log(found.od) - 0.3 * MU * found.time + volume / TAU
    np.testing.assert_allclose(left, left[0], atol=1e-9)
