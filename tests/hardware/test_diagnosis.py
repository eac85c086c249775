"""What a state that was read means: one list of checks, the gravest first, without a device."""

import json
import math
from dataclasses import replace
from typing import Any

import pytest

from hardware.chibio import messages
from hardware.chibio.config import ChiBioConfig
from hardware.chibio.diagnosis import diagnose, fault_of, regulates
from hardware.chibio.protocol import DeviceState, parse_state
from hardware.errors import DeviceStateError, IdentityError, LinkError, ProtocolError, ReactorError
from hardware.messages import Fault, OverflowPumpFault
from tests.hardware.script import state

CONFIG = ChiBioConfig()


def read(**values: Any) -> DeviceState:
    return parse_state(json.dumps(state(**values)).encode())


SOUND = replace(read(), running=True, cycles=5, blank=15000.0)
EXPECTED = {
    "start_time": SOUND.start_time, "blank": 15000.0, "setpoint": math.nan, "dosing": False, "stuck": "",
    "ended": "", "overflow_trouble": None,
}  # fmt: skip
ON = (True, False, False, False)


@pytest.mark.parametrize(
    ("found", "expected", "age_s", "kind"),
    [
        ({}, {}, 0.0, None),
        ({}, {"start_time": "earlier"}, 0.0, "restarted"),
        ({"running": False}, {}, 0.0, "stopped"),
        ({"running": False}, {"ended": "no sample"}, 0.0, "stopped"),
        ({}, {"ended": "no sample"}, 0.0, None),
        ({"cycles": 0, "start_time": "Waiting"}, {"start_time": "Waiting"}, 0.0, "restarted"),
        ({"blank": 65000.0}, {}, 0.0, "blank"),
        ({"blank": 15000.5}, {}, 0.0, None),
        ({"blank": 14999.4}, {}, 0.0, "blank"),
        ({}, {"stuck": "Pump1 still on"}, 0.0, "pump"),
        ({"pumps_on": ON}, {}, 0.0, "pump"),
        ({"pumps_on": ON}, {"dosing": True}, 0.0, None),
        ({"modes": ("Chemostat",)}, {}, 0.0, "mode"),
        ({"modes": ("Light",)}, {}, 0.0, None),
        ({"regulating": True}, {}, 0.0, "mode"),
        ({"regulating": True, "regulation_target": 0.5, "pumps_on": ON}, {"setpoint": 0.5}, 0.0, None),
        ({"regulating": True, "regulation_target": 0.6}, {"setpoint": 0.5}, 0.0, "mode"),
        ({"regulating": False}, {"setpoint": 0.5}, 0.0, "mode"),
        ({}, {}, CONFIG.stale_s, None),
        ({}, {}, CONFIG.stale_s + 0.1, "stalled"),
        (
            {},
            {"overflow_trouble": OverflowPumpFault("off")},
            0.0,
            "overflow_pump",
        ),
        ({"running": False, "blank": 65000.0}, {"stuck": "on"}, 999.0, "stopped"),
    ],
)
def test_each_fault_by_itself_and_the_gravest_first(
    found: dict[str, Any], expected: dict[str, Any], age_s: float, kind: str | None
) -> None:
    fault = diagnose(replace(SOUND, **found), CONFIG, age_s=age_s, **{**EXPECTED, **expected})
    assert (fault.kind if fault else None) == kind


@pytest.mark.parametrize(
    ("found", "expected", "told"),
    [
        ({"modes": ("Chemostat",)}, {}, messages.ForeignMode(mode="Chemostat")),
        ({"running": False}, {}, messages.EndedBySomebody()),
        ({"running": False}, {"ended": "Pump1 still on"}, messages.EndedByUs(why="Pump1 still on")),
        ({"pumps_on": (True, False, False, True)}, {}, messages.StrayPump(pumps="Pump1, Pump4")),
    ],
)
def test_a_fault_says_what_it_saw(found: dict[str, Any], expected: dict[str, Any], told: Fault) -> None:
    fault = diagnose(replace(SOUND, **found), CONFIG, age_s=0.0, **{**EXPECTED, **expected})
    assert fault is not None
    assert fault.row == told.row


@pytest.mark.parametrize(
    ("error", "present", "kind"),
    [
        (LinkError("no answer"), True, "link"),
        (ProtocolError("garbage"), False, "link"),
        (IdentityError("another"), False, "identity"),
        (DeviceStateError("shows M1"), True, "selection"),
        (DeviceStateError("absent"), False, "absent"),
    ],
)
def test_what_an_error_of_a_read_means(error: ReactorError, present: bool, kind: str) -> None:
    fault = fault_of(error, present)
    assert (fault.kind, fault.fields) == (kind, {"error": error})


def test_a_sample_is_stalled_by_the_age_that_is_set_and_a_restart_by_another() -> None:
    slow = ChiBioConfig(stale_s=150.0, lost_s=420.0)
    assert diagnose(SOUND, slow, age_s=149.0, **EXPECTED) is None
    fault = diagnose(SOUND, slow, age_s=151.0, **EXPECTED)
    assert fault is not None
    assert (fault.kind, fault.fields) == ("stalled", {"age_s": 151.0, "cycles": 5, "lost_s": 420.0})


@pytest.mark.parametrize(("on", "target", "as_left"), [(1, 0.5, True), (1, 0.503, False), (0, 0.5, False)])
def test_a_device_regulates_at_the_setpoint_it_was_left_with_alone(on: int, target: float, as_left: bool) -> None:
    found = read(OD__ON=on, OD__target=target)
    assert regulates(found, 0.5) is as_left
    assert not regulates(found, math.nan)
