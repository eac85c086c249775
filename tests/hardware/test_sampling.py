"""A sample by itself: new or not, how late it was seen, when to look again."""

import json
import math
from dataclasses import replace

import pytest

from hardware.chibio.config import ChiBioConfig
from hardware.chibio.messages import SampleBeforeLate, SampleLate
from hardware.chibio.protocol import DeviceState, parse_state
from hardware.chibio.sampling import CYCLE_S, FIRST_SAMPLE_S, Sampling
from hardware.clock import VirtualClock
from tests.hardware.script import state

CONFIG = ChiBioConfig()
STATE = parse_state(json.dumps(state()).encode())


def sample(time_s: float, cycles: int) -> DeviceState:
    return replace(STATE, sample_s=time_s, cycles=cycles, sample_od=0.4)


def take(sampling: Sampling, clock: VirtualClock, seen: DeviceState) -> str:
    assert sampling.look(seen, clock.now())
    return sampling.take(seen, clock.now())


def started() -> tuple[VirtualClock, Sampling]:
    """An experiment that was just started, at 1000 s, whose first sample is there now."""
    clock = VirtualClock(1000.0)
    sampling = Sampling(CONFIG, clock)
    sampling.expect_first()
    clock.sleep(FIRST_SAMPLE_S)
    return clock, sampling


def test_a_sample_is_new_once_and_never_goes_back() -> None:
    clock = VirtualClock()
    sampling = Sampling(CONFIG, clock)
    assert not sampling.look(sample(math.nan, 0), 0.0)
    take(sampling, clock, sample(60.0, 2))
    assert not sampling.look(sample(60.0, 2), 0.0)
    assert not sampling.look(sample(60.0, 3), 0.0)  # cycles counts cycles begun
    assert not sampling.look(sample(0.0, 1), 0.0)
    assert sampling.look(sample(120.0, 3), 0.0)
    sampling.key = None
    assert sampling.look(sample(0.0, 1), 0.0)
    sampling.pass_over(sample(0.0, 1))
    assert not sampling.look(sample(0.0, 1), 0.0)
    take(sampling, clock, sample(60.0, 3))  # seen so late that the next cycle had begun: it does not hide the next one
    assert [sampling.look(sample(*each), 0.0) for each in ((120.0, 3), (0.0, 2))] == [True, False]


def test_only_a_sample_that_was_waited_for_has_a_known_age() -> None:
    clock = VirtualClock(1000.0)
    sampling = Sampling(CONFIG, clock)
    take(sampling, clock, sample(0.0, 1))
    assert sampling.appeared_s == -math.inf
    assert sampling.next_look == clock.now() + CYCLE_S - 20.0  # it may have waited long: look early
    clock.sleep(50.0)
    sampling.not_taken(is_new=False)
    clock.sleep(2.0)
    take(sampling, clock, sample(60.0, 2))
    assert sampling.appeared_s == clock.now()
    assert sampling.next_look == clock.now() + CYCLE_S - 2.5
    clock.sleep(70.0)  # ten seconds later than possible
    take(sampling, clock, sample(120.0, 3))
    assert sampling.late_s == 10.0
    assert sampling.appeared_s == clock.now() - 10.0


def lateness(looks: list[tuple[float, bool, float]], clock: VirtualClock, sampling: Sampling) -> list[float]:
    """Of a sample a minute, each seen (so late, waited for or not); the device's clock set by so much then."""
    zero_s, late = clock.now(), []
    for k, (seen_s, waited, set_s) in enumerate(looks):
        clock.sleep(zero_s + 60.0 * k + seen_s - clock.now())
        if waited:
            sampling.not_taken(is_new=False)
        told = take(sampling, clock, sample(60.0 * k + set_s, k + 1))
        assert bool(told) == (k > 0 and set_s != looks[k - 1][2])
        late.append(sampling.late_s)
    return late


def test_lateness_is_measured_against_the_earliest_of_the_last_three_that_were_waited_for() -> None:
    clock = VirtualClock()
    sampling = Sampling(CONFIG, clock)
    seen = [(5.0, True), (3.0, True), (6.0, True), (4.0, True), (7.0, True), (2.0, True)]
    seen += [(5.0, False), (6.0, True), (6.5, True), (9.0, False), (1.0, False), (2.0, True)]
    late = lateness([(seen_s, waited, 0.0) for seen_s, waited in seen], clock, sampling)
    assert late == [0.0, 0.0, 3.0, 1.0, 3.0, 0.0, 3.0, 4.0, 4.5, 7.0, 0.0, 1.0]
    sampling.pass_over(sample(math.nan, 13))
    assert sampling.key == (660.0, 12)
    clock.sleep(55.0)
    take(sampling, clock, sample(720.0, 13))
    assert sampling.late_s == math.inf  # what was known of the offsets is forgotten


@pytest.mark.parametrize(("step_s", "told"), [(64.9, False), (65.0, True), (-29.9, False), (-30.0, True)])
def test_how_much_lateness_is_a_step_of_a_clock(step_s: float, told: bool) -> None:
    clock, sampling = started()
    take(sampling, clock, sample(0.0, 1))
    clock.sleep(60.0)
    said = take(sampling, clock, sample(60.0 - step_s, 2))
    kind = SampleLate if step_s > 0.0 else SampleBeforeLate
    assert said is None if not told else (type(said), said.fields) == (kind, {"late_s": abs(step_s)})


def test_after_every_step_of_the_boards_clock_lateness_is_counted_by_its_new_time() -> None:
    """By the time before a step a sample would be minutes late, and no dose would be given any more."""
    looks = [
        (0.0, True, 0.0), (4.0, False, 0.0),
        (0.0, False, -400.0), (0.0, True, -400.0), (9.0, False, -400.0),  # put back by a time server ...
        (0.0, False, -90.0), (0.0, True, -90.0), (5.0, False, -90.0),  # ... and put right later
        (0.0, False, 700.0), (1.0, True, 700.0), (3.0, False, 700.0),
    ]  # fmt: skip
    late = lateness(looks, *started())
    assert late == [0.0, 4.0, math.inf, 0.0, 9.0, math.inf, 0.0, 5.0, math.inf, 0.0, 2.0]


def test_looks_are_as_far_apart_as_is_set() -> None:
    clock = VirtualClock(500.0)
    sampling = Sampling(replace(CONFIG, poll_s=7.0), clock)
    assert sampling.next_look == sampling.arrived_s == 500.0
    sampling.look(sample(math.nan, 0), 500.0)
    assert sampling.next_look == 507.0


def test_a_sample_is_made_of_its_own_numbers() -> None:
    clock = VirtualClock(70.0)
    sampling = Sampling(CONFIG, clock)
    seen = replace(STATE, sample_s=60.0, cycles=2, sample_od=0.41, sample_temperature=36.2, raw=8123.0, blank=14321.0)
    take(sampling, clock, seen)
    found = (sampling.od, sampling.temperature, sampling.raw, sampling.blank, sampling.at, sampling.key)
    assert found == (0.41, 36.2, 8123.0, 14321.0, 70.0, (60.0, 2))
