"""The control task in relative coordinates, with one policy for every strain, pump, volume and control period.

With h the control period and u_max the largest pump rate, B = g u_max h / tau is the decrease of ln x in one period at
full pump rate (g: true over calibrated flow). Then e = ln(x/r)/B is the error in periods of full pump, s = mu h / B the
growth share, and v = u/u_max the relative pump rate:

  e' = e + s - v

which is x' = (mu - u/tau) x (paper, equation 5) integrated exactly over one period. It contains no other property of
strain and pump. For s > 1 no pump rate holds the culture.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from conf.schema import check, setting
from envs.gym_adapter import EpisodeEnv
from envs.integrators import Array
from envs.vector_env import EpisodeVectorEnv


@dataclass(frozen=True)
class RelativeConfig:
    """`env=relative`: the task e' = e + s - v. Raises: ValueError with key, value and allowed range."""

    kind: str = setting("relative", "task")
    n_actions: int = setting(17, "number of pump rates, equally spaced from 0 to the largest", within=(2, 1001))
    episode_steps: int = setting(20, "control steps per episode, ended by truncation", at_least=1)
    growth_shares: tuple[float, float] = setting(
        (0.05, 0.98), "range of s, drawn uniformly per episode", above=0.0, at_most=1.0, interval=True
    )
    largest_error: float = setting(
        1.2,
        "episodes start within +- this error; beyond it the pump runs at full rate or not at all",
        "periods of full pump",
        within=(1.1, 100),
    )

    def __post_init__(self) -> None:
        check(self, "env")

    def levels(self) -> Array:
        """Return the action grid v, fractions of the largest pump rate, shape (A,)."""
        return np.linspace(0.0, 1.0, self.n_actions)


def relative_reward(error: Any) -> Any:
    """Compute r = -e'^2 of the reached error, NumPy or tensor."""
    return -error * error


def nearest_level(error: Array, growth_share: Array, n: int = 17) -> NDArray[np.intp]:
    """Choose the level nearest to clip(e + s, 0, 1), the lower of two equally near ones (myopic controller)."""
    wanted = np.clip(error + growth_share, 0.0, 1.0) * (n - 1)
    return np.asarray(np.ceil(wanted - 0.5).clip(0, n - 1), dtype=np.intp)


class RelativeVectorEnv(EpisodeVectorEnv[RelativeConfig]):
    """A culture held at a setpoint, in relative coordinates: e' = e + s - v (module's description).

    | observation | meaning                                        | range                | unit                 |
    |-------------|------------------------------------------------|----------------------|----------------------|
    | 0           | error e                                        | any                  | periods of full pump |
    | 1           | growth's share of the pump s, of this episode  | `growth_shares`      | -                    |

    Action: index a of v = a / (n_actions - 1), fraction of the largest pump rate. Reward: -e'^2 of the reached error.
    Start: e uniform within +- `largest_error`, s uniform in `growth_shares`, both from the copy's own stream.
    End and autoreset: as `EpisodeVectorEnv`. Args, raises: as there.
    """

    default = RelativeConfig
    names = ("error", "growth_share")

    @staticmethod
    def observations(config: RelativeConfig) -> spaces.Box:
        """[e, s], shape (2,), float32."""
        low, high = np.array(config.growth_shares, dtype=np.float32)
        ends = np.array([[-np.inf, low], [np.inf, high]], dtype=np.float32)
        return spaces.Box(ends[0], ends[1], dtype=np.float32)

    def _prepare(self) -> None:
        self._levels = self.config.levels()

    def _begun(self, numbers: Array) -> Array:
        span, (low, high) = self.config.largest_error, self.config.growth_shares
        return np.stack([span * (2.0 * numbers[:, 0] - 1.0), low + (high - low) * numbers[:, 1]], axis=1)

    def _advance(self, actions: NDArray[Any]) -> Array:
        self.state[:, 0] += self.state[:, 1] - (actions if self.continuous else self._levels[actions])
        reward: Array = relative_reward(self.state[:, 0])
        return reward


class RelativeEnv(EpisodeEnv):
    """`RelativeVectorEnv` as one environment. Version history: v0."""

    batch = RelativeVectorEnv
