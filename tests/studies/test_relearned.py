"""The study of learning during a run: which vials fly, when a law is changed, and how a difference is told."""

from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from dqn import policy as policies
from experiments.control.policies import SHIPPED_COMPOSITION
from experiments.control.question import Question
from experiments.laws.share.base import Estimate, Wanted
from experiments.laws.share.estimator import CompositionEstimator, CompositionEstimatorConfig
from experiments.loop.share import program_of
from tests.studies.relearned import (
    DAY_MIN,
    LAW,
    PROGRAMS,
    SPECIAL,
    RelearnedConfig,
    Second,
    asked,
    compared,
    law,
    misjudged,
    vials,
)
from tests.studies.second_vials import draw

pytestmark = pytest.mark.numeric

SMALL = RelearnedConfig(vials=3, special=2, steps=1000, hours=5.0, seed=4)


def test_the_drawn_vials_are_those_of_the_other_study_and_behind_them_each_kind() -> None:
    conditions, rows = vials(SMALL)
    assert rows == ["drawn"] * 3 + [row for row in SPECIAL for _ in range(2)]
    np.testing.assert_array_equal(conditions.scale_p[:3], draw(3, 4, calibrated=True).scale_p)  # type: ignore[index]
    assert conditions.calibrated
    bottle = rows.index("another bottle after 30 h")
    assert np.isfinite(conditions.bottle_swap[bottle:]).all()  # type: ignore[index]
    assert np.isnan(conditions.bottle_swap[:bottle]).all()  # type: ignore[index]
    assert conditions.scale_e[rows.index("mu_e x 0.8")] == 0.8  # type: ignore[index]


def test_after_a_day_each_vial_flies_its_own() -> None:
    policy = policies.load(SHIPPED_COMPOSITION[LAW])
    other = replace(policy, metadata={**policy.metadata, "model": {**policy.metadata["model"], "scale_e": 0.6}})
    both = Second(law(LAW, policy), learned={1: other})
    both.reset(2)
    zero = np.zeros(2)
    estimate = Estimate(zero, zero, zero + 33.0, zero + 0.85, zero, zero, zero)
    wanted, rows = Wanted(zero + 0.5, zero + 0.5, zero), np.ones(2, dtype=np.bool_)
    for minute in (0, DAY_MIN - 1):
        first, second = both.act(estimate, wanted, zero + minute, rows)
        assert first == second
    first, second = both.act(estimate, wanted, zero + DAY_MIN, rows)
    assert both.first.number.tolist() == [0, 2]
    assert first != second


@pytest.mark.parametrize(
    ("less", "told"),
    [([-0.01, -0.03, -0.02], "-0.0200 ± 0.0113"), ([0.005], "+0.0050"), ([0.0, 0.0], "+0.0000 ± 0.0000")],
)
def test_a_difference_in_words(less: list[float], told: str) -> None:
    assert compared(np.array(less)) == told


def test_how_often_the_worse_policy_flies(monkeypatch: pytest.MonkeyPatch) -> None:
    luck = iter([[-0.02] * 3 + [-0.021], [0.04] * 4, [-0.05, 0.05, 0.0, 0.0], [0.05] * 4])  # less than the better one's

    def judged(question: Question, old: str, new: str) -> dict[str, list[float]]:
        assert (question.hours[1] - question.hours[0], old, new) == (pytest.approx(6.0), "shipped", "own")
        return {"old": [0.1] * 4, "new": [0.1 + less for less in next(luck)]}

    monkeypatch.setattr("tests.studies.relearned.lesson.judged", judged)
    one = CompositionEstimator(CompositionEstimatorConfig())
    with ThreadPoolExecutor(1) as pool:
        found = misjudged(pool, asked(one, SMALL, 0), "shipped", "own", 4)  # type: ignore[arg-type]
    assert found == {"judgements": 4, "worse_by": pytest.approx((0.04 + 0.05 - 0.02025) / 4), "worse_flew": 1}


def test_the_question_is_of_the_day_that_comes(tmp_path: Path) -> None:
    one = CompositionEstimator(CompositionEstimatorConfig())
    ones = np.ones(1)
    one.watch(0.5 * ones, 2000.0 * ones, 33.2 * ones, 0.0 * ones, ones.astype(np.bool_))
    (tmp_path / "001.json").write_text(asked(one, SMALL, 7).text())
    question = Question.read(tmp_path / "001.json")
    assert question.hours == pytest.approx((1439.0 / 60.0, 1439.0 / 60.0 + 5.0))
    assert (question.plan.seed, question.plan.steps) == (4007, 1000)
    program, theirs = program_of(question.scenario), PROGRAMS["ratio_steps"]
    for minute in (1440.0, 1700.0, 2100.0, 3000.0):
        mine = program.wanted(np.array([minute]), question.scenario.announce_min)
        share, following, until = theirs.ahead(minute)
        assert (mine.setpoint[0], mine.following[0], mine.minutes[0]) == (share, following, until)
