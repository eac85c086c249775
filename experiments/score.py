"""Score a policy file or a function against the exact optimum of a task: `python -m experiments.score policy=FILE`."""

import logging
import os
import sys
from collections.abc import Callable
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from pkgutil import resolve_name
from typing import Any

import numpy as np
from numpy.typing import NDArray

from conf.schema import check, part, setting
from dqn import policy as policies
from envs.task import EnvConfig
from envs.vector_env import checked_actions
from experiments.cli import files, frame
from experiments.cli.calibrated import read_env_file
from experiments.control.policies import find_policy
from experiments.training import tasks
from experiments.training.config import env_schema
from experiments.training.evaluation import Evaluation

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class ScoreConfig:
    """Config of a score: policy and task. Raises: ValueError with key, value and allowed range."""

    policy: str = setting(
        "", "a policy.npz, a run folder, `latest`, `shipped` (with env=relative), or module:function of a file here"
    )
    env: Any = part(EnvConfig, "the task", env_schema)
    env_file: str | None = setting(None, "a calibrated.yaml, or `latest`: the newest one of calibrate; replaces env")
    onnx: str | None = setting(None, "FILE.onnx: also write the network of a policy.npz there")

    def __post_init__(self) -> None:
        check(self)


@dataclass(frozen=True, eq=False)
class Function:
    """A function that can be scored like a `dqn.policy.Policy`.

    call: maps observations, float32 (N, O), to action indices, (N,). actions: value of each action, (A,).
    """

    call: Callable[[NDArray[np.float32]], Any]
    actions: NDArray[np.float64]

    def act(self, observation: NDArray[Any]) -> NDArray[np.intp]:
        return checked_actions(self.call(observation.astype(np.float32)), observation.shape[:1], self.actions.size)

    def chosen(self, observation: NDArray[Any]) -> NDArray[np.float64]:
        """Return the value of the chosen action for each observation, (N,)."""
        return self.actions[self.act(observation)]


def _found(name: str, task: tasks.Task) -> Any:
    remedy = "give a policy.npz, or module:function of a Python file in this folder"
    if not name:
        raise frame.UserError(f"policy = '': nothing to score; {remedy}")
    if ":" in name and not Path(name).exists():
        sys.path.insert(0, os.getcwd())
        try:
            call = resolve_name(name)
        except (ImportError, AttributeError, ValueError) as error:
            raise frame.UserError(f"policy={name}: {error}; {remedy}") from None
        if not callable(call):
            raise frame.UserError(f"policy={name}: {type(call).__name__} is not a function; {remedy}")
        return Function(call, task.actions)
    with frame.refusing(policies.PolicyError):
        policy = policies.load(find_policy(name))
    if policy.observation != task.observation or policy.actions.size != task.actions.size:
        seen = f"{policy.actions.size} actions from {', '.join(policy.observation)}"
        asked = f"{task.actions.size} from {', '.join(task.observation)}"
        raise frame.UserError(
            f"policy={name}: {seen}, but this task has {asked}; choose the env= of the policy"
            + (", env=relative" if policy.observation == policies.RELATIVE else "")
        )
    return policy


def score(config: ScoreConfig, folder: Path) -> float:
    """Score the policy and write a report; return the regret, per cent. Raises: frame.UserError without a policy."""
    from experiments.reporting import charts, page
    from experiments.reporting.tensorboard import Events

    task = tasks.of(config.env if config.env_file is None else read_env_file(config.env_file))
    policy = _found(config.policy, task)
    if config.onnx is not None:
        _write_onnx(policy, Path(config.onnx))
    grid = Evaluation(task, task.report_grid())
    with frame.refusing(ValueError, about=f"policy={config.policy}: "):
        found = grid(lambda observation: policy.act(observation[0])[None])
        drawn = task.figures(policy)
    summary = {
        "policy": config.policy,
        "task": task.description,
        "regret_pct": float(found.regret_pct[0]),
        "steady_abs_error": float(found.steady_abs_error[0]),
        "steady_abs_error_by_setpoint": found.steady_by_setpoint[0],
        "mean_abs_error": float(found.mean_abs_error[0]),
        "optimum_steady_abs_error": grid.optimum_steady,
        "optimum_mean_abs_error": grid.optimum_abs_error,
        "myopic_regret_pct": float(grid(task.myopic).regret_pct[0]),
    }
    files.write_json(folder / "summary.json", summary)
    with closing(Events(folder)) as events:
        events.scalars({key: value for key, value in summary.items() if isinstance(value, float)}, 0)
        for name, figure in drawn.items():
            events.picture(f"figures/{name}", charts.save(figure, folder / "figures", name), 0)
    log.info("%s, %s", config.policy, task.description)
    log.info(
        "regret %.4g %% (one-line controller: %.4g %%)",
        summary["regret_pct"],
        round(summary["myopic_regret_pct"], 4) + 0.0,
    )
    log.info("steady error %.4g %s (optimum: %.4g)", found.steady_abs_error[0], task.unit, grid.optimum_steady)
    log.info("report %s", page.save(page.of_runs(folder, [folder]), folder))
    return float(found.regret_pct[0])


def _write_onnx(policy: Any, to: Path) -> None:
    if isinstance(policy, Function):
        raise frame.UserError(f"onnx={to}: a function has no network; give policy=FILE.npz")
    try:
        from dqn.onnx import write
    except ImportError:
        raise frame.UserError(f"onnx={to}: needs the package onnx; pip install 'turbidostat-dqn[onnx]'") from None
    write(policy, to)
    log.info("network %s", to)


main = frame.EntryPoint("score", ScoreConfig(), score)


if __name__ == "__main__":
    main()
