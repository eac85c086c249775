"""What is proven of a policy of (error, growth share): formulas of the law, simulated worst cases, planted faults."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from dqn.policy import Policy
from envs.bench import Bench
from envs.task import EnvConfig
from experiments.certification import judge
from experiments.certification.bounds import EstimateBounds
from experiments.certification.config import LIMITS, CertifyConfig
from experiments.certification.intervals import Band, Pieces, images
from experiments.certification.judge import certify, recheck
from experiments.certification.loops import ShareCase, ShareLoop
from experiments.certification.polygons import Array
from experiments.certification.question import CertificationError, question
from tests.experiments import laws, proofs

pytestmark = pytest.mark.numeric

FAST = CertifyConfig(trajectories=0)
B = 0.06


def bounds(**changes: float) -> EstimateBounds:
    none = EstimateBounds(B, 0.0, 0.0, 0.0, 0.0, laws.SHARES, (0.2, 1.0))
    return replace(none, **changes)


CLIP = (np.array([-1.15, 0.05]), np.array([1.15, 0.98]))
LEVELS = np.linspace(0.0, 1.0, 17)


def loop(*strips: tuple[float, float]) -> ShareLoop:
    """Entered from OD 0.05 to 1.5, at setpoints from 0.2 to 1."""
    low, high = np.array(strips).T
    return ShareLoop(LEVELS, (0.05, 1.5), (0.2, 1.0), low, high, CLIP)


def single(s: float) -> ShareLoop:
    return loop((s, s))


def limit(of: ShareLoop, case: ShareCase) -> Band:
    """Of the one-line controller."""
    return images(of.law(case), of.shift(case), of.range(case))


@pytest.mark.parametrize(("error", "share"), [(0.0, 0.0), (0.1, 0.05), (0.3, 0.0)])
def test_the_band_of_the_law_is_half_a_level_and_the_errors(error: float, share: float) -> None:
    """e' = e + s - v with v within 1/32 of (e + d1) + (s + d2): |e'| <= 1/32 + |d1| + |d2|, and it is reached."""
    given, case = single(0.5), ShareCase("", bounds(error=error, growth_share=share))
    band = limit(given, case)
    assert given.half_width(band.low, band.high)[0] == pytest.approx(1 / 32 + error + share, abs=1e-9)


def test_doses_that_scatter_take_more_or_less_and_a_wrong_gain_is_another_unit_of_the_error() -> None:
    """s = 0.5 with doses 10 % off: level 9 may take only 0.50625, level 8 as much as 0.55.

    A gain that is 10 % off for long changes no dose. What is shown as 1 is between 1/1.1 and 1/0.9; the same OD is as
    far away as ln(x / r) / (0.9 B).
    """
    given, off = single(0.5), bounds(gain=0.1)
    spread, slow, none = ShareCase("", off), ShareCase("", off, slow=True), ShareCase("", bounds())
    np.testing.assert_allclose(
        given.shift(spread)[0][[8, 9]], [[0.5 - 0.55, 0.5 - 0.45], [0.5 - 0.61875, 0.5 - 0.50625]]
    )
    np.testing.assert_array_equal(given.shift(slow), given.shift(none))
    shown, share = np.array([-1.0, 1.0]), np.full(2, 0.5)
    np.testing.assert_allclose(given.states(slow)(shown, share), [[-1 / 0.9, 1 / 1.1], [-1 / 1.1, 1 / 0.9]])
    np.testing.assert_array_equal(given.states(spread)(shown, share), [shown, shown])
    for case, b in ((spread, B), (none, B), (slow, 0.9 * B)):
        np.testing.assert_allclose(given.range(case), [[np.log(0.05 / 1.0) / b, np.log(1.5 / 0.2) / b]])
        at = replace(case, setpoint=0.6)
        np.testing.assert_allclose(given.range(at), [[np.log(0.05 / 0.6) / b, np.log(1.5 / 0.6) / b]])


def test_a_half_width_in_od_is_that_of_the_pump_as_strong_as_it_may_be() -> None:
    """Half a period of full pump above 0.6: OD 0.6 exp(0.06 / 2), and exp(1.25 * 0.06 / 2) of a gain that is 25 % off.

    Doses that scatter leave the unit of the error as it is.
    """
    given, off = single(0.5), bounds(gain=0.25)
    for slow, setpoint, od in (
        (True, 0.6, 0.6 * np.expm1(0.0375)),
        (False, 0.6, 0.6 * np.expm1(0.03)),
        (True, None, None),
    ):
        assert given.in_od(ShareCase("", off, setpoint, slow=slow), 0.5) == (od and pytest.approx(od))


def by_brute_force(strip: tuple[float, float], case: ShareCase, step: float = 0.001) -> tuple[float, float]:
    """The band of the one-line controller from a grid of true errors of e, every disturbance tried at each of them.

    A run of the culture: e is the true ln(x / r) / B', the filter believes in B, so a perfect one would say e B' / B.
    It says any estimate whose own bound, max(error, ln(1 + od / (r exp(B estimate))) / B), reaches that. The law gives
    the level nearest to clip(estimate + a share within its own error), of which the pump gives what it likes.
    """
    off, r = case.bounds, case.setpoint
    assert r is not None
    e = np.arange(-2.0, 2.0 + step, step)
    bound = np.maximum(off.error, np.log(1.0 + off.od / (r * np.exp(off.full_pump * e))) / off.full_pump)
    least, most = np.full(e.size, np.inf), np.full(e.size, -np.inf)
    for scale in {1.0 - case.scale, 1.0, 1.0 + case.scale}:
        said = np.abs(e - scale * e[:, None]) <= bound  # (true, estimate)
        known = said.any(axis=1)
        first, last = e[said.argmax(axis=1)], e[e.size - 1 - said[:, ::-1].argmax(axis=1)]
        for part in np.linspace(0.0, 1.0, 9):
            estimate = first + part * (last - first)
            for s in strip:
                for wrong in (-off.growth_share, 0.0, off.growth_share):
                    level = np.rint(16.0 * np.clip(estimate + s + wrong, 0.0, 1.0)) / 16.0
                    for gain in {1.0 - case.spread, 1.0, 1.0 + case.spread}:
                        then = np.where(known, e + s - gain * level, 0.0)
                        least, most = np.minimum(least, then), np.maximum(most, then)
    low, high = e[0] / 2.0, e[-1] / 2.0
    for _ in range(300):
        at = (e >= low - step / 2.0) & (e <= high + step / 2.0)
        low, high = least[at].min(), most[at].max()
    return float(low), float(high)


@pytest.mark.parametrize("slow", [False, True], ids=["spread doses", "slow error"])
@pytest.mark.parametrize("b", [0.03, 0.12])
@pytest.mark.parametrize("r", [0.2, 0.6])
def test_the_band_of_the_law_under_an_error_of_the_gain_against_brute_force(r: float, b: float, slow: bool) -> None:
    """It lies between that of the grid and that of the grid with errors larger by three of its steps.

    The two are alike but where a level of the dose is met by a hair, which moves an end by a level's error.
    """
    off = bounds(full_pump=b, error=0.1, od=0.005, growth_share=0.05, gain=0.2)
    more = replace(off, error=0.103, od=0.005 + 0.003 * b * r, growth_share=0.053)
    for strip in ((0.3, 0.305), (0.6, 0.605)):
        case = ShareCase("", off, r, slow=slow)
        band = limit(loop(strip), case)
        inner, outer = (by_brute_force(strip, replace(case, bounds=these)) for these in (off, more))
        assert band.invariant[0]
        assert -1.5 < outer[0] - 1e-3 <= band.low[0] <= inner[0] + 1e-3
        assert 1.5 > outer[1] + 1e-3 >= band.high[0] >= inner[1] - 1e-3
        assert outer[1] - outer[0] == pytest.approx(inner[1] - inner[0], abs=0.04)
        without = limit(loop(strip), replace(case, bounds=replace(off, gain=0.0)))
        assert band.high[0] - band.low[0] > without.high[0] - without.low[0] + 0.02


def step_by_step(pieces: Pieces, shift: Array, start: Array, strip: int) -> list[tuple[float, float]]:
    """The intervals of one strip, a period each, until they change no more."""
    path = [(float(start[strip, 0]), float(start[strip, 1]))]
    parts = [
        (low, high, *shift[strip, action])
        for low, high, action in zip(pieces.low[strip], pieces.high[strip], pieces.action[strip], strict=True)
    ]
    while True:
        low, high = path[-1]
        met = [(max(low, p), min(high, q), a, b) for p, q, a, b in parts if max(low, p) <= min(high, q)]
        path.append((min(p + a for p, _, a, _ in met), max(q + b for _, q, _, b in met)))
        if np.abs(np.subtract(path[-1], path[-2])).max() <= 1e-9:
            return path


def compared(pieces: Pieces, shift: Array, start: Array, rng: np.random.Generator) -> list[int]:
    """Asserts that bands and periods are those of single steps; how many steps they are, of each strip."""
    band = images(pieces, shift, start)
    paths = [step_by_step(pieces, shift, start, strip) for strip in range(len(start))]
    last = np.array([path[-1] for path in paths])
    assert band.invariant.all()
    np.testing.assert_allclose(np.stack([band.low, band.high], axis=1), last, atol=1e-7)
    assert (band.taken.sum(axis=0) >= band.periods).all()
    for _ in range(40):
        low, high = last.T + rng.uniform(1e-3, 1.0, (2, 1)) ** 3 * (start - last).T
        asked = [sum(a < low[n] or b > high[n] for a, b in path) for n, path in enumerate(paths)]
        np.testing.assert_array_equal(band.until(low, high), asked)
    inside = last + np.array([-1e-6, 1e-6])
    np.testing.assert_array_equal(
        band.until(*inside.T), [sum(a < i or b > j for a, b in p) for p, (i, j) in zip(paths, inside, strict=True)]
    )
    assert np.isinf(band.until(last[:, 0] + 1e-3, last[:, 1])).all()
    return [len(path) for path in paths]


@pytest.mark.parametrize("b", [0.01, 0.06])
def test_many_periods_at_once_are_as_many_single_ones(b: float) -> None:
    """From OD 0.05 at a setpoint of 1, B = 0.01, a culture grows by s = 0.05 a period: 5991 of them."""
    strips, off = ((0.05, 0.05), (0.3, 0.305), (0.55, 0.56), (0.95, 0.95)), bounds(full_pump=b, error=0.1, od=0.005)
    given, rng = loop(*strips), np.random.default_rng(5)
    for case in (ShareCase("", off), ShareCase("", replace(off, growth_share=0.05, gain=0.04), 0.6, slow=True)):
        steps = compared(given.law(case), given.shift(case), given.range(case), rng)
        alone = (-np.log(0.05 / (case.setpoint or 1.0)) / b / (1.0 - case.scale) - 0.5) / 0.05
        assert max(steps) == pytest.approx(alone, abs=40)
        taken = images(given.law(case), given.shift(case), given.range(case)).taken
        assert len(taken) < max(steps) / 4  # it did take many at once
        assert taken.max() > max(steps) / 2


def test_many_periods_at_once_through_pieces_at_random() -> None:
    """Pieces that overlap, two of them without an end below and above; above, further out, a third that moves less."""
    rng = np.random.default_rng(6)
    for _ in range(12):
        edges = np.sort(rng.uniform(-1, 1, 6))
        low = np.concatenate([[-np.inf], edges - rng.uniform(0, 0.3, 6), [rng.uniform(1.5, 4.0)]])
        high = np.concatenate([edges, [np.inf, np.inf]])
        middle = np.append(np.linspace(0.2, -0.2, 7) + rng.uniform(-0.08, 0.08, 7), -0.05)
        shift = np.stack([middle - 0.01, middle + 0.01], axis=1)
        pieces = Pieces(low[None], high[None], np.arange(8)[None])
        compared(pieces, shift[None], np.array([[-rng.uniform(5, 60), rng.uniform(5, 60)]]), rng)


@given(
    b=st.floats(0.005, 2.0),
    r=st.floats(0.05, 4.0),
    error=st.floats(0.0, 1.0),
    od=st.floats(1e-4, 0.1),
    x=st.floats(0.01, 10.0),
    side=st.sampled_from([-1.0, 1.0]),
)
def test_the_farthest_estimate_is_as_far_as_its_own_bound(b, r, error, od, x, side):
    """|e - estimate| = max(error, ln(1 + od / y) / B) at the OD y = r exp(B estimate) that is estimated.

    Any farther one is too far, any nearer one is not. Below, an OD of less than the error of the OD has no farthest.
    """
    assume(x > 1.05 * od)
    off, e = bounds(full_pump=b, error=error, od=od), np.log(x / r) / b
    found = float(off.estimate(np.array([e]), np.array([side]), r)[0])

    def room(estimate: float) -> float:
        y = r * np.exp(b * estimate)
        return float(max(error, np.log(1.0 + od / y) / b) - abs(e - estimate))

    assert room(found) == pytest.approx(0.0, abs=1e-8 / b)
    assert side * (found - e) >= 0.0
    assert off.error_at(np.array([found]), r)[0] == pytest.approx(abs(e - found), abs=1e-8 / b)
    further = 1e-5 * max(1.0, abs(found - e))
    assert room(found + side * further) < 0.0 < room(found - side * further)
    np.testing.assert_allclose(off.estimate(np.array([e]), np.array([side]), None), e + side * error)


@pytest.mark.slow
def test_the_law_passes_and_its_polygons_give_the_law() -> None:
    """Where the policy is shown what it was trained for; beyond, it is clipped and the law is not.

    An end of a band may lie a level's error beside that of the law, 0.2 / 16, where a switch is met by a hair; of
    thousands of bands that is one.
    """
    found = certify(laws.share_law(), CertifyConfig())
    assert CertifyConfig().trajectories == 20_000
    assert found.passed, [str(check) for check in found.checks if not check.holds]
    assert len([check for check in found.checks if "no attack reaches" in check.name]) == 2
    beside, bands = 0, 0
    for proof in found.proofs:
        low, high = found.question.loop.seen(proof.case)
        shown = proof.holdable & (low > CLIP[0][1] + 1e-6) & (high < CLIP[1][1] - 1e-6)
        assert (proof.excess[proof.holdable] <= 0.2 / 16).all()
        beside, bands = beside + int((np.abs(proof.excess[shown]) > 1e-3).sum()), bands + int(shown.sum())
    assert bands > 5000
    assert beside <= 1
    assert found.drops == []


def test_what_is_asked_of_a_policy_of_error_and_growth_share() -> None:
    """Five B and the bench's own, which is one of them, at three setpoints; a quick one is of the bench alone."""
    own = ["nominal", "errors"]
    gains = [
        f"{kind} at setpoint {r}, B = {b}"
        for b in ("0.01", "0.03", "0.06", "0.12", "0.3")
        for r in ("0.2", "0.6", "1")
        for kind in (("errors",) if r == "0.6" else ()) + ("spread doses", "slow gain error")
    ]
    watched = ["watched errors at setpoint 0.6"]
    asked = question(laws.share_law(), FAST)
    assert [case.name for case in asked.cases] == own + gains + watched
    assert asked.judged == {case.name: 0.025 for case in asked.cases}
    limits = {case.name: (asked.margins[case.name], asked.late[case.name]) for case in asked.cases}
    assert limits.pop("nominal") == (0.005, 1)
    assert limits == {name: (1 / 64, 4 if name.startswith("slow") else 1) for name in [*own[1:], *gains, *watched]}
    other = question(laws.share_law(), replace(FAST, bench=Bench(volume_ml=12.0)))
    assert {case.bounds.full_pump for case in other.cases} == {0.01, 0.03, 0.06, 0.12, 0.3, 0.1, 0.02 * 60 / 12.0}
    quick = question(laws.share_law(), replace(FAST, quick=True))
    assert [case.name for case in quick.cases] == [
        *own, *(f"errors at setpoint {r}, B = 0.06" for r in ("0.2", "0.6", "1")), *watched
    ]  # fmt: skip
    assert not any(case.bounds.gain for case in quick.cases)


