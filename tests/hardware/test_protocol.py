"""The device's language: states in, commands out, and everything that must never get through."""

import json
import math
from itertools import product
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from hardware.chibio.protocol import PUMPS, Permitted, check_command, parse_state
from hardware.errors import DeviceStateError, ProtocolError
from tests.hardware.script import state


def parse(data: Any) -> Any:
    return parse_state(json.dumps(data).encode())


def test_each_number_of_a_state_is_read_from_its_own_field() -> None:
    data = state(
        OD0__raw=9123.0, OD0__target=14567.0, ThermometerIR__current=36.4, ThermometerIR__record=[35.9],
        Thermostat__target=33.5, Thermostat__ON=0, Stir__target=0.6, OD__target=0.45, OD__ON=1, OD__Measuring=1,
        Volume__target=17.0, Pump1__target=0.01, Pump2__target=0.2, Pump3__target=0.3, Pump4__target=0.04, Pump4__ON=1,
        Experiment__cycles=7, time__record=[123.5], OD__record=[0.51], Experiment__startTime="2026-02-03 04:05:06",
    )  # fmt: skip
    found = parse(data)
    assert (found.raw, found.blank, found.temperature, found.temperature_target) == (9123.0, 14567.0, 36.4, 33.5)
    assert (found.sample_s, found.sample_od, found.sample_temperature) == (123.5, 0.51, 35.9)
    assert (found.heating, found.stirring, found.stir_target, found.volume_ml) == (False, True, 0.6, 17.0)
    assert (found.regulating, found.regulation_target, found.measuring, found.cycles) == (True, 0.45, True, 7)
    assert (found.pump_targets, found.running_pumps) == ((0.01, 0.2, 0.3, 0.04), ("Pump4",))
    assert (found.selected, found.present, found.running, found.started) == ("M0", ("M0", "M1"), True, True)
    assert (found.pumps_on, found.modes, found.start_time) == ((False, False, False, True), (), "2026-02-03 04:05:06")


def test_lists_that_are_just_being_replaced_hold_no_sample() -> None:
    data = state(time__record=[0.07, 60.1])
    assert math.isnan(parse(data).sample_s)
    assert math.isnan(parse(state(time__record=[], OD__record=[], ThermometerIR__record=[])).sample_s)


def test_the_lengths_that_the_serial_agent_sends_beside_its_cut_lists_count() -> None:
    data = state()
    data["_records"] = {"time": 30, "OD": 30, "ThermometerIR": 30}
    assert parse(data).sample_s == 0.07
    data["_records"]["OD"] = 29
    assert math.isnan(parse(data).sample_s)


def test_forks_with_a_list_terminal_extra_and_missing_fields() -> None:
    data = state(Terminal__text=["2026-01-01 00:00:01  - Experiment Stopped", "older"])
    data["Surprise"] = {"x": [1]}
    del data["Light"], data["Version"], data["biofilm"]
    assert parse(data).ended


@pytest.mark.parametrize(
    ("newest", "ended"),
    [
        ("Experiment {}Stopped", True),
        ("Experiment {}Stopping at end of cycle", False),
        ("Experiment {}Started", False),
        ("Cycle 4 {}Complete", False),
        ("Terminal {}Cleared", False),
    ],
)
@pytest.mark.parametrize("named", ["", "on M0 ", "on M0 (1000200030004000) "])
def test_only_the_newest_line_says_whether_an_experiment_has_ended(newest: str, ended: bool, named: str) -> None:
    """Older apps do not name the reactor."""
    for older in ("Experiment Stopped", "Experiment on M0 (1000200030004000) Stopped"):
        lines = [f"2026-01-01 00:02:00  - {newest.format(named)}", f"2026-01-01 00:01:00  - {older}"]
        assert parse(state(Terminal__text="</br>".join([*lines, ""]))).ended is ended
        assert parse(state(Terminal__text=lines)).ended is ended


def test_modes_that_act_on_their_own_are_named() -> None:
    assert parse(state(Zigzag__ON=1, FP2__ON=1)).modes == ("Zigzag", "FP2")


