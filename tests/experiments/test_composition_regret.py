"""Simple laws on the learning task, noise-free: what docs/coculture.md, What planning brings, says of them."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from envs.coculture.optimum import Grid, best_action, cost_to_go, transitions
from envs.coculture.task import CocultureConfig, advance, passed, share
from experiments.laws import registry
from experiments.laws.share.base import Array, Estimate, Law, Wanted
from experiments.training.coculture import Coculture
from experiments.training.evaluation import Evaluation

PREVIEW = CocultureConfig(control_min=30.0, episode_steps=24, preview_min=360.0)


def cost(law: Law, config: CocultureConfig, start: Array) -> float:
    """Mean over the starts of the sum of squared errors, with the state as the estimate."""
    law.reset(len(start))
    state, goal, total = start[:, :3], start[:, 3:], np.zeros(len(start))
    for k in range(config.episode_steps):
        wanted = share(goal[:, 0])
        following = share(goal[:, 1]) if config.preview_min else wanted
        left = goal[:, 2] if config.preview_min else np.zeros(len(start))
        for minute in range(round(config.control_min)):  # laws with a period of a minute act within the decision, too
            estimate = Estimate(
                state[:, 0], np.full(len(start), 0.01), state[:, 1], state[:, 2], *np.zeros((3, len(start)))
            )
            at = np.full(len(start), k * config.control_min + minute)
            told = Wanted(wanted, following, np.maximum(left - minute, 0.0) * (left > 0.0))
            target = law.act(estimate, told, at, np.ones(len(start), dtype=np.bool_))
            state = advance(config, state, target, 1.0)
        total += np.square(share(state[:, 0]) - wanted)
        goal = passed(config, goal)
    return float(total.mean())


@pytest.fixture(scope="module")
def regret() -> Callable[[str, CocultureConfig], float]:
    """Of a law on the reported grid, per cent."""
    known: dict[CocultureConfig, Evaluation] = {}

    def of(name: str, config: CocultureConfig, **values: float) -> float:
        if config not in known:
            task = Coculture(config)
            known[config] = Evaluation(task, task.report_grid())
        law = registry.build(replace(registry.config(name, registry.SHARE), **values), registry.SHARE)
        return 100.0 * (cost(law, config, known[config].start) / known[config].optimum_cost - 1.0)

    return of


@pytest.mark.parametrize(
    ("name", "expected"), [("proportional", 0.106), ("inverse_dynamics", 0.094), ("bang_bang", 0.134), ("pi", 2.33)]
)
def test_without_preview_simple_laws_are_close(regret, name: str, expected: float) -> None:
    assert regret(name, CocultureConfig()) == pytest.approx(expected, rel=0.05)


@pytest.mark.parametrize(("name", "expected"), [("midpoint", 13.0), ("proportional", 375.5)])
def test_with_preview_the_time_to_begin_decides(regret, name: str, expected: float) -> None:
    assert regret(name, PREVIEW) == pytest.approx(expected, rel=0.05)


def receding(decisions: int, config: CocultureConfig, start: Array) -> float:
    """Cost of the plan that ends after so many decisions, made anew before each of them."""
    model, state = transitions(config, Grid()), start[:, :3]
    program, goal = np.empty((config.episode_steps + decisions, len(start))), start[:, 3:]
    for k in range(len(program)):
        program[k], goal = share(goal[:, 0]), passed(config, goal)
    total = np.zeros(len(start))
    for k in range(config.episode_steps):
        value = cost_to_go(model, program[k : k + decisions])[1]
        action = best_action(config, model, value, state, program[k])
        state = advance(config, state, config.targets()[action], config.control_min)
        total += np.square(share(state[:, 0]) - program[k])
    return float(total.mean())


@pytest.mark.slow
@pytest.mark.parametrize(("hours", "expected"), [(1, 283.4), (2, 149.4), (3, 75.1)])
def test_how_far_a_plan_must_reach(hours: int, expected: float) -> None:
    task = Coculture(PREVIEW)
    evaluation = Evaluation(task, task.report_grid())
    regret = 100.0 * (receding(2 * hours, PREVIEW, evaluation.start) / evaluation.optimum_cost - 1.0)
    assert regret == pytest.approx(expected, rel=0.05)
