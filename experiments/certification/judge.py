"""The certificate of a policy: what is proven of it, and whether that is enough."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from dqn.policy import Policy
from experiments.certification.boxes import contradictions
from experiments.certification.config import CertifyConfig, Limits
from experiments.certification.intervals import Mask, Points, drops, points_in_strips
from experiments.certification.line import on_lines
from experiments.certification.network import Array, Network
from experiments.certification.polygons import Regions, partition
from experiments.certification.question import Question, actions, question
from experiments.certification.verdict import Loop, Proof, dose_below, escapes, prove

__all__ = ["Certificate", "Check", "certify", "recheck"]

GRID = (256, 128)  # boxes of the cross-check


@dataclass(frozen=True)
class Check:
    """One requirement: the worst value found, where, and the limit it must not exceed."""

    name: str
    value: float
    limit: float
    where: str = ""

    @property
    def holds(self) -> bool:
        """nan holds nothing."""
        return self.value <= self.limit

    def __str__(self) -> str:
        return f"{self.name}: {self.value:.4g}, allowed {self.limit:g}" + (f" ({self.where})" if self.where else "")


@dataclass(frozen=True, eq=False)
class Certificate:
    """What was found.

    doses: how far below the setpoint each of `levels` may be given, periods of growth, (3, S).
    drops: where a higher reading gets a smaller dose, (first, second coordinate, from, to).
    regions: the exact polygons of the policy.
    """

    question: Question
    proofs: tuple[Proof, ...]
    checks: tuple[Check, ...]
    levels: tuple[int, ...]
    doses: Array
    drops: list[tuple[float, float, int, int]]
    regions: Regions

    @property
    def passed(self) -> bool:
        """Whether every requirement is met."""
        return all(check.holds for check in self.checks)

    def cannot_hold(self) -> list[str]:
        """What no policy holds, because the pump or the growth is too weak."""
        return [
            f"{proof.case.name}: from {self.question.what} {low:.4g} to {high:.4g} no pump rate holds the culture"
            for proof in self.proofs
            for low, high in _runs(self.question.loop, ~proof.holdable)
        ]


def _runs(loop: Loop, where: np.ndarray[Any, Any]) -> Iterator[tuple[float, float]]:
    """Stretches of neighbouring strips."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], where, [False]])))
    for first, last in edges.reshape(-1, 2):
        yield float(loop.low[first]), float(loop.high[last - 1])


def certify(policy: Policy, config: CertifyConfig) -> Certificate:
    """Prove what can be proven of a policy. Raises: CertificationError where nothing can be asked."""
    asked, network = question(policy, config), Network.of(policy)
    exact, wider = partition(network, asked.box)

    def points(case: Any) -> Points:
        return points_in_strips(wider, *asked.loop.seen(case))

    proofs = tuple(prove(asked.loop, points(case), wider.action, case) for case in asked.cases)
    levels = (1, 2, _half(policy))
    doses = dose_below(asked.loop, points(asked.cases[0]), wider.action, asked.cases[0], levels)
    checks = (
        Check("polygons that the bounds of boxes contradict", contradictions(network, exact, GRID), 0),
        *_required(asked, proofs, doses[-1], config.limits),
        Check("adversarial trajectories that left the band", _escaped(policy, asked, proofs, config.trajectories), 0),
    )
    return Certificate(asked, proofs, checks, levels, doses, drops(exact), exact)


def _half(policy: Policy) -> int:
    """The action of half of the largest dose."""
    return max(1, (actions(policy).size - 1) // 2)


def _escaped(policy: Policy, asked: Question, proofs: Sequence[Proof], trajectories: int) -> int:
    """Under the worst case that can be held."""
    names = [*asked.judged, *(name for name, *_ in asked.widths)]
    held = [proof for proof in proofs if proof.holdable.any() and proof.case.name in names]
    return escapes(policy, asked.loop, held[-1], trajectories) if held else 0


def _required(asked: Question, proofs: Sequence[Proof], dose: Array, limits: Limits) -> Iterator[Check]:
    """Every requirement with its worst strip. What the pump cannot hold fails in the nominal model alone.

    dose: how far below the setpoint half of the largest dose may be given, periods of growth, (S,).
    """
    every = np.ones(dose.size, dtype=bool)
    yield _count("nominal: strips that the pump cannot hold", asked, ~proofs[0].holdable)
    for proof in proofs:
        name, held = proof.case.name, proof.holdable
        if not held.any():
            continue
        yield _count(f"{name}: strips without a band", asked, held & ~proof.band.invariant)
        yield _count(f"{name}: strips in which a low culture may be washed out", asked, held & ~proof.grows)
        yield _worst(f"{name}: entry time over the pump's own", asked, proof.entry, limits.entry, held)
        if name in asked.judged:
            title = f"{name}: half-width over that of the law, {asked.unit}"
            yield _worst(title, asked, proof.excess, asked.judged[name], held)
    for name, low, high, limit in asked.widths:
        proof = next(p for p in proofs if p.case.name == name)
        inside = (asked.loop.low >= low - 1e-9) & (asked.loop.high <= high + 1e-9)
        title = f"{name}: half-width, {asked.what} {low:g} to {high:g}, {asked.unit}"
        yield _worst(title, asked, proof.half_width, limit, inside & proof.holdable)
    yield _worst("half of the largest dose below the setpoint, periods of growth", asked, dose, limits.low_dose, every)


def _count(name: str, asked: Question, wrong: Mask) -> Check:
    """Strips of which none may be."""
    where = ", ".join(_place(asked, low, high) for low, high in _runs(asked.loop, wrong))
    return Check(name, float(wrong.sum()), 0.0, where)


def _worst(name: str, asked: Question, value: Array, limit: float, where: Mask) -> Check:
    """The largest value in some strips; nan, which is where nothing could be proven, is the worst."""
    if not where.any():
        return Check(name, 0.0, limit)
    at = int(np.where(where, np.where(np.isnan(value), np.inf, value), -np.inf).argmax())
    return Check(name, float(value[at]), limit, _place(asked, asked.loop.low[at], asked.loop.high[at]))


def _place(asked: Question, low: float, high: float) -> str:
    return f"{asked.what} {low:.4g}" + (f" to {high:.4g}" if high > low else "")


def recheck(policy: Policy, config: CertifyConfig, strips: Sequence[float]) -> list[Check]:
    """The requirements that single setpoints, or growth shares, fail, along their own lines.

    Lines need no polygons: this is another way to the same numbers. On a line the policy is shown a single second
    coordinate, so cases in which that one has an error are left out.
    """
    asked, network = question(policy, config), Network.of(policy)
    loop = asked.loop.at(np.asarray(strips, dtype=np.float64))
    points, action = on_lines(network, asked.box[0], loop.low)
    cases = [case for case in asked.cases if np.equal(*loop.seen(case)).all()]
    proofs = [prove(loop, points, action, case) for case in cases]
    doses = dose_below(loop, points, action, cases[0], (_half(policy),))
    line = replace(asked, loop=loop, widths=tuple(w for w in asked.widths if w[0] in {c.name for c in cases}))
    return [check for check in _required(line, proofs, doses[0], config.limits) if not check.holds]
