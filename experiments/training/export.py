"""What a training run leaves for control: one policy file per agent, and which of them to use."""

from __future__ import annotations

import hashlib
import json
from dataclasses import asdict
from pathlib import Path

from dqn import policy
from dqn.export import export
from experiments.training.config import TrainConfig
from experiments.training.evaluation import Score
from experiments.training.session import Session

__all__ = ["export_policies", "fingerprint"]


def fingerprint(config: TrainConfig) -> str:
    """Short hash of everything that shapes the policy."""
    relevant = {"env": asdict(config.env), "agent": asdict(config.agent)}
    return hashlib.sha256(json.dumps(relevant, sort_keys=True).encode()).hexdigest()[:12]


def export_policies(session: Session, score: Score) -> Path:
    """Every agent's best policy under policies/, the best agent's as policy.npz."""
    c, best = session.config, session.best
    folder = session.folder / "policies"
    folder.mkdir(exist_ok=True)
    for i, seed in enumerate(session.seeds):
        metadata = {
            "seed": seed,
            "control_min": c.env.control_min,
            "model": asdict(c.env),
            "agent": asdict(c.agent),
            "config_hash": fingerprint(c),
            "trained_steps": int(best.step[i]),
            "regret_pct": float(score.regret_pct[i]),
            "steady_abs_error": float(score.steady_abs_error[i]),
        }
        exported = export(session.agents.network, i, best.weights, c.env.pump_rates(), metadata)
        policy.save(folder / f"seed{seed:04d}.npz", exported)
        if i == int(best.merit.argmin()):
            policy.save(session.folder / "policy.npz", exported)
    return session.folder / "policy.npz"
