"""The composition task and its pair of species: rates by hand, announced changes, an optimum that nothing beats."""

import itertools
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from envs.coculture.optimum import Grid, best_action, cost_to_go, transitions
from envs.coculture.pair import PairConfig, SpeciesConfig, named_pair
from envs.coculture.second import of_pair
from envs.coculture.task import CocultureConfig, CocultureVectorEnv, advance, at_rest, limits, logit, passed, share
from envs.plant.plant import Plant, PlantConfig
from experiments.coculture.task import Coculture
from experiments.training.evaluation import Evaluation
from tests.envs.test_plant import preset
from tests.two_species import EQUAL_RATES_C, p_putida_rate

pytestmark = pytest.mark.numeric

PREVIEW = CocultureConfig(control_min=30.0, episode_steps=24, preview_min=360.0)


def test_an_announced_change_comes_nearer_and_is_then_the_setpoint() -> None:
    goal = np.array([[0.1, 0.9, 60.0]])
    np.testing.assert_array_equal(first := passed(PREVIEW, goal), [[0.1, 0.9, 30.0]])
    np.testing.assert_array_equal(second := passed(PREVIEW, first), [[0.9, 0.9, 0.0]])
    np.testing.assert_array_equal(passed(PREVIEW, second), second)
    slow = CocultureConfig(control_min=20.0, preview_min=360.0)
    np.testing.assert_array_equal(passed(slow, goal), [[0.1, 0.9, 40.0]])
    np.testing.assert_array_equal(passed(slow, np.array([[0.1], [0.2]])), [[0.1], [0.2]])


def test_starts_are_drawn_one_by_one() -> None:
    """Share, temperature, setpoint, the next one and when it comes: none is known from another."""
    env = CocultureVectorEnv(4000, PREVIEW)
    env.reset(seed=1)
    alike = np.corrcoef(env.state[:, [0, 1, 3, 4, 5]].T)
    assert np.abs(alike - np.eye(5)).max() < 0.06


def test_the_reward_is_that_of_the_setpoint_in_force() -> None:
    env = CocultureVectorEnv(2, PREVIEW)
    env.reset(seed=0)
    rest = at_rest(PREVIEW, logit(np.array([0.3, 0.3])))
    env.state[:] = np.concatenate([rest, logit(np.array([[0.4, 0.8]] * 2)), [[30.0], [60.0]]], axis=1)
    for wanted in ([0.4, 0.4], [0.8, 0.4], [0.8, 0.8]):
        _, reward, *_ = env.step(np.array([10, 10]))
        np.testing.assert_allclose(reward, -np.square(share(env.state[:, 0]) - wanted), rtol=1e-12)


def minutes_of_two(state: np.ndarray, target: np.ndarray, minutes: float, step: float = 0.1) -> np.ndarray:
    """State (N, 3) after `minutes` at targets (N,), by equations written down here, in steps of 6 s.

    A vial cools towards 24 degC with 39 min, a heater adds up to 2 degC/min until the target; mu_e follows at once,
    m_p with 60 min; the logit grows by their difference.
    """
    x, warm, m_p = state.T.copy()
    for _ in range(round(minutes / step)):
        falls = (warm - 24.0) / 39.0
        warm = np.maximum(warm - falls * step, np.minimum(target, warm + (2.0 - falls) * step))
        mu_p = -0.02208 * warm**2 + 1.3796 * warm - 20.56996
        m_p = m_p + (mu_p - m_p) / 60.0 * step
        x = x + (m_p - (0.07727 * warm - 1.66954)) / 60.0 * step
    return np.stack([x, warm, m_p], axis=1)


def test_share_heat_and_rate_follow_their_equations() -> None:
    """Heated, cooled and held; a minute of the task is one step, of which the heat is late by less than a tenth."""
    rng = np.random.default_rng(1)
    warm = rng.uniform(29.0, 36.0, 50)
    state = np.stack([rng.normal(0.0, 1.0, 50), warm, rng.uniform(0.5, 0.95, 50)], axis=1)
    target = np.where(rng.uniform(size=50) < 0.2, warm, rng.uniform(29.0, 36.0, 50))
    for minutes in (30.0, 240.0):
        ours, theirs = advance(PREVIEW, state, target, minutes), minutes_of_two(state, target, minutes, 0.01)
        np.testing.assert_allclose(ours[:, 1], theirs[:, 1], atol=0.02)
        np.testing.assert_allclose(ours[:, 2], theirs[:, 2], atol=2e-3)
        np.testing.assert_allclose(ours[:, 0] - state[:, 0], theirs[:, 0] - state[:, 0], atol=4e-3)


