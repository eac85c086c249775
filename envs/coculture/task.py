"""Composition of two species as a control task: the temperature determines which species grows faster.

Dilution removes the same fraction of both species, so only the growth rates change the share r of P. putida:

  d logit(r)/dt = m_p - mu_e(T),     m_p' = (mu_p(T) - m_p) / 1 h,     T heats by 2 degC/min and cools passively

The growth of the first species, E. coli, follows the temperature within 2 min; the model neglects this lag. The logit
of the share is an integrator of limited rate: +0.30 per hour at 29 degC, -0.63 per hour at 36 degC. A change of the
setpoint can take hours, so a controller gains by starting before the change. The species are in envs/coculture/pair.py.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from conf.schema import check, part, require, setting
from envs import preview
from envs.coculture.pair import PairConfig
from envs.gym_adapter import EpisodeEnv
from envs.vector_env import EpisodeVectorEnv

Array = NDArray[np.float64]

LOGIT, TEMPERATURE, RATE, SETPOINT, NEXT, TIME = range(6)
"""Columns of an observation; NEXT and TIME exist only if changes are announced."""

SCALES = (0.5, 2.0)  # allowed factors on a growth curve
LARGEST = 20.0  # limit of |logit|, where one species has almost vanished


@dataclass(frozen=True)
class CocultureConfig:
    """Task `env=coculture` and `env=coculture_preview`. Raises: ValueError with key, value and allowed range."""

    kind: str = setting("coculture", "task")
    n_actions: int = setting(17, "number of temperatures, equally spaced", within=(2, 1001))
    temperatures: tuple[float, float] | None = setting(
        None, "range of temperatures; null: the range of the pair's curves", "degC", within=(4, 60), interval=True
    )
    pair: PairConfig = part(PairConfig, "the two species")
    control_min: float = setting(10.0, "control period, whole minutes", "min", within=(1, 240))
    episode_steps: int = setting(72, "decisions per episode, ended by truncation", at_least=1)
    preview_min: float = setting(
        0.0, "time between announcement and change of the setpoint; 0: no announcement", "min", within=(0, 1440)
    )
    setpoints: tuple[float, float] = setting(
        (0.1, 0.9), "range of the setpoint, a share", above=0.0, below=1.0, interval=True
    )
    start_share: tuple[float, float] = setting(
        (0.05, 0.95), "range of the share at the start", above=0.0, below=1.0, interval=True
    )
    scale_e: float = setting(1.0, "factor on the growth of the first species", within=SCALES)
    scale_p: float = setting(1.0, "factor on the growth of the second species", within=SCALES)
    heating_c_per_min: float = setting(2.0, "fastest rise of a heated vial", "degC/min", within=(0.1, 10))
    cooling_min: float = setting(39.0, "time constant of passive cooling", "min", within=(1, 600))
    ambient_c: float = setting(24.0, "temperature an unheated vial cools to", "degC", within=(0, 40))

    def __post_init__(self) -> None:
        check(self, "env")
        require(self.control_min % 1.0 == 0.0, "env.control_min", self.control_min, "whole minutes")
        even = self.preview_min % self.control_min == 0.0
        require(even, "env.preview_min", self.preview_min, f"a multiple of env.control_min = {self.control_min:g}")
        (low, high), (coldest, warmest) = self.span, self.pair.temperatures
        within = f"{coldest:g} to {warmest:g} degC, the range of the pair's curves"
        require(coldest <= low and high <= warmest, "env.temperatures", self.span, within)
        require(self.ambient_c < low, "env.ambient_c", self.ambient_c, f"less than the coldest target, {low:g} degC")

    @property
    def span(self) -> tuple[float, float]:
        """Coldest and warmest target, degC."""
        return self.pair.temperatures if self.temperatures is None else self.temperatures

    def targets(self) -> Array:
        """List the temperatures of the actions, degC, shape (A,)."""
        return np.linspace(*self.span, self.n_actions)

    @property
    def columns(self) -> int:
        """Number of columns of an observation: 4, or 6 if changes are announced."""
        return 6 if self.preview_min else 4


def logit(r: Any) -> Any:
    """Return ln(r / (1 - r)) of a share r."""
    return np.log(r / (1.0 - np.asarray(r)))


def share(x: Any) -> Any:
    """Return the share 1 / (1 + exp(-x)) of a logit x."""
    return 1.0 / (1.0 + np.exp(-np.asarray(x)))


def advance(config: CocultureConfig, state: Array, target: Array, minutes: float, errors: Array | None = None) -> Array:
    """Advance the state (..., 3): logit of the share, temperature in degC, m_p in 1/h, by whole `minutes`.

    Each step of 1 min uses the rates at its mean temperature. Args: target: of the thermostat, degC, broadcastable to
    (...). errors: relative errors of both growth curves, in addition to the config's scales, (..., 2).
    """
    off = np.zeros(2) if errors is None else errors
    scale_e, scale_p = config.scale_e * (1.0 + off[..., 0]), config.scale_p * (1.0 + off[..., 1])
    x, temperature, rate = (state[..., k] for k in range(3))
    kept, follow = np.exp(-1.0 / config.cooling_min), -np.expm1(-1.0 / config.pair.second.lag_min)
    for _ in range(round(minutes)):
        cooled = config.ambient_c + (temperature - config.ambient_c) * kept
        reached = np.maximum(cooled, np.minimum(target, cooled + config.heating_c_per_min))
        mean = 0.5 * (temperature + reached)
        first, second = np.moveaxis(config.pair.rates(mean), -1, 0)
        faster = rate + (scale_p * second - rate) * follow
        x = x + (0.5 * (rate + faster) - scale_e * first) / 60.0
        temperature, rate = reached, faster
    return np.stack(np.broadcast_arrays(x, temperature, rate), axis=-1)


def passed(config: CocultureConfig, goal: Array) -> Array:
    """Advance the goal columns, (..., 1) or (..., 3), by one decision: an announced change comes closer or happens."""
    return goal if goal.shape[-1] == 1 else preview.passed(config.control_min, goal)


def at_rest(config: CocultureConfig, x: Array, temperature: Array | float | None = None) -> Array:
    """Return the state (..., 3) after a long time at a temperature; None: that of equal growth of both species."""
    warm = config.pair.even_c if temperature is None else temperature
    t = np.broadcast_to(np.asarray(warm, dtype=np.float64), np.shape(x))
    return np.stack([x, t, config.scale_p * config.pair.rates(t)[..., 1]], axis=-1)


def limits(config: CocultureConfig) -> tuple[Array, Array]:
    """Return the lowest and highest value of each column of an observation, each (O,)."""
    goal = logit(np.array(config.setpoints))
    rates = 10.0 * config.pair.rates(np.linspace(*config.pair.temperatures, 71))[:, 1]
    slow, fast = np.floor(rates.min()) / 10.0 * config.scale_p, np.ceil(rates.max()) / 10.0 * config.scale_p
    low = np.array([-LARGEST, config.ambient_c, slow, goal[0], goal[0], 0.0])
    high = np.array([LARGEST, config.pair.temperatures[1], fast, goal[1], goal[1], config.preview_min])
    return low[: config.columns], high[: config.columns]


class CocultureVectorEnv(EpisodeVectorEnv[CocultureConfig]):
    """Task: hold the share of P. putida at a setpoint by the temperature of the vial (docstring of this module).

    | observation | meaning                                                     | range           | unit |
    |-------------|-------------------------------------------------------------|-----------------|------|
    | 0           | logit of the share r                                        | -20 to 20       | -    |
    | 1           | temperature of the vial                                     | 24 to 36        | degC |
    | 2           | growth rate m_p of P. putida, which lags the temperature    | 0.4 to 1        | 1/h  |
    | 3           | logit of the setpoint                                       | `setpoints`     | -    |
    | 4           | logit of the next setpoint, or of the setpoint if unknown   | `setpoints`     | -    |
    | 5           | time to the change; 0 if unknown                            | 0 to `preview_min` | min |

    Columns 4 and 5 exist only with `preview_min` > 0. Action: index of a thermostat target; these are equally spaced.
    Reward: -(r - setpoint)^2 with the reached share r and the setpoint before the step.
    Start: r, temperature, setpoints and time of the change are uniform, from the stream of the copy; m_p is in balance
    with the temperature. End, autoreset, args and raises: as in `EpisodeVectorEnv`.
    """

    default = CocultureConfig
    names = ("share_logit", "temperature", "growth_rate", "setpoint_logit", "next_setpoint_logit", "minutes_to_change")
    numbers = 5

    @staticmethod
    def observations(config: CocultureConfig) -> spaces.Box:
        """Return the space of the observations in the table, float32."""
        low, high = limits(config)
        return spaces.Box(low.astype(np.float32), high.astype(np.float32), dtype=np.float32)

    def _prepare(self) -> None:
        self._targets = self.config.targets()

    def _begun(self, numbers: Array) -> Array:
        c = self.config
        spans = np.array([c.start_share, c.span, c.setpoints, c.setpoints])
        drawn = spans[:, 0] + (spans[:, 1] - spans[:, 0]) * numbers[:, :4]
        state = at_rest(c, logit(drawn[:, 0]), drawn[:, 1])
        goal = logit(drawn[:, 2:])
        if not c.preview_min:
            return np.concatenate([state, goal[:, :1]], axis=1)
        time = preview.minutes_ahead(c.control_min, c.preview_min, numbers[:, 4:])
        return np.concatenate([state, goal, time], axis=1)

    def _advance(self, actions: NDArray[Any]) -> Array:
        wanted = self.state[:, SETPOINT].copy()
        coldest, warmest = self.config.span
        target = coldest + (warmest - coldest) * actions if self.continuous else self._targets[actions]
        self.state[:, :3] = advance(self.config, self.state[:, :3], target, self.config.control_min)
        np.clip(self.state[:, LOGIT], -LARGEST, LARGEST, out=self.state[:, LOGIT])
        self.state[:, 3:] = passed(self.config, self.state[:, 3:])
        reward: Array = -np.square(share(self.state[:, LOGIT]) - share(wanted))
        return reward


class CocultureEnv(EpisodeEnv):
    """`CocultureVectorEnv` as a single environment. Version history: v0."""

    batch = CocultureVectorEnv