def test_full_pump_is_that_of_the_bench_in_all_its_parts_unless_a_model_is_given() -> None:
    """0.05 mL/s for 3 min into 12 mL take 0.75 off ln x; a model of tau 0.3 and 2 min with 0.03 mL/s takes 0.2."""
    bench = Bench(volume_ml=12.0, period_s=180.0, max_rate=0.05)
    given = EnvConfig(tau=0.3, control_min=2.0, max_pump_rate=0.03, setpoints=(0.9, 0.3, 0.4))
    for config, b, setpoints in (
        (replace(FAST, bench=bench, quick=True), 0.75, (0.2, 1.0)),
        (replace(FAST, bench=bench, env=given, quick=True), 0.2, (0.3, 0.9)),
    ):
        asked = question(laws.share_law(), config)
        assert [case.bounds.full_pump for case in asked.cases] == pytest.approx([b] * len(asked.cases))
        assert asked.setpoints == asked.loop.setpoints == setpoints


def test_what_the_supervisor_is_to_watch_is_the_largest_error_that_is_proven() -> None:
    """Its own bounds of OD and growth share, and a gain that is exact; the others are those that are asked for."""
    changes: dict[str, Any] = {"error": 0.2, "error_od": 0.006, "error_share": 0.04, "error_gain": 0.1}
    config = replace(FAST, growth_shares=(0.1, 0.9), **changes)
    asked = question(laws.share_law(), config)
    assert asked.bounds == asked.cases[-1].bounds
    watched = EstimateBounds(B, 0.2, 0.04, 0.5, 0.0, (0.1, 0.9), (0.2, 1.0))
    assert replace(asked.bounds, full_pump=B) == watched
    exact, errors = (case.bounds for case in asked.cases[:2])
    assert (exact.error, exact.od, exact.growth_share) == (0.0, 0.0, 0.0)
    assert (errors.error, errors.od, errors.growth_share, errors.gain) == (0.2, 0.006, 0.04, 0.0)
    assert {case.bounds.gain for case in asked.cases[2:-1]} == {0.0, 0.1}
    assert (asked.loop.low[0], asked.loop.high[-1], asked.loop.low.size) == (0.1, 0.9, 160)


