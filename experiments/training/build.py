"""Config to objects: the single place where the parts meet. Torch is loaded by what trains, not by what controls."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from envs.rewards import tracking_reward
from envs.task import EnvConfig
from experiments.training import seeding

if TYPE_CHECKING:
    import torch

    from dqn.config import DQNConfig
    from dqn.hindsight import Relabel
    from dqn.network import QNetwork
    from dqn.policy import Policy
    from dqn.population import Population
    from dqn.trainer import Trainer
    from envs.plant.plant import Plant
    from experiments.controllers.base import Controller
    from experiments.training.evaluation import Act

__all__ = ["act_with", "controller", "hindsight", "population", "trainer"]


def population(
    env: EnvConfig, agent: DQNConfig, seeds: Sequence[int], device: str = "cpu", threads: int | None = None
) -> Population:
    """Agents with the given seeds in groups of a size that suits the device; arguments as `Population`."""
    from dqn.population import GROUP, Population

    size = GROUP if device == "cpu" else len(seeds)
    groups = [seeds[k : k + size] for k in range(0, len(seeds), size)]
    return Population([trainer(env, agent, group, device) for group in groups], threads)


def trainer(env: EnvConfig, agent: DQNConfig, seeds: Sequence[int], device: str = "cpu") -> Trainer:
    """One group of agents with the given seeds, each in its own copy of the environment; one record per episode."""
    from dqn.agent import STREAMS, DQNAgent
    from dqn.trainer import Trainer
    from envs.vector_env import BioreactorVectorEnv

    streams = seeding.streams(seeds, (*STREAMS, "env"))
    copies = BioreactorVectorEnv(len(seeds), env)
    copies.seed_streams(streams["env"])
    learner = DQNAgent(agent, 2, env.n_actions, streams, hindsight(env, agent), device)
    return Trainer(copies, learner, interval=env.episode_steps)


def hindsight(env: EnvConfig, agent: DQNConfig) -> Relabel:
    """Goals of replayed transitions: the task's range of setpoints and its reward."""
    from dqn.hindsight import goal_relabel

    return goal_relabel(agent, (min(env.setpoints), max(env.setpoints)), tracking_reward)


def act_with(network: QNetwork, flat: torch.Tensor) -> Act:
    """The greedy policies of weights (S, P) as a function on NumPy grids."""
    import torch

    network = network.with_weights(flat)

    def act(od: np.ndarray, setpoint: np.ndarray) -> np.ndarray:
        observation = torch.from_numpy(np.stack([od, setpoint], axis=-1).astype(np.float32)).to(flat.device)
        return network(observation).argmax(-1).cpu().numpy()

    return act


def controller(
    config: Any, model: EnvConfig, policy: Policy | None = None, plant: Plant | None = None, flow_ml_s: float = 1.0
) -> Controller:
    """The controller that a config of `experiments.control.config.controller_config` describes.

    Args:
      config: its dataclass; `kind` names it.
      model: the calibrated growth model, control period and largest pump rate, for those that use a model.
      policy: what `dqn` follows. plant: the vials that `oracle` knows; only a simulation has it.
      flow_ml_s: what the backend believes its pumps deliver (the oracle must know what a rate becomes).
    Raises: ValueError naming what is missing for this kind of controller.
    """
    from experiments.controllers.baselines import Hold, Threshold
    from experiments.controllers.inverse import Inverse
    from experiments.controllers.learned import LearnedController
    from experiments.controllers.mpc import Mpc
    from experiments.controllers.oracle import Oracle
    from experiments.controllers.pi import ChiBioPI, TunedPI

    match config.kind:
        case "dqn":
            if policy is None:
                raise ValueError("controller = dqn: needs a policy; give policy=RUN/policy.npz")
            return LearnedController(policy)
        case "oracle":
            if plant is None:
                raise ValueError("controller = oracle: knows a simulated plant; allowed with backend=sim only")
            return Oracle(config, plant, model, flow_ml_s)
        case "pi":
            return ChiBioPI(config)
        case "pi_tuned":
            return TunedPI(config, model)
        case "mpc":
            return Mpc(config, model)
        case "inverse":
            return Inverse(config, model)
        case "threshold":
            return Threshold(config)
        case "hold":
            return Hold(config, model)
    raise ValueError(f"controller.kind = {config.kind}: no such controller")
