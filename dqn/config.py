"""Hyper-parameters of the agent. This module does not import torch, so a command line is checked fast."""

from dataclasses import dataclass

from conf.schema import check, setting


@dataclass(frozen=True)
class DQNConfig:
    """All settings of learning. The defaults give a plain DQN; conf/agent/*.yaml have other values and their reasons.

    Steps are control steps of one environment; updates are gradient steps.
    Raises: ValueError with key, value and allowed range.
    """

    kind: str = setting("dqn", "algorithm")
    hidden: tuple[int, ...] = setting((64, 64), "widths of the ReLU layers", "units", at_least=1, some=True)
    gamma: float = setting(0.99, "discount factor per step", at_least=0.0, below=1.0)
    learning_rate: float = setting(1e-3, "learning rate of Adam", above=0.0, at_most=1.0)
    learning_rate_end: float | None = setting(
        None, "final rate; reached from the middle of the updates on; null: constant", above=0.0, at_most=1.0
    )
    total_steps: int = setting(10_000, "length of training", "steps", at_least=1)
    epsilon_start: float = setting(1.0, "exploration rate at step 0", within=(0, 1))
    epsilon_end: float = setting(0.05, "exploration rate from step epsilon_steps on", within=(0, 1))
    epsilon_steps: int = setting(5_000, "steps over which the exploration rate changes linearly", "steps", at_least=0)
    replay_size: int = setting(10_000, "size of the replay memory", "transitions", at_least=1)
    learn_start: int = setting(
        500, "steps before the first update", "steps", at_least=1, note="the replay memory must not be empty"
    )
    batch_size: int = setting(64, "transitions in a minibatch", "transitions", at_least=1)
    updates_per_step: int = setting(1, "gradient steps per control step", "updates", at_least=1)
    target_period: int = setting(
        500, "updates between copies of the online network to the target network", "updates", at_least=1
    )
    action_gap: float = setting(
        0.0,
        "alpha of advantage learning; widens the gaps between actions by 1 / (1 - alpha)",
        at_least=0.0,
        below=1.0,
    )
    output_basis_decay: float = setting(
        0.0, "decay of the output basis, whose rows scale as (1 + degree)^-decay; 0: no basis", at_least=0.0
    )
    huber: float = setting(0.0, "TD error, +-, beyond which the gradient is clipped; 0: no clipping", at_least=0.0)
    value_root: float = setting(
        0.0,
        "c in h(z) = c - sqrt(c^2 - z), which the network learns instead of the value z; 0: the value itself",
        at_least=0.0,
    )
    reward_scale: float = setting(1.0, "factor by which the agent multiplies the rewards", above=0.0)
    hindsight_share: float = setting(0.0, "fraction of each minibatch whose goals are replaced", within=(0, 1))
    hindsight_near: float = setting(0.0, "fraction of replaced goals close to the reached state", within=(0, 1))
    hindsight_width: tuple[float, float] = setting(
        (1e-3, 0.8), "distance of a close goal from the state, log-uniform", "OD", above=0.0, interval=True
    )
    input_matrix: tuple[float, ...] = setting((), "M of the features M observation + c, row by row; []: identity")
    input_offset: tuple[float, ...] = setting((), "c of the features M observation + c, one number per feature")
    init_zero_output: bool = setting(False, "initialise the last layer with zeros")

    def __post_init__(self) -> None:
        check(self, "agent")
        if bool(self.input_matrix) != bool(self.input_offset) or (
            self.input_offset and len(self.input_matrix) % len(self.input_offset)
        ):
            raise ValueError(
                f"agent.input_matrix has {len(self.input_matrix)} values and agent.input_offset "
                f"{len(self.input_offset)}: allowed one row of the matrix per value of the offset, or neither"
            )

    def epsilon(self, step: int) -> float:
        """Return the probability of a random action at an environment step: first linear in the step, then constant."""
        if step >= self.epsilon_steps:
            return self.epsilon_end
        return self.epsilon_start + (self.epsilon_end - self.epsilon_start) * step / self.epsilon_steps

    def learning_rate_at(self, update: int) -> float:
        """Return Adam's learning rate at a gradient step."""
        if self.learning_rate_end is None:
            return self.learning_rate
        part = max(0.0, 2.0 * update / max(1, self.total_updates) - 1.0)
        return float(self.learning_rate * (self.learning_rate_end / self.learning_rate) ** part)

    @property
    def total_updates(self) -> int:
        """Gradient steps of a whole training run."""
        return max(0, self.total_steps - self.learn_start) * self.updates_per_step
