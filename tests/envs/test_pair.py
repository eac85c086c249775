"""A pair of species: its curves by hand, where they cross, and what is refused."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from envs.coculture.optimum import Grid, cost_to_go, transitions
from envs.coculture.pair import PairConfig, SpeciesConfig, named_pair
from envs.coculture.second import of_pair
from envs.coculture.task import CocultureConfig, CocultureVectorEnv, advance, limits
from envs.plant.plant import Plant, PlantConfig
from tests.envs.test_plant import preset

pytestmark = pytest.mark.numeric

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
        (lambda: SpeciesConfig("x", (), ()), "one of polynomial and cardinal"),
        (lambda: SpeciesConfig("x", (1.0,), (1.0, 2.0, 3.0, 4.0)), "one of polynomial and cardinal"),
        (lambda: SpeciesConfig("x", (), (5.0, 37.0, 36.0, 1.0)), r"\[t_min, t_opt, t_max, mu_opt\], rising"),
        (lambda: SpeciesConfig("x", (), (5.0, 20.0, 45.0, 1.0)), "t_opt nearer to t_max"),
        (lambda: SpeciesConfig("x", (0.1, float("nan"))), "pair, polynomial of x = .*: allowed numbers"),
        (lambda: replace(PairConfig(), temperatures=(34.0, 36.0)), "two of which the other one is faster at the other"),
        (
            lambda: replace(PairConfig(), temperatures=(10.0, 36.0)),
            "growth of E. coli at 10 degC = 0 1/h: allowed",
        ),
        (
            lambda: replace(PairConfig(), first=SpeciesConfig("x", (0.0012, -0.026))),
            "fastest growth of x = 0.0172 1/h: allowed 0.02 to 10 1/h; curves are per hour",
        ),
        (lambda: replace(PairConfig(), first=replace(PairConfig().first, name="P. putida")), "pair, names = P. putida"),
        (lambda: replace(PairConfig(), first=replace(PairConfig().first, lag_min=61.0)), "at most pair.second.lag_min"),
        (lambda: CocultureConfig(temperatures=(28.0, 36.0)), "29 to 36 degC, where the curves of the pair hold"),
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
    with pytest.raises(ValueError, match="holds no key: value pairs"):
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