def test_the_setpoints_that_are_named_are_those_that_are_asked_about() -> None:
    """`certify setpoints=[0.3,0.7]`: both and their middle, entered from ln(0.05 / 0.7) / B. A run at 0.25 and 0.8 asks
    for every error there and nowhere else."""
    command = question(laws.share_law(), replace(FAST, setpoints=(0.3, 0.7)))
    assert {case.setpoint for case in command.cases} == {None, 0.3, 0.5, 0.7}
    assert command.setpoints == (0.3, 0.7)
    assert command.bounds is not None
    assert command.bounds.setpoints == (0.3, 0.7)
    np.testing.assert_allclose(command.loop.range(command.cases[0])[0], np.log([0.05 / 0.7, 1.5 / 0.3]) / B)
    run = question(laws.share_law(), replace(FAST, full_pumps=()), (0.25, 0.8))
    own = [
        f"{kind} at setpoint {r}, B = 0.06"
        for r in (0.25, 0.8)
        for kind in ("errors", "spread doses", "slow gain error")
    ]
    assert [(case.name, case.setpoint) for case in run.cases] == [
        ("nominal", None), ("errors", None), *zip(own, [0.25] * 3 + [0.8] * 3, strict=True),
        ("watched errors at setpoint 0.25", 0.25), ("watched errors at setpoint 0.8", 0.8),
    ]  # fmt: skip


