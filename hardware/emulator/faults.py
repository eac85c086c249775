"""Faults of the emulated device, switched by name while it runs: in the same process or over HTTP."""

from itertools import product
from types import SimpleNamespace
from typing import Any

from hardware.emulator.sysdata import SLOTS

# name: (kind, allowed values, what it does)
#   kinds: board (of the whole device) and vial (of a reactor) are `Switches`; plant: a switch of the plant; act: once
FAULTS: dict[str, tuple[str, str, str]] = {
    "worker_wipe": ("act", "any", "the web worker is killed and replaced: state wiped, everything off"),
    "crash": ("act", "any", "the software ends itself (code 4): connections refused, power cut after 1 s"),
    "power_cut": ("act", "any", "the whole board loses power; its clock, without a battery, starts again in 2026"),
    "restart": (
        "act",
        "any",
        "somebody starts the crashed software again, with defaults; unplugged reactors are then absent",
    ),
    "clock_step": ("act", "seconds", "the board's clock is set forward, or back if negative"),
    "cycle_dead": ("act", "any", "the experiment thread of the reactor ends; Experiment.ON stays 1"),
    "marked_absent": (
        "act",
        "any",
        "one failed thermometer poll: present = 0, so the reactor's own threads end the software",
    ),
    "slow_s": ("board", "seconds >= 0", "network delay of every request"),
    "hang_s": ("board", "seconds >= 0", "duration of the next request; above 30 s the worker is killed"),
    "lost_request": ("board", "count", "half-open connection: the server never sees the request"),
    "lost_reply": ("board", "count", "the server acts, but its reply is lost"),
    "reset_before": ("board", "count", "connection reset, not acted on"),
    "reset_after": ("board", "count", "connection reset, acted on"),
    "malformed": ("board", "count", "getSysdata returns broken JSON"),
    "truncated": ("board", "count", "getSysdata sends half its body"),
    "lying": ("board", "count", "POST routes reply 204 and do nothing"),
    "bus_stuck": ("board", "0 or 1", "the bus lock is never released: POSTs reply 204, but pumps stay as they are"),
    "bus_stuck_when_pumping": ("board", "0 or 1", "bus_stuck as soon as a feed pump runs"),
    "disk_full": ("board", "0 or 1", "the next cycle cannot write its row and keeps the bus lock, as in bus_stuck"),
    "foreign_selects": ("board", "probability", "before a request, somebody's page selects another reactor"),
    "require_requested_with": ("board", "0 or 1", "fork: 403 for a POST without X-Requested-With"),
    "terminal_as_list": ("board", "0 or 1", "fork: Terminal.text is a list of lines"),
    "terminal_named": ("board", "0 or 1", "newer app: lines of the log name reactor and identity"),
    "extra_fields": ("board", "0 or 1", "fork: more fields in getSysdata"),
    "fp_off": ("act", "any", "somebody's web page switches the fluorescence slots off"),
    "unplugged": ("vial", "0 or 1", "cable out: the next access to the reactor ends the software"),
    "od_frozen": ("vial", "0 or 1", "the spectrometer repeats its last count"),
    "od_offset": ("vial", "OD", "added to every reading"),
    "od_jump": ("vial", "OD", "added to the next measurement only"),
    "spectrometer_dead": ("vial", "0 or 1", "raw = 1, OD reads 12 to 14"),
    "spectrometer_dark": ("vial", "0 or 1", "raw = 0, OD reads 0"),
    "spectrometer_glitch": ("vial", "probability", "a single reading fails (raw = 1)"),
    "feed_stuck_open": ("vial", "0 or 1", "Pump1 runs at full power whatever is commanded"),
    "waste_stuck_open": ("vial", "0 or 1", "Pump2 runs at full power whatever is commanded"),
    "heater_runaway": ("vial", "0 or 1", "heater at full power whatever is commanded"),
    "stirrer_dead": ("vial", "0 or 1", "the stirrer does not turn"),
    "internal_zero": (
        "vial",
        "count",
        "count of 0 readings of the air thermometer: each ends the thread that measures, and `OD.Measuring` stays 1",
    ),
    "pump_gain_factor": ("plant", "factor >= 0", "feed flow: 0 blocked, 0.5 weak, 1 sound"),
    "waste_gain_factor": ("plant", "factor >= 0", "waste flow: 0 blocked, 1 sound"),
    "overflow_gain_factor": ("plant", "factor >= 0", "flow of the overflow pump: 0 blocked, 1 sound"),
    "back_leak_ml": ("plant", "mL >= 0", "volume that siphons back after each feed pulse"),
    "media_left_ml": ("plant", "mL >= 0", "fresh medium left in the bottle; 0 = empty"),
    "mu_factor": ("plant", "factor >= 0", "growth rate relative to healthy"),
    "fp_frozen": ("plant", "0 or 1", "fluorescence, if the culture has any, repeats its last count"),
    "fp_dead": ("plant", "0 or 1", "fluorescence, if the culture has any, reads 0"),
    "fp_saturated": ("plant", "0 or 1", "fluorescence, if the culture has any, reads full scale"),
}
PLANT = {  # fault: part of the plant, its switch
    "pump_gain_factor": ("feed", "gain_factor"),
    "back_leak_ml": ("feed", "back_leak_ml"),
    "media_left_ml": ("feed", "media_left_ml"),
    "waste_gain_factor": ("vessel", "waste_gain_factor"),
    "overflow_gain_factor": ("vessel", "overflow_gain_factor"),
    "mu_factor": ("culture", "mu_factor"),
    "fp_frozen": ("fluorescence", "frozen"),
    "fp_dead": ("fluorescence", "dead"),
    "fp_saturated": ("fluorescence", "saturated"),
}
SIGNED = {"clock_step", "od_offset", "od_jump"}
TYPES = {"0 or 1": bool, "count": int}  # type of a switch, by its allowed values; else float


