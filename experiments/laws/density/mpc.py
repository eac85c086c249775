"""Model predictive control of OD on the training model, solved by particle swarm or by gradient."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from conf.schema import check, part, require, setting
from envs.task import EnvConfig
from experiments.laws.base import Array, ControllerConfig, Mask, usable

LOWEST_OD = 1e-3  # a lower reading counts as this: the model cannot grow from zero


@dataclass(frozen=True)
class SwarmConfig:
    """Settings of the particle swarms.

    Inertia and attraction are Clerc and Kennedy's constriction coefficients in inertia form. 40 particles and 120
    iterations end within 1 % of the optimum from every one of 400 random cold starts.

    Raises: ValueError also where particles would not converge: c1 + c2 = 2 attraction must stay below
      24 (1 - w^2) / (7 - 5 w), the bound of order-2 stability (Poli 2009; in the review of Bonyadi & Michalewicz 2017,
      Evolutionary Computation 25:1, section 3).
    """

    particles: int = setting(40, "particles per swarm", within=(2, 10_000))
    iterations: int = setting(120, "iterations per swarm", within=(1, 10_000))
    inertia: float = setting(0.7298, "weight of a particle's velocity", at_least=0.0, below=1.0)
    attraction: float = setting(1.49618, "weight of the pull to a particle's own best and to the swarm's best position")

    def __post_init__(self) -> None:
        check(self, "controller.swarm")
        bound = 12.0 * (1.0 - self.inertia**2) / (7.0 - 5.0 * self.inertia)
        require(
            0.0 < self.attraction < bound,
            "controller.swarm.attraction",
            self.attraction,
            f"0 < attraction < {bound:.4f} for inertia = {self.inertia}, beyond which the swarm does not contract; "
            "lower one of them",
        )


@dataclass(frozen=True)
class MpcConfig(ControllerConfig):
    """The paper's receding-horizon controller; `gradient` is L-BFGS-B with the exact gradient, as a cross-check."""

    kind: str = setting("mpc", "controller")
    horizon: int = setting(
        5,
        "prediction horizon in periods of 1 min (paper); only the first move is applied (paper: control horizon 1 min)",
        "control periods",
        within=(1, 60),
    )
    penalty: float = setting(
        100.0, "cost of a move outside [0, max_pump_rate] (paper)", above=0.0, note="or the pump's range costs nothing"
    )
    solver: str = setting("pso", "optimiser; pso: the paper's", choices=("pso", "gradient"))
    swarm: SwarmConfig = part(SwarmConfig, "particle swarm; the paper states no numbers")
    seed: int = setting(0, "random seed of the swarms", at_least=0)


@dataclass(frozen=True, eq=False)
class Problem:
    """min over v of  sum_{k=0}^{H-1} [(x_k - r)^2 + penalty * (v_k outside [0, 1])] + (x_H - r)^2.

    v_k = u_k / u_max are the moves as fractions of the largest pump rate, x_{k+1} = f(u_k) x_k the model's step with
    the integrator and sub-steps of `envs.task.step_factors`. (x_0 - r)^2 is the same for all v and left out.

    start: measured OD, shape (R,); setpoint: r, shape (R,); model: mu, tau, period, integrator; penalty: see above.
    """

    start: Array
    setpoint: Array
    model: EnvConfig
    penalty: float

    def factors(self, v: Array) -> tuple[Array, Array]:
        """Return f(u_max v) and df/dv, shape of v; in closed form, for ten thousand calls per decision."""
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
        """Optimise moves by L-BFGS-B in the box [0, 1] from `start`, row by row, shape (R, H)."""
        from scipy.optimize import minimize

        moves = np.empty_like(start)
        for row in range(start.shape[0]):
            one = Problem(self.start[row : row + 1], self.setpoint[row : row + 1], self.model, self.penalty)
            guess = np.clip(start[row], 0.0, 1.0)
            # The cost is of the order of the smallest OD error that matters, squared; scaled up for the solver's tests
            found = minimize(
                one.value_and_gradient, guess, args=(1e4,), jac=True, method="L-BFGS-B",
                bounds=[(0.0, 1.0)] * guess.size, options={"ftol": 1e-14, "gtol": 1e-9, "maxiter": 200},
            )  # fmt: skip
            moves[row] = found.x
        return moves

    def value_and_gradient(self, v: Array, scale: float = 1.0) -> tuple[float, Array]:
        """Return the cost inside the box and its exact gradient for the single row of a problem, both times `scale`.

        dx_j/dv_k = x_j f'(v_k)/f(v_k) for j >= k, so the gradient is a reversed cumulative sum.
        """
        f, slope = self.factors(v)
        x = self.start[0] * np.cumprod(f)
        miss = x - self.setpoint[0]
        tail = np.cumsum((2.0 * miss * x)[::-1])[::-1]
        return scale * float(miss @ miss), scale * tail * slope / f


def _power(base: Array, exponent: int) -> Array:
    """Return base**exponent by repeated squaring: several times faster than a general power."""
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
    """Minimise R costs over R^H by R particle swarms with a global best (Kennedy & Eberhart 1995).

      v <- w v + c r1 (own best - x) + c r2 (swarm's best - x),   x <- x + v,   r1, r2 uniform per dimension

    Particles start at rest in [low, high] and may leave it; the cost must penalise that.

    Args:
      cost: positions (R, P, H) -> costs (R, P); swarm r's costs may depend on r only.
      low, high: box the particles are scattered over.
      start: one place per swarm where a particle begins, shape (R, H), e.g. the last solution shifted by a step.
      rngs: one generator per swarm, so that swarms are independent.
    Returns: best positions (R, H) and their costs (R,). Raises: nothing; `SwarmConfig` has checked the search.
    """
    swarms, dimensions = start.shape
    particles = config.particles
    pulls = np.empty((config.iterations, 2, swarms, particles, dimensions))
    x = np.empty((swarms, particles, dimensions))
    for r, rng in enumerate(rngs):
        x[r] = rng.uniform(low, high, (particles, dimensions))
        pulls[:, :, r] = rng.random((config.iterations, 2, particles, dimensions))
    pulls *= config.attraction
    x[:, 0] = start
    v = np.zeros_like(x)
    own, own_cost = x.copy(), cost(x)
    swarm = np.arange(swarms)
    for own_pull, best_pull in pulls:
        best = own[swarm, own_cost.argmin(axis=1)][:, None]
        v *= config.inertia
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
    """Every minute: measure, minimise `Problem` over the horizon, apply the first move.

    Each solution, shifted by one period, is the start of one particle (or of the gradient) in the next period.

    Args: config: horizon, penalty, solver; model: mu, tau, control period, integrator and the largest pump rate.
    """

    remembers = ("moves", "predicted", "rate", "rngs")  # with the swarms' random streams

    def __init__(self, config: MpcConfig, model: EnvConfig) -> None:
        self.config, self.model = config, model
        self.reset(1)

    def reset(self, n: int) -> None:
        """See `Controller.reset`. The swarms' random streams start anew: one per reactor, the same for every n."""
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
            # A penalty of 100 is too small if the OD error itself costs as much: at the 12 to 14 of a failed read.
            moves = np.clip(moves, 0.0, 1.0)
            self._moves[idx], self._predicted[idx] = moves, problem.predict(moves)
            self._rate[idx] = moves[:, 0] * self.model.max_pump_rate
        return self._rate.copy()

    def explain(self) -> dict[str, Array]:
        """Explain the last decision by its plan: pump rates in mL/s and predicted OD, both (N, horizon)."""
        return {"planned_rate": self._moves * self.model.max_pump_rate, "predicted_od": self._predicted.copy()}
