"""What is to be proven of a policy: its closed loops, what may disturb them, and how much is allowed."""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from conf.schema import build
from dqn.policy import RELATIVE, Policy
from envs.task import EnvConfig
from experiments.certification.bounds import EstimateBounds
from experiments.certification.config import CertifyConfig
from experiments.certification.network import Array
from experiments.certification.od_loop import OdCase, OdLoop
from experiments.certification.share_loop import ShareCase, ShareLoop

__all__ = ["CertificationError", "Question", "actions", "model_of", "question"]

BEYOND = 1e-6  # the plane that is cut reaches this much beyond what is asked
MODEL = ("mu", "tau", "control_min", "max_pump_rate", "setpoints")


class CertificationError(Exception):
    """A policy that no certificate can be made of; the message says why and what to do."""


@dataclass(frozen=True, eq=False)
class Question:
    """What is to be proven of a policy.

    loop: its closed loops. cases: what may disturb them; the first one is the nominal.
    judged: case -> largest excess of the half-width over that of the law.
    widths: (case, lowest, highest strip, largest half-width). box: of the plane that the policy is shown.
    unit: of half-widths. what: a strip is one of. setpoints: lowest and highest, OD.
    bounds: of an estimator, where the policy needs one.
    """

    loop: Any
    cases: tuple[Any, ...]
    judged: dict[str, float]
    widths: tuple[tuple[str, float, float, float], ...]
    box: tuple[tuple[float, float], tuple[float, float]]
    unit: str
    what: str
    setpoints: tuple[float, float]
    bounds: EstimateBounds | None = None


def actions(policy: Policy) -> Array:
    """The action grid, rising from 0. Raises: CertificationError for another one."""
    grid = np.asarray(policy.actions, dtype=np.float64)
    if grid[0] != 0.0 or not (np.diff(grid) > 0.0).all():
        raise CertificationError("its actions do not rise from 0; train with the action grid of env")
    return grid


def model_of(policy: Policy, config: CertifyConfig) -> EnvConfig:
    """The nominal model: the one that is asked for, else the one the policy was trained on.

    A policy of (error, growth share) serves any; that of the bench turns OD into e where bounds depend on the OD.
    Raises: CertificationError where the policy does not say it, or has another control period.
    """
    said = policy.metadata.get("model", {})
    model = config.env
    if policy.observation == RELATIVE:
        bench = config.bench
        own = EnvConfig(tau=bench.tau, control_min=bench.control_min, max_pump_rate=bench.max_rate)
        return model or own
    if model is None:
        if not {"mu", "tau"} <= set(said):
            raise CertificationError("it does not say which model it was trained on; give env.mu=MU env.tau=TAU")
        model = build(EnvConfig(), {k: said[k] for k in MODEL if k in said})
    period = float(policy.metadata.get("control_min", model.control_min))
    if abs(period - model.control_min) > 1e-9:
        raise CertificationError(
            f"it acts every {period:g} min, env.control_min = {model.control_min:g}; give env.control_min={period:g}"
        )
    return model


def _strips(low: float, high: float, width: float) -> tuple[Array, Array]:
    edges = np.linspace(low, high, max(1, int(np.ceil((high - low) / width - 1e-9))) + 1)
    return edges[:-1], edges[1:]


def _of_od(policy: Policy, config: CertifyConfig) -> Question:
    """(OD, setpoint) in, a pump rate out."""
    model, limits = model_of(policy, config), config.limits
    trained = policy.metadata.get("model", {}).get("setpoints", model.setpoints)
    low, high = config.setpoints or (min(trained), max(trained))
    if not low < high:
        raise CertificationError(f"setpoints {low:g} to {high:g}: allowed low < high; give setpoints=[LOW,HIGH]")
    if not (np.isneginf(policy.low) & np.isposinf(policy.high)).all():
        raise CertificationError("it clips OD or setpoint, which is not proven; export it without limits")
    strips = _strips(low, high, config.strip)
    loop = OdLoop(model.mu, model.tau, model.control_min, actions(policy), config.start_od, *strips)
    cases = (
        OdCase("nominal", 0.0, 0.0),
        OdCase("noise", 0.0, config.noise),
        OdCase("uncertain", config.uncertainty, 0.0),
        OdCase("noise and uncertain", config.uncertainty, config.noise),
    )
    judged = {"nominal": limits.excess, "noise and uncertain": limits.excess_uncertain}
    highest = config.start_od[1] * float((strips[1] / strips[0]).max())  # of any setpoint that starts at a strip's d
    box = ((-config.noise - BEYOND, highest + config.noise + BEYOND), (low, high))
    return Question(loop, cases, judged, (), box, "OD", "setpoint", (low, high))


def _of_share(policy: Policy, config: CertifyConfig) -> Question:
    """(error, growth share) in, a share of the largest dose out."""
    model, limits, (low, high) = model_of(policy, config), config.limits, config.growth_shares
    clip = (np.asarray(policy.low, dtype=np.float64), np.asarray(policy.high, dtype=np.float64))
    if not clip[0][1] - BEYOND <= low < high <= clip[1][1] + BEYOND:
        raise CertificationError(
            f"growth_shares = [{low:g}, {high:g}]: allowed {clip[0][1]:g} to {clip[1][1]:g}, which it was trained for"
        )
    span = model.max_pump_rate * model.control_min / model.tau
    lowest, highest = config.setpoints or (min(model.setpoints), max(model.setpoints))
    start = (float(np.log(config.start_od[0] / highest)) / span, float(np.log(config.start_od[1] / lowest)) / span)
    off = EstimateBounds(
        span, config.error, config.error_od, config.error_share, config.error_gain, (low, high), (lowest, highest)
    )
    watched = replace(off, od=config.watched_od, growth_share=config.watched_share)
    middle = float(np.round((lowest + highest) / 2.0, 3))
    cases = (
        ShareCase("nominal", replace(off, error=0.0, od=0.0, growth_share=0.0, gain=0.0)),
        ShareCase("errors", off),
        *(ShareCase(f"errors at setpoint {r:g}", off, r) for r in (lowest, middle, highest)),
        *(ShareCase(f"watched errors at setpoint {r:g}", watched, r) for r in (lowest, middle, highest)),
    )
    inner, outer = limits.inner_shares, (low, high)
    widths = (
        ("nominal", *outer, limits.half_width_outer),
        ("errors", *inner, limits.half_width),
        ("errors", *outer, limits.half_width_outer),
        (f"watched errors at setpoint {middle:g}", *outer, limits.half_width_watched),
    )
    loop = ShareLoop(actions(policy), start, *_strips(low, high, config.strip), clip)
    seen = loop.seen(cases[-1])
    box = ((float(clip[0][0]), float(clip[1][0])), (float(seen[0].min()), float(seen[1].max())))
    return Question(loop, cases, {}, widths, box, "periods of full pump", "growth share", (lowest, highest), watched)


def question(policy: Policy, config: CertifyConfig) -> Question:
    """What is to be proven of this kind of policy. Raises: CertificationError where it cannot be asked."""
    return _of_share(policy, config) if policy.observation == RELATIVE else _of_od(policy, config)
