"""What the vendor's software loads as a plugin in the rig: its mock sensor and pumps become those of our vials.

This file is copied beside the vendor's package and imported there, never here; it imports nothing of ours. A request is
one JSON datagram to the rig, which answers each with one.
"""

import importlib
import json
import os
import random
import socket
import threading
import time
from typing import Any

__all__: list[str] = []

UNIT, PORT = os.environ.get("HOSTNAME", ""), os.environ.get("TURBIDOSTAT_RIG_PORT", "")
REUSE_S = 0.1  # a reading averages forty looks within a second
REFERENCE = 0.1  # V of the photodiode that looks at the lamp
NOISE = 0.02  # sd of one look, as a fraction; forty of them are averaged


def ask(what: dict[str, Any], timeout_s: float = 0.5) -> dict[str, Any]:
    """Ask the rig; nothing after the timeout."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as wire:
        wire.settimeout(timeout_s)
        try:
            wire.sendto(json.dumps({"unit": UNIT, "pid": os.getpid(), **what}).encode(), ("127.0.0.1", int(PORT)))
            answer: dict[str, Any] = json.loads(wire.recv(4096))
            return answer
        except OSError:
            return {}


def leave_with_the_rig() -> None:
    """End this process when the rig does not answer any more: somebody killed it."""
    silent = 0
    while silent < 12:
        time.sleep(5.0)
        silent = 0 if ask({"ask": "truth"}) else silent + 1
    os._exit(1)


def install() -> None:
    """Put our sensor, pumps and thermometer in the place of the vendor's mock ones."""
    mock: Any = importlib.import_module("pioreactor.utils.mock")
    pwm: Any = importlib.import_module("pioreactor.utils.pwm")
    utils, config = importlib.import_module("pioreactor.utils"), importlib.import_module("pioreactor.config").config
    seen: dict[str, Any] = {"at": -1.0, "volts": 0.0}

    def look() -> dict[str, Any]:
        if time.monotonic() - seen["at"] > REUSE_S:
            seen.update(at=time.monotonic(), volts=ask({"ask": "volts"}).get("volts", 0.0))
        with utils.local_intermittent_storage("leds") as leds:  # newer versions take dark and lit looks within 0.1 s
            lit = float(leds.get(config.get("leds_reverse", "IR"), 0.0)) > 0.0
        return {"lit": lit, "volts": seen["volts"]}

    def read(self: Any) -> int:
        state = look()
        if not state["lit"]:
            return int(self.from_voltage_to_raw(self.OFFSET))
        volts = REFERENCE if self.adc_channel == 1 else state["volts"] * (1.0 + random.gauss(0.0, NOISE))
        return int(self.from_voltage_to_raw(volts + self.OFFSET))

    mock.Mock_ADC.read_from_channel = read
    mock.MockTMP1075.get_temperature = lambda self: float(ask({"ask": "temperature"}).get("temperature", 25.0))

    class Output(mock.MockPWMOutputDevice):  # type: ignore[misc]
        """A pin whose duty the rig's vial feels; as on a unit, whoever takes it switches it off first."""

        def __init__(self, pin: int, *args: Any, **values: Any) -> None:
            super().__init__(pin, *args, **values)
            self.dc = 0.0

        def start(self, initial_dc: float) -> None:
            super().start(initial_dc)
            self.dc = initial_dc

        def __setattr__(self, name: str, value: Any) -> None:
            super().__setattr__(name, value)
            if name == "dc":
                ask({"pin": int(self.pin), "dc": float(value)}, 10.0)  # a pin is switched before its job goes on

    pwm.MockPWMOutputDevice = Output


if PORT:
    install()
    threading.Thread(target=leave_with_the_rig, daemon=True).start()
