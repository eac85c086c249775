"""Every kind of composition controller: its config, and what it is built from."""

from typing import Any

from dqn.policy import Policy

__all__ = ["build", "config"]

KINDS: dict[str, type[Any]] = {}


def config(kind: str) -> Any:
    """The default config of this kind of controller. Raises: ValueError naming the kinds there are."""
    if kind not in KINDS:
        raise ValueError(f"composition.kind = {kind}: allowed {', '.join(KINDS)}")
    return KINDS[kind]()


def build(config: Any, policy: Policy | None = None) -> Any:
    """The controller that a config describes. Raises: ValueError naming what is missing for it."""
    raise ValueError(f"composition = {config.kind}: no such controller")
