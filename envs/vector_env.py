"""N parallel training episodes as one `gymnasium.vector.VectorEnv`, without a Python loop over copies."""

import reprlib
from abc import abstractmethod
from collections.abc import Sequence
from dataclasses import fields, replace
from typing import Any, Generic, Self, TypeVar

import numpy as np
from gymnasium import logger, spaces
from gymnasium.envs.registration import EnvSpec
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from numpy.typing import NDArray

from conf.schema import build, require
from envs.integrators import Array
from envs.task import MAX_OD, EnvConfig, step_factors, tracking_reward

C = TypeVar("C", bound=Any)  # config dataclass of the task
EPISODES_PER_BLOCK = 64


def checked_actions(actions: Any, shape: tuple[int, ...], n_actions: int) -> NDArray[np.intp]:
    """Return the actions as an array of `shape`. Raises: ValueError unless all are integers from 0 to n_actions - 1."""
    given = np.asarray(actions)
    if given.shape != shape or given.dtype.kind not in "iu" or given.min() < 0 or given.max() >= n_actions:
        raise ValueError(
            f"action {reprlib.repr(given.tolist())} of shape {given.shape} and type {given.dtype}: allowed "
            f"integers from 0 to {n_actions - 1} (indices of pump rates) of shape {shape}"
        )
    return given


class EpisodeSpec:
    """Base class that adds the episode length to Gymnasium's `spec` and does not render.

    The environments truncate their episodes, so no time limit is registered with Gymnasium.
    """

    config: Any
    _spec: EnvSpec | None = None

    @property
    def spec(self) -> EnvSpec | None:
        """Gymnasium's spec with the length of an episode."""
        return self._spec

    @spec.setter
    def spec(self, value: EnvSpec | None) -> None:
        self._spec = None if value is None else replace(value, max_episode_steps=self.config.episode_steps)

    def render(self) -> None:
        """Warn that nothing is drawn, as Gymnasium's environments do without a `render_mode`."""
        logger.warn("this environment has nothing to draw; plot what `reset` and `step` return")


class EpisodeStreams:
    """Uniform numbers for each episode of each copy (start, setpoint), from one generator per copy.

    Copy i draws the same numbers for every N. Numbers are drawn in blocks, so a reset of thousands of copies needs no
    Python loop. The saved state has each generator before its block and the position of each copy in its block.
    """

    def __init__(self, seeds: Sequence[int | np.random.SeedSequence], numbers: int = 2) -> None:
        self._generators = [np.random.default_rng(seed) for seed in seeds]
        self._states: list[Any] = [None] * len(seeds)
        self._block = np.empty((len(seeds), EPISODES_PER_BLOCK, numbers))
        self._position = np.zeros(len(seeds), dtype=np.intp)
        self._refill(np.arange(len(seeds)))

    def _refill(self, copies: NDArray[np.intp]) -> None:
        for i in copies:
            self._states[i] = self._generators[i].bit_generator.state
            self._generators[i].random(out=self._block[i])
        self._position[copies] = 0

    def take(self, copies: NDArray[np.intp]) -> Array:
        """Return the numbers in [0, 1) for the next episode of each of `copies`, shape (len(copies), numbers)."""
        used_up = copies[self._position[copies] == EPISODES_PER_BLOCK]
        if used_up.size:
            self._refill(used_up)
        numbers = self._block[copies, self._position[copies]]
        self._position[copies] += 1
        return numbers

    def state_dict(self) -> dict[str, Any]:
        """Return the state needed to continue, as plain numbers and lists."""
        return {"generators": list(self._states), "position": self._position.tolist()}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        for generator, stored in zip(self._generators, state["generators"], strict=True):
            generator.bit_generator.state = stored
        self._refill(np.arange(len(self._generators)))
        self._position[:] = state["position"]


