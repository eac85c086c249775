"""Laws of the composition by hand, against the model, by their regret; the program that they follow."""

import json
from collections.abc import Callable
from dataclasses import asdict, replace

import numpy as np
import pytest

from dqn.policy import Policy
from envs.coculture.pair import PairConfig
from envs.coculture.task import CocultureConfig, advance, at_rest, logit, share
from experiments.coculture import laws
from experiments.coculture.base import SEEN as COCULTURE
from experiments.coculture.base import SEEN_AHEAD as COCULTURE_PREVIEW
from experiments.coculture.base import SHARE, ShareEstimate, Wanted
from experiments.coculture.program import Program
from experiments.coculture.task import Coculture
from experiments.laws import registry
from experiments.training.evaluation import Evaluation
from hardware import memory
from tests.studies import learners
from tests.two_species import EQUAL_RATES_C, e_coli_rate, p_putida_rate

pytestmark = pytest.mark.numeric

NAN = float("nan")
STEPS = Program((NAN, 0.3, 0.7, 0.3), (60.0, 360.0, 600.0, 600.0))
BLIND = ("pi", "proportional", "inverse_dynamics", "bang_bang", "myopic", "receding")


def law(kind, program=STEPS, policy=None, **values):
    made = type(registry.config(kind, SHARE))(**values)
    return registry.build(made, SHARE, policy=policy, program=program)


def seen(x, temperature=33.2, rate=None):
    x = np.atleast_1d(np.asarray(x, dtype=float))
    warm = np.broadcast_to(float(temperature), x.shape)
    lagged = p_putida_rate(warm) if rate is None else np.full(x.shape, rate)
    return ShareEstimate(x, np.full(x.shape, 0.1), warm, lagged, *np.zeros((3, x.size)))


def asked(s, following=None, minutes=0.0, n=1):
    now = np.full(n, float(s))
    return Wanted(now, now if following is None else np.full(n, float(following)), np.full(n, float(minutes)))


def at(minute, n=1):
    return np.full(n, float(minute)), np.ones(n, dtype=bool)


def on_the_model(kind, program, announce_min=360.0, start=0.5, policy=None, **values):
    """Shares minute by minute where the estimate is the truth."""
    controller, config = law(kind, program, policy, **values), CocultureConfig()
    controller.reset(1)
    state, shares = at_rest(config, logit(np.array([start]))), [start]
    for minute in range(int(program.total_min)):
        wanted = program.wanted(np.array([float(minute)]), announce_min)
        known = ShareEstimate(state[:, 0], np.zeros(1), state[:, 1], state[:, 2], *np.zeros((3, 1)))
        target = controller.act(known, wanted, np.array([float(minute)]), np.isfinite(wanted.setpoint))
        state = advance(config, state, np.where(np.isfinite(wanted.setpoint), target, 33.2), 1.0)
        shares.append(float(share(state[0, 0])))
    return np.array(shares)


def error(shares, program):
    wanted = program.setpoint(np.arange(len(shares), dtype=float))
    return float(np.nanmean(np.abs(shares - wanted)))


def test_the_vendors_pi_is_its_formula():
    pi, integral = law("pi"), 0.0
    for minute, r in enumerate((0.45, 0.47, 0.52)):
        integral += 0.01 * (0.5 - r)
        target = pi.act(seen(logit(r)), asked(0.5), *at(minute))
        assert target[0] == pytest.approx(EQUAL_RATES_C - 15.0 * (0.5 - r) - integral, abs=1e-9)


def test_the_vendors_integrator_rests_at_the_limit_it_pushes_against():
    pi = law("pi")
    for minute in range(50):
        assert pi.act(seen(logit(0.1)), asked(0.9), *at(minute))[0] == 29.0
    assert pi.act(seen(logit(0.9)), asked(0.9), *at(50))[0] == pytest.approx(EQUAL_RATES_C)


def test_bang_bang_by_hand():
    x = np.log(0.4 / 0.6)
    assert law("bang_bang").act(seen(x), asked(0.45), *at(0))[0] == 29.0
    assert law("bang_bang").act(seen(x), asked(0.35), *at(0))[0] == 36.0


