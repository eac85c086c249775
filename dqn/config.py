"""Hyper-parameters of the agent; free of torch, so that a command line can be checked without loading it."""

from __future__ import annotations

from dataclasses import dataclass

__all__ = ["DQNConfig"]


@dataclass(frozen=True)
class DQNConfig:
    """Everything that shapes learning; the values, their sources and reasons are in conf/agent/*.yaml.

    Steps are control steps of one environment; updates are gradient steps.
    Raises: ValueError naming key, value and allowed range.
    """

    hidden: tuple[int, ...] = (64, 64)  # units of the ReLU layers
    gamma: float = 0.99  # discount per step
    learning_rate: float = 1e-3  # Adam's
    total_steps: int = 10_000  # length of training
    epsilon_start: float = 1.0  # exploration rate at step 0
    epsilon_end: float = 0.05  # and from step epsilon_steps on
    epsilon_steps: int = 5_000  # steps over which it falls linearly
    replay_size: int = 10_000  # transitions kept
    learn_start: int = 500  # steps before the first update
    batch_size: int = 64
    updates_per_step: int = 1
    target_period: int = 500  # updates between copies of the online network to the target network
    action_gap: float = 0.0  # alpha of advantage learning, which makes action gaps 1 / (1 - alpha) times as wide
    output_basis_decay: float = 0.0  # rows of the output basis fall as (1 + degree)^-decay; 0: no basis
    huber: float = 0.0  # TD errors beyond this are clipped in the gradient; 0 means squared error
    reward_scale: float = 1.0  # rewards are multiplied by this inside the agent
    hindsight_share: float = 0.0  # share of each minibatch that is given another goal
    hindsight_near: float = 0.0  # share of those whose new goal lies close to the state reached
    hindsight_width: tuple[float, float] = (1e-3, 0.8)  # range of that distance, drawn log-uniformly
    input_matrix: tuple[float, ...] = ()  # features = M observation + c, M row by row; () means identity
    input_offset: tuple[float, ...] = ()  # c, one number per feature
    init_mirror: tuple[int, ...] = ()  # -1 or 1 per feature: half of the units start as mirror images; () = none
    init_zero_output: bool = False  # the last layer starts at zero

    def __post_init__(self) -> None:
        """Check every range once, where the value enters."""
        checks = (
            ("hidden", self.hidden, len(self.hidden) > 0 and min(self.hidden) >= 1, "one or more layer sizes >= 1"),
            ("gamma", self.gamma, 0.0 <= self.gamma < 1.0, "0 <= gamma < 1"),
            ("learning_rate", self.learning_rate, 0.0 < self.learning_rate <= 1.0, "0 < rate <= 1"),
            ("total_steps", self.total_steps, self.total_steps >= 1, "at least 1"),
            ("epsilon_start", self.epsilon_start, 0.0 <= self.epsilon_start <= 1.0, "0 to 1"),
            ("epsilon_end", self.epsilon_end, 0.0 <= self.epsilon_end <= 1.0, "0 to 1"),
            ("epsilon_steps", self.epsilon_steps, self.epsilon_steps >= 0, "at least 0"),
            ("replay_size", self.replay_size, self.replay_size >= 1, "at least 1"),
            ("learn_start", self.learn_start, self.learn_start >= 1, "at least 1 (there must be something to replay)"),
            ("batch_size", self.batch_size, self.batch_size >= 1, "at least 1"),
            ("updates_per_step", self.updates_per_step, self.updates_per_step >= 1, "at least 1"),
            ("target_period", self.target_period, self.target_period >= 1, "at least 1 update"),
            ("action_gap", self.action_gap, 0.0 <= self.action_gap < 1.0, "0 <= alpha < 1"),
            ("output_basis_decay", self.output_basis_decay, self.output_basis_decay >= 0.0, "at least 0 (0 = off)"),
            ("huber", self.huber, self.huber >= 0.0, "at least 0 (0 = squared error)"),
            ("reward_scale", self.reward_scale, self.reward_scale > 0.0, "greater than 0"),
            ("hindsight_share", self.hindsight_share, 0.0 <= self.hindsight_share <= 1.0, "0 to 1"),
            ("hindsight_near", self.hindsight_near, 0.0 <= self.hindsight_near <= 1.0, "0 to 1"),
            (
                "hindsight_width",
                self.hindsight_width,
                len(self.hindsight_width) == 2 and 0.0 < self.hindsight_width[0] <= self.hindsight_width[1],
                "[low, high] with 0 < low <= high",
            ),
        )
        for key, value, ok, allowed in checks:
            if not ok:
                raise ValueError(f"agent.{key} = {value}: allowed {allowed}")
        if bool(self.input_matrix) != bool(self.input_offset) or (
            self.input_offset and len(self.input_matrix) % len(self.input_offset)
        ):
            raise ValueError(
                f"agent.input_matrix has {len(self.input_matrix)} values and agent.input_offset "
                f"{len(self.input_offset)}: allowed one row of the matrix per value of the offset, or neither"
            )
        mirror = self.init_mirror
        if mirror and (len(mirror) != len(self.input_offset) or set(mirror) - {-1, 1}):
            raise ValueError(
                f"agent.init_mirror = {list(mirror)}: allowed -1 or 1 for each of the {len(self.input_offset)} values "
                "of agent.input_offset, or []"
            )
        if mirror and any(units % 2 for units in self.hidden):
            raise ValueError(f"agent.hidden = {list(self.hidden)}: allowed even sizes with agent.init_mirror, or []")

    def epsilon(self, step: int) -> float:
        """Probability of a random action at an environment step: linear in the step, then constant."""
        if step >= self.epsilon_steps:
            return self.epsilon_end
        return self.epsilon_start + (self.epsilon_end - self.epsilon_start) * step / self.epsilon_steps

    @property
    def total_updates(self) -> int:
        """Gradient steps of a whole training run."""
        return max(0, self.total_steps - self.learn_start) * self.updates_per_step
