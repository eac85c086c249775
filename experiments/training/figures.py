"""What a training run shows: learning curves, the policy beside the optimum, and trajectories of both."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from dqn import policy
from envs.optimum import solve
from experiments.reporting import charts
from experiments.training.evaluation import rollout
from experiments.training.session import Session

__all__ = ["figures"]


def figures(session: Session, policy_path: Path) -> None:
    """Learning curves, policy map and example trajectories, as files and in TensorBoard."""
    env, gamma, best = session.config.env, session.config.agent.gamma, session.best
    rates, factors = env.pump_rates(), session.selection.factors
    learned = policy.load(policy_path)
    history = np.array([[step, *regret] for step, regret, _ in best.history])
    drawn = {
        "learning": charts.learning(np.array(session.returns), history[:, 0], history[:, 1:], best.step.astype(float))
    }

    od, setpoint = np.linspace(0.05, 1.25, 241), np.linspace(min(env.setpoints), max(env.setpoints), 33)
    optimum = solve(env, gamma, setpoints=np.append(setpoint, env.setpoints), grid=3001)
    x, s = (a.ravel() for a in np.meshgrid(od, setpoint))
    learned_map = learned.rate(np.stack([x, s], axis=1)).reshape(setpoint.size, od.size)
    best_map = rates[optimum.act(x, s)].reshape(setpoint.size, od.size)
    drawn["policy_map"] = charts.policy_map(od, setpoint, learned_map, best_map)

    goals = np.asarray(env.setpoints)[[0, len(env.setpoints) // 2, -1]]
    starts, targets = np.repeat(env.start_od, goals.size)[None], np.tile(goals, 2)[None]
    ours = rollout(
        lambda a, b: learned.act(np.stack([a[0], b[0]], axis=1))[None], factors, starts, targets, env.episode_steps
    )
    theirs = rollout(lambda a, b: optimum.act(a[0], b[0])[None], factors, starts, targets, env.episode_steps)
    drawn["trajectories"] = charts.trajectories(
        np.arange(env.episode_steps + 1, dtype=np.float64) * env.control_min,
        np.concatenate([starts, ours.od[:, 0]]),
        np.concatenate([starts, theirs.od[:, 0]]),
        targets[0],
        rates[ours.action[:, 0]],
        rates[theirs.action[:, 0]],
    )
    for name, figure in drawn.items():
        charts.save(figure, session.folder / "figures", name)
        session.writer.events.figure(f"figures/{name}", figure, session.agents.steps)