def test_targets_stay_within_the_range_of_the_fits():
    for kind in BLIND:
        for r in (0.01, 0.99):
            assert 29.0 <= law(kind).act(seen(logit(r)), asked(0.5), *at(0))[0] <= 36.0


def test_myopic_is_the_best_of_seventeen_and_a_horizon_of_one_decision_is_myopic():
    config = CocultureConfig(control_min=30.0)
    x = np.linspace(-1.0, 1.0, 9)
    state = np.stack([x, np.full(9, 33.2), p_putida_rate(np.full(9, 33.2))], axis=1)
    reached = [share(advance(config, state, t, 30.0)[:, 0]) for t in np.linspace(29.0, 36.0, 17)]
    best = np.linspace(29.0, 36.0, 17)[np.abs(np.array(reached) - 0.5).argmin(axis=0)]
    for kind, values in (("myopic", {}), ("receding", {"horizon_min": 30.0})):
        found = law(kind, control_min=30.0, **values)
        found.reset(9)
        np.testing.assert_array_equal(found.act(seen(x), asked(0.5, n=9), *at(0, 9)), best)


def test_a_law_keeps_its_target_until_its_period_is_over_and_decides_at_its_multiples():
    found = law("myopic")
    first = found.act(seen(-1.0), asked(0.5), *at(3))[0]
    for minute in (4, 9):
        assert found.act(seen(1.0), asked(0.5), *at(minute))[0] == first
    assert found.act(seen(1.0), asked(0.5), *at(10))[0] != first


@pytest.mark.parametrize(("now", "following"), [(0.3, 0.7), (0.7, 0.3), (0.2, 0.5), (0.8, 0.6)])
def test_the_midpoint_law_is_half_way_at_the_change(now, following):
    program = Program((now, following), (480.0, 480.0))
    shares = on_the_model("midpoint", program, start=now)
    half = 0.5 * (logit(now) + logit(following))
    one_decision = 10.0 / 60.0 * 0.64  # logit, the fastest there is
    assert abs(logit(shares[480]) - half) <= one_decision
    assert np.abs(shares[:120] - now).max() < 0.01  # it does not begin before it must
    assert abs(shares[-1] - following) < 0.01


def test_a_midpoint_law_that_has_begun_does_not_turn_back_nor_does_one_that_is_resumed():
    """From .3 to .7 in 90 min is late, and from .5 in 85 min early: one that had not begun would warm it."""
    begun, resumed, other = law("midpoint"), law("midpoint"), law("midpoint")
    assert begun.act(seen(logit(0.3)), asked(0.3, 0.7, 90.0), *at(0))[0] == 29.0
    memory.restore(resumed, json.loads(json.dumps(memory.save(begun))), "composition")
    targets = [each.act(seen(0.0), asked(0.3, 0.7, 85.0), *at(5))[0] for each in (begun, resumed, other)]
    assert targets == [29.0, 29.0, 36.0]


def test_errors_of_curves_and_thermometer_reach_the_laws():
    """A culture that is on its setpoint with its rates in balance stays there, whatever is off by how much."""
    off = replace(seen(np.zeros(1)), error_e=np.array([0.2]), error_p=np.array([-0.1]), thermometer=np.array([0.5]))
    t = np.linspace(29.0, 36.0, 70001)
    even = t[np.argmin(np.abs(1.2 * e_coli_rate(t) - 0.9 * p_putida_rate(t)))]
    rest = replace(off, rate=0.9 * p_putida_rate(np.array([even])))
    for kind in ("proportional", "inverse_dynamics", "midpoint"):
        assert law(kind).act(rest, asked(0.5), *at(0))[0] == pytest.approx(even - 0.5, abs=5e-3), kind
    assert law("pi").act(rest, asked(0.5), *at(0))[0] == pytest.approx(EQUAL_RATES_C)  # the vendor's knows of neither
    ahead = Wanted(np.array([0.5]), np.array([0.7]), np.array([150.0]))
    faster = replace(off, error_e=np.array([-0.3]), error_p=np.array([0.3]))
    assert law("midpoint").act(faster, ahead, *at(0))[0] > 29.0  # it gets there sooner than the curves say
    assert law("midpoint").act(off, ahead, *at(0))[0] == 29.0


