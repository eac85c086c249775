"""Laws that plan by dynamic programming on the model: over a receding horizon, or over the whole program."""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from conf.schema import setting
from envs.coculture.optimum import best_action, cost_to_go, transitions
from envs.coculture.pair import PairConfig
from envs.coculture.task import CocultureConfig
from experiments.coculture.base import Array, ShareEstimate, Wanted
from experiments.coculture.laws import Index, LawConfig, Periodic
from experiments.coculture.program import Program

__all__ = ["Optimum", "OptimumConfig", "Receding", "RecedingConfig"]


@lru_cache(maxsize=64)
def _ahead(model: CocultureConfig, setpoints: tuple[float, ...]) -> Array:
    """Least cost of decisions with these setpoints in force, on the grid, (G,)."""
    return np.asarray(cost_to_go(transitions(model), np.array(setpoints)[:, None])[0, :, 0])


def _best(model: CocultureConfig, value: Array | None, estimate: ShareEstimate, setpoint: Array) -> Array:
    """Choose the best temperature now, by the estimated curves; what comes after it by the model's."""
    chosen = best_action(model, transitions(model), value, estimate.state, setpoint, estimate.errors)
    return np.asarray(model.targets()[chosen])


@dataclass(frozen=True)
class RecedingConfig(LawConfig):
    """How far it plans."""

    kind: str = setting("receding", "composition controller")
    control_min: float = setting(30.0, "between decisions; the target is kept in between", "min", within=(1, 240))
    horizon_min: float = setting(360.0, "how far ahead it plans", "min", within=(1, 1440))


class Receding(Periodic[RecedingConfig]):
    """The first action of the best plan for the next hours: least sum of (r - s)^2 after each decision, on the model.

    The setpoint is that in force until the announced change, then the next one. Programs are planned once and kept.
    """

    def __init__(self, config: RecedingConfig, pair: PairConfig | None = None) -> None:
        self.steps = max(round(config.horizon_min / config.control_min), 1)
        super().__init__(config, pair)

    def _decide(self, estimate: ShareEstimate, wanted: Wanted, minute: Array, idx: Index) -> Array:
        until = np.where(wanted.minutes > 0.0, np.ceil(wanted.minutes / self.control_min - 1e-6), self.steps)
        kinds = np.stack([wanted.setpoint, wanted.following, np.minimum(until, self.steps)], axis=1).round(6)
        target = np.empty(idx.size)
        for now, following, left in np.unique(kinds, axis=0):
            row = np.flatnonzero((kinds == (now, following, left)).all(axis=1))
            later = tuple(now if k < left else following for k in range(1, self.steps))
            value = _ahead(self.model, later) if later else None
            target[row] = _best(self.model, value, estimate.of(row), wanted.setpoint[row])
        return target


@dataclass(frozen=True)
class OptimumConfig(LawConfig):
    """How often it decides."""

    kind: str = setting("optimum", "composition controller")
    control_min: float = setting(30.0, "between decisions; the target is kept in between", "min", within=(1, 240))


class Optimum(Periodic[OptimumConfig]):
    """Dynamic programming over the whole program, known from its beginning; what is announced does not matter to it.

    Where no share is asked for, the next one counts already. After the end the last decision's value holds.
    Args: program: what will be asked for.
    """

    def __init__(self, config: OptimumConfig, program: Program, pair: PairConfig | None = None) -> None:
        steps = max(int(np.ceil(program.total_min / config.control_min)), 1)
        asked = program.setpoint(config.control_min * (np.arange(steps, dtype=np.float64) + 0.5))
        known = np.flatnonzero(np.isfinite(asked))
        following = known[np.minimum(np.searchsorted(known, np.arange(steps)), known.size - 1)]
        self._asked = asked[following]
        self._value: Array | None = None
        super().__init__(config, pair)

    def _decide(self, estimate: ShareEstimate, wanted: Wanted, minute: Array, idx: Index) -> Array:
        if self._value is None:
            self._value = cost_to_go(transitions(self.model), self._asked[:, None])[:, :, 0]
        step = np.clip(np.floor(minute / self.control_min + 1e-6), 0, len(self._asked) - 1).astype(np.intp)
        target = np.empty(idx.size)
        for k in np.unique(step):
            row = np.flatnonzero(step == k)
            target[row] = _best(self.model, self._value[k + 1], estimate.of(row), wanted.setpoint[row])
        return target
