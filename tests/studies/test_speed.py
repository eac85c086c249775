"""Timing in pairs: what is measured, in which unit, and against whom."""

from collections.abc import Callable
from itertools import count

import pytest

from experiments.cli import frame
from tests.studies import measurements
from tests.studies.measurements import Measurement, measure
from tests.studies.speed import GROUPS, SpeedConfig, table

pytestmark = pytest.mark.numeric


class Clock:
    """Time passes where it is told to."""

    def __init__(self) -> None:
        self.now = 0.0

    def takes(self, *seconds: float) -> Callable[[], None]:
        """Work of so many seconds, the last one for ever."""
        left = list(seconds)

        def work() -> None:
            self.now += left.pop(0) if len(left) > 1 else left[0]

        return work


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> Clock:
    made = Clock()
    monkeypatch.setattr(measurements.time, "perf_counter", lambda: made.now)
    return made


def test_the_ratio_is_the_rivals_time_over_ours_and_the_first_pair_is_thrown_away(clock: Clock) -> None:
    """The medians of five pairs are 4 and 20 ms; ours took 50 ms before, theirs 7 once."""
    ours, theirs = clock.takes(0.05, 0.002, 0.004), clock.takes(0.1, 0.02, 0.007, 0.02)
    found = measure(Measurement("sleep", "work", "slower", ours, theirs, "ms per item", 1e3, 2, 2.1), 5)
    assert (found["ours"], found["theirs"]) == (pytest.approx(2.0), pytest.approx(10.0))
    assert found["ratio"] == pytest.approx(5.0)
    assert found["ratio_range"] == pytest.approx([1.75, 10.0])
    assert found["within_limit"] is True
    assert measure(Measurement("s", "w", "r", ours, theirs, limit=0.003), 5)["within_limit"] is False
    assert measure(Measurement("s", "w", "r", ours, theirs), 5)["within_limit"] is None


def test_pairs_alternate() -> None:
    calls: list[str] = []
    ours, theirs = (lambda name=name: calls.append(name) for name in ("ours", "theirs"))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(measurements.time, "perf_counter", count().__next__)
        measure(Measurement("a", "w", "r", ours, theirs), 5)
    assert calls == ["theirs", "ours", "ours", "theirs"] * 3


def test_every_measurement_names_its_rival_and_does_its_work():
    measurements = [m for name in ("controllers", "mpc") for m in GROUPS[name]()]
    assert {m.name for m in measurements} >= {"closed loop, pi", "closed loop, dqn", "closed loop, inverse",
                                              "closed loop, mpc", "mpc solve, single"}  # fmt: skip
    assert all(m.rival for m in measurements)
    limits = {m.name: m.limit for m in measurements if m.name.startswith("closed loop")}
    assert limits == {
        "closed loop, pi": 1.0,
        "closed loop, dqn": 1.0,
        "closed loop, inverse": 1.0,
        "closed loop, mpc": 20.0,
    }
    found = [measure(m, 5) for m in measurements if m.name == "mpc solve, single"]
    assert "mpc solve, single" in table(found, 5, "here").csv()


def test_a_group_that_is_none_is_named_with_those_there_are() -> None:
    with pytest.raises(frame.UserError, match=r"groups = nothing: .*controllers"):
        frame.load(frame.compose("speed", ["groups=[nothing]"]), SpeedConfig())
