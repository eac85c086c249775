"""Model predictive control of OD with the growth model, solved by particle swarms or by gradient."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from conf.schema import check, part, setting
from envs.task import EnvConfig
from experiments.laws.base import Array, ControllerConfig, Mask, usable

LOWEST_OD = 1e-3  # a lower reading counts as this OD, because the model cannot grow from zero


INERTIA, ATTRACTION = 0.7298, 1.49618
"""Weights of a particle's velocity, and of the pull to its own best and the swarm's best position: Clerc and Kennedy's
constriction coefficients in inertia form, within the bound of order-2 stability (Poli 2009)."""


@dataclass(frozen=True)
class SwarmConfig:
    """Settings of the particle swarms.

    40 particles and 120 iterations ended within 1 % of the optimum from each of 400 random cold starts.
    """

    particles: int = setting(40, "particles per swarm", within=(2, 10_000))
    iterations: int = setting(120, "iterations per swarm", within=(1, 10_000))

    def __post_init__(self) -> None:
        check(self, "controller.swarm")


@dataclass(frozen=True)
class MpcConfig(ControllerConfig):
    """Settings of the paper's receding-horizon controller. Solver `gradient`: L-BFGS-B with the exact gradient."""

    kind: str = setting("mpc", "controller")
    horizon: int = setting(
        5,
        "prediction horizon (paper: 5 periods of 1 min); only the first move is applied",
        "control periods",
        within=(1, 60),
    )
    penalty: float = setting(
        100.0, "cost of a move outside [0, max_pump_rate] (paper)", above=0.0, note="else the range has no effect"
    )
    solver: str = setting("pso", "optimiser; the paper uses pso", choices=("pso", "gradient"))
    swarm: SwarmConfig = part(SwarmConfig, "particle swarm; the paper states no values")
    seed: int = setting(0, "random seed of the swarms", at_least=0)


@dataclass(frozen=True, eq=False)
class Problem:
    """Problem: minimise over v  sum_{k=0}^{H-1} [(x_k - r)^2 + penalty * (v_k outside [0, 1])] + (x_H - r)^2.

    The moves v_k = u_k / u_max are fractions of the largest pump rate. x_{k+1} = f(u_k) x_k is the model's step with
    the integrator and sub-steps of `envs.task.step_factors`. The constant (x_0 - r)^2 is left out.

    start: measured OD x_0, shape (R,). setpoint: r, shape (R,). model: mu, tau, period, integrator.
    """

    start: Array
    setpoint: Array
    model: EnvConfig
    penalty: float

    def factors(self, v: Array) -> tuple[Array, Array]:
        """Return f(u_max v) and df/dv, each with the shape of v."""
        m = self.model
        h = m.control_min / m.substeps
        slope = -h * m.max_pump_rate / m.tau
        z = h * m.mu + slope * v
        if m.integrator == "euler":
            one, d_one = 1.0 + z, np.ones_like(z)
        else:  # rk4: the exponential's first terms
            d_one = 1.0 + z * (1.0 + z * (0.5 + z / 6.0))
            one = d_one + z**4 / 24.0
        power = _power(one, m.substeps - 1)
        return one * power, m.substeps * slope * power * d_one

    def cost(self, v: Array) -> Array:
        """Return the cost of moves v, shape (R, P, H) -> (R, P)."""
        miss = self._reached(self.factors(v)[0]) - self.setpoint[:, None, None]
        outside = (v < 0.0) | (v > 1.0)
        return np.asarray(np.einsum("rph,rph->rp", miss, miss) + self.penalty * outside.sum(axis=-1))

    def _reached(self, factors: Array) -> Array:
        """Return x_1 .. x_H, shape (R, P, H)."""
        reached = np.empty_like(factors)
        x = self.start[:, None]
        for k in range(factors.shape[-1]):
            x = x * factors[..., k]
            reached[..., k] = x
        return reached

    def predict(self, v: Array) -> Array:
        """Return x_1 .. x_H for moves v, shape (R, H) -> (R, H)."""
        return self._reached(self.factors(v[:, None])[0])[:, 0]

    def by_gradient(self, start: Array) -> Array:
        """Return the best moves, by L-BFGS-B in the box [0, 1], row by row. Args: start: first guess, (R, H)."""
        from scipy.optimize import minimize

        moves = np.empty_like(start)
        for row in range(start.shape[0]):
            one = Problem(self.start[row : row + 1], self.setpoint[row : row + 1], self.model, self.penalty)
            guess = np.clip(start[row], 0.0, 1.0)
            # The cost is a squared OD error, far below 1; it is scaled up for the solver's convergence tests.
            found = minimize(
                one.value_and_gradient, guess, args=(1e4,), jac=True, method="L-BFGS-B",
                bounds=[(0.0, 1.0)] * guess.size, options={"ftol": 1e-14, "gtol": 1e-9, "maxiter": 200},
            )  # fmt: skip
            moves[row] = found.x
        return moves

    def value_and_gradient(self, v: Array, scale: float = 1.0) -> tuple[float, Array]:
        """Return the cost inside the box and its exact gradient, both times `scale`; for a problem with one row."""
        # dx_j/dv_k = x_j f'(v_k)/f(v_k) for j >= k, so the gradient is a reversed cumulative sum
        f, slope = self.factors(v)
        x = self.start[0] * np.cumprod(f)
        miss = x - self.setpoint[0]
        tail = np.cumsum((2.0 * miss * x)[::-1])[::-1]
        return scale * float(miss @ miss), scale * tail * slope / f