def test_short_programs_agree_with_all_sequences_of_actions() -> None:
    """Three temperatures, six decisions, a change in the middle: the least cost of all 729 sequences, each followed by
    other equations than the optimum's own; a decision too many or too few would cost a tenth."""
    config = CocultureConfig(control_min=30.0, n_actions=3, preview_min=90.0)
    model = transitions(config, Grid(logits=321, temperatures=29, rates=9, logit_span=3.0))
    program = np.array([0.3, 0.3, 0.3, 0.5, 0.5, 0.5])
    value, start = cost_to_go(model, program[:, None]), np.array([[np.log(0.3 / 0.7), EQUAL_RATES_C, 0.0]])
    start[0, 2] = -0.02208 * EQUAL_RATES_C**2 + 1.3796 * EQUAL_RATES_C - 20.56996
    targets = np.array([29.0, 32.5, 36.0])
    state, cost = start, 0.0
    for k, wanted in enumerate(program):
        action = best_action(config, model, value[k + 1, :, 0], state, np.array([wanted]))
        state = minutes_of_two(state, targets[action], 30.0)
        cost += float(np.square(1.0 / (1.0 + np.exp(-state[0, 0])) - wanted))
    sequences = targets[np.array(list(itertools.product(range(3), repeat=6)))]
    states, costs = np.repeat(start, 729, axis=0), np.zeros(729)
    for k, wanted in enumerate(program):
        states = minutes_of_two(states, sequences[:, k], 30.0)
        costs += np.square(1.0 / (1.0 + np.exp(-states[:, 0])) - wanted)
    assert cost == pytest.approx(costs.min(), rel=5e-3)
    assert np.sort(costs)[1] > 1.005 * costs.min()


@pytest.mark.parametrize("scale", [0.7, 1.0, 1.6])
def test_the_optimum_s_grid_holds_what_a_culture_can_be(scale: float) -> None:
    """At rest anywhere from 29 to 36 degC, the second species growing by its curve times its scale."""
    config = CocultureConfig(scale_p=scale, scale_e=1.3)
    temperature, rate, x = Grid().axes(config)
    curve = scale * p_putida_rate(np.linspace(29.0, 36.0, 701))
    assert (temperature[0], temperature[-1], x[0], x[-1]) == (29.0, 36.0, -6.0, 6.0)
    assert (rate[0], rate[-1]) == pytest.approx((curve.min(), curve.max()), rel=1e-3)
    rest = at_rest(config, np.zeros(3), np.array([29.0, 31.2, 36.0]))
    np.testing.assert_allclose(rest[:, 2], scale * p_putida_rate(np.array([29.0, 31.2, 36.0])), rtol=1e-9)
    low, high = limits(config)
    assert low[2] <= curve.min() < curve.max() <= high[2]


def test_a_minute_by_hand_of_a_pair_a_heater_and_a_room_of_one_s_own() -> None:
    """From 30 degC towards 35 in a room of 20: the heater adds 0.5 degC to what 20 min of cooling leave."""
    config = CocultureConfig(scale_e=1.3, scale_p=0.7, heating_c_per_min=0.5, cooling_min=20.0, ambient_c=20.0)
    warm = 20.0 + 10.0 * np.exp(-0.05) + 0.5
    mean, follow = 0.5 * (30.0 + warm), 1.0 - np.exp(-1.0 / 60.0)
    mu_e, mu_p = 0.07727 * mean - 1.66954, -0.02208 * mean**2 + 1.3796 * mean - 20.56996
    for errors, e, p in ((None, 1.3, 0.7), (np.array([0.1, -0.2]), 1.43, 0.56)):
        after = advance(config, np.array([0.4, 30.0, 0.5]), np.float64(35.0), 1.0, errors)
        rate = 0.5 + (p * mu_p - 0.5) * follow
        np.testing.assert_allclose(after, [0.4 + (0.5 * (0.5 + rate) - e * mu_e) / 60.0, warm, rate], rtol=1e-9)


