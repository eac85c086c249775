"""What every controller owes the loop: independence of rows, indifference to bad readings, and a place in conf/."""

import time
from collections.abc import Callable

import numpy as np
import pytest

from conf import presets
from conf.schema import build
from dqn.policy import Policy
from envs.plant.plant import Plant, PlantConfig
from envs.task import EnvConfig
from experiments.laws import registry
from experiments.laws.base import Controller, Explains
from experiments.laws.density.baselines import Hold, HoldConfig, Threshold, ThresholdConfig
from experiments.laws.density.inverse import Inverse, InverseConfig
from experiments.laws.density.learned import LearnedController
from experiments.laws.density.mpc import Mpc, MpcConfig
from experiments.laws.density.pi import ChiBioPI, ChiBioPIConfig, TunedPI, TunedPIConfig
from experiments.laws.density.pso import SwarmConfig

pytestmark = pytest.mark.numeric

MODEL = EnvConfig()
QUICK = SwarmConfig(particles=6, iterations=8)
MAKERS: dict[str, Callable[[], Controller]] = {
    "pi": lambda: ChiBioPI(ChiBioPIConfig()),
    "pi_tuned": lambda: TunedPI(TunedPIConfig(), MODEL),
    "inverse": lambda: Inverse(InverseConfig(), MODEL),
    "mpc": lambda: Mpc(MpcConfig(swarm=QUICK), MODEL),
    "threshold": lambda: Threshold(ThresholdConfig(hysteresis=0.02)),
    "hold": lambda: Hold(HoldConfig(), MODEL),
}
CONFIGS = {
    "pi": ChiBioPIConfig(),
    "pi_tuned": TunedPIConfig(),
    "inverse": InverseConfig(),
    "mpc": MpcConfig(),
    "threshold": ThresholdConfig(),
    "hold": HoldConfig(),
}


@pytest.mark.parametrize("name", MAKERS)
def test_a_batch_of_64_is_64_singles(name: str) -> None:
    """Also when only some rows are fresh: a single controller sees just its own fresh readings."""
    n, steps = 64, 12
    rng = np.random.default_rng(7)
    od = np.clip(0.5 + np.cumsum(0.02 * rng.standard_normal((steps, n)), axis=0), 0.05, 2.0)
    setpoint = rng.choice([0.4, 0.5, 0.6], (steps, n))
    fresh = rng.random((steps, n)) < 0.8
    batch = MAKERS[name]()
    batch.reset(n)
    together = np.array([batch.act(od[k], setpoint[k], np.full(n, float(k)), fresh[k]) for k in range(steps)])
    assert together.shape == (steps, n)
    for i in range(n):
        single = MAKERS[name]()
        size, row = (i + 1, i) if name == "mpc" else (1, 0)  # row i of a swarm has random stream i
        single.reset(size)
        for k in np.flatnonzero(fresh[:, i]):
            x, r, t = np.full((3, size), np.nan)
            x[row], r[row], t[row] = od[k, i], setpoint[k, i], float(k)
            rate = single.act(x, r, t, np.arange(x.size) == row)[row]
            assert rate == pytest.approx(together[k, i], rel=1e-12, abs=1e-15)


@pytest.mark.parametrize("name", MAKERS)
def test_readings_of_any_value_give_a_rate_in_range(name: str) -> None:
    odd = np.array([np.nan, np.inf, -np.inf, 0.0, -0.3, 1e-9, 14.0, 1e6, 0.5, 0.7])
    controller = MAKERS[name]()
    controller.reset(odd.size)
    setpoint = np.full(odd.size, 0.5)
    for k in range(8):
        rate = controller.act(np.roll(odd, k), setpoint, np.full(odd.size, float(k)), np.ones(odd.size, dtype=bool))
        assert np.all(np.isfinite(rate))
        assert np.all((rate >= 0.0) & (rate <= 0.02 + 1e-15))


@pytest.mark.parametrize("name", MAKERS)
def test_reset_forgets(name: str) -> None:
    rng = np.random.default_rng(2)
    od = 0.5 + 0.05 * rng.standard_normal((10, 3))
    controller = MAKERS[name]()

    def run() -> list[list[float]]:
        controller.reset(3)
        everything = np.ones(3, dtype=bool)
        return [controller.act(x, np.full(3, 0.5), np.full(3, float(k)), everything).tolist() for k, x in enumerate(od)]

    assert run() == run()


