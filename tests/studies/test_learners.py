"""The comparison of learners: which trainings there are, and rows in order of regret of those that are whole."""

import pytest

from tests.studies import learners
from tests.studies.learners import Job, LearnersConfig

pytestmark = pytest.mark.numeric


@pytest.fixture
def two_tasks(monkeypatch: pytest.MonkeyPatch) -> LearnersConfig:
    """A law of regret 4 in the first task and of .25 in the second."""
    regret = {"sim": "4", "coculture_preview": "0.25"}
    monkeypatch.setattr(
        learners, "laws", lambda task: [[learners.TASKS[task], "law", "–", regret[task], "–", "0.1", "–"]]
    )
    return LearnersConfig(("sim", "coculture_preview"), ("ppo",), (2000,), ("ppo",), 9000, ("hindsight",), 3)


def test_short_trainings_come_first_and_each_has_all_seeds(two_tasks: LearnersConfig) -> None:
    asked = learners.jobs(two_tasks)
    kinds = list(dict.fromkeys((job.task, job.learner, job.steps) for job in asked))
    assert kinds == [
        ("sim", "ours", 2000), ("sim", "ppo", 2000), ("coculture_preview", "ours", 2000),
        ("coculture_preview", "ppo", 2000), ("sim", "ours", 0), ("coculture_preview", "ours", 0),
        ("coculture_preview", "without hindsight", 0), ("sim", "ppo", 9000), ("coculture_preview", "ppo", 9000),
    ]  # fmt: skip
    assert len(asked) == 3 * len(kinds) == len({job.name for job in asked})


def test_rows_are_medians_in_order_of_regret_and_one_that_lacks_a_seed_is_left_out(two_tasks: LearnersConfig) -> None:
    def found(task: str, learner: str, steps: int, *regrets: float) -> dict[Job, dict[str, float]]:
        each = {"steady": 0.02, "cpu_s": 7.0, "steps": float(steps or 2000)}
        return {Job(task, learner, steps, k): {"regret_pct": r} | each for k, r in enumerate(regrets)}

    known = found("sim", "ours", 2000, 0.5, 90.0, 0.1) | found("sim", "ours", 0, 0.5, 90.0, 0.1)  # the same training
    known |= found("sim", "ppo", 2000, 30.0, 10.0, 20.0) | found("coculture_preview", "ppo", 2000, 1.0, 2.0)
    known |= found("coculture_preview", "without hindsight", 0, 8.0, 9.0, 7.0)
    rows = learners.table(two_tasks, known)
    assert [row[:5] for row in rows] == [
        ["Bioreactor-v0", "this program's DQN", "2000", "0.5", "90"],
        ["Bioreactor-v0", "law", "–", "4", "–"],
        ["Bioreactor-v0", "SB3 PPO", "2000", "20", "30"],
        ["CoculturePreview-v0", "law", "–", "0.25", "–"],
        ["CoculturePreview-v0", "this program's DQN without hindsight", "2000", "8", "9"],
    ]
    assert rows[2][5:] == ["0.02", "7"]


def test_regrets_stand_beside_each_other_by_task_and_the_hardest_task_orders_them() -> None:
    """Our agent's own steps are 10,000 for the density and 20,000 with a preview; the law has no seeds."""
    ours, sim, preview = learners.OURS, "Bioreactor-v0", "CoculturePreview-v0"
    rows = [
        [sim, "law", "–", "0", "–", "0.1", "–"],
        [sim, ours, "10000", "0.5", "0.9", "0.1", "7"],
        [sim, "PPO", "10000", "30", "40", "0.1", "7"],
        [preview, f"{ours} without hindsight", "20000", "8", "9", "0.1", "7"],
        [preview, "PPO", "10000", "20", "21", "0.1", "7"],
        [preview, ours, "10000", "4", "5", "0.1", "7"],
        [preview, ours, "20000", "3", "4", "0.1", "7"],
    ]
    head, found = learners.by_task(rows)
    assert head == ["policy", "steps", sim, preview]
    assert found == [
        [ours, "its own", "0.5 (0.9)", "3 (4)"],
        [ours, "10000", "0.5 (0.9)", "4 (5)"],
        [f"{ours} without hindsight", "its own", "–", "8 (9)"],
        ["PPO", "10000", "30 (40)", "20 (21)"],
        ["law", "–", "0", "–"],
    ]
