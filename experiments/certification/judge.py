"""Certification of a policy: its proven properties are compared with limits."""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from dqn.policy import RELATIVE, Policy
from experiments.certification.config import CertifyConfig
from experiments.certification.intervals import Mask, drops, points_in_strips
from experiments.certification.loops import Loop
from experiments.certification.polygons import Array, Network, Regions, contradictions, partition
from experiments.certification.question import Question, actions, question
from experiments.certification.verdict import Proof, attacked, dose_below, prove

KINDS = SAFETY, PERFORMANCE = "safety", "performance"
GRID = (256, 128)  # boxes of the cross-check
ENOUGH = 100  # trajectories per strip from which on they must reach the ends of a band


@dataclass(frozen=True)
class Requirement:
    """Requirement: the worst value that was found must not exceed the limit.

    name: "CASE: TITLE". where: strip with the worst value. kind: one of `KINDS`. A device refuses a policy that fails a
    safety requirement; it only reports a failed performance requirement."""

    name: str
    value: float
    limit: float
    where: str = ""
    kind: str = SAFETY

    @property
    def holds(self) -> bool:
        """Whether the value is within the limit; False for nan."""
        return self.value <= self.limit

    @property
    def title(self) -> str:
        """Name of the requirement without the disturbance before its colon."""
        return self.name.split(": ", 1)[-1]

    def __str__(self) -> str:
        value = f"{self.value:.4g}" if np.isfinite(self.value) else "no finite value"
        return f"{self.name}: {value}, allowed {self.limit:g}" + (f" ({self.where})" if self.where else "")


def worst(checks: Iterable[Requirement]) -> list[Requirement]:
    """Return for each title the requirement with the largest value relative to its limit; nan counts as largest."""
    found: dict[str, Requirement] = {}
    for check in checks:
        if check.title not in found or _beyond(check) > _beyond(found[check.title]):
            found[check.title] = check
    return list(found.values())


def _beyond(check: Requirement) -> float:
    over = (check.value - check.limit) / max(check.limit, 1e-9)
    return float("inf") if np.isnan(over) else over


@dataclass(frozen=True, eq=False)
class Certificate:
    """Result of a certification.

    question: what was to be proven. proofs: one per case. checks: all requirements. levels: three actions; doses:
    largest distance below the setpoint at which each of them may be chosen, periods of growth, (3, S). drops: points
    where a higher reading gets a smaller dose, see `intervals.drops`. regions: exact polygons of the policy. quick:
    whether errors of the gain were omitted."""

    question: Question
    proofs: tuple[Proof, ...]
    checks: tuple[Requirement, ...]
    levels: tuple[int, ...]
    doses: Array
    drops: list[tuple[float, float, int, int]]
    regions: Regions
    quick: bool

    def failed(self, kind: str) -> list[Requirement]:
        return [check for check in self.checks if check.kind == kind and not check.holds]

    @property
    def safe(self) -> bool:
        return not self.failed(SAFETY)

    @property
    def passed(self) -> bool:
        return all(check.holds for check in self.checks)

    def cannot_hold(self) -> list[str]:
        """List the ranges of setpoints or growth shares that no policy can hold, as pump or growth is too weak."""
        found: dict[tuple[float, float], list[str]] = {}
        for proof in self.proofs:
            for stretch in _runs(self.question.loop, ~proof.holdable):
                found.setdefault(stretch, []).append(proof.case.name)
        others = {1: "", 2: " and 1 other"}
        return [
            f"{names[0]}{others.get(len(names), f' and {len(names) - 1} others')}: from {self.question.what} "
            f"{low:.4g} to {high:.4g} no pump rate holds the culture"
            for (low, high), names in found.items()
        ]

    def lines(self) -> list[str]:
        """List every failed requirement and, for each title, the fulfilled case that is closest to its limit."""
        titles: dict[str, list[Requirement]] = {}
        for check in self.checks:
            titles.setdefault(check.title, []).append(check)
        lines = []
        for checks in titles.values():
            lines += [f"{'FAIL' if check.kind == SAFETY else 'short'}  {check}" for check in checks if not check.holds]
            met = [check for check in checks if check.holds]
            if met:
                closest = max(met, key=lambda check: check.value - check.limit)
                others = len(met) - 1
                lines.append(f"pass  {closest}" + (f"; and {others} more" if others else ""))
        return lines


def _runs(loop: Loop, where: np.ndarray[Any, Any]) -> Iterator[tuple[float, float]]:
    edges = np.flatnonzero(np.diff(np.concatenate([[False], where, [False]])))
    for first, last in edges.reshape(-1, 2):
        yield float(loop.low[first]), float(loop.high[last - 1])


def certify(policy: Policy, config: CertifyConfig) -> Certificate:
    """Certify a policy. Raises: CertificationError if a policy of this kind cannot be certified."""
    asked, network, levels = question(policy, config), Network.of(policy), (1, 2, _half(policy))
    exact, wider = partition(network, asked.box)
    proofs, doses = _proven(asked, wider, levels)
    checks = (
        Requirement("polygons that the bounds of boxes contradict", contradictions(network, exact, GRID), 0),
        *_required(asked, proofs, doses[-1]),
        *_attacks(policy, asked, proofs, config.trajectories),
    )
    return Certificate(asked, proofs, checks, levels, doses, drops(exact), exact, config.quick)


