"""What every controller owes the loop: independence of rows, indifference to bad readings, and a place in conf/."""

from collections.abc import Callable
from functools import cache, partial

import numpy as np
import pytest

from dqn.policy import Policy
from envs.plant.plant import Plant, PlantConfig
from envs.task import EnvConfig
from experiments.certification import certificate
from experiments.certification.bounds import EstimateBounds
from experiments.coculture.base import SHARE
from experiments.control.policies import find_policy, load_policy
from experiments.laws import registry
from experiments.laws.base import Accounts, Array, Controller, Explains, Watches
from experiments.laws.density import baselines
from experiments.laws.density.learned import LearnedController, settings
from experiments.laws.density.mpc import MpcConfig, SwarmConfig
from tests.experiments import laws

pytestmark = pytest.mark.numeric

MODEL = EnvConfig()
KINDS = tuple(registry.KINDS)
GIVEN = {
    "mpc": MpcConfig(swarm=SwarmConfig(particles=6, iterations=8)),
    "threshold": baselines.ThresholdConfig(hysteresis=0.02),
    "gain_scheduled": baselines.GainScheduledConfig(gain=(0.2, 0.7)),
    "hold": baselines.HoldConfig(rate=0.007),
}
N = 6
ROUNDING = 1e-4  # of a Q value: a network adds up in single precision, and in another order for another number of rows
VOLUME_ML, GROWTH = np.linspace(12.0, 27.0, N), np.linspace(0.02, 0.035, N)


@cache
def shipped() -> tuple[Policy, EstimateBounds | None]:
    policy = load_policy("shipped", 1.0, 0.02)
    return policy, certificate.bounds(policy, settings(policy), find_policy("shipped"), MODEL)


def made(kind: str, vials: Array | None = None) -> Controller:
    """A law of these of the N vials, by default of all."""
    vials = np.arange(N) if vials is None else vials
    plant = Plant(PlantConfig(), vials.size, np.random.default_rng(0))
    plant.draws["mu"][:], plant.draws["volume_ml"][:] = GROWTH[vials], VOLUME_ML[vials]
    plant.reset(0.45 + 0.03 * vials)
    config = GIVEN.get(kind, registry.config(kind))
    policy, bounds = shipped()
    parts = {"policy": policy, "bounds": bounds, "plant": plant, "volume_ml": VOLUME_ML[vials]}
    law: Controller = registry.build(config, model=MODEL, **parts)
    law.reset(vials.size)
    return law


def of_the_od(vials: Array | None = None) -> Controller:
    """The network that sees OD and setpoint."""
    law = LearnedController(laws.law())
    law.reset(N if vials is None else vials.size)
    return law


MAKERS: dict[str, Callable[..., Controller]] = {kind: partial(made, kind) for kind in KINDS} | {"dqn of OD": of_the_od}


