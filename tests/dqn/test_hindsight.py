"""Relabelled transitions: still true, goals where they are said to be."""

from collections.abc import Callable

import numpy as np
import pytest
import torch

from dqn.config import DQNConfig
from dqn.hindsight import GoalRelabel, ProgramRelabel, ShiftRelabel
from dqn.replay import Transition

pytestmark = pytest.mark.numeric

AGENTS, BATCH = 4, 500


def _batch(od: float | None = None) -> Transition:
    generator = torch.Generator().manual_seed(0)
    numbers = torch.rand(AGENTS, BATCH, 2, 2, generator=generator)
    before, after = numbers[..., 0], numbers[..., 1]
    if od is not None:
        after[..., 0] = od
    action = torch.randint(0, 17, (AGENTS, BATCH), generator=generator)
    return Transition(before, action, torch.full((AGENTS, BATCH), 9.0), after, torch.ones(AGENTS, BATCH))


def _relabel(near: float, batch: Transition, width: tuple[float, float] = (1e-3, 0.8)) -> Transition:
    uniform = torch.rand(AGENTS, BATCH, 2, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    config = DQNConfig(hindsight_near=near, hindsight_width=width)
    relabel = GoalRelabel(config, (0.2, 1.0), lambda x, goal: -((x - goal) ** 2))
    relabel.replace(batch, relabel.drawn(uniform))
    return batch


@pytest.mark.parametrize("near", [0.0, 0.5, 1.0])
def test_only_the_goal_and_its_reward_change(near: float) -> None:
    old, new = _batch(), _relabel(near, _batch())
    assert torch.equal(old.s_tm1[..., 0], new.s_tm1[..., 0])
    assert torch.equal(old.s_t[..., 0], new.s_t[..., 0])
    assert torch.equal(old.a_tm1, new.a_tm1)
    assert torch.equal(old.continues, new.continues)
    goal = new.s_t[..., 1]
    assert torch.equal(goal, new.s_tm1[..., 1])
    assert float(goal.min()) >= 0.2 - 1e-6
    assert float(goal.max()) <= 1.0 + 1e-6
    torch.testing.assert_close(new.r_t, -((new.s_t[..., 0] - goal) ** 2))
    assert [field.dtype for field in new] == [field.dtype for field in old]


def test_far_goals_are_uniform() -> None:
    goal = _relabel(0.0, _batch()).s_t[..., 1].numpy().ravel()
    count, _ = np.histogram(goal, bins=8, range=(0.2, 1.0))
    assert ((count - 250.0) ** 2 / 250.0).sum() < 24.3  # 99.9 % quantile with 7 degrees of freedom


def test_share_of_near_goals() -> None:
    new = _relabel(0.3, _batch(od=0.6), width=(1e-3, 1e-2))
    close = (new.s_t[..., 1] - 0.6).abs() <= 1.001e-2
    assert bool(close[:, :150].all())
    assert float(close[:, 150:].double().mean()) < 0.06


def test_a_state_outside_all_setpoints_gets_a_far_goal() -> None:
    goal = _relabel(1.0, _batch(od=5.0)).s_t[..., 1]
    assert float(goal.max()) <= 1.0
    assert float(goal.std()) > 0.2


def _both(
    relabel: ShiftRelabel | ProgramRelabel, width: int, step: Callable[[torch.Tensor, torch.Tensor], torch.Tensor]
) -> tuple[Transition, Transition]:
    """A batch in which an action moves the first number of an observation by `step`; and the same relabelled."""
    generator = torch.Generator().manual_seed(2)
    before = torch.rand(AGENTS, BATCH, width, generator=generator)
    action = torch.randint(0, 17, (AGENTS, BATCH), generator=generator)
    after = before.clone()
    after[..., 0] += step(before, action)
    old = Transition(before, action, torch.zeros(AGENTS, BATCH), after, torch.ones(AGENTS, BATCH))
    new, generator = Transition(*(field.clone() for field in old)), torch.Generator().manual_seed(1)
    uniform = torch.rand(AGENTS, BATCH, relabel.numbers, generator=generator, dtype=torch.float64)
    relabel.replace(new, relabel.drawn(uniform))
    return old, new


def _shifted(near: float) -> tuple[Transition, Transition]:
    """Transitions of e' = e + s - v."""
    relabel = ShiftRelabel(DQNConfig(hindsight_near=near, hindsight_width=(0.01, 0.3)), 1.2, lambda e: -e * e)
    return _both(relabel, 2, lambda before, action: before[..., 1] - action / 16.0)


@pytest.mark.parametrize("near", [0.0, 0.4, 1.0])
def test_a_shifted_error_is_as_true_as_the_one_that_was_seen(near: float) -> None:
    old, new = _shifted(near)
    assert torch.equal(old.a_tm1, new.a_tm1)
    for one, other in ((old.s_tm1, new.s_tm1), (old.s_t, new.s_t)):
        assert torch.equal(one[..., 1], other[..., 1])
    torch.testing.assert_close(new.s_t[..., 0], new.s_tm1[..., 0] + new.s_tm1[..., 1] - new.a_tm1 / 16.0)
    torch.testing.assert_close(new.r_t, -(new.s_t[..., 0] ** 2))
    n = round(near * BATCH)
    close = new.s_t[:, :n, 0].abs()
    assert ((close > 0.0099) & (close < 0.3001)).all()
    far = new.s_tm1[:, n:, 0].numpy().ravel()
    if far.size:
        np.testing.assert_allclose(np.quantile(far, [0.25, 0.5, 0.75]), [-0.6, 0.0, 0.6], atol=0.1)
        assert np.abs(far).max() <= 1.2001


def test_near_goals_cover_every_order_of_magnitude_on_both_sides() -> None:
    goals = _relabel(1.0, _batch(od=0.6), width=(1e-3, 0.1)).s_t[..., 1] - 0.6
    for error, least, most in ((goals, 1e-3, 0.1), (_shifted(1.0)[1].s_t[..., 0], 0.01, 0.3)):
        distance = np.log(error.abs().numpy().ravel())
        count, _ = np.histogram(distance, bins=4, range=(np.log(least), np.log(most)))
        assert count.sum() >= 0.999 * distance.size  # rounding of x' may move the ends
        assert ((count - 500.0) ** 2 / 500.0).sum() < 16.3  # 99.9 % quantile with 3 degrees of freedom
        assert float((error > 0).double().mean()) == pytest.approx(0.5, abs=0.05)


def test_a_state_that_a_step_multiplies_is_moved_by_a_factor() -> None:
    place = {
        "place": lambda u: 0.1 + u,
        "spread": lambda u: u,
        "reward": lambda x, setpoint: -torch.square(x - setpoint),
    }
    relabel = ProgramRelabel(DQNConfig(), column=1, scales=True, **place)  # type: ignore[arg-type]
    _, new = _both(relabel, 2, lambda before, action: before[..., 0] * action / 20.0)
    torch.testing.assert_close(new.s_t[..., 0] / new.s_tm1[..., 0], 1.0 + new.a_tm1 / 20.0, atol=1e-4, rtol=0.0)


def _program(near: float, preview: float) -> tuple[Transition, Transition]:
    """Transitions of x' = x + (a - 8) / 20 under a setpoint, with or without an announced change."""
    relabel = ProgramRelabel(
        DQNConfig(hindsight_near=near, hindsight_width=(0.01, 0.3)), lambda u: 6.0 * u - 3.0, lambda u: 4.0 * u - 2.0,
        lambda x, setpoint: -torch.square(x - setpoint), 1, 30.0, preview,
    )  # fmt: skip
    return _both(relabel, 4 if preview else 2, lambda before, action: (action - 8) / 20.0)


@pytest.mark.parametrize("near", [0.0, 0.5])
@pytest.mark.parametrize("preview", [0.0, 90.0])
def test_another_program_is_as_true_as_the_one_that_was_seen(near: float, preview: float) -> None:
    old, new = _program(near, preview)
    assert torch.equal(old.a_tm1, new.a_tm1)
    torch.testing.assert_close(new.s_t[..., 0] - new.s_tm1[..., 0], (new.a_tm1 - 8) / 20.0, atol=1e-5, rtol=0.0)
    x, setpoint = new.s_t[..., 0], new.s_tm1[..., 1]
    torch.testing.assert_close(new.r_t, -torch.square(x - setpoint))
    assert float(x.abs().max()) <= 3.0
    assert float(setpoint.abs().max()) <= 2.0 + 1e-6
    n = round(near * BATCH)
    inside = x[:, :n].abs() < 1.7
    distance = (x - setpoint)[:, :n].abs()[inside]
    assert bool(((distance > 0.0099) & (distance < 0.3001)).all())
    if not preview:
        assert torch.equal(new.s_t[..., 1], setpoint)
        return
    following, time = new.s_tm1[..., 2], new.s_tm1[..., 3]
    assert set(time.unique().tolist()) == {0.0, 30.0, 60.0, 90.0}
    assert float((time == 0.0).double().mean()) == pytest.approx(0.2, abs=0.04)
    assert torch.equal(following[time == 0.0], setpoint[time == 0.0])
    for before, after in ((0.0, 0.0), (30.0, 0.0), (60.0, 30.0), (90.0, 60.0)):
        here = time == before
        assert set(new.s_t[..., 3][here].tolist()) == {after}
        assert torch.equal(new.s_t[..., 2][here], following[here])
        assert torch.equal(new.s_t[..., 1][here], (setpoint if after else following)[here])
