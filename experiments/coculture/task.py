"""Training task of two species: an agent controls their composition by the temperature."""

from collections.abc import Mapping, Sequence
from dataclasses import asdict
from typing import Any

import numpy as np
import torch
from matplotlib.figure import Figure
from numpy.typing import NDArray

from dqn.config import DQNConfig
from dqn.hindsight import ProgramRelabel, Relabel
from dqn.policy import Policy
from envs.coculture.optimum import Grid, best_action, cost_to_go, transitions
from envs.coculture.task import (
    LOGIT,
    NEXT,
    SETPOINT,
    TEMPERATURE,
    TIME,
    CocultureConfig,
    CocultureVectorEnv,
    advance,
    at_rest,
    limits,
    logit,
    passed,
    share,
)
from experiments.coculture import charts
from experiments.coculture.base import SEEN, SEEN_AHEAD
from experiments.training.evaluation import Rollout, each, rollout

Array = NDArray[np.float64]
SPAN = 3.0  # largest |logit of the share| in training: shares 0.05 to 0.95
FINE = Grid(logits=321)


class Coculture:
    """Training task of two species. `Task` describes the attributes, and arguments and errors of every method."""

    unit = "of the share"
    arrived = 0.02
    provable = False
    scalars: Mapping[str, float] = {}
    steady_unit = 0.02
    """Limit of the steady error: twice the error of an estimate, so that mostly the regret decides."""

    def __init__(self, config: CocultureConfig) -> None:
        self.config = config
        self.regret_unit = 5.0 if config.preview_min else 0.5  # %; higher with preview, where planning has a benefit
        self.steps = self.episode_steps = config.episode_steps
        ahead, law = "no announced changes", "dqn"
        if config.preview_min:
            ahead, law = f"setpoints announced {config.preview_min:g} min ahead", "dqn_preview"
        every = f"a decision every {config.control_min:g} min"
        self.description = f"composition of two species by temperature, {every}, {ahead}"
        self.tried = f"plant=coculture scenario=ratio_steps composition={law} composition_policy={{}}"
        self.steady_steps = max(1, config.episode_steps // 6)
        self.observation: tuple[str, ...] = SEEN_AHEAD if config.preview_min else SEEN
        self.actions = config.targets()
        self.limits = limits(config)
        for end, span, temperature in zip(self.limits, (-SPAN, SPAN), config.span, strict=True):
            end[LOGIT], end[TEMPERATURE] = span, temperature  # a policy's inputs are cut to this range

    def copies(self, seeds: Sequence[np.random.SeedSequence]) -> CocultureVectorEnv:
        env = CocultureVectorEnv(len(seeds), self.config)
        env.seed_streams(seeds)
        return env

    def hindsight(self, agent: DQNConfig) -> Relabel:
        """Build the relabelling of transitions with another share, other setpoints and another time of the change."""
        low, high = self.config.setpoints
        return ProgramRelabel(
            agent,
            lambda uniform: SPAN * (2.0 * uniform - 1.0),
            lambda uniform: torch.logit(low + (high - low) * uniform),
            lambda x, setpoint: -torch.square(torch.sigmoid(x) - torch.sigmoid(setpoint)),
            SETPOINT,
            self.config.control_min,
            self.config.preview_min,
        )

    def selection_grid(self) -> Array:
        """Return the starts that select a policy: 8 shares x 8 setpoints; with preview, one per change of setpoint."""
        return self._grid(np.linspace(0.15, 0.85, 8), np.linspace(0.06, 0.94, 8))

    def report_grid(self) -> Array:
        """Return the starts that score a policy: 19 shares x 9 setpoints; with preview, one per change of setpoint."""
        return self._grid(np.linspace(0.1, 0.9, 9), np.linspace(0.05, 0.95, 19))

    def _grid(self, setpoints: Array, starts: Array) -> Array:
        """Return observations of cultures at rest: each start with each setpoint.

        With preview: at each setpoint, at the moment when the change to each other setpoint is announced.
        """
        c = self.config
        if not c.preview_min:
            start, goal = (logit(a.ravel()) for a in np.meshgrid(starts, setpoints, indexing="ij"))
            return np.concatenate([at_rest(c, start), goal[:, None]], axis=1)
        now, following = (logit(a.ravel()) for a in np.meshgrid(setpoints, setpoints, indexing="ij"))
        now, following = now[now != following], following[now != following]
        time = np.full(now.shape, c.preview_min)
        return np.concatenate([at_rest(c, now), np.stack([now, following, time], axis=1)], axis=1)

    def advance(self, observation: Array, action: NDArray[Any]) -> tuple[Array, Array]:
        """Advance the model and the program by one decision; return the observation and the error r - setpoint."""
        c = self.config
        state = advance(c, observation[..., :3], self.actions[action], c.control_min)
        error = share(state[..., LOGIT]) - share(observation[..., SETPOINT])
        return np.concatenate([state, passed(c, observation[..., 3:])], axis=-1), error

    def asked(self, start: Array) -> Array:
        return np.asarray(start[:, NEXT if self.config.preview_min else SETPOINT].round(9))

    def best(self, start: Array) -> Rollout:
        model = transitions(self.config, FINE)
        programs, which = np.unique(start[:, 3:].round(9), axis=0, return_inverse=True)
        shape = (self.steps, 1, len(start))
        run = Rollout(np.empty(shape), np.empty(shape), np.empty(shape, dtype=np.intp))
        for first in range(0, len(programs), 24):  # in groups of 24, to limit the memory
            rows = np.flatnonzero((which >= first) & (which < first + 24))
            own, state, goal = which[rows] - first, start[rows, :3], programs[first : first + 24]
            setpoints = np.empty((self.steps, len(goal)))
            for k in range(self.steps):
                setpoints[k], goal = share(goal[:, 0]), passed(self.config, goal)
            value = cost_to_go(model, setpoints)
            for k in range(self.steps):
                wanted = setpoints[k, own]
                action = best_action(self.config, model, value[k + 1][:, own], state, wanted)
                state = advance(self.config, state, self.actions[action], self.config.control_min)
                run.action[k, 0, rows], run.state[k, 0, rows] = action, state[:, 0]
                run.error[k, 0, rows] = share(state[:, 0]) - wanted
        return run

    def myopic(self, observation: Array) -> NDArray[np.intp]:
        """Return the action after which the share is nearest to the current setpoint."""
        flat = observation.reshape(-1, observation.shape[-1])
        action = best_action(self.config, None, None, flat[:, :3], share(flat[:, SETPOINT]))
        return action.reshape(observation.shape[:-1])

    def model(self) -> dict[str, Any]:
        return {"control_min": self.config.control_min, "model": asdict(self.config)}

    def figures(self, policy: Policy) -> dict[str, Figure]:
        """Draw share, setpoint and temperature of six episodes, with those of the optimum."""
        grid = self.selection_grid()
        picked = grid[np.linspace(0, len(grid) - 1, 6).astype(int)]
        ours, theirs = rollout(each(policy), self, picked[None]), self.best(picked)
        hours = np.arange(1.0, self.steps + 1.0) * (self.config.control_min / 60.0)
        change = picked[:, TIME] / 60.0 if self.config.preview_min else np.zeros(len(picked))
        last = share(picked[:, NEXT if self.config.preview_min else SETPOINT])
        wanted = np.where(hours[:, None] <= change, share(picked[:, SETPOINT]), last)
        temperatures = (self.actions[ours.action[:, 0]], self.actions[theirs.action[:, 0]])
        figure = charts.episodes(
            hours,
            wanted,
            share(ours.state[:, 0]),
            share(theirs.state[:, 0]),
            *temperatures,
            self.config.pair.second.name,
        )
        return {"trajectories": figure}