def failing(bent: Callable[[str, Band], Band]) -> list[str]:
    """What attacks on the law find where the bands of cases are others than were proven."""
    asked = CertifyConfig(quick=True, growth_shares=(0.3, 0.6), trajectories=0)
    found = proofs.proven(laws.share_law(), asked)
    bands = [replace(proof, band=bent(proof.case.name, proof.band)) for proof in found.proofs]
    checks = judge._attacks(laws.share_law(), found.question, bands, 20_000)
    return [check.name for check in checks if not check.holds]


@pytest.mark.slow
@pytest.mark.parametrize("side", [-1, 1], ids=["below", "above"])
@pytest.mark.parametrize(
    ("kind", "wider", "fails"),
    [
        ("errors", 0.1, ["errors: share of the band that no attack reaches"]),
        ("nominal", 0.12, ["exact: share of the band that no attack reaches"]),
        ("", 0.0, []),
    ],
    ids=["errors", "exact", "neither"],
)
def test_a_band_that_is_too_wide_is_not_reached(kind: str, wider: float, fails: list[str], side: int) -> None:
    """Of one 10 % wider no more than 1 / 1.1 = 0.909 can be reached, and 0.95 must be; of one 12 % 0.893, and 0.9."""

    def bent(name: str, band: Band) -> Band:
        more = wider * (band.high - band.low) * (name == kind)
        return replace(band, low=band.low - more * (side < 0), high=band.high + more * (side > 0))

    assert failing(bent) == fails


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["nominal", "errors", "watched errors at setpoint 0.6"])
def test_a_band_that_is_a_little_too_narrow_is_left(kind: str) -> None:
    """By 2 %, a half of it on each side."""

    def bent(name: str, band: Band) -> Band:
        less = 0.01 * (band.high - band.low) * (name == kind)
        return replace(band, low=band.low + less, high=band.high - less)

    assert failing(bent) == ["adversarial trajectories that left the band"]


