"""Keys of earlier versions: what they are called now, or why they are gone."""

from __future__ import annotations

__all__ = ["REMOVED", "RENAMED"]

RENAMED: dict[str, str] = {
    "agent.action_smoothness": "agent.output_basis_decay",
    "agent.relabel": "agent.hindsight_share",
    "agent.relabel_near": "agent.hindsight_near",
    "agent.relabel_width": "agent.hindsight_width",
}
"""Full dotted key -> full dotted key."""

REMOVED: dict[str, str] = {
    "agent.adam_beta2": "it is the published 0.999",
    "agent.adam_eps": "it is the published 1e-8",
    "agent.average": "the last weights act",
    "agent.double": "the target is the plain maximum",
    "agent.learning_rate_decay": "the rate is constant",
    "agent.relabel_margin": "new goals lie between the task's lowest and highest setpoint",
    "agent.target_blend": "the target network is always a copy",
}
"""Full dotted key -> reason."""
