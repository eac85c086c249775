"""One training run, from its config to its output files: a policy per agent, figures and summary.json."""

import hashlib
import json
import logging
import shlex
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
import torch

from dqn import policy
from dqn.checkpoint import CheckpointError
from dqn.network import export
from dqn.policy import Policy
from envs.task import EnvConfig, step_factors
from experiments.cli import files, frame
from experiments.cli.calibrated import read_env_file
from experiments.laws.density.estimator import EstimatorConfig
from experiments.reporting import charts
from experiments.reporting.verdict import verdict
from experiments.training import announcements
from experiments.training.config import TASKS, TrainConfig
from experiments.training.evaluation import Score
from experiments.training.session import Session

log = logging.getLogger(__name__)


def train(config: TrainConfig, folder: Path) -> float:
    """Train, export and report; return the merit of the worst seed, which is the objective of a sweep.

    The merit is `session.merit` on the selection grid: 1 is at the task's limits, and lower is better. The reported
    grid does not influence the choice of hyper-parameters.
    """
    if (whole := _completed(config)) is not config:
        config = whole
        frame.save_config(config, folder)
    if config.device == "cuda" and not torch.cuda.is_available():
        raise frame.UserError("device=cuda: this machine's torch finds no GPU; use device=cpu")
    if isinstance(config.env, EnvConfig):
        _warn_of_growth(config.env)
    torch.set_num_threads(1)  # threads of one operation: small matrices do not gain from more
    try:
        with frame.refusing(ValueError):
            session = Session(config, folder, resume=config.resume is not None)
    except CheckpointError as error:
        raise frame.UserError(f"resume={config.resume}: {error}") from None
    try:
        session.run()
        _finish(session)
    finally:
        session.writer.close()
    return float(session.best.merit.max())


def _completed(config: TrainConfig) -> TrainConfig:
    own = TASKS[type(config.env)].completed
    if own is not None:
        return own(config)
    return config if config.env_file is None else replace(config, env=read_env_file(config.env_file), env_file=None)


def _warn_of_growth(env: EnvConfig) -> None:
    """Warn if no policy can hold the culture: f >= 1 for every action, so even the largest rate does not dilute it."""
    if step_factors(env).min() >= 1.0:
        log.warning(
            "env.mu = %g 1/min outgrows the pump: with env.tau = %.4g a setpoint needs more than mu tau = %.4g mL/s, "
            "but env.max_pump_rate = %g mL/s. Raise env.max_pump_rate, or check mu and tau",
            env.mu, env.tau, env.mu * env.tau, env.max_pump_rate,
        )  # fmt: skip


def _finish(session: Session) -> None:
    c, agents, best = session.config, session.agents, session.best
    report, kept, last = session.report()
    myopic = report(session.task.myopic)
    path, exported = _export(session, kept)
    _figures(session, exported)
    summary = {
        "seeds": list(session.seeds),
        "env_steps": agents.steps,
        "updates": agents.updates,
        "ended": session.ended,
        "train_seconds": round(session.seconds, 3),
        "regret_pct": kept.regret_pct,
        "steady_abs_error": kept.steady_abs_error,
        "steady_abs_error_by_setpoint": kept.steady_by_setpoint,
        "mean_abs_error": kept.mean_abs_error,
        "regret_pct_last": last.regret_pct,
        "steady_abs_error_last": last.steady_abs_error,
        "kept_step": best.step,
        "optimum_cost": report.optimum_cost,
        "optimum_steady_abs_error": report.optimum_steady,
        "optimum_mean_abs_error": report.optimum_abs_error,
        "myopic_regret_pct": float(myopic.regret_pct[0]),
        "myopic_steady_abs_error": float(myopic.steady_abs_error[0]),
        "policy": str(path),
        "policy_seed": session.seeds[int(best.merit.argmin())],
        "config_hash": fingerprint(c),
    }
    files.write_json(session.folder / "summary.json", summary)
    announcements.results(session.writer, agents.steps, kept, session.task, session.seeds)
    spent = f"{agents.steps} steps and {agents.updates} updates of each agent in {session.seconds:.1f} s"
    told, whole = verdict(summary, asdict(c)), c.stop_within is None
    announcements.ended(session.folder, session.task, kept, told, spent, path, _repeated(c), whole)


def _repeated(config: TrainConfig) -> str:
    given = {key: getattr(config, key) for key in TASKS[type(config.env)].repeats}
    return " ".join(f"{key}={shlex.quote(value)}" for key, value in given.items() if value is not None)


def fingerprint(config: TrainConfig) -> str:
    """Return a short hash of everything that determines the policy."""
    relevant = {"env": asdict(config.env), "agent": asdict(config.agent)}
    return hashlib.sha256(json.dumps(relevant, sort_keys=True).encode()).hexdigest()[:12]


def _export(session: Session, score: Score) -> tuple[Path, Policy]:
    """Write every agent's best policy to policies/, the best of all to policy.npz; return policy.npz and its policy."""
    c, best, task = session.config, session.best, session.task
    folder = session.folder / "policies"
    folder.mkdir(exist_ok=True)
    exported = []
    for i, seed in enumerate(session.seeds):
        metadata = {
            "seed": seed,
            "observation": list(task.observation),
            **task.model(),
            **({"estimator": asdict(EstimatorConfig())} if task.observation == policy.RELATIVE else {}),
            "agent": asdict(c.agent),
            "config_hash": fingerprint(c),
            "trained_steps": int(best.step[i]),
            "updates": int(best.updates[i]),
            "regret_pct": float(score.regret_pct[i]),
            "steady_abs_error": float(score.steady_abs_error[i]),
        }
        exported.append(export(session.agents.network, i, best.weights, task.actions, task.limits, metadata))
        policy.save(folder / f"seed{seed:04d}.npz", exported[i])
    best_of_all, path = exported[int(best.merit.argmin())], session.folder / "policy.npz"
    policy.save(path, best_of_all)
    return path, best_of_all


def _figures(session: Session, exported: Policy) -> None:
    best = session.best
    history = np.array([[step, *regret] for step, regret, _ in best.history])
    returns = np.array(session.returns)
    ended = ~np.isnan(returns).all(axis=1)  # a last, shorter interval has no finished episode
    curves = (returns[ended], history[:, 0], history[:, 1:], best.step.astype(float))
    drawn = {"learning": charts.learning(*curves), **session.task.figures(exported)}
    for name, figure in drawn.items():
        path = charts.save(figure, session.folder / "figures", name)
        session.writer.events.picture(f"figures/{name}", path, session.agents.steps)
