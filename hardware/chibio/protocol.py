"""The Chi.Bio's protocol as pure functions: parse its state from JSON, check the few commands that a client may send.

Nothing here talks to a device. Sources: docs/device.md.
"""

import json
import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from hardware.chibio.messages import Forbidden, NotUnderstood

POSITIONS = tuple(f"M{k}" for k in range(8))
PUMPS = ("Pump1", "Pump2", "Pump3", "Pump4")
FEED, WASTE = "Pump1", "Pump2"
SPARE = ("Pump3", "Pump4")
"""Pumps without tubes on a standard reactor; one of them may be an overflow pump (`overflow_pump.py`)."""
MAX_OVERFLOW_DUTY = 0.95
"""Below 1, because the device does not switch a pump of duty 1 off between its periods (docs/device.md, Pumps)."""
PERIOD_S = 63.0
"""A pump that is ON runs at full power for PERIOD_S * target seconds of every PERIOD_S (docs/device.md, Pumps)."""
LEAST_ML = 10.0
"""Smallest culture volume that is sent to the device, mL."""
CONTROL_S = 60.0
"""One dose per cycle of the device: the control period, s."""
MAX_TEXT = 160
"""Characters kept of a text from the device; the longest relevant line of its log has 80."""
UNSET_BLANK = 65000.0
"""Blank of a device that lost its memory or was never calibrated (docs/device.md, Blank)."""
SLOTS = ("FP1", "FP2", "FP3")
"""Each measures fluorescence once per cycle while it is on (docs/device.md, Fluorescence)."""
LEDS = tuple(f"LED{k}" for k in "ABCDEFGHI")
BANDS = ("nm410", "nm440", "nm470", "nm510", "nm550", "nm583", "nm620", "nm670", "CLEAR")

_NUMBER = r"[0-9]{1,6}(?:\.[0-9]{1,12})?"
_LIMITS: Mapping[str, tuple[float, float]] = {
    "Pump1": (0.0, 0.05),  # a twentieth of full power; the on-board regulator stays below 0.02
    "Pump2": (0.0, 0.5),  # a waste dose must end before the next measurement
    "Pump3": (0.0, 0.0),
    "Pump4": (0.0, 0.0),
    "Stir": (0.0, 1.0),
    "Thermostat": (0.0, 42.0),  # the device has no over-temperature cut-off of its own
    "OD": (0.01, 1.5),
    "Volume": (LEAST_ML, 30.0),
}
_SWITCHES = (*PUMPS, "OD", "Stir", "Thermostat", "Heat")
PUMPING_MODES = ("Zigzag", "Custom", "Chemostat")
_MAY_GO_ON = ("Pump1", "Pump2", "OD", "Stir", "Thermostat")


@dataclass(frozen=True)
class Slot:
    """A fluorescence slot: whether it is on and, if so, its settings and last values.

    base: counts of the base band. emission: counts of `band` divided by `base`.
    """

    name: str
    on: bool
    led: str = ""
    base_band: str = ""
    band: str = ""
    gain: str = ""
    base: float = math.nan
    emission: float = math.nan

    @property
    def counts(self) -> float:
        """Counts of `band`, base times emission; nan where the base is not above 0."""
        return self.base * self.emission if self.base > 0.0 else math.nan


@dataclass(frozen=True)
class DeviceState:
    """The part of one reactor's state that a client needs. Times in s, temperatures in degC, blank and raw in counts.

    sample_s, sample_od, sample_temperature: last entries of the records; nan if there is none yet or the device was
    just replacing its lists. pumps_on, pump_targets: Pump1 to Pump4. regulating, regulation_target: the on-board OD
    regulation. modes: other modes that are on. slots: fluorescence slots that the device shows. spoilt: items that hold
    a nan; the device's thread ends when it saves them, in every tenth cycle.
    """

    selected: str
    present: tuple[str, ...]
    device_id: str
    version: str
    running: bool
    cycles: int
    start_time: str
    sample_s: float
    sample_od: float
    sample_temperature: float
    measuring: bool
    raw: float
    blank: float
    temperature: float
    pumps_on: tuple[bool, ...]
    pump_targets: tuple[float, ...]
    stirring: bool
    stir_target: float
    heating: bool
    temperature_target: float
    regulating: bool
    regulation_target: float
    modes: tuple[str, ...]
    volume_ml: float
    terminal: str
    slots: tuple[Slot, ...] = ()
    spoilt: tuple[str, ...] = ()

    @property
    def running_pumps(self) -> tuple[str, ...]:
        return tuple(p for p, is_on in zip(PUMPS, self.pumps_on, strict=True) if is_on)

    @property
    def pumping_modes(self) -> tuple[str, ...]:
        return tuple(m for m in self.modes if m in PUMPING_MODES)

    @property
    def ended(self) -> bool:
        """Whether the log's newest line is "Experiment Stopped" or, in newer apps, "Experiment on M0 (ID) Stopped"."""
        return re.search(r"\bExperiment\b.*\bStopped\b", self.terminal) is not None

    @property
    def started(self) -> bool:
        """Whether the device remembers an experiment; False after a restart of its server."""
        return self.cycles > 0 or "Waiting" not in self.start_time


