"""Fluorescence over real sockets: the driver and an emulator that is a process of its own, by HTTP and by a line."""

from collections.abc import Iterator
from pathlib import Path

import pytest

from hardware.chibio.config import ChiBioConfig
from hardware.chibio.dosing import ReactorCalibration
from hardware.chibio.fluorescence import FluorescenceSlotConfig
from hardware.chibio.reactors import ChiBioReactors
from hardware.clock import DeviceClock
from hardware.emulator.process import EmulatorProcess
from hardware.link.http import HttpTransport
from hardware.link.transport import Transport
from tests.hardware.test_emulator_server import Process
from tests.hardware.test_serial_link import Link

SPEED = 60.0


@pytest.fixture
def emulator() -> Iterator[EmulatorProcess]:
    arguments = ["--reactors", "M0,M1", "--plant", "coculture", "--od", "0.5", "--temperature", "33.2"]
    with EmulatorProcess([*arguments, "--speed", f"{SPEED:g}"]) as process:
        yield process


def counts(transport: Transport, names: tuple[str, ...], samples: int) -> dict[str, list[float]]:
    """What the driver reads of so many samples of each reactor; the experiments are ended."""
    slot = FluorescenceSlotConfig(measure=True)
    config = ChiBioConfig(reactors=names, speed=SPEED, temperature=33.2, fluorescence=slot)
    reactors = ChiBioReactors(transport, DeviceClock(SPEED), config, [ReactorCalibration()] * len(names))
    reactors.begin()
    found: dict[str, list[float]] = {name: [] for name in names}
    try:
        while min(map(len, found.values())) < samples:
            m = reactors.measure()
            assert m.fluorescence is not None
            for name, fresh, value in zip(names, m.fresh, m.fluorescence, strict=True):
                found[name] += [float(value)] * bool(fresh)
    finally:
        reactors.end()
    return found


def test_each_reactor_s_counts_come_over_http(emulator: EmulatorProcess) -> None:
    """Pigment starts at g p / mu_p = 5270 * 0.25 / 0.895 = 1472 counts; with 150 OD and the offset 1761."""
    found = counts(HttpTransport(emulator.url, SPEED), ("M0", "M1"), 2)
    for values in found.values():
        assert values == pytest.approx([1761.0] * len(values), rel=0.15)
    assert found["M0"] != found["M1"]


def test_they_come_through_the_agent_on_the_board_too(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    arguments = ("--plant", "coculture", "--od", "0.5", "--temperature", "33.2")
    monkeypatch.setattr("tests.hardware.test_serial_link.Process", lambda *given: Process(*given, *arguments))
    link = Link(tmp_path)
    try:
        assert counts(link.transport, ("M1",), 1)["M1"] == pytest.approx([1761.0], rel=0.15)
    finally:
        link.end()
