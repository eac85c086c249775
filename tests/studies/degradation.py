"""Why a plain DQN gets worse late in training: `python -m tests.studies.degradation`.

Two measurements, on the same task and seeds:

1. What the target copies do. The same agent is trained with rarer and more frequent copies of its target network, and
   every record compares its values with the optimum's: each copy is one sweep of value iteration, and looks one step
   further into the future.
2. What the network can represent. It is fitted to the optimum's Q values by plain regression, with the inputs, output
   basis, gap and loss of each variant, and its greedy policy is scored. The regret that is left does not come from
   bootstrapping.
"""

import logging
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from conf.schema import check, part, setting
from dqn.config import DQNConfig
from envs.optimum import OptimalPolicy, solve
from envs.task import EnvConfig
from experiments.cli import files, frame
from tests.entry import command
from tests.studies.results import write_csv
from tests.studies.variants import seeds, variant

__all__ = ["DegradationConfig", "action_gap", "main", "optimal_q"]

log = logging.getLogger(__name__)

Array = NDArray[np.float64]


@dataclass(frozen=True)
class DegradationConfig:
    """The agent under study and its variants. Raises: ValueError naming key, value and allowed range."""

    env: EnvConfig = part(EnvConfig, "the training model and its episodes")
    agent: DQNConfig = part(DQNConfig, "the agent that the variants change")
    trained: dict[str, dict[str, Any]] = setting({}, "variants by name: values of the agent that differ")
    fitted: dict[str, dict[str, Any]] = setting({}, "the same, for the regression")
    seed: int = setting(0, "of the first agent", at_least=0)
    n_agents: int = setting(8, "seeds of each variant", at_least=1)
    eval_every: int = setting(500, "between evaluations", "steps", at_least=1)

    def __post_init__(self) -> None:
        """Check every variant before the first one trains."""
        check(self)
        for group in (self.trained, self.fitted):
            for name, values in group.items():
                variant(self.agent, name, values)


def optimal_q(policy: OptimalPolicy, od: Array, row: NDArray[np.intp]) -> Array:
    """Q*(x, s, a) = -[(f_a x - s)^2 + gamma V(f_a x)], the discounted return, shape of `od` + (A,).

    Args: policy: the solved task. od: x, any shape. row: index of the setpoint in `policy.setpoints`, shape of `od`.
    """
    after = od[..., None] * policy.factors
    goal = policy.setpoints[row][..., None]
    return -((after - goal) ** 2 + policy.gamma * policy.cost_to_go(after, row[..., None]))


def action_gap(policy: OptimalPolicy) -> float:
    """Median over setpoints of what one level too much or too little costs at the setpoint: Q* of the best action
    minus the mean Q* of its two neighbours."""
    rows = np.arange(policy.setpoints.size)
    q = optimal_q(policy, policy.setpoints, rows)
    best = np.clip(q.argmax(-1), 1, q.shape[1] - 2)
    return float(np.median(q[rows, best] - (q[rows, best - 1] + q[rows, best + 1]) / 2.0))


def _watch(config: DegradationConfig, name: str) -> list[dict[str, float | str]]:
    """Train one variant; a row per evaluation with medians over agents."""
    import torch

    from experiments.training import build
    from experiments.training.density import Density
    from experiments.training.evaluation import Evaluation

    agent = variant(config.agent, name, config.trained[name])
    task = Density(config.env)
    agents = build.population(task, agent, range(config.seed, config.seed + config.n_agents))
    selection = Evaluation(task, task.selection_grid())
    optimum = solve(config.env, agent.gamma)
    grid = task.selection_grid()
    od, setpoint = grid.T
    value = optimal_q(optimum, od, np.searchsorted(optimum.setpoints, setpoint - 1e-9)).max(-1)
    rows: list[dict[str, float | str]] = []
    observation = torch.from_numpy(grid.astype(np.float32)).expand(config.n_agents, -1, -1)
    for record in agents.run():
        if record.step % config.eval_every and record.step != agent.total_steps:
            continue
        greedy = agents.network.with_weights(agents.weights())
        score = selection(build.act_with(greedy, greedy.flat), config.n_agents)
        error = greedy(observation).amax(-1).numpy() / agent.reward_scale - value
        rows.append(
            {
                "variant": name,
                "step": record.step,
                "sweeps": record.updates // agent.target_period,
                "regret_pct": float(np.median(score.regret_pct)),
                "regret_pct_worst": float(score.regret_pct.max()),
                "steady_abs_error": float(np.median(score.steady_abs_error)),
                "value_error": float(np.median(np.sqrt(np.mean(error**2, axis=-1)))),
                "lowest_value": float(np.median(record.curves["q/min"])) / agent.reward_scale,
                "td_error": float(np.median(np.sqrt(2.0 * record.curves["train/loss"]))) / agent.reward_scale
                if not agent.huber
                else np.nan,
            }
        )
    log.info("%s: regret %.2f %% (worst %.2f)", name, rows[-1]["regret_pct"], rows[-1]["regret_pct_worst"])
    return rows


