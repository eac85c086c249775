"""How often an estimate was as near to the truth as it said: truth of a vial, two standard deviations, the counts."""

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from envs.bench import Bench
from envs.plant.plant import Plant
from envs.scenario import Scenario
from envs.task import EnvConfig
from experiments.comparison.statistics import totals
from experiments.comparison.trials import Cell, run_trial
from experiments.loop.signals import Density, within_2sd
from hardware.emulator.device import plant_preset
from tests.experiments.test_statistics import trial


class Told:
    """Doses the share at rest; says that a supervisor acts wherever it was not asked, and e to be `off` too high."""

    def __init__(self, off: float = 0.0) -> None:
        self.off = off

    def reset(self, n: int) -> None:
        self._asked, self._od, self._setpoint = np.zeros(n, dtype=bool), np.zeros(n), np.ones(n)

    def act(self, od: Any, setpoint: Any, minute: Any, rows: Any) -> Any:
        self._asked, self._od, self._setpoint = rows, od, setpoint
        return np.full(len(od), 0.01)

    def explain(self) -> dict[str, Any]:
        n = len(self._od)
        with np.errstate(divide="ignore", invalid="ignore"):
            error = np.log(self._od / self._setpoint) / 0.06 + self.off
        estimates = {"error": error, "growth_share": np.full(n, 0.5), "supervised": 1.0 - self._asked}
        return estimates | dict.fromkeys(("error_sd", "growth_share_sd"), np.full(n, 0.1))


@pytest.mark.parametrize("flow", [1.0, 0.5])
def test_a_smaller_vial_rests_at_the_same_share_of_its_own_largest_rate(flow: float) -> None:
    """0.03 1/min of 0.06: 1.2 mL a minute from 20 mL, and 0.72 from 12; also by a pump of half the flow."""
    volumes, bench = np.array([12.0, 20.0]), Bench()
    preset = plant_preset("nominal")
    plant = Plant(replace(preset, pump=replace(preset.pump, gain_ml_s=flow)), 2, np.random.default_rng(0), volumes)
    law = Told()
    law.reset(2)
    density = Density(law, volumes / 20.0, bench.max_rate)
    density.known(plant, flow, bench)
    assert density.truth is not None
    error, share = density.truth(np.array([0.4, 0.6]))
    np.testing.assert_allclose(share, 0.5, rtol=1e-9)
    np.testing.assert_allclose(error, np.log(plant.apparent_od / [0.4, 0.6]) / 0.06, rtol=1e-9)


def test_a_dose_is_told_by_what_it_is_of_the_bench_s_vial() -> None:
    """.7 mL into 14 mL dilute as 1 mL into 20; what a tube kept counts as well."""
    told: list[Any] = []
    law: Any = SimpleNamespace(dosed=lambda ml: told.append(ml.tolist()), restore=None)
    Density(law, np.array([0.7, 1.0])).dosed(np.array([0.7, 0.7]), np.array([0.14, 0.2]), np.array([1, 1]))
    assert told == [pytest.approx([1.2, 0.9])]


def test_another_period_has_another_full_pump() -> None:
    """2 min of 0.01 mL/s are as much as 1 min of 0.02; growth in 2 min is twice as much: 0.06 of 0.06."""
    bench = Bench(period_s=120.0, max_rate=0.01)
    plant = Plant(plant_preset("nominal"), 1, np.random.default_rng(0))
    density = Density(Told(), 1.0, bench.max_rate)
    density.known(plant, 1.0, bench)
    assert density.truth is not None
    np.testing.assert_allclose(density.truth(np.array([0.5]))[1], 1.0, rtol=1e-9)


def test_two_standard_deviations_count_on_either_side() -> None:
    off = np.array([-2.1, -1.9, 0.0, 1.9, 2.1, np.nan])
    why = {"error": 0.3 + 0.1 * off, "error_sd": np.full(6, 0.1), "true_error": np.full(6, 0.3)}
    np.testing.assert_array_equal(within_2sd(why)["error"], [0.0, 1.0, 1.0, 1.0, 0.0, np.nan])
    assert list(within_2sd(why)) == ["error"], "the truth of the other is not known"


@pytest.mark.parametrize(("off", "inside"), [(0.0, 1.0), (-0.19, 1.0), (-0.21, 0.0), (0.21, 0.0)])
def test_decisions_are_counted_from_where_the_schedule_begins(off: float, inside: float) -> None:
    """The culture grows for some minutes to 0.5 first, in which the law is not asked."""
    schedule = Scenario((0.5,), (20.0,), (37.0,), recovery_od=0.5)
    preset = replace(plant_preset("nominal"), start_od=0.4)
    found = run_trial(Cell("told", "nominal", "hold"), preset, schedule, lambda _: Told(off), EnvConfig(), 3, 0)
    np.testing.assert_array_equal(found.told["supervised"], [0.0] * 3)
    np.testing.assert_allclose(found.told["error"], inside)
    np.testing.assert_allclose(found.told["growth_share"], 1.0)


def test_totals_tell_the_mean_over_vials_in_per_cent() -> None:
    told = {"supervised": np.array([0.0, 0.0, 0.3]), "growth_share": np.array([1.0, 1.0, 0.7])}
    [found] = totals([replace(trial(error=(0.1, 0.2, 0.6)), told=told)])
    assert found["supervised_pct"] == pytest.approx(10.0)
    assert found["share_2sd_pct"] == pytest.approx(90.0)
    assert "error_2sd_pct" not in found
