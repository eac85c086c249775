"""An agent with some of its values replaced: what ablation and degradation compare."""

from __future__ import annotations

from dataclasses import fields, replace
from typing import Any

from dqn.config import DQNConfig

__all__ = ["variant"]


def _frozen(value: Any) -> Any:
    """Lists from YAML as the tuples a config holds."""
    return tuple(_frozen(v) for v in value) if isinstance(value, list | tuple) else value


def variant(agent: DQNConfig, name: str, values: dict[str, Any]) -> DQNConfig:
    """`agent` with some values replaced.

    Raises: ValueError naming the variant and the key that does not exist or is out of range.
    """
    known = [f.name for f in fields(DQNConfig)]
    for key in values:
        if key not in known:
            raise ValueError(f"ablations.{name}.{key}: no such key; allowed: {', '.join(known)}")
    try:
        return replace(agent, **{key: _frozen(value) for key, value in values.items()})
    except (ValueError, TypeError) as error:
        raise ValueError(f"ablations.{name}: {error}") from None