def _get(data: Any, *keys: str) -> Any:
    for key in keys:
        if not isinstance(data, dict) or key not in data:
            raise NotUnderstood(what=f"field {'.'.join(keys)} is missing")
        data = data[key]
    return data


def _number(data: Any, *keys: str) -> float:
    value = _get(data, *keys)
    if isinstance(value, (int, float)) and not isinstance(value, bool):
        try:
            return float(value)
        except OverflowError:
            pass
    raise NotUnderstood(what=f"{'.'.join(keys)} = {str(value)[:40]!r}, expected a number")


def _flag(data: Any, *keys: str) -> bool:
    value = _get(data, *keys)
    if value in (0, 1):  # also True, False, 0.0 and 1.0
        return bool(value)
    raise NotUnderstood(what=f"{'.'.join(keys)} = {str(value)[:40]!r}, expected 0 or 1")


def _line(text: str) -> str:
    """Return printable ASCII of limited length, because the journal stores the device's texts."""
    return re.sub(r"[^ -~]", "?", text[:MAX_TEXT])


def _text(data: Any, *keys: str) -> str:
    value = _get(data, *keys)
    if isinstance(value, str):
        return _line(value)
    raise NotUnderstood(what=f"{'.'.join(keys)} = {str(value)[:40]!r}, expected text")


def _newest(data: Any) -> tuple[float, ...]:
    """Return the last entries of the three records, nan while the lists differ in length (an agent sends lengths)."""
    lists = {name: _get(data, name, "record") for name in ("time", "OD", "ThermometerIR")}
    if not all(isinstance(x, list) for x in lists.values()):
        raise NotUnderstood(what="a record is not a list")
    cut = data.get("_records")
    lengths = {_number(cut, name) if isinstance(cut, dict) else len(x) for name, x in lists.items()}
    whole = len(lengths) == 1 and 0 < min(lengths) < math.inf
    return tuple(_number({"last": x[-1]}, "last") if whole and x else math.nan for x in lists.values())


def _terminal(data: Any) -> str:
    """Return the newest line of the text log; some forks keep a list instead of a text."""
    text = data.get("Terminal", {})
    text = text.get("text", "") if isinstance(text, dict) else ""
    if isinstance(text, list):
        text = text[0] if text else ""
    return _line(str(text)[:400].split("</br>", 1)[0])


def _slot(data: Any, name: str) -> Slot:
    """Parse a slot; settings are empty and values nan where it is off."""
    on, entry = _flag(data, name, "ON"), _get(data, name)
    if not (on and "LED" in entry):
        return Slot(name, on)
    led, base_band, band, gain = (_text(data, name, key) for key in ("LED", "BaseBand", "Emit1Band", "Gain"))
    return Slot(name, on, led, base_band, band, gain, _number(data, name, "Base"), _number(data, name, "Emit1"))