def _exact(unit: OptimalPolicy, od: Array, goal: Array, action: NDArray[np.intp], alpha: float) -> Array:
    """Q* of (x, s, a) with gaps widened as advantage learning with `alpha` does, shape of `od`.

    The model is linear in x, so V(x, s) = s^2 V(x / s, 1) and one setpoint's solution `unit` serves all.
    """
    s = unit.setpoints[0]
    q = optimal_q(unit, od / goal * s, np.zeros(od.shape, dtype=np.intp)) * ((goal / s) ** 2)[..., None]
    value = q.max(-1)
    chosen = np.take_along_axis(q, action[..., None], -1)[..., 0]
    return np.asarray(value - (value - chosen) / (1.0 - alpha))


def _fit(config: DegradationConfig, name: str) -> dict[str, Any]:
    """Regress the network on exact Q values at random (x, setpoint, action); score its greedy policy."""
    import torch

    from dqn.agent import STREAMS, DQNAgent
    from dqn.replay import Transition
    from experiments.training import build
    from experiments.training.density import Density
    from experiments.training.evaluation import Evaluation

    agent = variant(config.agent, name, config.fitted[name])
    seeds = range(config.seed, config.seed + config.n_agents)
    task = Density(config.env)
    relabel = task.hindsight(agent)
    learner = DQNAgent(agent, 2, config.env.n_actions, build.streams(seeds, STREAMS), relabel)
    unit = solve(replace(config.env, start_od=(0.04, 3.9)), agent.gamma, setpoints=np.array([0.5]), grid=9001)
    numbers = [np.random.default_rng(seed) for seed in seeds]
    low, high = config.env.start_od
    shape = (config.n_agents, agent.batch_size)
    zero = torch.zeros(shape)
    for _ in range(agent.total_updates):
        u = np.stack([rng.random((4, agent.batch_size)) for rng in numbers], axis=1)
        od, action = low + (high - low) * u[0], (u[1] * config.env.n_actions).astype(np.intp)
        pair = [torch.from_numpy(np.stack([x, zero], -1).astype(np.float32)) for x in (od, od * unit.factors[action])]
        batch = Transition(pair[0], torch.from_numpy(action), torch.empty(shape), pair[1], zero)
        relabel.replace(batch, relabel.drawn(torch.from_numpy(np.stack([u[2], u[3]], -1))))
        target = _exact(unit, od, batch.s_t[..., 1].double().numpy(), action, agent.action_gap)
        features = learner.network.features(batch.s_tm1)
        learner.fit(features, batch.a_tm1, torch.from_numpy(target * agent.reward_scale).float())
    report = Evaluation(task, task.report_grid())
    score = report(build.act_with(learner.network, learner.network.flat), config.n_agents)
    log.info("%s, fitted to Q*: regret %.2f %% (worst %.2f)", name, np.median(score.regret_pct), score.regret_pct.max())
    return {"regret_pct": score.regret_pct, "steady_abs_error": score.steady_abs_error}


def draw(rows: list[dict[str, float | str]], fitted: dict[str, dict[str, Any]], folder: Path) -> None:
    """Regret and value error during training; regret and steady error of the networks fitted to exact values."""
    from experiments.reporting import charts

    canvas, axes = charts.new_figure(11.0, 7.0, 2, 2)
    regret, value, *fits = axes
    for colour, name in zip(charts.COLOURS, dict.fromkeys(str(row["variant"]) for row in rows), strict=False):
        own = [row for row in rows if row["variant"] == name]
        step = [float(row["step"]) for row in own]
        regret.plot(step, [float(row["regret_pct"]) for row in own], color=colour, linewidth=1.4, label=name)
        regret.plot(step, [float(row["regret_pct_worst"]) for row in own], color=colour, linewidth=0.7, linestyle=":")
        value.plot(step, [float(row["value_error"]) for row in own], color=colour, linewidth=1.4)
    regret.set(yscale="log", xlabel="environment step", ylabel="regret, % (dotted: worst seed)", ylim=(0.01, 300))
    value.set(yscale="log", xlabel="environment step", ylabel="rms of max Q − V*, OD²")
    regret.legend()
    panels = (("regret_pct", "regret when fitted to Q*, %"), ("steady_abs_error", "steady error when fitted to Q*, OD"))
    for ax, (key, label) in zip(fits, panels, strict=True):
        seeds(ax, {name: np.asarray(score[key]) for name, score in fitted.items()}, label)
    charts.save(canvas, folder / "figures", "degradation")


def degradation(config: DegradationConfig, folder: Path) -> float:
    """Both measurements; returns the median regret of the first trained variant at its end."""
    import torch

    if not config.trained:
        raise frame.UserError("trained: no variant; name at least one, as degradation.yaml does")
    torch.set_num_threads(1)
    rows = []
    for name in config.trained:
        rows += _watch(config, name)
        write_csv(folder / "curves.csv", rows)  # whole variants, for a run that is stopped
    fitted = {name: _fit(config, name) for name in config.fitted}
    gap = action_gap(solve(config.env, config.agent.gamma))
    log.info("one level beside the best action costs %.1e at the setpoint", gap)
    ends = {name: [r for r in rows if r["variant"] == name][-1] for name in config.trained}
    files.write_json(folder / "summary.json", {"action_gap": gap, "trained": ends, "fitted": fitted})
    draw(rows, fitted, folder)
    log.info("curves %s, figure %s", folder / "curves.csv", folder / "figures" / "degradation.png")
    return float(rows[-1]["regret_pct"])


main = command(__file__, DegradationConfig(), degradation)


if __name__ == "__main__":
    main()