def test_each_number_of_a_start_is_of_its_own_range() -> None:
    """Few start where the setpoints are, and a change comes after one, two or three decisions."""
    config = CocultureConfig(
        start_share=(0.05, 0.2), setpoints=(0.6, 0.9), temperatures=(30.0, 32.0), control_min=30.0, preview_min=90.0
    )
    env = CocultureVectorEnv(300, config)
    env.reset(seed=3)
    for values, low, high in (
        (share(env.state[:, 0]), 0.05, 0.2),
        (env.state[:, 1], 30.0, 32.0),
        (share(env.state[:, 3]), 0.6, 0.9),
        (share(env.state[:, 4]), 0.6, 0.9),
    ):
        assert low <= values.min() < low + 0.02 * (high - low) + 1e-9
        assert high - 0.02 * (high - low) < values.max() <= high
    assert set(env.state[:, 5]) == {30.0, 60.0, 90.0}
    np.testing.assert_allclose(env.state[:, 2], p_putida_rate(env.state[:, 1]), rtol=1e-9)
    env.reset(options={"temperature": 31.0, "next_setpoint_logit": 1.5})
    np.testing.assert_array_equal(env.state[:, [1, 4]], np.tile([31.0, 1.5], (300, 1)))


@pytest.fixture(scope="module")
def tasks() -> dict[str, Evaluation]:
    """Both tasks on a few starts, with few programs: from several shares to .2 and .7, and changes between four."""
    found = {}
    for name, config in (("plain", CocultureConfig()), ("preview", PREVIEW)):
        task = Coculture(config)
        grid = task.report_grid()
        goals = np.isin(share(grid[:, 3]).round(6), (0.2, 0.7))
        found[name] = Evaluation(task, grid[goals][::3] if name == "plain" else grid[::17])
    return found


@pytest.mark.slow
@pytest.mark.parametrize("name", ["plain", "preview"])
def test_nothing_beats_the_optimum(tasks: dict[str, Evaluation], name: str) -> None:
    evaluation = tasks[name]
    targets, rng = evaluation.task.actions, np.random.default_rng(0)  # type: ignore[attr-defined]

    def towards(observation: np.ndarray, gain: float) -> np.ndarray:
        wanted = EQUAL_RATES_C - gain * (observation[..., 3] - observation[..., 0])
        return np.asarray(np.abs(wanted[..., None] - targets).argmin(-1))

    rivals = {gain: evaluation(lambda o, g=gain: towards(o, g)).regret_pct[0] for gain in (3.0, 10.0, 20.0, 100.0)}
    rivals["random"] = evaluation(lambda o: rng.integers(0, 17, o.shape[:-1])).regret_pct[0]
    assert min(rivals.values()) > -0.05, rivals
    assert rivals["random"] > 50.0


WARM = PairConfig(  # the second gains where it is warm
    SpeciesConfig("cold", (-0.05, 2.0)), SpeciesConfig("warm", (0.06, -1.0), (), 45.0), temperatures=(20.0, 32.0)
)


def test_the_default_is_the_published_pair() -> None:
    """mu_p - mu_e, 1/h, as its authors' code gives it; beyond 29 to 36 degC the rate of the nearer end holds.

    Pigment at 33.2, x = 0.7: 44.4957 x^4 + 31.8205 x^3 - 917.586 x^2 - 886.685 x + 6318.71.
    """
    pair = PairConfig()
    assert named_pair("ecoli_pputida") == pair
    assert pair.even_c == pytest.approx(33.197, abs=1e-3)
    degrees = np.array([20.0, 29.0, 30.0, 31.0, 32.0, 33.0, pair.even_c, 34.0, 35.0, 36.0, 40.0])
    published = [0.298, 0.298, 0.298, 0.253, 0.164, 0.031, 0.0, -0.146, -0.367, -0.632, -0.632]
    rates = pair.rates(degrees)
    np.testing.assert_allclose(rates[:, 1] - rates[:, 0], published, atol=6e-4)
    np.testing.assert_allclose(rates[[1, 4, 9], 0], 0.07727 * degrees[[1, 4, 9]] - 1.66954)
    production = pair.production(np.array([20.0, 29.0, 32.5, 33.2, 35.0, 36.0, 40.0]))
    np.testing.assert_allclose(production, [3495, 3495, 6318.7, 5270, 602, 20, 20], rtol=1e-3)