def parse_state(body: bytes) -> DeviceState:
    """Parse the answer to GET /getSysdata/; ignore unknown fields, accept NaN as a number. Raises: ProtocolError."""
    try:
        data = json.loads(body)
    except (ValueError, RecursionError) as error:
        raise NotUnderstood(what=f"not JSON ({str(error)[:80]}): {body[:60]!r}") from error
    if not isinstance(data, dict):
        raise NotUnderstood(what=f"expected an object, got {body[:60]!r}")
    present = _get(data, "presentDevices")
    sample_s, sample_od, sample_temperature = _newest(data)
    cycles = _number(data, "Experiment", "cycles")
    if not (math.isfinite(cycles) and -1 <= cycles < 1e9):
        raise NotUnderstood(what=f"Experiment.cycles = {cycles}, expected a count")
    return DeviceState(
        selected=_text(data, "UIDevice"),
        present=tuple(m for m in POSITIONS if isinstance(present, dict) and m in present and _flag(present, m)),
        device_id=_text(data, "DeviceID"),
        version=_line(str(data["Version"].get("value", ""))) if isinstance(data.get("Version"), dict) else "",
        running=_flag(data, "Experiment", "ON"),
        cycles=int(cycles),
        start_time=_text(data, "Experiment", "startTime"),
        sample_s=sample_s,
        sample_od=sample_od,
        sample_temperature=sample_temperature,
        measuring=_flag(data, "OD", "Measuring"),
        raw=_number(data, "OD0", "raw"),
        blank=_number(data, "OD0", "target"),
        temperature=_number(data, "ThermometerIR", "current"),
        pumps_on=tuple(_flag(data, p, "ON") for p in PUMPS),
        pump_targets=tuple(_number(data, p, "target") for p in PUMPS),
        stirring=_flag(data, "Stir", "ON"),
        stir_target=_number(data, "Stir", "target"),
        heating=_flag(data, "Thermostat", "ON"),
        temperature_target=_number(data, "Thermostat", "target"),
        regulating=_flag(data, "OD", "ON"),
        regulation_target=_number(data, "OD", "target"),
        modes=tuple(n for n in (*PUMPING_MODES, "Light", *SLOTS) if n in data and _flag(data, n, "ON")),
        volume_ml=_number(data, "Volume", "target"),
        terminal=_terminal(data),
        slots=tuple(_slot(data, n) for n in SLOTS if n in data),
        spoilt=tuple(key for key, item in data.items() if "NaN" in json.dumps(item)) if b"NaN" in body else (),
    )


@dataclass(frozen=True)
class Permitted:
    """Reactors that a client may command, and commands beyond those of the standard hardware.

    reactors: positions that the client controls. overflow_pump: spare pump that may be switched on; "" if none may.
    slot_command: the only permitted toggle, of the selected reactor's fluorescence slot; "" if none is. supply_pumps:
    spare pumps that may give doses.
    """

    reactors: Sequence[str]
    overflow_pump: str = ""
    slot_command: str = ""
    supply_pumps: Sequence[str] = ()


def check_command(path: str, permitted: Permitted) -> None:
    """Check a command before it is sent: a known POST, for a permitted reactor, within the limits.

    A spare pump may run only as the overflow pump, or as a supply pump within the limits of the feed. All other
    commands of the device erase, toggle or end something (docs/device.md, Routes and Client rules).

    Raises: DeviceStateError if the command is not permitted.
    """
    if permitted.slot_command and path == permitted.slot_command:
        return
    spare = {pump: _LIMITS[FEED] for pump in permitted.supply_pumps if pump in SPARE}
    if permitted.overflow_pump in SPARE:
        spare[permitted.overflow_pump] = (0.0, MAX_OVERFLOW_DUTY)
    limits, allowed, name = {**_LIMITS, **spare}, False, ""
    match path.split("/"):
        case ["", "changeDevice", name] | ["", "MeasureTemp", "IR", name] | ["", "Experiment", "0" | "1", name]:
            allowed = True
        case ["", "SetOutputTarget", item, name, value] if item in limits and re.fullmatch(_NUMBER, value):
            low, high = limits[item]
            allowed = low <= float(value) <= high
        case ["", "SetOutputOn", item, "0" | "1" as force, name] if item in _SWITCHES:
            allowed = force == "0" or item in (*_MAY_GO_ON, *spare)
        case ["", "CalibrateOD", "OD0", name, raw, "0"] if re.fullmatch(_NUMBER, raw):
            allowed = 3000.0 <= float(raw) <= 60000.0
    if not (allowed and name in permitted.reactors and name in POSITIONS):
        raise Forbidden(path=path[:80], reactors=", ".join(permitted.reactors))
