"""What is asked for and what is known of it ahead, by hand."""

import numpy as np
import pytest

from experiments.coculture.program import Program

NAN = float("nan")
STEPS = Program((NAN, 0.3, 0.7, 0.7, 0.3, NAN, 0.5), (60.0, 360.0, 300.0, 300.0, 60.0, 60.0, 60.0))


def told(program, minute, preview_min):
    found = program.wanted(np.array([float(minute)]), preview_min)
    return tuple(float(v[0]) for v in (found.setpoint, found.following, found.minutes))


@pytest.mark.parametrize(
    ("minute", "preview", "expected"),
    [
        (60, 0.0, (0.3, 0.3, 0.0)),
        (60, 360.0, (0.3, 0.7, 360.0)),
        (60, 359.0, (0.3, 0.3, 0.0)),
        (419, 360.0, (0.3, 0.7, 1.0)),
        (420, 360.0, (0.7, 0.7, 0.0)),  # .7 goes on for 600 min
        (700, 360.0, (0.7, 0.3, 320.0)),
        (1050, 360.0, (0.3, 0.3, 0.0)),  # nothing is asked for after it
        (1150, 360.0, (0.5, 0.5, 0.0)),
        (5000, 360.0, (0.5, 0.5, 0.0)),  # the last one after the end
    ],
)
def test_a_change_is_announced_as_early_as_it_says(minute, preview, expected):
    assert told(STEPS, minute, preview) == expected


@pytest.mark.parametrize("minute", [-1.0, NAN, 0.0, 59.0, 1080.0])
def test_where_nothing_is_asked_for_nothing_is(minute):
    assert np.isnan(STEPS.setpoint(np.array([minute]))[0])
    assert np.isnan(told(STEPS, minute, 360.0)[0])
    assert told(STEPS, minute, 360.0)[2] == 0.0


def test_a_sine_falls_first_and_is_announced_as_a_step():
    sine = Program((), (2400.0,), (0.5, 0.4, 1200.0))
    assert told(sine, 0, 0.0) == pytest.approx((0.5, 0.5, 0.0))
    assert told(sine, 300, 0.0)[0] == pytest.approx(0.1)
    assert told(sine, 900, 360.0) == pytest.approx((0.9, 0.5, 120.0))
    assert told(sine, 900, 100.0) == pytest.approx((0.9, 0.5 + 0.4 * np.cos(np.pi / 6.0), 40.0))
    assert told(sine, 2200, 360.0)[2] == 0.0  # what comes after the end is nobody's business


@pytest.mark.parametrize(
    ("values", "says"),
    [
        (((0.3, 0.7), (60.0,)), "scenario.ratios"),
        (((1.2,), (60.0,)), "each 0 < share < 1"),
        (((), (60.0,), (0.5, 0.5, 600.0)), "0 < mean"),
        (((), (60.0,)), "scenario.ratios"),
    ],
)
def test_a_program_that_cannot_be_is_refused(values, says):
    with pytest.raises(ValueError, match=says):
        Program(*values)


def test_when_changes_are_announced() -> None:
    """Each as long before it as asked for, but not before its phase begins; phases of one share are one."""
    program = Program((NAN, 0.3, 0.3, 0.7, NAN, 0.5, 0.2), (60.0, 100.0, 200.0, 30.0, 10.0, 500.0, 20.0))
    minute, share = program.announcements(150.0)
    assert minute.tolist() == [210.0, 750.0]  # .3 to .7 at 360, .5 to .2 at 900
    assert share.tolist() == [0.7, 0.2]
    minute, _ = program.announcements(1000.0)
    assert minute.tolist() == [60.0, 400.0]
    assert program.announcements(0.0)[0].size == 0
    assert Program((), (60.0,), (0.5, 0.2, 100.0)).announcements(60.0)[0].size == 0
    assert program.extremes == (0.3, 0.3, 0.7, 0.5, 0.2)
    assert Program((), (60.0,), (0.5, -0.2, 100.0)).extremes == (0.3, 0.7)


def test_a_sine_holds_only_where_a_share_is_asked_for_and_counts_from_the_beginning_of_the_program() -> None:
    """The hour without one is part of its period of 12 h; nothing is announced into the last phase or from it."""
    sine = Program((NAN, 0.5, NAN), (60.0, 600.0, 120.0), (0.5, 0.3, 720.0))
    wanted = sine.setpoint(np.array([0.0, 59.0, 60.0, 180.0, 540.0, 700.0, 5000.0]))
    np.testing.assert_allclose(wanted, [NAN, NAN, 0.35, 0.2, 0.8, NAN, NAN], atol=1e-9)
    assert told(sine, 180, 240.0) == pytest.approx((0.2, 0.65, 96.0))  # s(420) = .5 - .3 sin(7 pi / 6)
    assert told(sine, 500, 240.0)[2] == 0.0
    assert (sine.asked, Program((NAN, NAN), (60.0, 60.0)).asked) == (True, False)
    assert sine.edges.tolist() == [0.0, 60.0, 660.0, 780.0]