def recheck(policy: Policy, config: CertifyConfig, setpoints: Sequence[float]) -> list[Requirement]:
    """List the requirements that a policy fails at single setpoints. Simulated trajectories are skipped."""
    asked = question(policy, config, setpoints)
    if policy.observation != RELATIVE:
        lines = np.clip(np.asarray(setpoints, dtype=np.float64), *asked.setpoints)
        asked = replace(asked, loop=asked.loop.at(lines), median=None)
    proofs, doses = _proven(asked, partition(Network.of(policy), asked.box)[1], (_half(policy),))
    return [check for check in _required(asked, proofs, doses[0]) if not check.holds]


def _proven(asked: Question, wider: Regions, levels: Sequence[int]) -> tuple[tuple[Proof, ...], Array]:
    """Prove every case; also return, in the nominal case, `dose_below` of the actions `levels`, (L, S)."""
    met = [points_in_strips(wider, *asked.loop.seen(case)) for case in asked.cases]
    proofs = tuple(
        prove(asked.loop, points, wider.action, case, asked.margins[case.name])
        for case, points in zip(asked.cases, met, strict=True)
    )
    return proofs, dose_below(asked.loop, met[0], wider.action, asked.cases[0], levels)


def _half(policy: Policy) -> int:
    """Return the index of the smallest action with at least half of the largest dose."""
    grid = actions(policy)
    return int(np.argmax(grid >= (0.5 - 1e-9) * grid[-1]))


def _attacks(policy: Policy, asked: Question, proofs: Sequence[Proof], trajectories: int) -> Iterator[Requirement]:
    """Yield two requirements on worst-case trajectories: none leaves its band, and together they fill the band."""
    once = {asked.loop.key(proof.case): proof for proof in reversed(proofs)} if trajectories else {}
    proofs = [proof for proof in proofs if proof in once.values()]
    found = [attacked(policy, asked.loop, proof, trajectories) for proof in proofs]
    if found:
        yield Requirement("adversarial trajectories that left the band", sum(left for left, _ in found), 0)
    if asked.reached is None or trajectories < ENOUGH * asked.loop.low.size:
        return
    for least, named, some in zip(asked.reached, ("exact", "errors"), (slice(1), slice(1, None)), strict=True):
        worst = [
            Requirement(proof.case.name, float(np.nanmax(1.0 - share)), 0.0, _strip(asked, int(np.nanargmin(share))))
            for proof, (_, share) in list(zip(proofs, found, strict=False))[some]
            if np.isfinite(share).any()
        ]
        if worst:
            most = max(worst, key=lambda check: check.value)
            title = f"{named}: share of the band that no attack reaches"
            yield Requirement(title, most.value, round(1.0 - least, 9), f"{most.name}, {most.where}", PERFORMANCE)


def _required(asked: Question, proofs: Sequence[Proof], dose: Array) -> Iterator[Requirement]:
    """Yield every requirement of the proofs with its worst strip.

    A strip that the pump cannot hold fails in the nominal case; other cases ignore such strips.
    Args: dose: largest distance below the setpoint at which half of the largest dose is given, periods of growth, (S,).
    """
    every = np.ones(dose.size, dtype=bool)
    yield _count("nominal: strips that the pump cannot hold", asked, ~proofs[0].holdable)
    if asked.median is not None:
        middle = float(np.median(np.nan_to_num(proofs[0].excess, nan=np.inf)))
        title = f"nominal: median half-width over that of the one-line controller, safety, {asked.unit}"
        yield Requirement(title, middle, asked.median, f"all {asked.what}s")
    for proof in proofs:
        name, held = proof.case.name, proof.holdable
        if not held.any():
            continue
        yield _count(f"{name}: strips without a band", asked, held & ~proof.band.invariant)
        yield _count(f"{name}: strips whose band is not entered", asked, held & ~proof.band.entered)
        yield _count(f"{name}: strips in which a low culture may be washed out", asked, held & ~proof.grows)
        if name in asked.late:
            title, value, limit = "entry after the one-line controller's, periods", proof.later, asked.late[name]
        else:
            title, value, limit = "entry time over the pump's own", proof.entry, asked.limits.entry
        yield _worst(f"{name}: {title}", asked, value, limit, held, PERFORMANCE)
        if name in asked.judged:
            title = f"{name}: half-width over that of the one-line controller"
            yield _worst(f"{title}, {asked.unit}", asked, proof.excess, asked.margins[name], held, PERFORMANCE)
            yield _worst(f"{title}, safety, {asked.unit}", asked, proof.excess, asked.judged[name], held)
    title = "half of the largest dose below the setpoint"
    yield _worst(f"{title}, periods of growth", asked, dose, asked.limits.low_dose, every, PERFORMANCE)
    yield _worst(f"{title}, safety, periods of growth", asked, dose, asked.limits.safe_low_dose, every)


def _count(name: str, asked: Question, wrong: Mask) -> Requirement:
    """Return the requirement that no strip is `wrong`; its value is the number of wrong strips."""
    where = ", ".join(_place(asked, low, high) for low, high in _runs(asked.loop, wrong))
    return Requirement(name, float(wrong.sum()), 0.0, where)


def _worst(name: str, asked: Question, value: Array, limit: float, where: Mask, kind: str = SAFETY) -> Requirement:
    """Return the requirement that the largest value of the strips `where` is within the limit; nan is the worst."""
    if not where.any():
        return Requirement(name, 0.0, limit, kind=kind)
    at = int(np.where(where, np.where(np.isnan(value), np.inf, value), -np.inf).argmax())
    return Requirement(name, float(value[at]), limit, _strip(asked, at), kind)


def _strip(asked: Question, at: int) -> str:
    return _place(asked, float(asked.loop.low[at]), float(asked.loop.high[at]))


def _place(asked: Question, low: float, high: float) -> str:
    return f"{asked.what} {low:.4g}" + (f" to {high:.4g}" if high > low else "")