def _power(base: Array, exponent: int) -> Array:
    """Return base**exponent by repeated squaring, which is several times faster than `**`."""
    result = np.ones_like(base)
    while exponent:
        if exponent & 1:
            result = result * base
        base = base * base
        exponent >>= 1
    return result


def minimise(
    cost: Callable[[Array], Array],
    low: float,
    high: float,
    start: Array,
    rngs: Sequence[np.random.Generator],
    config: SwarmConfig,
) -> tuple[Array, Array]:
    """Minimise R cost functions of H variables by R particle swarms with a global best (Kennedy & Eberhart 1995).

      v <- w v + c r1 (own best - x) + c r2 (swarm's best - x),   x <- x + v,   r1, r2 uniform per dimension

    Particles start at rest in the box [low, high]. They may leave the box; the cost must penalise that.

    Args:
      cost: function from positions (R, P, H) to costs (R, P); row r is the cost function of swarm r.
      low, high: limits of the box in every variable.
      start: first position of one particle per swarm, (R, H), e.g. the last solution shifted by a step.
      rngs: one generator per swarm, so that swarms are independent.
    Returns: best positions (R, H) and their costs (R,).
    """
    swarms, dimensions = start.shape
    particles = config.particles
    pulls = np.empty((config.iterations, 2, swarms, particles, dimensions))
    x = np.empty((swarms, particles, dimensions))
    for r, rng in enumerate(rngs):
        x[r] = rng.uniform(low, high, (particles, dimensions))
        pulls[:, :, r] = rng.random((config.iterations, 2, particles, dimensions))
    pulls *= ATTRACTION
    x[:, 0] = start
    v = np.zeros_like(x)
    own, own_cost = x.copy(), cost(x)
    swarm = np.arange(swarms)
    for own_pull, best_pull in pulls:
        best = own[swarm, own_cost.argmin(axis=1)][:, None]
        v *= INERTIA
        v += own_pull * (own - x)
        v += best_pull * (best - x)
        x += v
        value = cost(x)
        better = value < own_cost
        np.copyto(own, x, where=better[..., None])
        np.copyto(own_cost, value, where=better)
    winner = own_cost.argmin(axis=1)
    return own[swarm, winner], own_cost[swarm, winner]


class Mpc:
    """Model predictive controller: at each sample it minimises `Problem` over the horizon and applies the first move.

    The solution, shifted by one period, is the first guess of the next period (for the swarm, of one particle).

    Args: config: horizon, penalty, solver. model: mu, tau, control period, integrator and largest pump rate.
    """

    remembers = ("moves", "predicted", "rate", "rngs")  # with the swarms' random streams

    def __init__(self, config: MpcConfig, model: EnvConfig) -> None:
        self.config, self.model = config, model
        self.reset(1)

    def reset(self, n: int) -> None:
        """Reset the state and the random streams, one per reactor; stream i is the same for every n."""
        steady = np.clip(self.model.mu * self.model.tau / self.model.max_pump_rate, 0.0, 1.0)
        self._moves = np.full((n, self.config.horizon), steady)
        self._predicted = np.full((n, self.config.horizon), np.nan)
        self._rngs = np.random.default_rng(self.config.seed).spawn(n)
        self._rate = np.zeros(n)

    def act(self, od: Array, setpoint: Array, minute: Array, rows: Mask) -> Array:
        idx = np.flatnonzero(usable(od, rows))
        if idx.size:
            problem = Problem(np.maximum(od[idx], LOWEST_OD), setpoint[idx], self.model, self.config.penalty)
            start = np.concatenate([self._moves[idx, 1:], self._moves[idx, -1:]], axis=1)
            if self.config.solver == "pso":
                moves, _ = minimise(problem.cost, 0.0, 1.0, start, [self._rngs[i] for i in idx], self.config.swarm)
            else:
                moves = problem.by_gradient(start)
            # For an OD error above 10, as of a failed reading (12 to 14), the error costs more than the penalty of 100.
            moves = np.clip(moves, 0.0, 1.0)
            self._moves[idx], self._predicted[idx] = moves, problem.predict(moves)
            self._rate[idx] = moves[:, 0] * self.model.max_pump_rate
        return self._rate.copy()

    def explain(self) -> dict[str, Array]:
        """Return the plan of the last decision: pump rates in mL/s and predicted OD, (N, horizon) each."""
        return {"planned_rate": self._moves * self.model.max_pump_rate, "predicted_od": self._predicted.copy()}