@pytest.fixture(autouse=True)
def _coarse_oracle(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("experiments.laws.density.oracle.GRID", 301)  # what comes later hardly matters here


@pytest.mark.parametrize("name", MAKERS)
def test_a_batch_is_its_vials_alone(name: str) -> None:
    """What each vial gets and what is said of it, whatever the others read, lack, were given, and how warm they are.

    Readings and thermometers are missing now and then; the first vial has no thermometer.
    """
    steps, rng = 30, np.random.default_rng(7)
    od = np.clip(0.5 + np.cumsum(0.02 * rng.standard_normal((steps, N)), axis=0), 0.05, 2.0)
    od[rng.random((steps, N)) < 0.05] = np.nan
    degc = np.where(rng.random((steps, N)) < 0.2, np.nan, 37.0 - 7.0 * rng.random((steps, N)))
    degc[:, 0] = np.nan
    setpoint, fresh = rng.choice([0.4, 0.5, 0.6], (steps, N)), rng.random((steps, N)) < 0.8
    dose = rng.choice([0.0, 0.0, 0.3, 1.2], (steps, N))

    def follow(law: Controller, idx: Array) -> list[dict[str, Array]]:
        """Rate and explanations of each step; what is said of a row that is not fresh is nobody's business."""
        found = []
        for k in range(steps):
            at = np.full(idx.size, float(k))
            if isinstance(law, Watches):
                law.watch(od[k, idx], degc[k, idx], at, fresh[k, idx])
            rate = np.where(fresh[k, idx], law.act(od[k, idx], setpoint[k, idx], at, fresh[k, idx]), np.nan)
            if isinstance(law, Accounts):
                law.dosed(dose[k, idx])
            said = law.explain() if isinstance(law, Explains) else {}
            assert all(value.shape[0] == idx.size for value in said.values())
            found.append({"rate": rate, **said})
        return found

    together = follow(MAKERS[name](), np.arange(N))
    for i in range(N):
        idx = np.arange(i + 1) if name == "mpc" else np.array([i])  # row i of a swarm has random stream i
        for one, all_ in zip(follow(MAKERS[name](idx), idx), together, strict=True):
            assert one.keys() == all_.keys()
            lead = one.get("q_lead", np.array([np.inf]))[-1]
            for quantity, value in one.items():
                if quantity == "rate" and lead < ROUNDING:
                    continue  # two pump rates are equally good: rounding chooses between them
                rtol, atol = (1e-4, ROUNDING) if quantity.startswith("q_") else (1e-9, 1e-12)
                np.testing.assert_allclose(value[-1], all_[quantity][i], rtol=rtol, atol=atol, err_msg=quantity)


@pytest.mark.parametrize("name", MAKERS)
def test_readings_of_any_value_give_a_rate_in_range(name: str) -> None:
    odd = np.array([np.nan, np.inf, -np.inf, 0.0, -0.3, 1e-9, 14.0, 1e6, 0.5, 0.7])
    controller = MAKERS[name]()
    for k in range(10):
        od = np.roll(odd, k)[:N]
        rate = controller.act(od, np.full(N, 0.5), np.full(N, float(k)), np.ones(N, dtype=bool))
        assert np.all(np.isfinite(rate))
        assert np.all((rate >= 0.0) & (rate <= 0.02 + 1e-15))


@pytest.mark.parametrize("name", MAKERS)
def test_a_reading_that_is_no_number_is_as_good_as_no_sample(name: str) -> None:
    """In the third and the fourth minute, of one vial in two; what is decided from then on is the same."""
    od = 0.5 + 0.03 * np.random.default_rng(5).standard_normal((12, N))
    lost, yes = (np.arange(12) // 2 == 1)[:, None] & (np.arange(N) % 2 == 0), np.ones(N, dtype=bool)

    def rates(readings: Array, rows: Array) -> Array:
        law = MAKERS[name]()
        given = zip(range(12), readings, rows, strict=True)
        return np.array([law.act(x, np.full(N, 0.48), np.full(N, float(k)), fresh) for k, x, fresh in given])

    found, expected = rates(np.where(lost, np.nan, od), lost | yes), rates(od, ~lost)
    np.testing.assert_array_equal(found[4:], expected[4:])


@pytest.mark.parametrize("name", MAKERS)
def test_reset_forgets(name: str) -> None:
    od = 0.5 + 0.05 * np.random.default_rng(2).standard_normal((10, N))
    controller, yes = MAKERS[name](), np.ones(N, dtype=bool)

    def run() -> list[list[float]]:
        controller.reset(N)
        return [controller.act(x, np.full(N, 0.5), np.full(N, float(k)), yes).tolist() for k, x in enumerate(od)]

    assert run() == run()


def test_threshold_by_hand() -> None:
    threshold = baselines.Threshold(baselines.ThresholdConfig(rate=0.015, hysteresis=0.02))
    threshold.reset(1)
    path = [0.49, 0.51, 0.49, 0.481, 0.48, 0.49, 0.501]
    rates = [threshold.act(np.array([x]), np.array([0.5]), np.zeros(1), np.ones(1, dtype=bool))[0] for x in path]
    np.testing.assert_allclose(rates, [0.0, 0.015, 0.015, 0.015, 0.0, 0.0, 0.015])


@pytest.mark.parametrize(("given", "rate"), [({}, 0.009), ({"rate": 0.004}, 0.004), ({"rate": 0.0}, 0.0)])
def test_a_constant_rate_is_the_one_that_is_asked_for_else_that_of_the_model(given, rate):
    hold = baselines.Hold(baselines.HoldConfig(**given), EnvConfig(mu=0.02, tau=0.45))
    hold.reset(3)
    np.testing.assert_allclose(hold.act(np.ones(3), np.ones(3), np.zeros(3), np.ones(3, dtype=bool)), rate)


def test_a_gain_schedule_by_hand() -> None:
    """At 33 degC mu is 0.02 + 3/7 0.0175 = 0.0275 and K 0.25 + 3/7 0.35 = 0.4; 25 and 41 degC are outside of the table.

    The fourth vial never has a temperature; in the second sample that of the first vial is missing, and the
    third vial has no valid reading, so its temperature does not count.
    """
    config = baselines.GainScheduledConfig(temperatures=(30.0, 37.0), mu=(0.02, 0.0375), gain=(0.25, 0.6))
    law, yes = baselines.GainScheduled(config, EnvConfig(tau=0.45, control_min=2.0)), np.ones(4, dtype=bool)
    law.reset(4)
    od, setpoint = 0.5 * np.exp([0.02, 0.04, 0.01, -0.03]), np.full(4, 0.5)
    law.watch(od, np.array([33.0, 25.0, 41.0, np.nan]), np.zeros(4), yes)
    rate = law.act(od, setpoint, np.zeros(4), yes)
    np.testing.assert_allclose(rate, 0.45 * np.array([0.0275 + 0.004, 0.02 + 0.005, 0.0375 + 0.003, 0.0375 - 0.009]))
    law.watch(od, np.array([np.nan, 37.0, 30.0, np.nan]), np.full(4, 2.0), np.array([True, True, False, True]))
    rate = law.act(setpoint * np.exp([-0.03, 0.0, 0.01, -0.3]), setpoint, np.full(4, 2.0), yes)
    np.testing.assert_allclose(rate, 0.45 * np.array([0.0275 - 0.006, 0.0375, 0.0375 + 0.003, 0.0]))


def test_the_table_of_a_gain_schedule_rises_and_is_full() -> None:
    with pytest.raises(ValueError, match=r"controller\.temperatures"):
        baselines.GainScheduledConfig(temperatures=(37.0, 30.0))
    with pytest.raises(ValueError, match=r"controller\.gain"):
        baselines.GainScheduledConfig(gain=(0.5,))


def test_what_a_device_can_run_and_what_a_law_is_made_from() -> None:
    assert registry.on_device("pi_tuned") == "pi_tuned"
    with pytest.raises(ValueError, match="controller_kind = oracle"):
        registry.on_device("oracle")
    taken = {part: [kind for kind in KINDS if registry.takes(kind, part)] for part in ("volume_ml", "policy")}
    assert taken == {"volume_ml": ["pi"], "policy": ["dqn"]}
    assert not registry.takes("pi", "policy", SHARE)
    with pytest.raises(ValueError, match="mine: no part models"):
        registry.add("mine", baselines.HoldConfig, baselines.Hold, "of no use", ["model", "models"])
    with pytest.raises(ValueError, match=r"controller\.kind = mine"):
        registry.config("mine")


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


def test_the_oracle_knows_each_vial_by_itself() -> None:
    """Three vials of other growth, pump and volume, whose setpoints differ; all of them are there in one period."""
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


def test_an_oracle_on_another_grid_is_another_one(monkeypatch: pytest.MonkeyPatch) -> None:
    """What was solved before, on the grid of another test, is not taken for it."""
    for points in (301, 77):
        monkeypatch.setattr("experiments.laws.density.oracle.GRID", points)
        oracle = made("oracle")
        assert oracle._values.shape == (N, points)  # type: ignore[attr-defined]
