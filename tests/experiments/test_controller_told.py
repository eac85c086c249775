"""What the loop tells a controller: readings that the interlock believes, and what was really dosed."""

from dataclasses import dataclass

import numpy as np
import pytest

from envs.scenario import Scenario
from envs.task import EnvConfig
from experiments.laws.base import Array, Mask
from experiments.laws.density.inverse import Inverse, InverseConfig
from hardware.emulator.device import DeviceOptions
from hardware.emulator.vial import VialConfig
from tests.hardware.driver_lab import DriverLab, Law

QUIET = DeviceOptions(vial=VialConfig(outlier_rate=0.0))


@dataclass
class Call:
    """What a controller was shown once."""

    od: float
    row: bool
    minute: float


class Listening(Law):
    """Remembers what it is shown of the first reactor, and what it is told was dosed there."""

    def __init__(self, rate: float | None = None) -> None:
        self.rate, self.calls, self.told = rate, list[Call](), 0.0

    def act(self, od: Array, setpoint: Array, minute: Array, rows: Mask) -> Array:
        self.calls.append(Call(float(od[0]), bool(rows[0]), float(minute[0])))
        return super().act(od, setpoint, minute, rows)

    def dosed(self, volume_ml: Array) -> None:
        self.told += float(volume_ml[0])


def begun(od: float, scenario: Scenario, rate: float | None = None) -> tuple[DriverLab, Listening]:
    lab, law = DriverLab(od=od, options=QUIET, scenario=scenario), Listening(rate)
    lab.loop.density.law = law
    lab.reactors.begin()
    return lab, law


def jump(lab: DriverLab) -> None:
    """The next reading is 0.3 too high; up to that."""
    lab.fault("od_jump", 0.3)
    while not lab.step().rows[0]:
        pass
    assert "jump" in str(lab.steps[-1].reasons[0])
    assert lab.steps[-1].od[0] > 0.85


def test_a_reading_that_is_not_believed_begins_no_schedule_and_is_not_shown() -> None:
    lab, law = begun(0.6, Scenario((0.8,), (600.0,), (37.0,), recovery_od=0.8))
    lab.run(4)
    jump(lab)
    assert np.isnan(lab.loop.began[0])
    while np.isnan(lab.loop.began[0]):
        lab.step()
    assert lab.truth()["od"] == pytest.approx(0.8, abs=0.02)
    assert not any(call.row for call in law.calls[:-1])
    assert law.calls[-1].row
    lab.run(4)
    jump(lab)
    assert np.isnan(law.calls[-1].od)
    assert not law.calls[-1].row
    assert lab.steps[-1].proposed[0] == 0.0
    lab.run(2)
    assert law.calls[-1].row
    assert all(call.od < 0.87 for call in law.calls if call.row)


@pytest.mark.parametrize(
    ("looks", "then"),
    [(0, "kept for the next dose"), (1, "no dose: "), (4, "no dose: ")],
    ids=["put off", "late", "later"],
)
def test_a_controller_is_told_what_was_given_put_off_refused_and_repeated(looks: int, then: str) -> None:
    """looks: at a silent device, by so many the link is back later, so that a sample is seen in time or too late."""
    lab, law = begun(0.5, Scenario((0.5,), (600.0,), (37.0,)), rate=0.004)
    lab.run(12)  # 0.24 mL are less than the pump can deliver: every second dose gives them together
    asked_ml = 60.0 * sum(step.rate[0] for step in lab.steps if step.rows[0])
    assert law.told == pytest.approx(asked_ml, abs=1e-3)
    assert 0.0 < lab.fed[0] < asked_ml
    while lab.steps[-1].volume_ml[0] == 0.0:
        lab.step()
    lab.fault("lost_request", -1.0)  # in the middle of a dose, which the device repeats
    doses = lab.loop.reactors.stations[0].doses  # type: ignore[attr-defined]
    before_ml, fed_ml, carry_ml = law.told, lab.fed[0], doses.carry_ml
    lab.run(20)
    assert law.told == before_ml
    for _ in range(looks):
        lab.step()
    lab.fault("lost_request", 0.0)
    while not lab.step().rows[0]:
        pass
    assert law.told - before_ml == pytest.approx(lab.fed[0] - fed_ml + doses.carry_ml - carry_ml, abs=1e-3)
    assert law.told - before_ml > 15 * 0.45
    assert then in str(lab.steps[-1].notes)
    assert lab.steps[-1].rate[0] > 0.0
    assert doses.carry_ml == pytest.approx(0.0 if "no dose" in then else 0.24)


def test_half_an_hour_without_a_dose_teaches_nothing_wrong() -> None:
    """Growth and pump are as the model says; doses that were asked for are not given."""
    model = EnvConfig(mu=0.025)
    inverse = Inverse(InverseConfig(), model)
    inverse.reset(1)
    one, setpoint, log_od, given = np.ones(1, dtype=bool), np.array([0.8]), np.log(0.8), 0.0
    for minute in [*range(10), *range(40, 80)]:
        log_od += 0.025 * (30.0 if minute == 40 else 1.0) - given / 20.0
        rate = inverse.act(np.exp([log_od]), setpoint, np.array([float(minute)]), one)
        given = 0.0 if 9 <= minute < 43 else 60.0 * rate[0]
        inverse.dosed(np.array([given]))
    seen = inverse.explain()
    assert seen["mu"][0] == pytest.approx(0.025, abs=0.001)
    assert seen["gain"][0] == pytest.approx(1.0, abs=0.05)
    assert np.exp(log_od) == pytest.approx(0.8, abs=0.01)
