"""Work on the bench in virtual time: what becomes of the counts that are averaged to a blank."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from hardware.chibio import messages
from hardware.chibio.procedures import dose_series, measure_blanks, warm_up
from hardware.clock import VirtualClock
from hardware.reactor import Measurement, Vitals
from tests.hardware.driver_lab import begun


def test_a_blank_is_the_mean_of_the_counts_of_its_own_reactor() -> None:
    lab = begun(("M0", "M1"), od=0.001, blanked=False)
    mean, sd = measure_blanks(lab.reactors, 5)
    for i, name in enumerate(lab.names):
        counts = [row["raw"] for row in lab.of("sample") if row["reactor"] == name][:5]
        assert len(set(counts)) == 5
        assert mean[i] == pytest.approx(sum(counts) / 5.0)
        assert sd[i] == pytest.approx(np.sqrt(sum((c - mean[i]) ** 2 for c in counts) / 4.0))
        assert lab.device.apps[name].data["OD0"]["target"] == pytest.approx(mean[i], abs=1e-6)


def test_no_blank_is_taken_while_something_is_wrong() -> None:
    lab = begun(od=0.001, blanked=False)
    before = lab.device.apps["M0"].data["OD0"]["target"]
    lab.clock.sleep(5.0)
    lab.device.handle("POST", "/SetOutputTarget/Pump1/M0/0.01")
    lab.device.handle("POST", "/SetOutputOn/Pump1/1/M0")
    with pytest.raises(messages.FaultsStand):
        measure_blanks(lab.reactors, 5)
    assert lab.device.apps["M0"].data["OD0"]["target"] == before


class Told:
    """Two reactors whose counts and temperatures are told minute by minute; `blanks` are those that were set."""

    def __init__(self, counts: list[tuple[float, float]], degc: list[tuple[float, float]]) -> None:
        self.names, self.config = ("M0", "M6"), SimpleNamespace(temperature=33.0)
        self.counts, self.degc, self.minute, self.blanks = counts, degc, 0, dict[str, float]()
        self.stations = [
            SimpleNamespace(set_blank=lambda v, name=name: self.blanks.update({name: v})) for name in self.names
        ]

    def elapsed(self) -> float:
        return 60.0 * self.minute

    def measure(self) -> Measurement:
        k, self.minute = min(self.minute, len(self.counts) - 1), self.minute + 1
        vitals = Vitals(np.zeros(2), np.array(self.counts[k]), (None, None))
        degc = np.array(self.degc[min(k, len(self.degc) - 1)])
        return Measurement(np.full(2, self.elapsed()), np.full(2, 0.0), degc, np.ones(2, bool), vitals)


@pytest.mark.parametrize(
    ("counts", "refused"),
    [
        ((3000.0, 3004.0), None),
        ((2990.0, 3000.0), (2995.0, 7.0)),
        ((59990.0, 60000.0), None),
        ((60000.0, 60010.0), (60005.0, 7.0)),
        ((14000.0, 14380.0), None),  # their sd is 1.9 % of their mean
        ((14000.0, 14420.0), (14210.0, 297.0)),
    ],
)
def test_a_blank_that_none_can_be_is_refused_and_no_reactor_is_set(counts: Any, refused: Any) -> None:
    told = Told([(12000.0, counts[0]), (12010.0, counts[1]), (99.0, 99.0)], [(33.0, 33.0)])
    if refused is None:
        mean, _ = measure_blanks(told, 2)  # type: ignore[arg-type]
        assert told.blanks == {"M0": 12005.0, "M6": pytest.approx(sum(counts) / 2.0)}
        assert mean[1] == told.blanks["M6"]
    else:
        with pytest.raises(messages.NoBlank) as error:
            measure_blanks(told, 2)  # type: ignore[arg-type]
        assert error.value.fields == {"reactor": "M6", "counts": refused[0], "sd": pytest.approx(refused[1], abs=0.5)}
        assert told.blanks == {}


def test_a_vial_that_does_not_become_warm_is_named_with_its_temperature() -> None:
    """The first is within 0.5 degC of its 33 all along, the second warms by half a degree a minute."""
    warming = [(33.4, 25.0 + 0.5 * k) for k in range(60)]
    told = Told([(9000.0, 9000.0)] * 60, warming)
    with pytest.raises(messages.NotWarm) as error:
        list(warm_up(told, 0.5, 6.5))  # type: ignore[arg-type]
    assert list(error.value.fields.values()) == ["M6", 28.0, 7.0, 33.0, 0.5]
    told = Told([(9000.0, 9000.0)] * 60, warming)
    said = list(warm_up(told, 0.5, 30.0, every_min=5.0))  # type: ignore[arg-type]
    assert said == [(1.0, 25.0), (6.0, 27.5), (11.0, 30.0), (16.0, 32.5)]
    assert told.minute == 17  # 32.5 and 33 degC are two samples in a row


class Pump:
    """A connection that remembers when it was asked for what."""

    name = "M2"

    def __init__(self, clock: VirtualClock, running: bool = False) -> None:
        self.clock, self.running, self.asked = clock, running, list[tuple[Any, ...]]()

    def read(self) -> Any:
        return SimpleNamespace(running=self.running)

    def pumps_off(self) -> None:
        self.asked.append((self.clock.now(), "off"))

    def target(self, pump: str, duty: float) -> None:
        self.asked.append((self.clock.now(), pump, duty))

    def switch(self, pump: str, on: bool) -> None:
        self.asked.append((self.clock.now(), pump, on))


def test_doses_that_are_weighed_last_as_long_as_the_device_takes_for_them() -> None:
    """63 s of a duty of 0.02, and 2 s in which the motor may start late; then 2 s of rest."""
    clock = VirtualClock()
    pump = Pump(clock)
    assert list(dose_series(pump, clock, "Pump2", 0.02, 3)) == [1, 2, 3]  # type: ignore[arg-type]
    assert pump.asked[:2] == [(0.0, "off"), (0.0, "Pump2", 0.02)]
    on, off = ([at for at, *what in pump.asked[2:] if what == words] for words in (["Pump2", True], ["off"]))
    assert on == pytest.approx([0.0, 5.26, 10.52])
    assert off[:3] == pytest.approx([3.26, 8.52, 13.78])
    assert off[3:] == [clock.now()]
    series = dose_series(pump, clock, "Pump1", 0.02, 9)  # type: ignore[arg-type]
    next(series)
    before = len(pump.asked)
    series.close()  # somebody has seen enough
    assert [what for _, *what in pump.asked[before:]] == [["off"]]
    with pytest.raises(messages.ExperimentRuns):
        next(dose_series(Pump(clock, running=True), clock, "Pump1", 0.02, 1))  # type: ignore[arg-type]