def test_the_midpoint_law_is_inverse_dynamics_where_nothing_is_announced():
    shares = on_the_model("midpoint", STEPS, announce_min=0.0)
    other = on_the_model("inverse_dynamics", STEPS, control_min=5.0)
    np.testing.assert_allclose(shares, other)


@pytest.mark.slow
def test_nothing_beats_the_optimum_over_the_program_and_foresight_pays():
    """With the tolerance of its grid."""
    best = error(on_the_model("optimum", STEPS), STEPS)
    found = {kind: error(on_the_model(kind, STEPS), STEPS) for kind in (*BLIND, "midpoint")}
    assert best <= 1.03 * min(found.values())
    assert found["receding"] <= 1.1 * best
    assert found["midpoint"] <= 1.2 * best
    blind = error(on_the_model("receding", STEPS, announce_min=0.0), STEPS)
    assert blind > 1.5 * best


def linear_policy(names, column, control_min=10.0):
    """Prefers the second of two temperatures, 30 and 35 degC, where one number of the observation is above 0."""
    weight = np.zeros((len(names), 2), dtype=np.float32)
    weight[names.index(column), 1] = 1.0
    preview = 360.0 if len(names) == 6 else 0.0
    model = asdict(CocultureConfig(control_min=control_min, preview_min=preview))
    return Policy(
        weights=(weight,),
        biases=(np.zeros(2, dtype=np.float32),),
        input_matrix=np.eye(len(names), dtype=np.float32),
        input_offset=np.zeros(len(names), dtype=np.float32),
        actions=np.array([30.0, 35.0]),
        low=np.full(len(names), -1e6, dtype=np.float32),
        high=np.full(len(names), 1e6, dtype=np.float32),
        metadata={"observation": list(names), "control_min": control_min, "model": model},
    )


@pytest.mark.parametrize(
    ("column", "x", "wanted", "expected"),
    [
        ("logit_share", 0.1, asked(0.4), 35.0),
        ("logit_share", -0.1, asked(0.6), 30.0),
        ("logit_setpoint", -0.1, asked(0.6), 35.0),
        ("logit_next", 0.1, asked(0.4, 0.6, 100.0), 35.0),
        ("logit_next", 0.1, asked(0.4, 0.6, 700.0), 30.0),  # further ahead than it was trained for
        ("minutes_to_change", 0.1, asked(0.4, 0.6, 700.0), 30.0),
        ("minutes_to_change", 0.1, asked(0.4, 0.6, 300.0), 35.0),
    ],
)
def test_a_policy_sees_what_it_was_trained_on(column, x, wanted, expected):
    found = law("dqn_preview", policy=linear_policy(COCULTURE_PREVIEW, column))
    assert found.act(seen(x), wanted, *at(0))[0] == expected
    if column in COCULTURE:
        assert law("dqn", policy=linear_policy(COCULTURE, column)).act(seen(x), wanted, *at(0))[0] == expected


@pytest.mark.parametrize(("kind", "sees", "every"), [("dqn", COCULTURE, 10), ("dqn_preview", COCULTURE_PREVIEW, 5)])
def test_a_policy_decides_as_often_as_the_law_says_not_as_in_training(kind, sees, every):
    found = law(kind, policy=linear_policy(sees, "logit_share", control_min=30.0))
    assert found.act(seen(1.0), asked(0.5), *at(0))[0] == 35.0
    assert found.act(seen(-1.0), asked(0.5), *at(every - 1))[0] == 35.0
    assert found.act(seen(-1.0), asked(0.5), *at(every))[0] == 30.0