FAULTS: dict[str, Policy] = {
    "flipped sign": laws.share_law(gain=-1.0),
    "reversed actions": laws.share_law(order=-1),
    "growth not seen": laws.share_law(share=0.0),
    "law of tau x 2": laws.share_law(gain=2.0, share=2.0),
    "full dose in the low corner": laws.share_law(add=(2, 16, 100.0)),
    "spike": laws.share_law(add=(3, 16, 50.0)),
    "no dose in the high corner": laws.bent_share_law((-3.0, (1.0, 1.0, -1.5, 50.0))),
}


def beyond(e: float, s: float) -> Callable[..., laws.Ramp]:
    """Make a ramp that rises where e, or s, passes a value in this direction."""
    return lambda where, k=1e3: (e, s, -(e + s) * where, k)


e_above, e_below, s_above, s_below = beyond(1.0, 0.0), beyond(-1.0, 0.0), beyond(0.0, 1.0), beyond(0.0, -1.0)


NINETEEN: dict[str, Policy] = {
    "no dose near rest in a thin range of s": laws.bent_share_law(
        (-5.0, s_above(0.61), s_below(0.616), e_above(-0.1), e_below(0.1))
    ),
    "three levels too low in a thinner one": laws.bent_share_law((-3 / 16, s_above(0.3), s_below(0.304, 2e3))),
    "offset where s is low": laws.bent_share_law((0.04, s_below(0.2))),
    "level 5 is never given": laws.bent_share_law(never=(5,)),
    "even levels alone": laws.bent_share_law(never=tuple(range(1, 17, 2))),
    "levels 8 and 9 for one another": laws.bent_share_law(swapped=(8, 9)),
    "never the full pump": laws.bent_share_law(never=(16,)),
    "never no dose": laws.bent_share_law(never=(0,)),
    "gain 0.7": laws.bent_share_law(gain=0.7),
    "gain 1.5": laws.bent_share_law(gain=1.5),
    "s above 0.9 taken for 0.9": laws.bent_share_law((-1.0, s_above(0.9, 1.0))),
    "s 3 per cent low": laws.bent_share_law(share=0.97),
    "no dose from a third of a period below": laws.bent_share_law((-5.0, e_below(-0.35))),
    "no dose in a thin range of e, far above": laws.bent_share_law((-5.0, e_above(0.8), e_below(0.82))),
    "a dead zone": laws.bent_share_law((-0.06, e_above(-0.03, 1 / 0.06)), offset=0.03),
    "one level too low far above": laws.bent_share_law((-2 / 16, e_above(0.6))),
    "a dose far below where growth is slow": laws.bent_share_law((2.0, e_below(-0.9), s_below(0.06))),
    "always rounded down": laws.bent_share_law(offset=-1 / 32),
    "full pump in a very thin range of s": laws.bent_share_law((3.0, s_above(0.45), s_below(0.452, 4e3))),
}
"""Written by somebody who had seen neither this code nor its tests."""


