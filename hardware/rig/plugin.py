"""Plugin of the vendor's software in the rig: it connects the vendor's mock sensor and pumps to the simulated vials.

This file is copied into the vendor's plugin folder and imported there, never here; it imports nothing of this project.
A request is one JSON datagram to the rig, and so is its answer.
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
REUSE_S = 0.1  # time for which a value is reused; a reading averages forty values within a second
REFERENCE = 0.1  # V of the photodiode that faces the lamp
NOISE = 0.02  # sd of one value, as a fraction; a reading averages forty values


def ask(what: dict[str, Any], timeout_s: float = 0.5) -> dict[str, Any]:
    """Send a request to the rig and return its answer; {} after the time-out."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as wire:
        wire.settimeout(timeout_s)
        try:
            wire.sendto(json.dumps({"unit": UNIT, "pid": os.getpid(), **what}).encode(), ("127.0.0.1", int(PORT)))
            answer: dict[str, Any] = json.loads(wire.recv(4096))
            return answer
        except OSError:
            return {}


def leave_with_the_rig() -> None:
    """End this process when the rig has not answered for a minute, because it was killed."""
    silent = 0
    while silent < 12:
        time.sleep(5.0)
        silent = 0 if ask({"ask": "truth"}) else silent + 1
    os._exit(1)


def install() -> None:
    """Replace the vendor's mock sensor, pumps and thermometer by those of the simulated vials."""
    mock: Any = importlib.import_module("pioreactor.utils.mock")
    pwm: Any = importlib.import_module("pioreactor.utils.pwm")
    utils, config = importlib.import_module("pioreactor.utils"), importlib.import_module("pioreactor.config").config
    seen: dict[str, Any] = {"at": -1.0, "volts": 0.0}

    def look() -> dict[str, Any]:
        if time.monotonic() - seen["at"] > REUSE_S:
            seen.update(at=time.monotonic(), volts=ask({"ask": "volts"}).get("volts", 0.0))
        with utils.local_intermittent_storage("leds") as leds:  # newer versions read dark and lit within 0.1 s
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
        """A pin whose duty acts on the rig's vial; as on a unit, a process that opens the pin first switches it off."""

        def __init__(self, pin: int, *args: Any, **values: Any) -> None:
            super().__init__(pin, *args, **values)
            self.dc = 0.0

        def start(self, initial_dc: float) -> None:
            super().start(initial_dc)
            self.dc = initial_dc

        def __setattr__(self, name: str, value: Any) -> None:
            super().__setattr__(name, value)
            if name == "dc":
                ask({"pin": int(self.pin), "dc": float(value)}, 10.0)  # the job waits until the pin is switched

    pwm.MockPWMOutputDevice = Output


if PORT:
    install()
    threading.Thread(target=leave_with_the_rig, daemon=True).start()