def test_what_cannot_be_built_is_said_in_one_line():
    with pytest.raises(ValueError, match=r"^composition.kind = pid: allowed dqn, dqn_preview, pi"):
        registry.config("pid", SHARE)
    with pytest.raises(ValueError, match=r"^composition = dqn: needs a policy"):
        registry.build(registry.config("dqn", SHARE), SHARE)
    with pytest.raises(ValueError, match=r"^composition = optimum: needs the whole schedule"):
        registry.build(registry.config("optimum", SHARE), SHARE)
    with pytest.raises(ValueError, match=r"^policy = .*logit_next.*env=coculture"):
        law("dqn", policy=linear_policy(COCULTURE_PREVIEW, "rate"))
    with pytest.raises(ValueError, match=r"^composition.gain = 0.0 degC"):
        law("proportional", gain=0.0)


@pytest.mark.parametrize("kind", [*BLIND, "midpoint"])
def test_reactors_with_other_programs_and_clocks_are_as_if_alone(kind):
    """Samples every 1, 2 and 3 min; another program each; the third begins later. Without a sample a target stays."""
    programs = [Program((0.4, 0.7), (200.0, 200.0)), Program((0.6, 0.3), (90.0, 310.0)), STEPS]
    periods, begins = np.array([1, 2, 3]), np.array([0, 0, 70])
    together, each = law(kind), [law(kind) for _ in programs]
    together.reset(3)
    before = np.full(3, EQUAL_RATES_C)
    for k in range(150):
        rows = (k >= begins) & ((k - begins) % periods == 0)
        minute = np.maximum(k - begins, 0).astype(float)
        wanted = [p.wanted(minute[n : n + 1], 360.0) for n, p in enumerate(programs)]
        joined = Wanted(
            *(np.concatenate([getattr(w, a) for w in wanted]) for a in ("setpoint", "following", "minutes"))
        )
        rows &= np.isfinite(joined.setpoint)
        known = seen(0.3 * np.sin(k / 20.0 + np.arange(3)))
        target = together.act(known, joined, minute, rows)
        np.testing.assert_allclose(target[~rows], before[~rows])
        before = target
        for n in np.flatnonzero(rows):
            mine = each[n].act(known.of(np.array([n])), wanted[n], minute[n : n + 1], np.ones(1, dtype=bool))
            assert target[n] == mine[0], (k, n)


MIRRORED = PairConfig(  # the default pair with T for 65 - T: warmth makes the second species gain
    first=replace(PairConfig().first, polynomial=(-0.07727, 65.0 * 0.07727 - 1.66954)),
    second=replace(
        PairConfig().second,
        polynomial=(-0.02208, 2.0 * 65.0 * 0.02208 - 1.3796, -0.02208 * 65.0**2 + 1.3796 * 65.0 - 20.56996),
    ),
)


