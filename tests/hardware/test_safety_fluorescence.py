"""What the interlock says of fluorescence, and of the temperatures a composition controller asks for."""

import json

import numpy as np
import pytest

from hardware.actuator import THERMOSTAT
from hardware.reactor import Measurement
from hardware.safety.config import Response, Responses, SafetyConfig
from hardware.safety.interlock import Interlock, Ruling

NAN = np.nan


class Bench:
    """An interlock of N reactors that hold OD 0.5 and are not dosed, a sample a minute."""

    def __init__(self, n: int = 1, **config) -> None:
        self.n, self.minute = n, 0
        self.interlock = Interlock(n, SafetyConfig(mu_max=0.04, **config))

    def step(self, *counts: float | None, fresh: bool = True) -> tuple[np.ndarray | None, Ruling]:
        """Believed counts and verdict of a sample with these counts; None: fluorescence is not measured."""
        self.minute += 1
        light = None if counts == (None,) else np.array(counts, dtype=float)
        od = np.full(self.n, 0.5 + 1e-4 * (self.minute % 7))
        rows = np.full(self.n, fresh)
        m = Measurement(np.full(self.n, 60.0 * self.minute), od, np.full(self.n, 33.0), rows, None, light)
        believed = self.interlock.fluorescence(m)
        zero, setpoint = np.zeros(self.n), np.full(self.n, 0.5)
        return believed, self.interlock.check(m, zero, setpoint, np.full(self.n, 33.0), 60.0 * self.minute)


@pytest.mark.parametrize("counts", [0.0, 65535.0, NAN])
def test_what_no_working_sensor_gives_is_not_believed_and_said(counts) -> None:
    believed, verdict = Bench().step(None)  # where it is not measured nothing is said
    assert (believed, verdict.reasons) == (None, [None])
    believed, verdict = Bench(2).step(1500.0, 1.0)
    np.testing.assert_array_equal(believed, [1500.0, 1.0])
    assert verdict.reasons == [None, None]
    believed, verdict = Bench(2).step(1500.0, counts)
    np.testing.assert_array_equal(believed, [1500.0, NAN])
    assert verdict.kinds == ((), ("fluorescence",))
    np.testing.assert_equal(verdict.faults[1][0].fields, {"counts": counts, "samples": 1.0})
    assert verdict.response.tolist() == [Response.PASS, Response.PASS]


@pytest.mark.parametrize(("config", "n"), [({}, 5), *(({"frozen_light": n}, n) for n in (2, 3, 9))])
def test_the_same_reading_is_believed_until_the_nth(config: dict[str, int], n: int) -> None:
    bench = Bench(2, **config)
    seen = [bench.step(1500.0, 700.0 + k) for k in range(n + 1)]
    assert [np.isfinite(believed).tolist() for believed, _ in seen] == [[True, True]] * (n - 1) + [[False, True]] * 2
    assert seen[n - 1][1].faults[0][0].fields == {"counts": 1500.0, "samples": n}
    believed, verdict = bench.step(1501.0, 701.0)
    assert believed.tolist() == [1501.0, 701.0]
    assert verdict.reasons == [None, None]


def test_the_least_light_is_that_which_is_set() -> None:
    for least, passes in ((1.0, True), (50.0, False)):
        assert np.isfinite(Bench(light_min=least).step(40.0)[0][0]) == passes


def test_a_row_that_is_not_fresh_is_neither_believed_nor_counted() -> None:
    bench = Bench()
    bench.step(1500.0)
    for _ in range(6):
        believed, verdict = bench.step(1500.0, fresh=False)
        assert np.isnan(believed[0])
        assert "fluorescence" not in verdict.kinds[0]
    assert bench.step(1500.0)[0][0] == 1500.0


def test_after_a_quarter_of_an_hour_it_is_lost_until_it_comes_back() -> None:
    bench = Bench()
    bench.step(1500.0)
    kinds = [bench.step(0.0)[1].kinds[0] for _ in range(17)]
    assert kinds == [("fluorescence",)] * 15 + [("fluorescence_lost",)] * 2
    assert bench.step(1400.0)[1].kinds == ((),)
    assert bench.step(0.0)[1].kinds == (("fluorescence",),)


def test_one_that_never_came_is_lost_too() -> None:
    bench = Bench(light_lost=3.0)
    kinds = [bench.step(NAN)[1].kinds[0] for _ in range(5)]
    assert kinds == [("fluorescence",)] * 4 + [("fluorescence_lost",)]


def test_it_may_be_declared_to_hold() -> None:
    bench = Bench(light_lost=1.0, responses=Responses(fluorescence_lost="hold"))
    bench.step(1500.0)
    assert [bench.step(0.0)[1].response[0] for _ in range(2)] == [Response.PASS, Response.HOLD]


def test_a_resumed_run_remembers_repeats_and_silence() -> None:
    bench = Bench(light_lost=3.0)
    for _ in range(5):
        bench.step(1500.0)
    bench.minute = 6
    state = json.loads(json.dumps(bench.interlock.state()).replace("-Infinity", "null").replace("NaN", "null"))
    bench.interlock = Interlock(1, bench.interlock.config)
    bench.interlock.restore(state)
    believed, verdict = bench.step(1500.0)
    assert np.isnan(believed[0])
    assert verdict.reasons[0].count("the same in 6 samples") == 1


def test_a_temperature_is_cut_to_the_limits_and_that_is_said_once() -> None:
    bench = Bench(5)
    asked = np.array([20.0, 29.0, 33.2, 37.5, NAN])
    np.testing.assert_array_equal(bench.interlock.command(THERMOSTAT, asked), [29.0, 29.0, 33.2, 36.0, NAN])
    _, verdict = bench.step(*[1500.0] * 5)
    cut = ("command_limit",)
    assert verdict.kinds == (cut, (), (), cut, ())
    assert "thermostat: 37.5 degC asked, allowed 29 to 36" in str(verdict.reasons[3])
    assert bench.step(*[1600.0] * 5)[1].kinds == ((),) * 5


def test_limits_of_the_temperature_are_settings() -> None:
    interlock = Interlock(2, SafetyConfig(composition_low=30.0, composition_high=34.0))
    np.testing.assert_array_equal(interlock.command(THERMOSTAT, np.array([-np.inf, np.inf])), [30.0, 34.0])
    with pytest.raises(ValueError, match=r"safety\.composition_high = 30\.0: allowed 31 to 42"):
        SafetyConfig(composition_low=31.0, composition_high=30.0)
