"""What is computed for N rows is what each row gives alone, in any order; and only flow over volume matters."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import gymnasium
import numpy as np
import pytest
from numpy.typing import NDArray

from conf import presets
from conf.schema import build
from envs.bench import Bench
from envs.coculture import task as coculture
from envs.gym_adapter import REGISTERED
from envs.identification.model import trajectory
from envs.identification.screening import pumped_volume
from envs.integrators import INTEGRATORS
from envs.plant import disturbance
from envs.plant.plant import Plant, PlantConfig
from envs.plant.sensor import counts_from_od, od_from_counts
from envs.plant.strains import response
from envs.relative import relative_reward
from envs.scenario import Scenario
from envs.task import EnvConfig, step_factors, tracking_reward
from envs.vector_env import BioreactorVectorEnv

Array = NDArray[np.float64]
Rows = list[int]

N = 5
DRAW = np.random.default_rng(7).uniform(size=(12, N))
"""Numbers in [0, 1) that differ from row to row."""


def between(low: float, high: float, k: int) -> Array:
    """The k-th of the rows' numbers on a range, (N,)."""
    return low + (high - low) * DRAW[k]


MU, TAU = between(0.01, 0.04, 0), between(0.2, 0.6, 1)
U, OD, WARM = between(0.0, 0.02, 4), between(0.1, 1.1, 5), between(4.0, 50.0, 6)
STATE = np.stack([OD, between(0.1, 1.0, 7)], axis=1)
HELD = between(29.0, 36.0, 8)
PREVIEW = coculture.CocultureConfig(preview_min=120.0)
SCENARIO = Scenario((0.3, 0.6, 0.9), (10.0, 25.0, 5.0), (30.0, 37.0, 33.0), ratios=(0.3, 0.7, 0.4))


def grown(name: str) -> Callable[[Rows], Any]:
    """Half an hour by an integrator."""
    return lambda rows: INTEGRATORS[name](lambda y: (MU - U / TAU)[rows, None] * y, STATE[rows], 30.0, 60)


def mixed(rows: Rows) -> tuple[Array, ...]:
    """Two hours of two species at targets of their own, with errors of their own."""
    start = coculture.at_rest(PREVIEW, coculture.logit(between(0.1, 0.9, 9))[rows], HELD[rows])
    errors = np.stack([between(-0.2, 0.2, 10), between(-0.2, 0.2, 11)], axis=1)[rows]
    goal = np.stack([between(-1.0, 1.0, 0), between(-1.0, 1.0, 1), between(0.0, 30.0, 2)], axis=1)[rows]
    after = coculture.advance(PREVIEW, start, between(29.0, 36.0, 3)[rows], 120.0, errors)
    return start, after, coculture.passed(PREVIEW, goal), coculture.share(after[:, 0]), PREVIEW.pair.rates(HELD[rows])


def courses(rows: Rows) -> tuple[Array, Array]:
    """Recordings on clocks of their own."""
    time = np.cumsum(np.random.default_rng(1).uniform(0.5, 1.5, (N, 40)), axis=1)[rows]
    rate = np.random.default_rng(2).uniform(0.0, 0.02, (N, 40))[rows]
    return trajectory(time, rate, MU[rows], TAU[rows], OD[rows]), pumped_volume(time, rate)


FUNCTIONS: dict[str, Callable[[Rows], Any]] = {
    "temperature": lambda rows: tuple(response(law, None, 48.0, 0)(WARM[rows]) for law in ("arrhenius", "cardinal")),
    **{name: grown(name) for name in INTEGRATORS},
    "counts": lambda rows: counts_from_od(OD[rows], between(9000.0, 20000.0, 8)[rows]),
    "od": lambda rows: od_from_counts(between(900.0, 20000.0, 9)[rows], between(9000.0, 20000.0, 8)[rows]),
    "step factors": lambda rows: step_factors(EnvConfig(integrator="rk4", substeps=3), U[rows]),
    "rewards": lambda rows: (tracking_reward(OD[rows], U[rows]), relative_reward(OD[rows])),
    "recordings": courses,
    "two species": mixed,
}


