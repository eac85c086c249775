"""Simple laws on the learning task, noise-free: what docs/coculture.md, Benefit of planning, says of them."""

from collections.abc import Callable

import pytest

from envs.coculture.task import CocultureConfig
from experiments.coculture.task import Coculture
from experiments.training.evaluation import Evaluation
from tests.studies.learners import one_line, planned

pytestmark = pytest.mark.numeric

PREVIEW = CocultureConfig(control_min=30.0, episode_steps=24, preview_min=360.0)


@pytest.fixture(scope="module")
def regret() -> Callable[[str, CocultureConfig], float]:
    """Of a law on the reported grid, per cent."""
    known: dict[CocultureConfig, Evaluation] = {}

    def of(name: str, config: CocultureConfig) -> float:
        if config not in known:
            task = Coculture(config)
            known[config] = Evaluation(task, task.report_grid())
        return 100.0 * (one_line(name, config, known[config].start) / known[config].optimum_cost - 1.0)

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
    score = Evaluation(task, task.report_grid())(planned(task, 60 * hours), 1)
    assert score.regret_pct[0] == pytest.approx(expected, rel=0.05)