@pytest.mark.parametrize("kind", ["pi", "proportional", "inverse_dynamics", "bang_bang", "midpoint"])
def test_where_warmth_makes_the_second_gain_every_target_is_mirrored(kind):
    """Long at a limit, so that an integrator which does not rest there is seen when the sign turns."""
    here = law(kind)
    there = registry.build(type(registry.config(kind, SHARE))(), SHARE, program=STEPS, pair=MIRRORED)
    for minute in range(300):
        s = (0.9, 0.1, 0.48)[minute // 100]
        known = seen(0.1 * np.sin(minute / 9.0))
        ours = here.act(known, asked(s), *at(minute))[0]
        theirs = there.act(replace(known, temperature=65.0 - known.temperature), asked(s), *at(minute))[0]
        assert theirs == pytest.approx(65.0 - ours, abs=2e-3), (kind, minute)


def test_settings_of_ones_own_are_those_that_decide():
    """Two cultures whose shares and setpoints differ; the vendor's integral after one decision of a quarter of an hour.

    Inverse dynamics with 2 h to reach it: m_p - mu_e(T) = (logit s - logit r) / 2.
    """
    x, goal = np.array([-0.05, 0.2]), Wanted(np.array([0.5, 0.52]), np.array([0.5, 0.52]), np.zeros(2))
    error = logit(goal.setpoint) - x
    found = {}
    for kind, values in (
        ("proportional", {"gain": 7.0}), ("pi", {"gain": 9.0, "integral": 2.0, "control_min": 15.0}),
        ("inverse_dynamics", {"reach_min": 120.0}),
    ):  # fmt: skip
        found[kind] = law(kind, **values)
        found[kind].reset(2)
        found[kind] = found[kind].act(seen(x), goal, *at(0, 2))
    np.testing.assert_allclose(found["proportional"], EQUAL_RATES_C - 7.0 * error, atol=2e-3)
    np.testing.assert_allclose(found["pi"], EQUAL_RATES_C - 11.0 * (goal.setpoint - share(x)), atol=1e-9)
    rates = p_putida_rate(33.2) - e_coli_rate(found["inverse_dynamics"])
    np.testing.assert_allclose(rates, error / 2.0, atol=1e-6)


def test_a_policy_is_shown_of_each_culture_its_own_numbers_and_each_thermostat_its_own_error():
    """True temperatures are what was learned from; a thermostat goes by its thermometer, which is off by another.

    The policy was trained with .8 of the first species' growth: a culture that has .75 is shown a larger m_p.
    """
    shown = []

    class Watched(Policy):
        def chosen(self, observation):
            shown.append(observation.copy())
            return np.where(observation[:, 0] > 0.0, 35.0, 31.0)

    given = Watched(**vars(linear_policy(COCULTURE_PREVIEW, "rate")))
    given.metadata["model"]["scale_e"] = 0.8
    found = law("dqn_preview", policy=given)
    found.reset(3)
    one = seen([0.3, -0.2, 9.0])
    one = replace(
        one, temperature=np.array([30.5, 34.0, 29.0]), rate=np.array([0.7, 0.8, 0.9]),
        thermometer=np.array([0.25, -0.5, 0.0]), error_e=np.array([-0.25, -0.2, 0.0]),
    )  # fmt: skip
    asked_for = Wanted(np.array([0.4, 0.6, 0.5]), np.array([0.7, 0.2, 0.5]), np.array([90.0, 400.0, 0.0]))
    target = found.act(one, asked_for, np.zeros(3), np.array([True, True, False]))
    first = [0.3, 30.5, 0.7 + 0.05 * e_coli_rate(EQUAL_RATES_C), logit(0.4), logit(0.7), 90.0]
    np.testing.assert_allclose(shown[0], [first, [-0.2, 34.0, 0.8, logit(0.6), logit(0.6), 0.0]])
    np.testing.assert_allclose(target, [34.75, 31.5, EQUAL_RATES_C])


def test_a_receding_plan_asks_for_the_next_share_from_its_change_on_and_no_further_than_its_horizon(monkeypatch):
    """Three decisions of half an hour: the first is judged at once, a change in 45 min comes before the third one."""
    plans, judged = [], []
    monkeypatch.setattr(laws, "_ahead", lambda model, later: plans.append(later) or np.array([len(plans)]))
    monkeypatch.setattr(
        laws, "_best",
        lambda model, value, known, goal: judged.append((int(value[0]), known.logit.tolist(), goal.tolist()))
        or 30.0 + known.logit,
    )  # fmt: skip
    found = law("receding", control_min=30.0, horizon_min=90.0)
    found.reset(4)
    wanted = Wanted(np.array([0.3, 0.5, 0.3, 0.3]), np.array([0.7, 0.5, 0.7, 0.7]), np.array([45.0, 0.0, 400.0, 30.0]))
    target = found.act(seen([1.0, 2.0, 3.0, 4.0]), wanted, *at(0, 4))
    assert sorted(plans) == [(0.3, 0.3), (0.3, 0.7), (0.5, 0.5), (0.7, 0.7)]
    by_culture = {known[0]: (plans[number - 1], goal) for number, known, goal in judged}
    assert by_culture == {
        1.0: ((0.3, 0.7), [0.3]), 2.0: ((0.5, 0.5), [0.5]), 3.0: ((0.3, 0.3), [0.3]), 4.0: ((0.7, 0.7), [0.3]),
    }  # fmt: skip
    assert target.tolist() == [31.0, 32.0, 33.0, 34.0]


def test_the_optimum_plans_what_is_asked_for_in_each_period_and_goes_by_what_comes_after_it(monkeypatch):
    """45 min without a share, 60 of .3, 30 without, in which the next one counts already, and 30 of .7."""
    programs, values = [], []

    def costs(model, setpoints):
        programs.append(setpoints[:, 0].tolist())
        return np.arange(len(setpoints) + 1.0)[:, None, None]

    monkeypatch.setattr(laws, "cost_to_go", costs)
    monkeypatch.setattr(laws, "transitions", lambda model: None)
    monkeypatch.setattr(
        laws, "_best",
        lambda model, value, known, goal: values.append((known.logit.tolist(), float(value[0]))) or 30.0 + 0 * goal,
    )  # fmt: skip
    found = law("optimum", Program((NAN, 0.3, NAN, 0.7), (45.0, 60.0, 30.0, 30.0)), control_min=30.0)
    found.reset(4)
    found.act(seen([1.0, 2.0, 3.0, 4.0]), asked(0.5, n=4), np.array([95.0, 20.0, 1000.0, 60.0]), np.ones(4, dtype=bool))
    assert programs == [[0.3, 0.3, 0.3, 0.7, 0.7, 0.7]]
    assert {known[0]: value for known, value in values} == {1.0: 4.0, 2.0: 1.0, 3.0: 6.0, 4.0: 3.0}


def test_each_culture_is_looked_ahead_for_as_many_periods_as_are_nearest_to_its_own_change():
    """At rest at 36 degC, and 36 asked for: the logit falls evenly, for 20, 30, 0 and 10 min in decisions of 10."""
    warm = seen([0.1, 0.2, 0.3, 0.4], 36.0)
    fall = (float(p_putida_rate(36.0)) - float(e_coli_rate(36.0))) / 60.0
    found = law("midpoint", control_min=10.0)._reached(warm, np.full(4, 36.0), np.array([17.0, 33.0, 4.0, 10.0]))
    np.testing.assert_allclose(found, warm.logit + fall * np.array([20.0, 30.0, 0.0, 10.0]))


def test_a_midpoint_law_that_has_begun_is_not_on_its_way_to_another_change():
    """Late on the way from .3 to .7. Then .32 is announced in its place, and a share of .42 has to fall to .3 first."""
    begun, other = law("midpoint"), law("midpoint")
    assert begun.act(seen(logit(0.3)), asked(0.3, 0.7, 90.0), *at(0))[0] == 29.0
    targets = [each.act(seen(logit(0.42)), asked(0.3, 0.32, 85.0), *at(5))[0] for each in (begun, other)]
    assert targets == [36.0, 36.0]


PREVIEW = CocultureConfig(control_min=30.0, episode_steps=24, preview_min=360.0)


@pytest.fixture(scope="module")
def regret() -> Callable[[str, CocultureConfig], float]:
    """Of a law on the reported grid, per cent."""
    known: dict[CocultureConfig, Evaluation] = {}

    def of(name: str, config: CocultureConfig) -> float:
        if config not in known:
            task = Coculture(config)
            known[config] = Evaluation(task, task.report_grid())
        return 100.0 * (learners.one_line(name, config, known[config].start) / known[config].optimum_cost - 1.0)

    return of


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "expected"), [("proportional", 0.106), ("inverse_dynamics", 0.094), ("bang_bang", 0.134), ("pi", 2.33)]
)
def test_without_preview_simple_laws_are_close(regret, name: str, expected: float) -> None:
    assert regret(name, CocultureConfig()) == pytest.approx(expected, rel=0.05)


