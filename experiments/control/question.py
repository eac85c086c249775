"""What a run asks while it goes on: whether a policy trained on the curves that it has found is better than its own."""

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields, replace
from pathlib import Path
from typing import Any

import numpy as np

from conf.presets import load
from conf.schema import build, check, setting
from dqn.config import DQNConfig
from dqn.policy import Policy
from envs.coculture.pair import PairConfig
from envs.coculture.task import SCALES, CocultureConfig
from envs.scenario import Scenario
from experiments.laws.share.base import Array
from experiments.laws.share.estimator import CompositionEstimator, CompositionEstimatorConfig
from hardware import memory

__all__ = ["LEAST_H", "Question", "Relearn", "Verdict"]

EVERY_H, LONG_MIN = 12.0, 24 * 60.0  # the first training needs half a day of data, and its policy some hours to pay
LEAST_H = 2.0  # of a program that is still to come, for a training to be worth it
BATCH = 128  # with twice the steps as good as 256 in the same time


@dataclass(frozen=True)
class Relearn:
    """When a run learns from itself, and with what means. Raises: ValueError naming key, value and allowed range."""

    every_h: float | None = setting(
        None,
        "at least so long from one training to the next, and before the first; 0: none; null: 12 in a run of more than "
        "a day with dqn_preview, else 0",
        "h",
        within=(0, 240),
    )
    sd: float = setting(0.03, "growth curves known so well, relative, are worth it ...", within=(0.001, 0.5))
    moved: float = setting(
        0.03, "... where one is so far, relative, from those of the policy or of the last training", within=(0, 0.5)
    )
    steps: int = setting(40_000, "of the training", within=(1000, 10_000_000))
    vials: int = setting(64, "drawn from the estimate, on which old and new policy are compared", within=(32, 1000))
    hours: float = setting(24.0, "of the program that is still to come, at most, on each of them", "h", within=(2, 240))
    seed: int = setting(0, "of the first training; the next ones count on", at_least=0)
    nice: int = setting(19, "of the training's process, which has one thread", within=(0, 19))
    limit_min: float = setting(120.0, "after which a training is given up", "min", above=0.0)
    memory_gib: float = setting(8.0, "that its process may have", "GiB", at_least=1.0)

    def __post_init__(self) -> None:
        check(self, "relearn")

    def settled(self, announced: bool, run_min: float) -> "Relearn":
        """With hours, where they were left open: it pays where a law foresees a program that lasts.

        Args: announced: whether the policy sees what is still to come. run_min: length of the longest program.
        """
        if self.every_h is not None:
            return self
        return replace(self, every_h=EVERY_H if announced and run_min > LONG_MIN else 0.0)


