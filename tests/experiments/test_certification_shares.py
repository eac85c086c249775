"""What is proven of a policy of (error, growth share): formulas of the law, simulated worst cases, planted faults."""

from dataclasses import replace

import numpy as np
import pytest

from dqn.policy import Policy
from experiments.certification.bounds import EstimateBounds
from experiments.certification.config import CertifyConfig
from experiments.certification.intervals import images
from experiments.certification.judge import certify, recheck
from experiments.certification.question import CertificationError, question
from experiments.certification.share_loop import ShareCase, ShareLoop
from tests.experiments import laws

FAST = CertifyConfig(trajectories=0)
B = 0.06


def bounds(**changes: float) -> EstimateBounds:
    none = EstimateBounds(B, 0.0, 0.0, 0.0, 0.0, laws.SHARES, (0.2, 1.0))
    return replace(none, **changes)


def single(s: float) -> ShareLoop:
    clip = (np.array([-1.15, 0.05]), np.array([1.15, 0.98]))
    return ShareLoop(np.linspace(0.0, 1.0, 17), (-50.0, 30.0), np.array([s]), np.array([s]), clip)


@pytest.mark.parametrize(("error", "share"), [(0.0, 0.0), (0.1, 0.05), (0.3, 0.0)])
def test_the_band_of_the_law_is_half_a_level_and_the_errors(error: float, share: float) -> None:
    """e' = e + s - v with v within 1/32 of (e + d1) + (s + d2): |e'| <= 1/32 + |d1| + |d2|, and it is reached."""
    loop, case = single(0.5), ShareCase("", bounds(error=error, growth_share=share))
    band = images(loop.law(case), loop.shift(case), loop.range())
    assert loop.half_width(band.low, band.high)[0] == pytest.approx(1 / 32 + error + share, abs=1e-9)


def test_an_error_of_the_od_estimate_weighs_more_at_a_low_setpoint() -> None:
    """Close to e = 0 it is ln(1 + 0.005 / r) / B: 0.41 at r = 0.2, at r = 1 less than the constant 0.1."""
    loop = single(0.5)
    widths = []
    for r in (0.2, 1.0):
        case = ShareCase("", bounds(error=0.1, od=0.005), r)
        band = images(loop.law(case), loop.shift(case), loop.range())
        widths.append(loop.half_width(band.low, band.high)[0])
    assert widths[0] == pytest.approx(1 / 32 + np.log1p(0.005 / 0.2) / B, rel=0.03)
    assert widths[1] == pytest.approx(1 / 32 + 0.1, abs=1e-9)


def test_a_wrong_gain_acts_as_more_or_less_of_every_dose() -> None:
    """s = 0.5 with a gain 10 % off: level 9 may take only 0.50625, level 8 as much as 0.55."""
    shift = single(0.5).shift(ShareCase("", bounds(gain=0.1)))[0]
    np.testing.assert_allclose(shift[[8, 9]], [[0.5 - 0.55, 0.5 - 0.45], [0.5 - 0.61875, 0.5 - 0.50625]])


def test_the_law_passes_and_its_polygons_give_the_law() -> None:
    found = certify(laws.share_law(), CertifyConfig())
    assert found.passed, [str(check) for check in found.checks if not check.holds]
    for proof in found.proofs:  # where the errors are wide, the policy is clipped to its shares and the law is not
        assert (proof.half_width <= proof.law_half_width + 1e-3).all()
        if not proof.case.name.startswith("watched"):
            np.testing.assert_allclose(proof.half_width, proof.law_half_width, atol=1e-3)
    assert found.drops == []


FAULTS: dict[str, Policy] = {
    "flipped sign": laws.share_law(gain=-1.0),
    "reversed actions": laws.share_law(order=-1),
    "growth not seen": laws.share_law(share=0.0),
    "law of tau x 2": laws.share_law(gain=2.0, share=2.0),
    "full dose in the low corner": laws.share_law(add=(2, 16, 100.0)),
    "spike": laws.share_law(add=(3, 16, 50.0)),
}


@pytest.mark.parametrize("policy", FAULTS.values(), ids=list(FAULTS))
def test_a_planted_fault_fails(policy: Policy) -> None:
    assert not certify(policy, FAST).passed


def test_no_dose_in_the_high_corner_fails() -> None:
    """The unit of the low corner, turned round: relu(50 (e + s) - 75) above e + s = 1.5."""
    given = laws.share_law(add=(2, 0, 100.0))
    weights, biases = ([a.copy() for a in arrays] for arrays in (given.weights, given.biases))
    weights[0][:, 2], biases[0][2] = 50.0, -75.0
    assert not certify(replace(given, weights=tuple(weights), biases=tuple(biases)), FAST).passed


def test_samples_and_lines_do_not_see_the_spike() -> None:
    spike = FAULTS["spike"]
    points = np.random.default_rng(0).uniform([-1.15, 0.05], [1.15, 0.98], (1_000_000, 2))
    near = points[np.abs(points[:, 1] - laws.SPIKE) < 1e-5]
    np.testing.assert_array_equal(spike.act(near), laws.share_law().act(near))
    assert spike.act(np.array([[-0.5, laws.SPIKE]]))[0] == 16
    assert recheck(spike, FAST, np.linspace(*laws.SHARES, 9).tolist()) == []


def test_beyond_what_the_policy_sees_it_acts_as_at_the_edge() -> None:
    """No dose below -1.15: a culture of OD 0.05 at a setpoint of 1, e = -50, grows; its policy sees -1.15."""
    found = certify(laws.share_law(), FAST)
    assert found.question.loop.start[0] == pytest.approx(np.log(0.05) / B)
    assert all(proof.grows.all() for proof in found.proofs)
    blind = replace(laws.share_law(), low=np.array([0.5, 0.05], np.float32))  # always sees too much
    assert not certify(blind, FAST).passed


def test_growth_shares_that_were_not_trained_are_not_asked() -> None:
    with pytest.raises(CertificationError, match=r"growth_shares = \[0.02, 0.97\]: allowed 0.05 to 0.98"):
        question(laws.share_law(), replace(FAST, growth_shares=(0.02, 0.97)))


def test_what_the_pump_cannot_hold_with_a_weaker_gain_is_said() -> None:
    """A gain 10 % lower takes 0.9 at most."""
    found = certify(laws.share_law(), replace(FAST, error_gain=0.1))
    assert found.cannot_hold()[0] == "errors: from growth share 0.895 to 0.97 no pump rate holds the culture"