def test_the_law_that_is_not_bent_passes() -> None:
    assert certify(laws.bent_share_law(), replace(FAST, full_pumps=())).passed


@pytest.mark.parametrize("policy", [*FAULTS.values(), *NINETEEN.values()], ids=[*FAULTS, *NINETEEN])
def test_a_planted_fault_or_one_by_another_hand_is_not_safe(policy: Policy) -> None:
    assert not certify(policy, replace(FAST, full_pumps=())).safe


WORSE: dict[str, tuple[Policy, float, tuple[float, float]]] = {
    "offset of the error": (laws.share_law(offset=0.04), 0.04, laws.SHARES),
    "even levels alone": (laws.share_law(levels=2), 1 / 16 - 1 / 32, laws.SHARES),
    "gain 1.5": (laws.share_law(gain=1.5), 1 / 16 - 1 / 32, laws.SHARES),
    "three levels too low in a hole": (
        laws.bent_share_law((-3 / 16, s_above(0.45, 100), s_below(0.55, 100), e_above(0.14, 100), e_below(0.24, 100))),
        3 / 16, (0.45, 0.55),
    ),
}  # fmt: skip


@pytest.mark.parametrize(("policy", "excess", "where"), WORSE.values(), ids=list(WORSE))
def test_a_policy_that_is_a_little_worse_than_the_law_fails_by_how_much_it_is(policy, excess, where):
    """Exact estimates: e' = s - v of the law is within 1/32.

    An offset of 0.04 is where e rests. Of even levels the nearest is within 1/16. With a gain of 1.5, e' = -e / 2
    within 1/32 rests within (1/32) / (1 - 1/2). Three levels less leave 3/16, which is in the middle of the hole.
    """
    found = certify(policy, replace(FAST, quick=True))
    assert not found.safe
    failed = {check.name: check for check in found.checks if not check.holds}
    nominal = failed["nominal: half-width over that of the one-line controller, periods of full pump"]
    assert nominal.value == pytest.approx(excess, abs=2e-3)
    proof, strips = found.proofs[0], found.question.loop
    worse = np.flatnonzero(proof.excess > 0.005)
    assert where[0] <= strips.low[worse].min() + 1e-9
    assert strips.high[worse].max() <= where[1] + 1e-9
    assert "errors: half-width over that of the one-line controller, periods of full pump" in failed
    assert np.isinf(failed["nominal: entry after the one-line controller's, periods"].value)