def test_cardinal_temperatures_by_hand() -> None:
    """1 at the best one, 0 at both ends, and Rosso's formula in between."""
    s = SpeciesConfig("x", (), (5.0, 37.0, 45.0, 2.0))
    np.testing.assert_allclose(s.rate(np.array([0.0, 5.0, 37.0, 45.0, 50.0])), [0, 0, 2, 0, 0], atol=1e-12)
    t = 30.0
    above = (t - 45.0) * (t - 5.0) ** 2
    below = (37.0 - 5.0) * ((37.0 - 5.0) * (t - 37.0) - (37.0 - 45.0) * (37.0 + 5.0 - 2.0 * t))
    assert s.rate(np.array(t)) == pytest.approx(2.0 * above / below)
    near = s.rate(np.array([36.99, 37.0, 37.01]))
    assert near[1] == near.max()


def test_where_both_grow_alike_follows_the_errors_of_the_curves() -> None:
    errors = np.array([[0.0, 0.0], [0.2, -0.1], [-0.1, 0.15], [5.0, 0.0]])
    even = PairConfig().even(errors)
    rates = PairConfig().rates(even[:3]) * (1.0 + errors[:3])
    np.testing.assert_allclose(rates[:, 0], rates[:, 1], atol=2e-4)
    assert even[3] == 29.0  # nowhere: where they differ least
    assert WARM.even_c == pytest.approx(3.0 / 0.11)


def test_the_first_species_curve_backwards() -> None:
    rate = np.array([0.7, 0.9, 1.1])
    np.testing.assert_allclose(PairConfig().first_at(rate), (rate + 1.66954) / 0.07727, atol=1e-6)
    np.testing.assert_allclose(WARM.first_at(np.array([0.5, 0.9])), [30.0, 22.0], atol=1e-6)
    assert PairConfig().first_at(np.array(9.0)) == 36.0
    bent = replace(PairConfig(), first=SpeciesConfig("bent", (), (5.0, 33.9, 40.0, 0.9)))  # falls behind its best one
    back = bent.first_at(bent.rates(np.array([30.0, 32.0]))[:, 0])
    np.testing.assert_allclose(back, [30.0, 32.0], atol=0.02)


def test_warmth_may_make_the_second_gain() -> None:
    assert (PairConfig().raising, PairConfig().lowering) == (29.0, 36.0)
    assert (WARM.raising, WARM.lowering) == (32.0, 20.0)


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: SpeciesConfig("x", (), ()), "either polynomial or cardinal"),
        (lambda: SpeciesConfig("x", (1.0,), (1.0, 2.0, 3.0, 4.0)), "either polynomial or cardinal"),
        (lambda: SpeciesConfig("x", (), (5.0, 37.0, 36.0, 1.0)), r"\[t_min, t_opt, t_max, mu_opt\], rising"),
        (lambda: SpeciesConfig("x", (), (5.0, 20.0, 45.0, 1.0)), "t_opt nearer to t_max"),
        (lambda: SpeciesConfig("x", (0.1, float("nan"))), "pair, polynomial of x = .*: allowed numbers"),
        (
            lambda: replace(PairConfig(), temperatures=(34.0, 36.0)),
            "growth of P. putida minus growth of E. coli is",
        ),
        (
            lambda: replace(PairConfig(), temperatures=(10.0, 36.0)),
            "growth of E. coli at 10 degC = 0 1/h: allowed",
        ),
        (
            lambda: replace(PairConfig(), first=SpeciesConfig("x", (0.0012, -0.026))),
            "fastest growth of x = 0.0172 1/h: allowed 0.02 to 10 1/h",
        ),
        (lambda: replace(PairConfig(), first=replace(PairConfig().first, name="P. putida")), "pair, names = P. putida"),
        (lambda: replace(PairConfig(), first=replace(PairConfig().first, lag_min=61.0)), "at most pair.second.lag_min"),
        (lambda: CocultureConfig(temperatures=(28.0, 36.0)), "29 to 36 degC, the range of the pair"),
        (lambda: CocultureConfig(preview_min=365.0), r"env\.preview_min = 365"),
        (lambda: CocultureConfig(ambient_c=30.0), "less than the coldest target, 29 degC"),
        (lambda: named_pair("yeasts"), "pair = yeasts: allowed ecoli_pputida, ecoli_psyringae, a pair.yaml, or a run"),
        (lambda: named_pair("nowhere.yaml"), "pair = nowhere.yaml: No such file or directory; give the pair.yaml"),
    ],
)
def test_what_is_no_pair_is_refused(make, words) -> None:  # type: ignore[no-untyped-def]
    with pytest.raises(ValueError, match=words):
        make()


WHOLE = {
    "first": "{name: alpha, polynomial: [0.06, -1.1]}",
    "second": "{name: beta, cardinal: [4, 30, 37, 0.8], lag_min: 45}",
    "pigment": "{}",
    "temperatures": "[26, 34]",
}