@pytest.mark.parametrize("name", ["pi", "pi_tuned", "inverse", "mpc"])
def test_explanations_have_one_row_per_reactor(name: str) -> None:
    controller = MAKERS[name]()
    controller.reset(5)
    controller.act(np.full(5, 0.52), np.full(5, 0.5), np.zeros(5), np.ones(5, dtype=bool))
    assert isinstance(controller, Explains)
    for key, value in controller.explain().items():
        assert value.shape[0] == 5, key


@pytest.mark.parametrize("name", CONFIGS)
def test_the_preset_names_the_kind_and_leaves_the_rest_to_the_defaults(name: str) -> None:
    default = CONFIGS[name]
    assert build(default, presets.load(f"controller/{name}")) == default
    assert presets.load(f"controller/{name}") == {"kind": name}


def test_threshold_and_hold_by_hand() -> None:
    threshold = Threshold(ThresholdConfig(rate=0.015, hysteresis=0.02))
    threshold.reset(1)
    path = [0.49, 0.51, 0.49, 0.481, 0.48, 0.49, 0.501]
    rates = [threshold.act(np.array([x]), np.array([0.5]), np.zeros(1), np.ones(1, dtype=bool))[0] for x in path]
    np.testing.assert_allclose(rates, [0.0, 0.015, 0.015, 0.015, 0.0, 0.0, 0.015])
    hold = Hold(HoldConfig(), MODEL)
    hold.reset(2)
    u = hold.act(np.array([0.1, 2.0]), np.full(2, 0.5), np.zeros(2), np.ones(2, dtype=bool))
    np.testing.assert_allclose(u, 0.01)  # mu tau
    with pytest.raises(ValueError, match=r"controller.rate = 1.0 mL/s"):
        HoldConfig(rate=1.0)
    with pytest.raises(ValueError, match=r"controller.hysteresis = -0.1 OD"):
        ThresholdConfig(hysteresis=-0.1)


@pytest.mark.parametrize(("config", "rate"), [(HoldConfig(), 0.009), (HoldConfig(rate=0.004), 0.004)])
def test_a_constant_rate_is_the_one_that_is_asked_for_else_that_of_the_model(config: HoldConfig, rate: float) -> None:
    hold = Hold(config, EnvConfig(mu=0.02, tau=0.45))
    hold.reset(3)
    np.testing.assert_allclose(hold.act(np.ones(3), np.ones(3), np.zeros(3), np.ones(3, dtype=bool)), rate)


def test_a_constant_rate_of_nothing_is_one() -> None:
    hold = Hold(HoldConfig(rate=0.0), MODEL)
    assert hold.act(np.ones(1), np.ones(1), np.zeros(1), np.ones(1, dtype=bool))[0] == 0.0


def test_what_a_device_can_run_and_what_a_law_is_made_from() -> None:
    assert registry.on_device("pi_tuned") == "pi_tuned"
    with pytest.raises(
        ValueError, match=r"controller_kind = oracle: allowed dqn, pi, pi_tuned, mpc, inverse, threshold, hold$"
    ):
        registry.on_device("oracle")
    taken = {part: [kind for kind in CONFIGS if registry.takes(kind, part)] for part in ("volume_ml", "policy")}
    assert taken == {"volume_ml": ["pi"], "policy": []}
    assert registry.takes("dqn", "policy")
    assert not registry.takes("pi", "policy", registry.SHARE)
    with pytest.raises(ValueError, match=r"density, law mine: no part models; allowed model, policy, plant"):
        registry.add("mine", HoldConfig, Hold, "of no use", ["model", "models"])
    with pytest.raises(ValueError, match=r"controller\.kind = mine: allowed dqn"):
        registry.config("mine")


def test_two_volumes_two_gains_of_the_devices_law() -> None:
    """0.7 ln(x / r) / (240 / V): a vial of 10 mL gets half of what one of 20 mL gets, in whatever order they are."""
    device = registry.build(registry.config("pi"), volume_ml=np.array([10.0, 20.0, 15.0]))
    device.reset(3)
    for minute in range(3):
        device.act(np.full(3, 0.52), np.full(3, 0.5), np.full(3, float(minute)), np.ones(3, dtype=bool))
    np.testing.assert_allclose(device.explain()["p"], 0.7 * np.log(1.04) * np.array([10.0, 20.0, 15.0]) / 240.0)