def test_samples_do_not_see_the_spike_and_the_proof_of_a_device_does() -> None:
    """At whatever setpoint: of (error, growth share) it goes over all shares."""
    spike = FAULTS["spike"]
    points = np.random.default_rng(0).uniform([-1.15, 0.05], [1.15, 0.98], (1_000_000, 2))
    near = points[np.abs(points[:, 1] - laws.SPIKE) < 1e-5]
    np.testing.assert_array_equal(spike.act(near), laws.share_law().act(near))
    assert spike.act(np.array([[-0.5, laws.SPIKE]]))[0] == 16
    assert recheck(spike, FAST, [0.5])
    assert recheck(laws.share_law(), FAST, [0.5]) == []


def test_beyond_what_the_policy_sees_it_acts_as_at_the_edge() -> None:
    """No dose below -1.15: a culture of OD 0.05 at a setpoint of 1, e = -50, grows; its policy sees -1.15."""
    found = proofs.proven(laws.share_law(), FAST)
    start = found.question.loop.range(found.question.cases[0])
    np.testing.assert_allclose(start[:, 0], np.log(0.05) / B)
    assert {case.name: case for case in found.question.cases}["nominal"].setpoint is None
    assert all(proof.grows.all() for proof in found.proofs)
    blind = replace(laws.share_law(), low=np.array([0.5, 0.05], np.float32))  # always sees too much
    assert not certify(blind, replace(FAST, full_pumps=())).safe