def written(path: Path, **other: str | None) -> Path:
    lines = [f"{key}: {value}" for key, value in (WHOLE | other).items() if value is not None]
    path.write_text("\n".join(lines) + "\n")
    return path


def test_a_file_says_all_of_a_pair_and_nothing_of_another_one_stands_in(tmp_path: Path) -> None:
    path = written(tmp_path / "pair.yaml")
    pair = named_pair(str(path))
    assert named_pair(str(tmp_path)) == pair  # the folder that it lies in
    assert (pair.second.cardinal, pair.second.polynomial, pair.second.lag_min) == ((4.0, 30.0, 37.0, 0.8), (), 45.0)
    for key in WHOLE:
        with pytest.raises(ValueError, match=rf"pair = .*pair\.yaml = no {key}: allowed first, second, pigment"):
            named_pair(str(written(path, **{key: None})))
    for key in ("first", "second"):
        for half in ("{name: beta, lag_min: 20}", "{polynomial: [1, 2]}", "1"):
            with pytest.raises(ValueError, match=rf"pair\.yaml, {key} = .*: allowed a name and a curve"):
                named_pair(str(written(path, **{key: half})))
    with pytest.raises(ValueError, match=r"pair\.second\.lag: no such key"):
        named_pair(str(written(path, second="{name: b, polynomial: [1, 2], lag: 90}")))
    path.write_text("- 1\n")
    with pytest.raises(ValueError, match="the file has no keys with values"):
        named_pair(str(path))
    with pytest.raises(ValueError, match=r"pair = .*: No such file or directory; give the pair\.yaml"):
        named_pair(str(tmp_path.parent))


def test_plant_task_and_optimum_are_of_the_pair() -> None:
    plant = Plant(of_pair(preset("coculture"), WARM), 2, np.random.default_rng(0))
    for t in (22.0, 30.0):
        plant.reset(0.5, temperature=t)
        np.testing.assert_allclose(60.0 * plant.culture.rates(0.0), np.tile(WARM.rates(t), (2, 1)), rtol=1e-6)
    plant.advance(30.0, np.zeros(2), temperature_target=32.0)  # warm after a minute; each follows with its own lag
    behind = np.exp(-29.5 / np.array([2.0, 45.0]))
    expected = WARM.rates(32.0) + (WARM.rates(30.0) - WARM.rates(32.0)) * behind
    np.testing.assert_allclose(60.0 * plant.culture.rates(0.0)[0], expected, rtol=0.01)
    slower = replace(preset("coculture_growth_both"))
    plant = Plant(of_pair(slower, WARM), 1, np.random.default_rng(0))
    plant.reset(0.5, temperature=30.0)
    np.testing.assert_allclose(60.0 * plant.culture.rates(0.0)[0], WARM.rates(30.0) * [0.95, 0.9], rtol=1e-6)
    assert of_pair(PlantConfig(), PairConfig()) == PlantConfig()
    config = CocultureConfig(pair=WARM, ambient_c=15.0, control_min=30.0, n_actions=5)
    np.testing.assert_array_equal(config.targets(), [20.0, 23.0, 26.0, 29.0, 32.0])
    low, high = limits(config)
    assert (low[1], high[1]) == (15.0, 32.0)
    assert low[2] <= WARM.rates(20.0)[1] < WARM.rates(32.0)[1] <= high[2]
    env = CocultureVectorEnv(3, config)
    state, _ = env.reset(seed=1)
    assert env.observation_space.contains(state)
    model = transitions(config, Grid(41, 5, 5))
    value = cost_to_go(model, np.full((6, 1), 0.7))
    assert value[0].min() < 1e-3 < value[0].max()


def test_the_second_species_of_the_task_follows_with_the_lag_of_its_own_pair() -> None:
    """WARM's at 28 degC, where it grows by .68/h and the other by .6/h: of a gap e^-2 is left after 90 min."""
    config, start = CocultureConfig(pair=WARM, ambient_c=15.0), np.array([[0.7, 28.0, 0.3]])
    ((logit, degc, rate),) = advance(config, start, np.array(28.0), 90.0)
    left = np.exp(-2.0)
    assert (degc, rate) == (pytest.approx(28.0), pytest.approx(0.68 - 0.38 * left))
    assert logit == pytest.approx(0.7 + 1.5 * 0.08 - 0.38 * 0.75 * (1.0 - left), abs=1e-4)