def test_nan_in_a_reading_is_a_reading_and_nan_in_a_flag_is_not() -> None:
    body = json.dumps(state()).replace("0.36", "NaN").encode()
    assert math.isnan(parse_state(body).sample_od)
    with pytest.raises(ProtocolError, match="OD.ON"):
        parse(state(OD__ON=math.nan))


@pytest.mark.parametrize(
    "body",
    [b"", b"{", b"[]", b"null", b"\xff\xfe", b"[" * 100_000, b"1" * 5000, b'{"UIDevice": "M0"}', b"<html>502</html>"],
)
def test_what_is_not_a_state_is_refused(body: bytes) -> None:
    with pytest.raises(ProtocolError):
        parse_state(body)


PATHS = [(group, key) for group, keys in state().items() if isinstance(keys, dict) for key in keys]
VALUES = st.one_of(
    st.none(), st.booleans(), st.integers(), st.floats(), st.text(max_size=5), st.just([]), st.just({}), st.just([None])
)


@settings(max_examples=100, deadline=None)
@given(st.sampled_from(PATHS), VALUES)
def test_any_value_in_any_field_parses_or_is_refused(path: tuple[str, str], value: Any) -> None:
    data = state()
    data[path[0]][path[1]] = value
    try:
        found = parse(data)
    except ProtocolError:
        return
    assert all(isinstance(flag, bool) for flag in (*found.pumps_on, found.running, found.regulating))


LIMITS = {  # of a target: smallest, largest; the pumps' signs and words that are none are tried beside
    "Pump1": (0.0, 0.05), "Pump2": (0.0, 0.5), "Thermostat": (0.0, 42.0), "Volume": (10.0, 30.0), "OD": (0.01, 1.5),
    "Stir": (0.0, 1.0),
}  # fmt: skip


@pytest.mark.parametrize("item", LIMITS)
def test_a_target_lies_within_its_limits(item: str) -> None:
    low, high = LIMITS[item]
    for value in (f"{low}", f"{high}", f"{high:.6f}", f"{0.5 * (low + high)}"):
        check_command(f"/SetOutputTarget/{item}/M0/{value}", Permitted(["M0"]))
    beyond = [f"{high * 1.003:.4f}", "-0.01", "nan", "inf", "1e-2", "1e2", ""] + [f"{low - 0.001}"] * (low > 0.0)
    for where, values in (("M0", beyond), ("M1", [f"{high}"]), ("0", [f"{high}"])):
        for value in values:
            with pytest.raises(DeviceStateError):
                check_command(f"/SetOutputTarget/{item}/{where}/{value}", Permitted(["M0"]))


