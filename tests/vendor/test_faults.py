"""A short form of `python -m tests.vendor`: what befell the driver first when it met the vendor's app."""

import os
import re
from pathlib import Path

import pytest

from tests.vendor.bench import missing
from tests.vendor.faults import FAULTS, PLANTED, play

SHORT = (
    "stopped in measuring, then deploy",
    "thread dead in measuring, in a run",
    "cable out 3 min in a dose, agent",
    "feed-on heard 2.65 s late",
)
BY_NAME = {fault.name: fault for fault in FAULTS + PLANTED}
needs_app = pytest.mark.skipif(bool(missing()), reason=missing() or "")


@pytest.fixture(scope="module")
def work(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("vendor")


@needs_app
@pytest.mark.timeout(900)
@pytest.mark.parametrize("name", SHORT)
def test_a_fault_is_told_counted_and_over(name: str, work: Path) -> None:
    assert play("app", BY_NAME[name], work, unit=os.getpid() % 900)["failures"] == []


@needs_app
@pytest.mark.slow
@pytest.mark.timeout(3600)
@pytest.mark.parametrize("name", [fault.name for fault in FAULTS if fault.name not in SHORT])
def test_every_fault_is_told_counted_and_over(name: str, work: Path) -> None:
    assert play("app", BY_NAME[name], work, unit=os.getpid() % 900)["failures"] == []


@needs_app
@pytest.mark.slow
@pytest.mark.timeout(3600)
@pytest.mark.parametrize("name", [fault.name for fault in PLANTED])
def test_the_judge_finds_what_is_planted(name: str, work: Path) -> None:
    failures = play("app", BY_NAME[name], work, unit=os.getpid() % 900)["failures"]
    assert any(re.search("booked|false|strays", failure) for failure in failures)