class EpisodeVectorEnv(EpisodeSpec, VectorEnv[Any, Any, Any], Generic[C]):
    """N copies of a task with episodes of fixed length. A subclass defines how episodes begin and advance.

    `state` (N, O) contains the observation of each copy in full precision: the state, and the goal or parameter.
    End: never terminated; truncated after `config.episode_steps` steps (bootstrapping continues).
    Autoreset: with SAME_STEP, infos["final_obs"] contains the last observation of each ended episode. With NEXT_STEP,
    the next step ignores its action and starts the next episode with reward 0 (for Gymnasium's stateful wrappers).

    Args:
      num_envs: N >= 1. config: the task; overrides: values to change in it, `episode_steps=50`.
      autoreset_mode: SAME_STEP or NEXT_STEP, as `gymnasium.vector.AutoresetMode` or its value.
      render_mode: only None, as nothing is drawn. max_episode_steps: limit of `episode_steps`, given by Gymnasium.
      continuous: whether actions are numbers from 0 to 1, (N, 1), positions in the grid's range, instead of indices.
    Raises: ValueError for an invalid value or an unknown key; TypeError for a `render_mode`.
    """

    metadata = {"autoreset_mode": AutoresetMode.SAME_STEP, "render_modes": []}  # noqa: RUF012  (Gymnasium's contract)
    default: type[C]
    names: tuple[str, ...]
    """Names of the observation's numbers, in order; the options of `reset` use them."""
    numbers = 2
    """Number of uniform numbers for the start of an episode."""

    config: C

    def __init__(
        self,
        num_envs: int = 1,
        config: C | None = None,
        *,
        autoreset_mode: AutoresetMode | str = AutoresetMode.SAME_STEP,
        render_mode: str | None = None,
        max_episode_steps: int | None = None,
        continuous: bool = False,
        **overrides: Any,
    ) -> None:
        if config is None:
            known = {field.name for field in fields(self.default)}
            build(self.default(), {key: value for key, value in overrides.items() if key not in known})  # refuses them
            config = self.default(**overrides)
        steps = min(config.episode_steps, max_episode_steps or config.episode_steps)
        self.config = replace(config, episode_steps=steps)
        if render_mode is not None:  # a TypeError: Stable-Baselines3 requests rendering, and continues without
            raise TypeError(f"render_mode = {render_mode}: allowed None (there is nothing to draw)")
        modes = {AutoresetMode.SAME_STEP, AutoresetMode.NEXT_STEP}
        allowed = ", ".join(sorted(str(mode) for mode in modes))
        require(autoreset_mode in modes | {m.value for m in modes}, "autoreset_mode", autoreset_mode, allowed)
        self.metadata = {**self.metadata, "autoreset_mode": AutoresetMode(autoreset_mode)}
        self.num_envs = num_envs
        self.render_mode = None
        self.single_observation_space = self.observations(self.config)
        self.continuous = continuous
        share = spaces.Box(0.0, 1.0, (1,), np.float32)
        self.single_action_space = share if continuous else spaces.Discrete(self.config.n_actions)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self.state = np.ones((num_envs, *self.single_observation_space.shape))
        self._steps = np.zeros(num_envs, dtype=np.int64)
        self._waiting = np.zeros(num_envs, dtype=np.bool_)  # NEXT_STEP: the next step starts an episode
        self._streams: EpisodeStreams | None = None
        self._prepare()

    @staticmethod
    @abstractmethod
    def observations(config: C) -> spaces.Box:
        """Return the space of one copy's observations."""

    def _prepare(self) -> None:
        """Prepare values that the task needs in every step; called once."""

    @abstractmethod
    def _begun(self, numbers: Array) -> Array:
        """Return the state (K, O) of new episodes from uniform numbers, (K, numbers)."""

    @abstractmethod
    def _advance(self, actions: NDArray[Any]) -> Array:
        """Advance `state` by one period; return the rewards (N,). Args: actions: indices or numbers from 0 to 1."""

    def _weigh(self, last: Array) -> Array:
        """Return the weighted rewards of the last steps of K episodes, (K,)."""
        return last

    @classmethod
    def seeded(cls, config: C, seeds: Sequence[np.random.SeedSequence]) -> Self:
        """Create an environment with one copy per seed."""
        env = cls(len(seeds), config)
        env.seed_streams(seeds)
        return env

    def seed_streams(self, seeds: Sequence[int | np.random.SeedSequence]) -> None:
        """Create the random stream of each copy; `reset(seed=...)` does this with seed, seed + 1, ..."""
        self._streams = EpisodeStreams(seeds, self.numbers)

    def _start(self, copies: NDArray[np.intp]) -> None:
        assert self._streams is not None
        self.state[copies] = self._begun(self._streams.take(copies))
        self._steps[copies] = 0
        self._waiting[copies] = False

    def _observe(self) -> NDArray[np.float32]:
        return self.state.astype(np.float32)

    def reset(
        self, *, seed: int | list[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[NDArray[np.float32], dict[str, Any]]:
        """Start new episodes.

        Args:
          seed: an integer (copy i gets seed + i), one integer or None per copy, or None to continue the streams.
          options: {"reset_mask": bool array (N,)} restarts only these copies; {NAME: number or (N,)} with NAME from
          `names` replaces a random start value, {"od": 0.3, "setpoint": 0.5}.
        Returns: observations (N, O), {}.
        Raises: ValueError for a mask of another shape, an unknown option or a value out of range.
        """
        if isinstance(seed, int):
            seed = [seed + i for i in range(self.num_envs)]
        if seed is not None:
            self.seed_streams([np.random.SeedSequence(s) for s in seed])
        elif self._streams is None:
            self.seed_streams(np.random.SeedSequence().spawn(self.num_envs))
        given = dict(options or {})
        mask = np.asarray(given.pop("reset_mask", np.ones(self.num_envs, dtype=np.bool_)))
        if mask.shape != (self.num_envs,):
            raise ValueError(f"reset_mask has shape {mask.shape}: allowed ({self.num_envs},)")
        starts = dict(self._given(name, value) for name, value in given.items())
        self._start(np.flatnonzero(mask))
        for column, value in starts.items():
            self.state[mask, column] = value[mask]
        return self._observe(), {}

    def _given(self, name: str, value: Any) -> tuple[int, Array]:
        """Return column and values (N,) of a start value in the options of `reset`. Raises: ValueError."""
        space, names = self.observations(self.config), self.names[: self.state.shape[1]]
        require(name in names, "reset option", name, ", ".join(("reset_mask", *names)))
        low, high = float(space.low[names.index(name)]), float(space.high[names.index(name)])
        given = np.asarray(value, dtype=np.float64)
        fits = given.shape in ((), (self.num_envs,)) and bool(np.all((low <= given) & (given <= high)))
        require(fits, name, reprlib.repr(given.tolist()), f"{low:g} to {high:g}, one number or {self.num_envs}")
        return names.index(name), np.broadcast_to(given, (self.num_envs,))

    def step(
        self, actions: NDArray[np.intp]
    ) -> tuple[NDArray[np.float32], Array, NDArray[np.bool_], NDArray[np.bool_], dict[str, Any]]:
        """Advance every copy by one control period.

        Args: actions: indices of the action grid, integers, (N,); if `continuous`, numbers from 0 to 1, (N, 1).
        Returns: observations (N, O), rewards (N,), terminated (N,) all False, truncated (N,), infos. With SAME_STEP,
        infos["final_obs"] (N, O) has the last observations of ended episodes; infos["_final_obs"] (N,) is their mask.
        Raises: RuntimeError before the first reset; ValueError for actions of another shape or outside the grid.
        """
        if self._streams is None:
            raise RuntimeError("step before reset: call reset(seed=...) first")
        reward = self._advance(self.checked(actions, (self.num_envs,)))
        self._steps += 1
        if self._waiting.any():
            reward[self._waiting] = 0.0
            self._start(np.flatnonzero(self._waiting))
        truncated = self._steps >= self.config.episode_steps
        infos = self._end(truncated, reward) if truncated.any() else {}
        return self._observe(), reward, np.zeros(self.num_envs, dtype=np.bool_), truncated, infos

    def checked(self, actions: Any, copies: tuple[int, ...]) -> NDArray[Any]:
        """Check actions, indices or numbers from 0 to 1; return them in the shape `copies`. Raises: ValueError."""
        if not self.continuous:
            return checked_actions(actions, copies, self.config.n_actions)
        given = np.asarray(actions, dtype=np.float64)
        fits = given.shape == (*copies, 1) and bool(np.all((given >= 0.0) & (given <= 1.0)))
        require(fits, "action", reprlib.repr(given.tolist()), f"numbers from 0 to 1, shape {(*copies, 1)}")
        return given[..., 0]

    def _end(self, truncated: NDArray[np.bool_], reward: Array) -> dict[str, Any]:
        """Weight the last reward of ended episodes in place; begin or schedule the next episodes; return infos."""
        reward[truncated] = self._weigh(reward[truncated])
        if self.metadata["autoreset_mode"] is AutoresetMode.NEXT_STEP:
            self._waiting = truncated.copy()
            return {}
        infos = {"final_obs": self._observe(), "final_info": {}}
        self._start(np.flatnonzero(truncated))
        return {**infos, **{f"_{key}": truncated.copy() for key in infos}}

    def state_dict(self) -> dict[str, Any]:
        """Return the state needed to continue bit for bit on one processor, as plain numbers and lists."""
        assert self._streams is not None, "reset before state_dict"
        return {
            "state": self.state.tolist(),
            "steps": self._steps.tolist(),
            "waiting": self._waiting.tolist(),
            "streams": self._streams.state_dict(),
        }

    def load_state_dict(self, state: dict[str, Any]) -> NDArray[np.float32]:
        assert self._streams is not None, "seed_streams before load_state_dict"
        self.state[:] = state["state"]
        self._steps[:] = state["steps"]
        self._waiting[:] = state["waiting"]
        self._streams.load_state_dict(state["streams"])
        return self._observe()


class BioreactorVectorEnv(EpisodeVectorEnv[EnvConfig]):
    """Task: hold a culture at a setpoint by choosing a pump rate every control period (paper, sections 2 and 3).

    Dynamics: x' = (mu - u/tau) x, integrated with `substeps` steps of `integrator` per control period.

    | observation | meaning                       | range      | unit |
    |-------------|-------------------------------|------------|------|
    | 0           | optical density x             | [0, 1000]  | -    |
    | 1           | setpoint of this episode      | (0, 2]     | -    |

    Action: index a of the pump rate u = a / (n_actions - 1) * max_pump_rate, mL/s.
    Reward: -(x - setpoint)^2 with the reached x; in the last step times `final_reward_weight`.
    Start: x uniform in `start_od`, setpoint drawn from `setpoints`, both from the stream of the copy.
    End, autoreset, args and raises: as in `EpisodeVectorEnv`.
    """

    default = EnvConfig
    names: tuple[str, ...] = ("od", "setpoint")

    @staticmethod
    def observations(config: EnvConfig) -> spaces.Box:
        """Return the space of [x, setpoint], shape (2,), float32: x from 0 to `MAX_OD`, setpoint from 0 to 2."""
        return spaces.Box(low=0.0, high=np.array([MAX_OD, 2.0], dtype=np.float32), shape=(2,), dtype=np.float32)

    def _prepare(self) -> None:
        self._factors = step_factors(self.config)
        self._setpoints = np.asarray(self.config.setpoints)

    @property
    def od(self) -> Array:
        """True OD x, (N,)."""
        return self.state[:, 0]

    @property
    def setpoint(self) -> Array:
        """Setpoint of the current episode, (N,)."""
        return self.state[:, 1]

    def _begun(self, numbers: Array) -> Array:
        low, high = self.config.start_od
        setpoint = self._setpoints[(numbers[:, 1] * self._setpoints.size).astype(np.intp)]
        return np.stack([low + (high - low) * numbers[:, 0], setpoint], axis=1)

    def _advance(self, actions: NDArray[Any]) -> Array:
        rates = actions * self.config.max_pump_rate
        factors = step_factors(self.config, rates) if self.continuous else self._factors[actions]
        np.minimum(self.od * factors, MAX_OD, out=self.od)
        return tracking_reward(self.od, self.setpoint)

    def _weigh(self, last: Array) -> Array:
        return last * self.config.final_reward_weight
