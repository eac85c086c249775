"""Schedules at their corners and in between."""

from __future__ import annotations

import pytest

from dqn.schedules import decayed, linear


@pytest.mark.parametrize(("step", "expected"), [(0, 1.0), (250, 0.525), (500, 0.05), (501, 0.05), (10**6, 0.05)])
def test_linear(step: int, expected: float) -> None:
    assert linear(1.0, 0.05, 500, step) == pytest.approx(expected)


def test_linear_of_no_length_is_its_end() -> None:
    assert linear(1.0, 0.05, 0, 0) == 0.05


@pytest.mark.parametrize(("step", "expected"), [(0, 2.0), (699, 2.0), (700, 2.0), (850, 1.0), (1000, 0.0), (1001, 0.0)])
def test_decay_over_the_last_part(step: int, expected: float) -> None:
    assert decayed(2.0, 0.3, 1000, step) == pytest.approx(expected)


def test_no_decay() -> None:
    assert decayed(2.0, 0.0, 1000, 999) == 2.0
    assert decayed(2.0, 0.0, 1000, 5000) == 2.0
