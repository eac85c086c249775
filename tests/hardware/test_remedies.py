"""What is told of a device in trouble names what helps, and nothing that is not the cause."""

import json
import math
import threading

import pytest

from hardware.chibio import messages as chibio
from hardware.chibio.config import ChiBioConfig
from hardware.chibio.diagnosis import diagnose
from hardware.chibio.messages import NoNumber, NoSamples
from hardware.chibio.protocol import parse_state
from hardware.link.http import HttpTransport
from hardware.link.messages import NotAnswered, NotReached
from hardware.link.transport import TransportConfig
from hardware.messages import Fault
from hardware.pioreactor import messages as pioreactor
from tests.hardware.script import state
from tests.hardware.test_diagnosis import EXPECTED
from tests.hardware.test_http_transport import Server
from tests.patience import PATIENCE_S


@pytest.mark.parametrize("where", ["target", "record"])
def test_a_thread_that_no_number_ended_is_not_said_to_be_mended_by_a_restart_of_the_experiment(where: str) -> None:
    """The app's record keeps it after the pump has a target again."""
    changes = {"Pump3__target": math.nan} if where == "target" else {"Pump3__record": [0.0, math.nan, 0.0]}
    for changed, spoilt in ((changes, ("Pump3",)), ({}, ())):
        seen = parse_state(json.dumps(state(**changed)).encode())
        assert seen.spoilt == spoilt
        expected = {**EXPECTED, "start_time": seen.start_time, "blank": seen.blank}
        fault = diagnose(seen, ChiBioConfig(), age_s=150.0, **expected)
        assert type(fault) is (NoNumber if spoilt else NoSamples)


def test_who_is_not_reached_is_another_than_who_does_not_answer() -> None:
    server, over = Server(), threading.Event()
    server.behave = lambda c, _: over.wait(PATIENCE_S) and None  # takes the request, and does not answer
    link = HttpTransport(server.url, 1.0, TransportConfig(read_s=0.2, connect_s=0.2, floor_s=0.1))
    with pytest.raises(NotAnswered):
        link.get("/getSysdata/")
    over.set()
    server.close()
    with pytest.raises(NotReached):
        link.get("/getSysdata/")
    link.close()


def test_every_fault_that_a_driver_tells_says_what_helps() -> None:
    told = [m for room in (chibio, pioreactor) for m in vars(room).values() if isinstance(m, type)]
    assert [m.__name__ for m in told if issubclass(m, Fault) and m.says and not m.remedy] == []
