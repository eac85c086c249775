"""One training run from its config to policies, figures and summary.json."""

from __future__ import annotations

import logging
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
import torch

from dqn.checkpoint import CheckpointError
from experiments.cli import files, frame
from experiments.training.config import TrainConfig
from experiments.training.export import export_policies, fingerprint
from experiments.training.figures import figures
from experiments.training.model_file import read_env_file
from experiments.training.session import Session

__all__ = ["train"]

log = logging.getLogger(__name__)


def train(config: TrainConfig, folder: Path) -> float:
    """Train, export and report; returns the median regret, the objective of a sweep."""
    if config.env_file is not None:
        config = replace(config, env=read_env_file(config.env_file), env_file=None)
        frame.save_config(config, folder)
    if config.device == "cuda" and not torch.cuda.is_available():
        raise frame.UserError("device=cuda: this machine's torch finds no GPU; use device=cpu")
    torch.set_num_threads(1)  # of one operation: matrices of this size do not gain from more
    try:
        session = Session(config, folder, resume=config.resume is not None)
    except CheckpointError as error:
        raise frame.UserError(f"resume={config.resume}: {error}") from None
    try:
        session.run()
        _finish(session)
    finally:
        session.writer.close()
    return float(np.median(session.best.regret))


def _finish(session: Session) -> None:
    """Score on the reported grid, export, draw, write summary.json."""
    c, agents, best = session.config, session.agents, session.best
    report, kept, last = session.report()
    path = export_policies(session, kept)
    figures(session, path)
    summary = {
        "seeds": list(session.seeds),
        "env_steps": agents.steps,
        "updates": agents.updates,
        "train_seconds": round(session.seconds, 3),
        "regret_pct": kept.regret_pct,
        "steady_abs_error": kept.steady_abs_error,
        "regret_pct_last": last.regret_pct,
        "steady_abs_error_last": last.steady_abs_error,
        "kept_step": best.step,
        "optimum_cost": report.optimum_cost,
        "optimum_steady_abs_error": report.optimum_steady,
        "policy": str(path),
        "policy_seed": session.seeds[int(best.merit.argmin())],
        "config_hash": fingerprint(c),
    }
    files.write_json(session.folder / "summary.json", summary)
    numbers = {
        k: v for k, v in {**asdict(c.agent), "mu": c.env.mu, "tau": c.env.tau}.items() if isinstance(v, int | float)
    }
    session.writer.events.hyper_parameters(numbers, ["eval/regret_pct", "eval/steady_abs_error"])
    log.info(
        "%d agent(s), %d steps and %d updates each in %.1f s: regret %.2f %% (worst %.2f %%), steady error %.4f OD",
        agents.n_agents, agents.steps, agents.updates, session.seconds, np.median(kept.regret_pct),
        kept.regret_pct.max(), np.median(kept.steady_abs_error),
    )  # fmt: skip
    log.info("policy %s; figures %s; tensorboard --logdir %s", path, session.folder / "figures", session.folder)