@pytest.mark.slow
@pytest.mark.parametrize(("name", "expected"), [("midpoint", 13.0), ("proportional", 375.5)])
def test_with_preview_the_time_to_begin_decides(regret, name: str, expected: float) -> None:
    assert regret(name, PREVIEW) == pytest.approx(expected, rel=0.05)


@pytest.mark.campaign
@pytest.mark.parametrize(("hours", "expected"), [(1, 283.4), (2, 149.4), (3, 75.1)])
def test_how_far_a_plan_must_reach(hours: int, expected: float) -> None:
    task = Coculture(PREVIEW)
    score = Evaluation(task, task.report_grid())(learners.planned(task, 60 * hours), 1)
    assert score.regret_pct[0] == pytest.approx(expected, rel=0.05)


EVENTS = Program((NAN, 0.3, 0.7, 0.7, 0.3, NAN, 0.5), (60.0, 360.0, 300.0, 300.0, 60.0, 60.0, 60.0))


def told(program, minute, preview_min):
    found = program.wanted(np.array([float(minute)]), preview_min)
    return tuple(float(v[0]) for v in (found.setpoint, found.following, found.minutes))


SINE = Program((), (2400.0,), (0.5, 0.4, 1200.0))


@pytest.mark.parametrize(
    ("program", "minute", "preview", "expected"),
    [
        (EVENTS, 60, 0.0, (0.3, 0.3, 0.0)), (EVENTS, 60, 359.0, (0.3, 0.3, 0.0)),
        (EVENTS, 60, 360.0, (0.3, 0.7, 360.0)),
        (EVENTS, 419, 360.0, (0.3, 0.7, 1.0)), (EVENTS, 700, 360.0, (0.7, 0.3, 320.0)),
        (EVENTS, 420, 360.0, (0.7, 0.7, 0.0)),  # .7 goes on for 600 min
        (EVENTS, 1050, 360.0, (0.3, 0.3, 0.0)),  # nothing is asked for after it
        (EVENTS, 1150, 360.0, (0.5, 0.5, 0.0)), (EVENTS, 5000, 360.0, (0.5, 0.5, 0.0)),  # the last one after the end
        (SINE, 0, 0.0, (0.5, 0.5, 0.0)), (SINE, 900, 360.0, (0.9, 0.5, 120.0)), (SINE, 300, 0.0, (0.1, 0.1, 0.0)),
        (SINE, 900, 100.0, (0.9, 0.5 + 0.4 * np.cos(np.pi / 6.0), 40.0)),
        (SINE, 2200, 360.0, (0.5 + 0.4 * np.sin(np.pi / 3.0), 0.5 + 0.4 * np.sin(np.pi / 3.0), 0.0)),  # the end is near
    ],
)  # fmt: skip
def test_a_change_is_announced_as_early_as_it_says(program, minute, preview, expected):
    """A sine falls first and is announced as a step."""
    assert told(program, minute, preview) == pytest.approx(expected)


