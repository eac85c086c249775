"""A short form of `python -m tests.vendor`: one fault whole, and the judge finds what is planted in the campaign."""

import os
import re

import pytest

from tests.vendor.bench import missing
from tests.vendor.faults import FAULTS, PLANTED, Fault, play

SHORT = "stopped in measuring, then blank"
WHOLE = [pytest.param(fault, id=fault.name, marks=pytest.mark.campaign) for fault in FAULTS if fault.name != SHORT]
NOW = [pytest.param(fault, id=fault.name, marks=pytest.mark.slow) for fault in FAULTS if fault.name == SHORT]
pytestmark = [pytest.mark.skipif(bool(missing()), reason=missing() or ""), pytest.mark.timeout(3600)]


def judged(fault: Fault, made: pytest.TempPathFactory) -> list[str]:
    work = made.getbasetemp() / "vendor"  # pumps are weighed once
    work.mkdir(exist_ok=True)
    failures: list[str] = play("app", fault, work, unit=os.getpid() % 900)["failures"]
    return failures


@pytest.mark.parametrize("fault", NOW + WHOLE)
def test_a_fault_is_told_counted_and_over(fault: Fault, tmp_path_factory: pytest.TempPathFactory) -> None:
    assert judged(fault, tmp_path_factory) == []


@pytest.mark.campaign
@pytest.mark.parametrize("fault", PLANTED, ids=lambda fault: fault.name)
def test_the_judge_finds_what_is_planted(fault: Fault, tmp_path_factory: pytest.TempPathFactory) -> None:
    assert any(re.search("booked|false|strays", failure) for failure in judged(fault, tmp_path_factory))