@dataclass(frozen=True)
class Question:
    """One culture as it is believed to be, what is still asked of it, and who decides for it now; plain numbers.

    number: of the training. reactor. rests_on_min: first and last minute of the recording behind it. elapsed_min: of
    the schedule at the last one. errors, sds: of both growth curves, relative. believed: the estimator of this culture
    alone (`memory.save`). estimator, pair, schedule, relearn: as in the config. volume_ml: of the culture. limits: of
    the thermostat, degC. law: that follows a policy. in_force: file of the policy, from the run's folder.
    """

    number: int
    reactor: str
    rests_on_min: tuple[float, float]
    elapsed_min: float
    errors: tuple[float, float]
    sds: tuple[float, float]
    believed: dict[str, Any]
    estimator: dict[str, Any]
    pair: dict[str, Any]
    schedule: dict[str, Any]
    relearn: dict[str, Any]
    volume_ml: float
    limits: tuple[float, float]
    law: str
    in_force: str

    @classmethod
    def read(cls, path: Path) -> "Question":
        """From its file. Raises: ValueError naming the file and what is wrong with it."""
        try:
            content = json.loads(path.read_text(encoding="utf-8"))
            asked = cls(**{f.name: content[f.name] for f in fields(cls)})
            _ = asked.plan, asked.scenario, asked.estimators(1)  # whether it fits this version
        except (OSError, ValueError, KeyError, TypeError) as error:
            why = getattr(error, "strerror", None) or f"{type(error).__name__}: {error}"
            raise ValueError(f"question {path}: {why}; give the one that a run wrote, RUN/policies/001.json") from None
        return asked

    def text(self) -> str:
        """Its file."""
        return json.dumps(asdict(self), indent=1, allow_nan=False)

    @property
    def plan(self) -> Relearn:
        """With what means."""
        return build(Relearn(), self.relearn, "relearn")

    @property
    def scenario(self) -> Scenario:
        """The whole schedule."""
        return build(Scenario(), self.schedule, "scenario")

    @property
    def curves(self) -> PairConfig:
        """The two species as the run was told of them."""
        return build(PairConfig(), self.pair, "pair")

    @property
    def hours(self) -> tuple[float, float]:
        """From when to when of the schedule policies are compared, h."""
        now = self.elapsed_min / 60.0
        return now, min(now + self.plan.hours, self.scenario.total_min / 60.0)

    def estimators(self, n: int) -> CompositionEstimator:
        """The run's estimator of this culture, n times."""
        config = build(CompositionEstimatorConfig(), self.estimator, "estimator")
        one = CompositionEstimator(config, self.volume_ml, self.curves)
        memory.restore(one, self.believed, memory.words("believed"))
        one.gave(np.zeros(1), np.ones(1, dtype=np.bool_))
        return one.of(np.zeros(n, dtype=np.intp))

    def task(self, in_force: Policy) -> tuple[CocultureConfig, DQNConfig]:
        """What is trained, the task of the policy in force on the curves that the run has found; and how."""
        model, plan = build(CocultureConfig(), in_force.metadata["model"], "env"), self.plan
        scales = np.clip(1.0 + np.array(self.errors), *SCALES).tolist()
        env = replace(model, scale_e=scales[0], scale_p=scales[1])
        agent = build(DQNConfig(), load(f"agent/coculture{'_preview' * bool(model.preview_min)}"), "agent")
        return env, replace(agent, total_steps=plan.steps, replay_size=plan.steps, batch_size=BATCH)


@dataclass(frozen=True)
class Verdict:
    """How the laws did on the vials: mean |share - setpoint| of each vial, by law; old and new are policies.

    regret_pct: of the new one on its own model.
    """

    errors: Mapping[str, list[float]]
    regret_pct: float

    @property
    def means(self) -> dict[str, float]:
        """Of each law."""
        return {law: float(np.mean(found)) for law, found in self.errors.items()}

    def less(self, law: str, than: str) -> tuple[float, float]:
        """Mean difference of two laws, vial by vial, and half its 95 % interval."""
        difference: Array = np.subtract(self.errors[law], self.errors[than])
        return float(difference.mean()), 1.96 * float(difference.std(ddof=1)) / len(difference) ** 0.5

    @property
    def best(self) -> str:
        """Of those that are better than the old policy by an interval that excludes 0 the lowest, else "old"."""
        better = [law for law in self.errors if sum(self.less(law, "old")) < 0.0]
        return min(better, key=self.means.__getitem__, default="old")

    @property
    def flies(self) -> bool:
        """Whether the old policy does not go on."""
        return self.best != "old"

    @property
    def why(self) -> str:
        """In words."""
        law = self.best if self.flies else "new"
        mean, half = self.less(law, "old")
        found = ", ".join(f"{law} {error:.4f}" for law, error in self.means.items())
        said = f"{law} less old {mean:+.4f} ± {half:.4f}"
        return f"{said}: {'better' if self.flies else 'not surely better'} (mean errors: {found})"

    def row(self) -> dict[str, Any]:
        """For journal, summary and policy file."""
        mean, half = self.less(self.best if self.flies else "new", "old")
        vials = len(self.errors["new"])
        return {
            "flies": self.flies, "law": self.best, "why": self.why, "errors": self.means, "difference": mean,
            "half_interval": half, "vials": vials, "regret_pct": self.regret_pct,
        }  # fmt: skip