def test_a_policy_of_the_od_says_how_sure_it_is_of_each_vial() -> None:
    """Q is (OD, setpoint, 0.25). The second vial has no reading, the third is not asked this time."""
    none = np.zeros(2, np.float32)
    policy = Policy(
        (np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0]], np.float32),), (np.array([0.0, 0.0, 0.25], np.float32),),
        np.eye(2, dtype=np.float32), none, np.array([0.001, 0.002, 0.003]), none - np.inf, none + np.inf, {},
    )  # fmt: skip
    law = LearnedController(policy)
    law.reset(4)
    od, setpoint = np.array([0.6, np.nan, 0.1, 0.1]), np.array([0.5, 0.5, 0.9, 0.2])
    rate = law.act(od, setpoint, np.zeros(4), np.array([True, True, False, True]))
    np.testing.assert_allclose(rate[[0, 1, 3]], [0.001, 0.0, 0.003])
    told = law.explain()
    np.testing.assert_allclose(told["q_best"], [0.6, 0.5, np.nan, 0.25], rtol=1e-6)
    np.testing.assert_allclose(told["q_lead"], [0.1, 0.25, np.nan, 0.05], rtol=1e-5)


def test_the_oracle_knows_each_vial_by_itself(monkeypatch: pytest.MonkeyPatch) -> None:
    """Three vials of other growth, pump and volume, whose setpoints differ; all of them are there in one period."""
    monkeypatch.setattr("experiments.laws.density.oracle.GRID", 301)  # what comes later hardly matters here
    plant = Plant(PlantConfig(), 3, np.random.default_rng(0))
    plant.draws["mu"][:], plant.draws["volume_ml"][:] = (0.02, 0.03, 0.035), (20.0, 16.0, 24.0)
    plant.draws["pump_gain_ml_s"][:] = (0.8, 1.0, 1.3)
    setpoint = np.array([0.3, 0.5, 0.8])
    plant.reset(setpoint * np.exp([0.01, 0.02, -0.005]))
    oracle = registry.build(registry.config("oracle"), model=MODEL, plant=plant)
    oracle.reset(3)
    rate = oracle.act(plant.read_od(), setpoint, np.zeros(3), np.ones(3, dtype=bool))
    assert np.unique(rate).size == 3
    plant.advance(1.0, 60.0 * rate)
    np.testing.assert_allclose(np.log(plant.apparent_od / setpoint), 0.0, atol=0.51 * 1.56 / 16.0 / 128)


@pytest.mark.parametrize(("flow_ml_s", "period"), [(1.0, 1.0), (0.7, 1.0), (1.4, 2.0)])
def test_the_oracle_reckons_with_the_pulse_that_the_driver_gives(flow_ml_s: float, period: float) -> None:
    """A driver that takes a pump of 1 mL/s for one of 0.7 lets it run 1/0.7 as long; one period is enough to arrive.

    With 129 rates each period takes off ln x up to 1.2 period / (20 flow), so the last one is off by half of a part.
    """
    model = EnvConfig(control_min=period)
    plant = Plant(PlantConfig(), 3, np.random.default_rng(0))
    plant.reset(np.array([0.5, 0.505, 0.51]))
    oracle = registry.build(registry.config("oracle"), model=model, plant=plant, flow_ml_s=flow_ml_s)
    oracle.reset(3)
    rate = oracle.act(plant.read_od(), np.full(3, 0.5), np.zeros(3), np.ones(3, dtype=bool))
    plant.advance(period, 60.0 * period * rate / flow_ml_s)
    most = 1.2 * period / (20.0 * flow_ml_s)
    np.testing.assert_allclose(np.log(plant.apparent_od / 0.5), 0.0, atol=0.51 * most / 128)


@pytest.mark.parametrize("name", ["pi", "pi_tuned", "inverse"])
def test_ninety_minutes_of_64_replicates_in_well_under_a_second(name: str) -> None:
    controller = MAKERS[name]()
    controller.reset(64)
    od = 0.5 + 0.01 * np.random.default_rng(0).standard_normal((90, 64))
    start = time.process_time()
    for k, x in enumerate(od):
        controller.act(x, np.full(64, 0.5), np.full(64, float(k)), np.ones(64, dtype=bool))
    assert time.process_time() - start < 0.5