def test_growth_shares_that_were_not_trained_are_not_asked() -> None:
    with pytest.raises(CertificationError, match=r"growth_shares = \[0.02, 0.97\]: allowed 0.05 to 0.98"):
        question(laws.share_law(), replace(FAST, growth_shares=(0.02, 0.97)))


def test_what_the_pump_cannot_hold_with_weaker_doses_is_said() -> None:
    """Doses 10 % smaller take 0.9 at most, in the 15 cases in which they are; a wrong estimate takes nothing away."""
    found = certify(laws.share_law(), replace(FAST, error_gain=0.1))
    first = "spread doses at setpoint 0.2, B = 0.01"
    assert found.cannot_hold() == [
        f"{first} and 14 others: from growth share 0.895 to 0.97 no pump rate holds the culture"
    ]
    assert all(proof.holdable.all() for proof in found.proofs if not proof.case.name.startswith("spread"))


def test_a_device_asks_the_same_as_the_command(monkeypatch: pytest.MonkeyPatch) -> None:
    """With limits that nothing meets, every case of one B at the three setpoints has the same worst value in both.

    The device asks at the setpoints of its run, whatever those of the certificate are.
    """
    strict = replace(LIMITS, excess_share=1e-9, excess_nominal=1e-9, late=0.0, late_slow=0.0)
    monkeypatch.setattr("experiments.certification.question.LIMITS", strict)
    config = replace(FAST, full_pumps=())
    policy = laws.share_law(offset=0.03)
    proven = certify(policy, replace(config, setpoints=(0.3, 0.7)))
    wanted = {c.name: c.value for c in proven.checks if "half-width" in c.name and not c.holds}
    found = {c.name: c.value for c in recheck(policy, config, (0.3, 0.5, 0.7)) if "half-width" in c.name}
    assert len(wanted) > 8
    assert {name.split("setpoint ")[1][:3] for name in found if "setpoint" in name} == {"0.3", "0.5", "0.7"}
    assert {name: found[name] for name in wanted} == pytest.approx(wanted, abs=1e-9)


def test_strips_cover_the_range_where_their_width_does_not_divide_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("experiments.certification.question.STRIP", 0.03)
    asked = question(laws.share_law(), FAST).loop
    assert (asked.low[0], asked.high[-1]) == (0.05, 0.97)
    np.testing.assert_array_equal(asked.low[1:], asked.high[:-1])
    assert (asked.high - asked.low).max() <= 0.03 + 1e-12