@pytest.mark.parametrize("minute", [-1.0, NAN, 0.0, 59.0, 1080.0])
def test_where_nothing_is_asked_for_nothing_is(minute):
    assert np.isnan(EVENTS.setpoint(np.array([minute]))[0])
    assert np.isnan(told(EVENTS, minute, 360.0)[0])
    assert told(EVENTS, minute, 360.0)[2] == 0.0


def test_when_changes_are_announced() -> None:
    """Each as long before it as asked for, but not before its phase begins; phases of one share are one."""
    program = Program((NAN, 0.3, 0.3, 0.7, NAN, 0.5, 0.2), (60.0, 100.0, 200.0, 30.0, 10.0, 500.0, 20.0))
    minute, share = program.announcements(150.0)
    assert minute.tolist() == [210.0, 750.0]  # .3 to .7 at 360, .5 to .2 at 900
    assert share.tolist() == [0.7, 0.2]
    minute, _ = program.announcements(1000.0)
    assert minute.tolist() == [60.0, 400.0]
    assert program.announcements(0.0)[0].size == 0
    assert Program((), (60.0,), (0.5, 0.2, 100.0)).announcements(60.0)[0].size == 0
    assert program.extremes == (0.3, 0.3, 0.7, 0.5, 0.2)
    assert Program((), (60.0,), (0.5, -0.2, 100.0)).extremes == (0.3, 0.7)
