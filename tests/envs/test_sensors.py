"""The sensor against its formula and against the frequencies it is configured with."""

import itertools

import numpy as np
import pytest
from numpy.typing import NDArray

from envs.plant.sensor import OdSensor, SensorConfig, counts_from_od, od_from_counts

Array = NDArray[np.float64]


def sensor(config: SensorConfig, n: int, seed: int = 0) -> OdSensor:
    rng = np.random.default_rng(seed)
    return OdSensor(config, rng.spawn(n), rng.spawn(n))


def readings(config: SensorConfig, od: float, n: int = 400, m: int = 400) -> Array:
    """m readings of n sensors at a constant OD, shape (m, n)."""
    s = sensor(config, n)
    return np.array([s.read(np.full(n, od), np.zeros(n), 0.0) for _ in range(m)])


def test_counts_invert_the_devices_formula() -> None:
    od = np.linspace(-0.1, 3.0, 50)
    np.testing.assert_allclose(od_from_counts(counts_from_od(od, 14000.0), 14000.0), od, atol=1e-12)
    # By hand: raw = blank / 10 is R = 1, OD = 1.833 + 0.226.
    assert od_from_counts(np.array([1400.0]), 14000.0)[0] == pytest.approx(2.059)
    # What the quadratic term adds at four ODs, in percent of the linear part (docs/biology.md, Sensor).
    ratio = np.array([0.1, 0.25, 0.4, 0.5])
    linear = 1.833 * ratio
    added = 100.0 * (od_from_counts(14000.0 * 10.0**-ratio, 14000.0) / linear - 1.0)
    np.testing.assert_allclose(added, [1.2, 3.1, 4.9, 6.2], atol=0.06)


@pytest.mark.parametrize("od", [0.2, 0.5, 1.0])
def test_noise_has_the_configured_size_and_memory(od: float) -> None:
    r = readings(SensorConfig(noise_floor=0.0033, noise_relative=0.003, lag1=0.12), od)[5:]
    assert r.mean() == pytest.approx(od, abs=5e-5)
    assert r.std() == pytest.approx(np.hypot(0.0033, 0.003 * od), rel=0.01)
    d = r - od
    assert np.mean(d[1:] * d[:-1]) / d.var() == pytest.approx(0.12, abs=0.01)


def test_noise_swings_as_far_and_as_long_as_configured() -> None:
    """Over thousands of sensors the log of a local sd spreads by noise_swing_sd and forgets in noise_swing_min."""
    rough = SensorConfig(noise_floor=0.004, noise_swing_sd=0.4, noise_swing_min=60.0)
    log_square = np.log(np.square(readings(rough, 0.5, n=4000, m=61) - 0.5))
    own = np.pi**2 / 2  # variance of ln z^2, z normal: what remains without a swing
    assert log_square.var() == pytest.approx(own + 4 * 0.4**2, rel=0.02)
    for apart in (1, 60):  # covariance between readings so many minutes apart
        first, last = log_square[0], log_square[apart]
        assert np.cov(first, last)[0, 1] == pytest.approx(4 * 0.4**2 * np.exp(-apart / 60), abs=0.25)


def test_outliers_come_as_often_and_as_high_as_configured() -> None:
    d = readings(SensorConfig(outlier_rate=0.006), 0.5) - 0.5
    hit = np.abs(d) > 1e-9
    assert hit.mean() == pytest.approx(0.006, rel=0.1)
    assert np.abs(d[hit]).min() >= 0.04
    assert (d[hit] > 0).mean() == pytest.approx(0.54, abs=0.05)


def test_bubbles_last_one_to_five_readings_at_one_height() -> None:
    d = readings(SensorConfig(bubble_rate=0.002), 0.5) - 0.5
    lengths = []
    for column in d.T:
        edges = np.flatnonzero(np.diff(np.concatenate([[0.0], column, [0.0]])) != 0.0)
        for start, stop in itertools.pairwise(edges):
            if column[start] != 0.0:
                assert 0.05 <= column[start] <= 0.3
                lengths.append(stop - start)
    assert len(lengths) == pytest.approx(0.002 * d.size, rel=0.15)
    assert np.mean(lengths) == pytest.approx(3.0, abs=0.25)
    assert set(lengths) <= {1, 2, 3, 4, 5}


def test_zeros_come_as_often_as_configured() -> None:
    r = readings(SensorConfig(noise_floor=0.003, zero_rate=0.005), 0.5, m=100)
    assert (r == 0.0).mean() == pytest.approx(0.005, rel=0.3)


def test_a_reading_that_freezes_is_repeated_5_to_30_times_each_number_as_likely() -> None:
    r = readings(SensorConfig(noise_floor=0.003, freeze_rate=0.02), 0.5)
    repeated = np.zeros((r.shape[0] + 1, r.shape[1]), dtype=bool)
    repeated[1:-1] = np.diff(r, axis=0) == 0.0
    lengths = []
    for column in repeated[:-1].T:
        edges = np.flatnonzero(np.diff(column.astype(int)))
        lengths += (edges[1::2] - edges[: len(edges) // 2 * 2 : 2]).tolist()  # without one that lasts to the end
    assert set(lengths) == set(range(5, 31))
    assert np.mean(lengths) == pytest.approx(17.5, abs=0.7)
    starts = len(lengths) / (~repeated[:-30]).sum()  # only a reading that is not frozen can freeze
    assert starts == pytest.approx(0.02, rel=0.1)


def test_frozen_switch_repeats_exactly_and_thaws() -> None:
    s = sensor(SensorConfig(noise_floor=0.01), 2)
    od = np.full(2, 0.5)
    last = s.read(od, np.zeros(2), 0.0)
    s.frozen[1] = True
    for k in range(5):
        now = s.read(od + 0.1 * k, np.zeros(2), 0.0)
        assert now[1] == last[1]
        assert now[0] != last[0]
    s.frozen[1] = False
    assert s.read(od, np.zeros(2), 0.0)[1] != last[1]


def test_offsets_slope_curvature_drift_and_wall_add_up() -> None:
    config = SensorConfig(gain_cv=0.07, curvature=-0.1, blank_error=0.01, drift_per_h=0.002, wall_gain=0.2)
    s = sensor(config, 2000)
    od, wall = np.full(2000, 0.8), np.full(2000, 0.1)
    s.extra_offset[0] = 0.05
    k, c, b = (s.draws[f"sensor_{x}"] for x in ("gain", "curvature", "offset"))
    expected = k * (0.8 + c * 0.64) + b + 0.02 + 0.002 * 2.0
    expected[0] += 0.05
    np.testing.assert_allclose(s.apparent(od, wall, 120.0), expected)
    assert k.std() == pytest.approx(0.07, rel=0.06)
    assert c.min() >= -0.1
    assert c.max() <= 0.0
    assert np.abs(b).max() <= 0.01


def test_counts_are_whole() -> None:
    s = sensor(SensorConfig(noise_floor=0.003, quantised=True, blank_cv=0.18), 50)
    value = s.read(np.full(50, 0.5), np.zeros(50), 0.0)
    raw = counts_from_od(value, np.round(s.draws["sensor_blank_counts"]))
    np.testing.assert_allclose(raw, np.round(raw), atol=1e-6)