class Switches(SimpleNamespace):
    """Fault switches of a kind, "board" or "vial": one attribute each, which may be set at any time.

    A counter goes down with every use; -1 lasts until it is set to 0. Forks and newer apps: docs/device.md, Variants.
    """

    def __init__(self, kind: str) -> None:
        super().__init__(**{k: TYPES.get(allowed, float)() for k, (of, allowed, _) in FAULTS.items() if of == kind})

    def take(self, name: str) -> bool:
        """Return whether this counted fault is due, and count it down."""
        left: int = getattr(self, name)
        if left > 0:
            setattr(self, name, left - 1)
        return left != 0


def inject(device: Any, name: str, reactor: str = "all", value: float = 1.0) -> None:
    """Set fault `name` of `FAULTS` of a `ChiBioDevice` to `value`, at a reactor, M0 to M7, or at "all".

    Raises: ValueError for an unknown name, a position without reactor, or a value out of range.
    """
    if name not in FAULTS:
        raise ValueError(f"fault = {name}: allowed {', '.join(FAULTS)}")
    if reactor != "all" and reactor not in device.vials:
        raise ValueError(f"reactor = {reactor}: allowed all, {', '.join(device.vials)}")
    kind, allowed, _ = FAULTS[name]
    signed = name in SIGNED or (kind, allowed) == ("board", "count")  # these counts may be -1
    if value != value or (value < 0.0 and not signed):
        raise ValueError(f"{name} = {value}: allowed {allowed}")
    names = tuple(device.vials) if reactor == "all" else (reactor,)
    now = device.computer.now()
    if kind == "act":
        _act(device, name, names, value)
    elif kind == "board":
        setattr(device.faults, name, type(getattr(device.faults, name))(value))
    elif kind == "vial":
        for vial in (device.vials[m] for m in names):
            vial.set_fault(name, type(getattr(vial.faults, name))(value), now)
    else:
        for vial in (device.vials[m] for m in names):
            vial.sync(now)
            part, switch = PLANT[name]
            if owner := getattr(vial.plant, part):  # None: nothing fluoresces
                getattr(owner, switch)[:] = value


def _act(device: Any, name: str, names: tuple[str, ...], value: float) -> None:
    s = device.supervisor
    of_board = {"worker_wipe": s.kill_worker, "crash": s.crash, "power_cut": s.cut_power, "restart": s.restart}
    if name in of_board:
        of_board[name]()
    elif name == "marked_absent":
        for m in names:
            device.apps[m].data["present"] = 0
    elif name == "fp_off":
        for m, slot in product(names, SLOTS):
            device.apps[m].data[slot]["ON"] = 0
    elif name == "clock_step":
        device.computer.wall_offset_s += value
    else:
        for m in names:
            device.computer.events.remove(f"{m}/Experiment")