def episodes(name: str) -> Callable[[Rows], Any]:
    """Thirty steps of a task with episodes of seven, each copy with a seed and with actions of its own."""

    def run(rows: Rows) -> tuple[Array, ...]:
        whole = rows == list(range(N))
        env = gymnasium.make_vec(name, num_envs=len(rows), episode_steps=7)
        seen = [(env.reset(seed=40 if whole else [40 + i for i in rows])[0], np.zeros(len(rows)))]
        actions = np.random.default_rng(3).integers(0, 17, (30, N))
        seen += [env.step(action[rows])[:2] for action in actions]
        return np.stack([o for o, _ in seen], axis=1), np.stack([r for _, r in seen], axis=1)

    return run


def upset(plant: Plant) -> None:
    """Pumps deliver less while the culture is between 20 and 40 min old."""
    plant.feed.gain_factor[:] = np.where((plant.age_min >= 20.0) & (plant.age_min < 40.0), 0.6, 1.0)


def preset(name: str) -> PlantConfig:
    return build(PlantConfig(), presets.load(f"plant/{name}"))


def watched(p: Plant, size: float = 1.0) -> list[Array]:
    """All that a plant shows, each (N,); its volumes over a size."""
    shown = [p.culture.od, p.culture.wall, p.culture.substrate, p.read_od()]
    shown += [p.vessel.volume_ml / size, p.feed.delivered_ml / size]
    return [
        *shown,
        p.thermal.read(),
        p.read_fluorescence(),
        *p.at_rest(1.0, 1.2),
        p.expected_od(1.0, np.full(p.n, 0.9)),
    ]


def vials(config: PlantConfig) -> Callable[[Rows], Any]:
    """Forty minutes of vials whose volumes, doses, targets and faults differ."""

    def run(rows: Rows) -> tuple[Array, ...]:
        streams = np.random.default_rng(3) if rows == list(range(N)) else np.random.default_rng(3).spawn(N)
        given = streams if isinstance(streams, np.random.Generator) else [streams[i] for i in rows]
        p = Plant(config, len(rows), given, between(14.0, 24.0, 0)[rows])
        p.reset(OD[rows], 37.0)
        p.culture.mu_factor[:], p.vessel.waste_gain_factor[:] = between(0.5, 1.0, 1)[rows], between(0.0, 1.0, 2)[rows]
        p.sensor.frozen[:], p.sensor.extra_offset[:] = np.array(rows) == 2, between(0.0, 0.1, 4)[rows]
        shown: list[Array] = []
        for minute in range(40):
            on, out = 3.0 * np.roll(DRAW[5], minute), 4.0 * np.roll(DRAW[6], minute)
            target = np.where((np.arange(N) + minute) % 4 == 0, between(30.0, 38.0, 7), np.nan)
            p.advance(0.94, on[rows], out[rows], target[rows], 0.2 * out[rows], 0.1 * on[rows])
            for _ in range(3):  # pulses that go on in the next piece, in some vials
                p.advance(0.02, np.where(np.roll(DRAW[8], minute) > 0.4, 1.2, 0.3)[rows])
            shown += watched(p)
        return *(value for value in shown), *p.draws.values()

    return run


def agrees(member: Callable[[Rows], Any]) -> None:
    """All rows at once, against some alone and against all in another order."""
    together = member(list(range(N)))
    for rows in ([3, 0, 4, 2, 1], [0], [2], [4]):
        for one, all_of_them in zip(tuple_of(member(rows)), tuple_of(together), strict=True):
            np.testing.assert_allclose(one, all_of_them[rows], rtol=1e-12, atol=1e-300, equal_nan=True)


def tuple_of(found: Any) -> tuple[Array, ...]:
    return found if isinstance(found, tuple) else (found,)


