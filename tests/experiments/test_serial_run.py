"""The serial line as a run has it, with the cable pulled and plugged in again."""

import json

import pytest

from hardware.emulator.process import EmulatorProcess
from hardware.errors import LinkError
from hardware.link.serial import SerialTransport
from tests.hardware.test_serial_transport import Cable, cable, config  # noqa: F401  (cable is a fixture)

TOGGLE = "/SetOutputOn/Pump3/2/M0"


def test_a_line_that_was_unplugged_is_reopened_and_carries_out_nothing_twice(
    cable: tuple[Cable, EmulatorProcess],  # noqa: F811
) -> None:
    line, _ = cable
    link = SerialTransport(str(line.pc), 60.0, config(line.pc, floor_s=2.0))  # a busy machine may be late
    link.post("/SetOutputTarget/Pump3/M0/0.001")
    for k in range(1, 4):
        assert link.post(TOGGLE).status == 204
        line.unplug()
        for _ in range(2):
            with pytest.raises(LinkError):
                link.post(TOGGLE)
        line.plug()
        assert json.loads(link.get("/getSysdata/").body)["Pump3"]["ON"] == k % 2
    link.close()