ALLOWED = """
    /changeDevice/M0 /SetOutputOn/Pump1/1/M0 /SetOutputOn/Pump4/0/M0 /SetOutputOn/Heat/0/M0 /MeasureTemp/IR/M0
    /CalibrateOD/OD0/M0/14000.000000/0 /CalibrateOD/OD0/M0/3000/0 /CalibrateOD/OD0/M0/60000/0 /Experiment/1/M0
    /Experiment/0/M0
"""
REFUSED = """
    /SetOutputTarget/Pump3/M0/0.01 /SetOutputTarget/UV/M0/0.5 /SetOutputTarget/Pump1/M0/0.01/../1
    /SetOutputOn/Pump1/2/M0 /SetOutputOn/Pump3/1/M0 /SetOutputOn/Heat/1/M0 /SetOutputOn/Pump1/1/M1
    /SetOutputOn/Experiment/1/M0 /SetOutputOn/Zigzag/1/M0 /CalibrateOD/OD0/M0/2999/0
    /CalibrateOD/OD0/M0/60001/0 /CalibrateOD/OD0/M0/0/0 /CalibrateOD/OD0/M0/65000/0
    /CalibrateOD/OD0/M0/14000/1 /MeasureOD/M0 /MeasureTemp/Internal/M0 /Experiment/2/M0 /ExperimentReset
    /CharacteriseDevice/M0/C1 /scanDevices/all /Direction/Pump1/M0 /SetCustom/C1/0 /ClearTerminal/M0
    /changeDevice/M8 /changeDevice/0 changeDevice/M0 //changeDevice/M0 /changeDevice/M0/ /changeDevice/M0?x=1
    /
"""
WITH_OVERFLOW_PUMP = {  # by the pump that is configured
    "Pump3": ("/SetOutputTarget/Pump3/M0/0.950000 /SetOutputOn/Pump3/1/M0 /SetOutputOn/Pump4/0/M0", """
        /SetOutputTarget/Pump3/M0/0.9501 /SetOutputTarget/Pump3/M0/1 /SetOutputTarget/Pump3/M0/-0.1
        /SetOutputTarget/Pump3/M1/0.5 /SetOutputTarget/Pump4/M0/0.5 /SetOutputOn/Pump4/1/M0 /SetOutputOn/Pump3/2/M0
        /SetOutputTarget/Pump1/M0/0.06"""),
    "Pump4": ("/SetOutputTarget/Pump4/M0/0.1", "/SetOutputTarget/Pump3/M0/0.1"),
    "Pump1": ("", "/SetOutputTarget/Pump1/M0/0.06"), "Pump2": ("", "/SetOutputTarget/Pump2/M0/0.6"),
    "Heat": ("", "/SetOutputOn/Heat/1/M0"),
}  # fmt: skip


@pytest.mark.parametrize(
    ("pump", "allowed", "refused"),
    [
        ("", ALLOWED.split(), ["", *REFUSED.split()]),
        *((p, a.split(), r.split()) for p, (a, r) in WITH_OVERFLOW_PUMP.items()),
    ],
)
def test_what_may_be_sent_also_with_an_overflow_pump(pump: str, allowed: list[str], refused: list[str]) -> None:
    for path in allowed:
        check_command(path, Permitted(["M0"], pump))
    for path in refused:
        with pytest.raises(DeviceStateError):
            check_command(path, Permitted(["M0"], pump))


VERBS = ("SetOutputTarget", "SetOutputOn", "Experiment", "changeDevice", "CalibrateOD", "MeasureTemp")
WORDS = ("Pump1", "Pump2", "Pump3", "Stir", "OD0", "M0", "M1", "UV", "0", "1", "2", "-0.01", "0.02", "0.9", "nan", "")


@pytest.mark.parametrize("pump", ["", "Pump1", "Pump3"])
def test_no_combination_of_words_pumps_too_much_or_reaches_another_reactor(pump: str) -> None:
    passed = set()
    for words in (words for n in range(4) for words in product(VERBS, *n * [WORDS])):
        try:
            check_command("/" + "/".join(words), Permitted(["M0"], pump))
        except DeviceStateError:
            continue
        verb, *args = words
        passed.add(verb)
        assert "M1" not in args
        assert args.count("M0") == 1
        if verb == "SetOutputTarget" and args[0] in PUMPS:
            limits = {"Pump1": 0.05, "Pump2": 0.5, "Pump3": 0.95 if pump == "Pump3" else 0.0, "Pump4": 0.0}
            assert 0.0 <= float(args[2]) <= limits[args[0]]
        if verb == "SetOutputOn":
            assert args[0] in (*PUMPS, "OD", "Stir", "Thermostat", "Heat")
            assert args[1] in ("0", "1")
    assert passed == {"SetOutputTarget", "SetOutputOn", "Experiment", "changeDevice"}


def test_a_text_of_the_device_is_one_short_line_whatever_it_sends() -> None:
    long = "Mon\n" + "x" * 200_000
    data = state()
    data["Experiment"]["startTime"] = data["DeviceID"] = long
    data["Terminal"], data["Version"] = {"text": long}, {"value": long}
    found = parse(data)
    for text in (found.start_time, found.device_id, found.version, found.terminal):
        assert text == "Mon?" + "x" * 156
