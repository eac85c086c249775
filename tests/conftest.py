"""What holds for every test."""

import os
import signal
import time
from collections.abc import Iterator

import pytest
from hypothesis import settings

from experiments.cli import extensions
from tests.programs import spent_s

extensions.load_all()

settings.register_profile("busy", deadline=None)  # a machine may be busy with other things
settings.load_profile("busy")

for _number in (signal.SIGINT, signal.SIGQUIT, signal.SIGHUP):
    if signal.getsignal(_number) is signal.SIG_IGN:  # a suite in the background; programs started by it would be deaf
        signal.signal(_number, signal.default_int_handler if _number == signal.SIGINT else signal.SIG_DFL)


def pytest_xdist_auto_num_workers() -> int:
    """One more than there are cores: a quarter of the tests' time is waiting, for a device or for another process."""
    return (os.cpu_count() or 1) + 1


FAST_CPU_S = 5.0  # of a test that is not marked slow, with its fixtures and the programs that it starts ...
PACE_S = 0.025  # ... on a machine that needs so long for `_pace_s`; a slower or busier one is allowed more
FAST = "not slow"  # in the expression of `make test`
_began = pytest.StashKey[float]()


def _cpu_s() -> float:
    """Return the processor time of this process, of those that it has waited for, and of forked programs, s."""
    times = os.times()
    return times.user + times.system + times.children_user + times.children_system + spent_s()


def _pace_s() -> float:
    """Return the most processor time of a piece of work done three times, s: a neighbour on the core comes and goes."""
    times = []
    for _ in range(3):
        began = time.process_time()
        sum(k * k for k in range(1_000_000))
        times.append(time.process_time() - began)
    return max(times)


@pytest.hookimpl(tryfirst=True)
def pytest_runtest_setup(item: pytest.Item) -> None:
    """Take the time before the first fixture."""
    item.stash[_began] = _cpu_s()


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport(item: pytest.Item) -> Iterator[None]:
    """Fail a test that is too slow for `make test`, so that those who run it after each change keep doing so."""
    report = yield
    used = _cpu_s() - item.stash.get(_began, _cpu_s())
    fast = item.get_closest_marker("slow") is None and item.get_closest_marker("campaign") is None
    asked = fast and report.when == "call" and report.passed and FAST in item.config.option.markexpr
    if asked and used > FAST_CPU_S and used > (allowed := FAST_CPU_S * _pace_s() / PACE_S):
        report.outcome = "failed"
        report.longrepr = f"{used:.1f} s of processor time, allowed {allowed:.1f}: make it faster, or mark it slow"
    return report
