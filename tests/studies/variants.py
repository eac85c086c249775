"""Variants of an agent by name, and how their seeds are drawn."""

from collections.abc import Mapping
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from numpy.typing import NDArray

from conf.schema import build
from dqn.config import DQNConfig
from experiments.reporting.charts import COLOURS

__all__ = ["seeds", "variant"]

Array = NDArray[np.float64]


def variant(agent: DQNConfig, name: str, values: dict[str, Any]) -> DQNConfig:
    """`agent` with some values replaced.

    Raises: ValueError naming the variant and the key that does not exist or is out of range.
    """
    where = f"ablations.{name}"
    try:
        return build(agent, values, where)
    except ValueError as error:
        raise ValueError(str(error) if str(error).startswith(where) else f"{where}: {error}") from None


def seeds(ax: Axes, values: Mapping[str, Array], label: str) -> None:
    """A row per name on a logarithmic axis called `label`: one dot per seed, a bar at their median.

    Args: values: name -> (S,), the first one on top.
    """
    jitter = np.random.default_rng(0)
    for row, each in enumerate(values.values()):
        height = row + jitter.uniform(-0.22, 0.22, each.size)
        ax.plot(np.maximum(each, 1e-4), height, ".", color=COLOURS[0], alpha=0.45, markersize=5)
        ax.plot([np.median(each)] * 2, [row - 0.34, row + 0.34], color=COLOURS[1], linewidth=2)
    ax.set(xscale="log", xlabel=label, ylim=(len(values) - 0.5, -0.5))
    ax.set_yticks(range(len(values)), list(values), fontsize=8)
