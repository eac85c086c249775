"""Question of a certificate: closed loops to prove, their disturbances, limits."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from conf.schema import build
from dqn.policy import ABSOLUTE, RELATIVE, Policy
from envs.task import EnvConfig
from experiments.certification.bounds import EstimateBounds
from experiments.certification.config import LIMITS, CertifyConfig, Limits
from experiments.certification.loops import OdCase, OdLoop, ShareCase, ShareLoop
from experiments.certification.polygons import Array

STRIP = 0.005  # largest width of the strips of setpoints, OD, or of growth shares
BEYOND = 1e-6  # margin around the required range
MODEL = ("mu", "tau", "control_min", "max_pump_rate", "setpoints")


class CertificationError(Exception):
    """Error of a policy that cannot be certified; the message has reason and remedy."""


@dataclass(frozen=True, eq=False)
class Question:
    """Properties to prove of a policy.

    loop: closed loops of the policy. cases: possible disturbances; the first case is the nominal.
    margins: case -> limit of the excess, the half-width of the band beyond that of the one-line controller. judged:
    case -> safety limit of the excess; cases without an entry have no limit of the half-width.
    late: case -> periods after the one-line controller within which the state must be in the half-width of that
    controller plus the margin; cases without an entry are compared with the pump's own time. box: range of the inputs
    of the policy. reached: fraction of the band that trajectories must reach, with exact estimates and with errors;
    None for a policy of the OD, whose band may contain gaps between several resting places.
    unit: unit of half-widths. what: second coordinate, of which strips are ranges. setpoints: lowest and highest, OD.
    drawn: cases in the figure. limits: of the requirements. bounds: on the errors of the estimator, None without one.
    median: safety limit of the median excess over the strips of the nominal case; None: no limit.
    """

    loop: Any
    cases: tuple[Any, ...]
    margins: dict[str, float]
    judged: dict[str, float]
    late: dict[str, float]
    box: tuple[tuple[float, float], tuple[float, float]]
    reached: tuple[float, float] | None
    unit: str
    what: str
    setpoints: tuple[float, float]
    drawn: tuple[str, ...]
    limits: Limits
    bounds: EstimateBounds | None = None
    median: float | None = None


def actions(policy: Policy) -> Array:
    """Return the action grid. Raises: CertificationError if it does not rise from 0."""
    grid = np.asarray(policy.actions, dtype=np.float64)
    if grid[0] != 0.0 or not (np.diff(grid) > 0.0).all():
        raise CertificationError("its actions do not rise from 0; train with the action grid of env")
    return grid


def model_of(policy: Policy, config: CertifyConfig) -> EnvConfig:
    """Return the nominal model: `env` of the config, else the model of the policy's training.

    A policy of (error, growth share) fits every model; by default it gets the bench's, which converts the bound on the
    OD's error to one on e.
    Raises: CertificationError if the policy has no model or another control period.
    """
    if policy.observation not in (ABSOLUTE, RELATIVE):
        seen = ", ".join(policy.observation)
        raise CertificationError(f"it sees ({seen}); only density policies can be certified")
    said = policy.metadata.get("model", {})
    model = config.env
    if policy.observation == RELATIVE:
        bench = config.bench
        return model or EnvConfig(tau=bench.tau, control_min=bench.control_min, max_pump_rate=bench.max_rate)
    if model is None:
        if not {"mu", "tau"} <= set(said):
            raise CertificationError("its file has no model of the training; set env.mu=MU env.tau=TAU")
        model = build(EnvConfig(), {k: said[k] for k in MODEL if k in said})
    period = float(policy.metadata.get("control_min", model.control_min))
    if abs(period - model.control_min) > 1e-9:
        raise CertificationError(
            f"it acts every {period:g} min, but env.control_min = {model.control_min:g}; set env.control_min={period:g}"
        )
    return model


def full_pump(model: EnvConfig) -> float:
    """Return B, the decrease of ln x in one period at full pump rate."""
    return model.max_pump_rate * model.control_min / model.tau


def _strips(low: float, high: float) -> tuple[Array, Array]:
    edges = np.linspace(low, high, max(1, int(np.ceil((high - low) / STRIP - 1e-9))) + 1)
    return edges[:-1], edges[1:]


def _of_od(policy: Policy, config: CertifyConfig) -> Question:
    model, limits = model_of(policy, config), LIMITS
    trained = policy.metadata.get("model", {}).get("setpoints", model.setpoints)
    low, high = config.setpoints or (min(trained), max(trained))
    if not low < high:
        raise CertificationError(f"setpoints {low:g} to {high:g}: allowed low < high; set setpoints=[LOW,HIGH]")
    if not (np.isneginf(policy.low) & np.isposinf(policy.high)).all():
        raise CertificationError("it clips OD or setpoint, which the proof does not cover; export it without limits")
    strips = _strips(low, high)
    loop = OdLoop(model.mu, model.tau, model.control_min, actions(policy), config.start_od, *strips)
    cases = (
        OdCase("nominal", 0.0, 0.0),
        OdCase("noise", 0.0, config.noise),
        OdCase("uncertain", config.uncertainty, 0.0),
        OdCase("noise and uncertain", config.uncertainty, config.noise),
    )
    margins = {case.name: limits.excess_uncertain for case in cases} | {"nominal": limits.excess}
    judged = {"nominal": limits.safe_excess, "noise and uncertain": limits.safe_excess_uncertain}
    highest = config.start_od[1] * float((strips[1] / strips[0]).max())  # highest start over a strip
    box = ((-config.noise - BEYOND, highest + config.noise + BEYOND), (low, high))
    return Question(
        loop, cases, margins, judged, {}, box, None, "OD", "setpoint", (low, high), tuple(margins), limits,
        median=limits.safe_excess_median,
    )  # fmt: skip


def _of_share(policy: Policy, config: CertifyConfig, setpoints: Sequence[float] | None) -> Question:
    """Build the question of a policy that sees (error, growth share)."""
    model, limits, (low, high) = model_of(policy, config), LIMITS, config.growth_shares
    clip = (np.asarray(policy.low, dtype=np.float64), np.asarray(policy.high, dtype=np.float64))
    if not clip[0][1] - BEYOND <= low < high <= clip[1][1] + BEYOND:
        raise CertificationError(
            f"growth_shares = [{low:g}, {high:g}]: allowed {clip[0][1]:g} to {clip[1][1]:g}, the range of the training"
        )
    full = full_pump(model)
    lowest, highest = config.setpoints or (min(model.setpoints), max(model.setpoints))
    middle = float(np.round((lowest + highest) / 2.0, 3))
    at_setpoints = sorted({lowest, middle, highest} if setpoints is None else set(setpoints))
    off = EstimateBounds(full, config.error, config.error_od, config.error_share, 0.0, (low, high), (lowest, highest))
    watched = replace(off, od=limits.watched_od, growth_share=limits.watched_share)
    cases = [ShareCase("nominal", replace(off, error=0.0, od=0.0, growth_share=0.0)), ShareCase("errors", off)]
    for b in sorted({round(b, 9) for b in (full, *(() if config.quick else config.full_pumps))}):
        own = replace(off, full_pump=b)
        for r in at_setpoints:
            at = f"at setpoint {r:g}, B = {b:.3g}"
            uncertain = replace(own, gain=config.error_gain)
            spread = ShareCase(f"spread doses {at}", uncertain, r)
            slow = ShareCase(f"slow gain error {at}", uncertain, r, slow=True)
            cases += [ShareCase(f"errors {at}", own, r)] if config.quick or setpoints is not None or r == middle else []
            cases += [] if config.quick else [spread, slow]
    for r in [middle] if setpoints is None else at_setpoints:
        cases.append(ShareCase(f"watched errors at setpoint {r:g}", watched, r))
    drawn = [c.name for c in cases if c.setpoint in (None, middle) and round(c.bounds.full_pump - full, 8) == 0.0]
    late = {case.name: limits.late_slow if case.slow else limits.late for case in cases}
    margins = {case.name: limits.excess_share for case in cases} | {"nominal": limits.excess_nominal}
    judged = dict.fromkeys(margins, limits.safe_excess_share)
    loop = ShareLoop(actions(policy), config.start_od, (lowest, highest), *_strips(low, high), clip)
    seen = loop.seen(cases[-1])
    box = ((float(clip[0][0]), float(clip[1][0])), (float(seen[0].min()), float(seen[1].max())))
    reached = limits.reached_nominal, limits.reached
    what = "periods of full pump", "growth share"
    return Question(
        loop, tuple(cases), margins, judged, late, box, reached, *what, (lowest, highest), tuple(drawn), limits, watched
    )


def question(policy: Policy, config: CertifyConfig, setpoints: Sequence[float] | None = None) -> Question:
    """Build the question for a policy. Raises: CertificationError if a policy of this kind cannot be certified.

    Args: setpoints: setpoints of the cases whose errors depend on the OD; None: lowest, middle and highest.
    """
    return _of_share(policy, config, setpoints) if policy.observation == RELATIVE else _of_od(policy, config)
