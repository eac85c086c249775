"""Every kind of law of the composition: its config, its class, and what the class is built from."""

from collections.abc import Callable
from typing import Any

from dqn.policy import Policy
from envs.bench import Bench
from experiments.composition.base import Array, Law
from experiments.composition.controller import CompositionController
from experiments.composition.estimator import CompositionEstimator
from experiments.composition.laws import (
    PI,
    BangBang,
    BangBangConfig,
    InverseDynamics,
    InverseDynamicsConfig,
    Midpoint,
    MidpointConfig,
    Myopic,
    MyopicConfig,
    PIConfig,
    Proportional,
    ProportionalConfig,
)  # fmt: skip
from experiments.composition.learned import LearnedLaw, LearnedLawConfig, PreviewLawConfig
from experiments.composition.planned import Optimum, OptimumConfig, Receding, RecedingConfig
from experiments.composition.program import Program

__all__ = ["FORESIGHT", "LEARNED", "build", "config"]

KINDS: dict[str, tuple[type[Any], Callable[..., Law], tuple[str, ...]]] = {
    "dqn": (LearnedLawConfig, LearnedLaw, ("config", "policy")),
    "dqn_preview": (PreviewLawConfig, LearnedLaw, ("config", "policy")),
    "pi": (PIConfig, PI, ("config",)),
    "proportional": (ProportionalConfig, Proportional, ("config",)),
    "inverse_dynamics": (InverseDynamicsConfig, InverseDynamics, ("config",)),
    "bang_bang": (BangBangConfig, BangBang, ("config",)),
    "myopic": (MyopicConfig, Myopic, ("config",)),
    "midpoint": (MidpointConfig, Midpoint, ("config",)),
    "receding": (RecedingConfig, Receding, ("config",)),
    "optimum": (OptimumConfig, Optimum, ("config", "program")),
}
LEARNED = ("dqn", "dqn_preview")
FORESIGHT = ("dqn_preview", "midpoint", "receding", "optimum")
"""Kinds that act on what is announced."""
MISSING = {
    "policy": "needs a policy; give policy=RUN/policy.npz of a training with env=coculture or env=coculture_preview",
    "program": "plans the whole program; give a scenario with ratios",
}


def config(kind: str) -> Any:
    """The default config of this kind of law. Raises: ValueError naming the kinds there are."""
    if kind not in KINDS:
        raise ValueError(f"composition.kind = {kind}: allowed {', '.join(KINDS)}")
    return KINDS[kind][0]()


def build(
    config: Any,
    policy: Policy | None = None,
    program: Program | None = None,
    volume_ml: Array | float = Bench.volume_ml,
) -> CompositionController:
    """The controller that a config describes.

    Args:
      config: as `config` gives it; `kind` names the law.
      policy: what `dqn` and `dqn_preview` follow. program: what `optimum` plans.
      volume_ml: of the cultures, as the bench says, (N,) or one for all.
    Raises: ValueError naming what is missing for this kind of law.
    """
    if config.kind not in KINDS:
        raise ValueError(f"composition.kind = {config.kind}: allowed {', '.join(KINDS)}")
    _, make, parts = KINDS[config.kind]
    given = {"config": config, "policy": policy, "program": program}
    for part in parts:
        if given[part] is None:
            raise ValueError(f"composition = {config.kind}: {MISSING[part]}")
    law = make(**{part: given[part] for part in parts})
    return CompositionController(CompositionEstimator(config.estimator, volume_ml), law)
