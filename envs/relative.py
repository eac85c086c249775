"""Control task in relative coordinates: one policy serves every strain, pump, volume and control period.

h is the control period, u_max the largest pump rate, g the true over the calibrated flow. B = g u_max h / tau is the
decrease of ln x in one period of full pump. Then e = ln(x/r)/B is the error in periods of full pump, s = mu h / B the
growth share, and v = u/u_max the relative pump rate. x' = (mu - u/tau) x (paper, equation 5), integrated exactly over
one period, becomes

  e' = e + s - v

No other property of strain or pump appears. For s > 1 the culture outgrows every pump rate.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from conf.schema import check, setting
from envs.integrators import Array
from envs.vector_env import EpisodeVectorEnv


@dataclass(frozen=True)
class RelativeConfig:
    """`env=relative`: the task e' = e + s - v. Raises: ValueError with key, value and allowed range."""

    kind: str = setting("relative", "task")
    n_actions: int = setting(17, "number of pump rates, equally spaced from 0 to the largest", within=(2, 1001))
    episode_steps: int = setting(20, "control steps per episode, ended by truncation", at_least=1)
    growth_shares: tuple[float, float] = setting(
        (0.05, 0.98), "range of the growth share s, uniform per episode", above=0.0, at_most=1.0, interval=True
    )
    largest_error: float = setting(
        1.2,
        "episodes start within +- this error; beyond it the policy uses full pump or none",
        "periods of full pump",
        within=(1.1, 100),
    )

    def __post_init__(self) -> None:
        check(self, "env")

    def levels(self) -> Array:
        """Return the action grid v, fractions of the largest pump rate, shape (A,)."""
        return np.linspace(0.0, 1.0, self.n_actions)


def relative_reward(error: Any) -> Any:
    """Compute the reward -e'^2 of the reached error, a NumPy array or tensor."""
    return -error * error


def nearest_level(error: Array, growth_share: Array, n: int = 17) -> NDArray[np.intp]:
    """Return the index of the level nearest to clip(e + s, 0, 1); a tie gives the lower level (myopic controller)."""
    wanted = np.clip(error + growth_share, 0.0, 1.0) * (n - 1)
    return np.asarray(np.ceil(wanted - 0.5).clip(0, n - 1), dtype=np.intp)


class RelativeVectorEnv(EpisodeVectorEnv[RelativeConfig]):
    """Task: hold a culture at a setpoint, in relative coordinates: e' = e + s - v (docstring of this module).

    | observation | meaning                                        | range                | unit                 |
    |-------------|------------------------------------------------|----------------------|----------------------|
    | 0           | error e                                        | any                  | periods of full pump |
    | 1           | growth share s, constant during an episode     | `growth_shares`      | -                    |

    Action: index a of v = a / (n_actions - 1), fraction of the largest pump rate. Reward: -e'^2 of the reached error.
    Start: e uniform within +- `largest_error`, s uniform in `growth_shares`, both from the stream of the copy.
    End, autoreset, args and raises: as in `EpisodeVectorEnv`.
    """

    default = RelativeConfig
    names = ("error", "growth_share")

    @staticmethod
    def observations(config: RelativeConfig) -> spaces.Box:
        """Return the space of [e, s], shape (2,), float32."""
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