@pytest.mark.parametrize("name", FUNCTIONS)
def test_rows_of_a_function_are_independent(name: str) -> None:
    agrees(FUNCTIONS[name])


@pytest.mark.parametrize("name", sorted(REGISTERED))
def test_copies_of_a_task_are_independent(name: str) -> None:
    agrees(episodes(name))


@pytest.mark.parametrize("name", [*presets.groups()["plant"], "disturbed"])
def test_vials_of_a_plant_are_independent(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(disturbance, "_known", {"upset": upset})
    own = PlantConfig(start_spread_min=60.0, disturbances=("upset",))
    agrees(vials(own if name == "disturbed" else preset(name)))


def scaled(config: PlantConfig, by: float) -> PlantConfig:
    """A plant in which every volume and every flow is larger by a factor."""
    pump, vessel = config.pump, config.vessel
    return replace(
        config,
        pump=replace(
            pump,
            gain_ml_s=by * pump.gain_ml_s,
            knots_ml_s=tuple(by * flow for flow in pump.knots_ml_s),
            waste_ml_s=by * pump.waste_ml_s,
            overflow_ml_s=by * pump.overflow_ml_s,
            back_leak_ml=by * pump.back_leak_ml,
        ),
        vessel=replace(
            vessel,
            volume_sd_ml=by * vessel.volume_sd_ml,
            overflow_above_ml=by * vessel.overflow_above_ml,
            capacity_ml=by * 30.0,
            evaporation_ml_day=by * vessel.evaporation_ml_day,
            media_ml=by * 90.0,
        ),
    )


@pytest.mark.parametrize("by", [0.7, 1.6])
@pytest.mark.parametrize("name", ["coculture", "long_run", "recorded", "tired_pump"])
def test_volumes_and_flows_in_proportion_change_no_concentration(name: str, by: float) -> None:
    """A bottle that runs out, waste that is slow, a leak and evaporation are in proportion, too."""
    plants: dict[float, Plant] = {}
    shown: dict[float, list[list[Array]]] = {}
    on = np.random.default_rng(8).uniform(0.0, 6.0, (60, 2))
    for factor in (1.0, by):
        config = replace(preset(name), vessel=replace(preset(name).vessel, evaporation_ml_day=20.0))
        plants[factor] = Plant(scaled(config, factor), 2, np.random.default_rng(4), factor * np.array([12.0, 17.0]))
        plants[factor].vessel.waste_gain_factor[1] = 0.3
        for dose in on:
            plants[factor].advance(1.0, dose, 1.1 * dose, overflow_s=0.1 * dose, supply_ml=0.2 * factor)
            shown.setdefault(factor, []).append(watched(plants[factor], factor))
        assert plants[factor].vessel.overflowed.tolist() == [False, True]
    np.testing.assert_allclose(shown[by], shown[1.0], rtol=1e-9, equal_nan=True)


@pytest.mark.parametrize("by", [0.7, 1.6])
def test_a_task_with_a_larger_volume_and_pump_is_the_same_task(by: float) -> None:
    """Largest rate and tau in proportion; so they are where a bench's volume and largest rate are."""
    bench, larger = Bench(volume_ml=14.0, max_rate=0.013), Bench(volume_ml=14.0 * by, max_rate=0.013 * by)
    configs = [EnvConfig(tau=b.tau, max_pump_rate=b.max_rate, episode_steps=9) for b in (bench, larger)]
    assert configs[1].tau == pytest.approx(by * configs[0].tau)
    np.testing.assert_allclose(step_factors(configs[1]), step_factors(configs[0]), rtol=1e-12)
    one, other = (BioreactorVectorEnv(3, config) for config in configs)
    np.testing.assert_array_equal(one.reset(seed=1)[0], other.reset(seed=1)[0])
    for action in np.random.default_rng(2).integers(0, 17, (20, 3)):
        for a, b in zip(one.step(action)[:2], other.step(action)[:2], strict=True):
            np.testing.assert_allclose(a, b, rtol=1e-6)
