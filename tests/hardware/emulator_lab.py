"""An emulated device without noise, and the few calls every test of it makes."""

import json
from typing import Any

import numpy as np

from envs.plant.culture import GrowthConfig
from envs.plant.plant import PlantConfig
from envs.plant.pump import PumpConfig
from hardware.clock import VirtualClock
from hardware.emulator.device import ChiBioDevice, DeviceOptions
from hardware.emulator.vial import VialConfig

BLANK = 14000.0
BIAS_S = 0.1  # every pump run is longer than asked by this
START_S = 0.45  # from the answer to a pump command until the motor turns
STOP_S = 0.09  # and until one that runs stands still


def quiet(mu: float = 0.0, **vial: Any) -> DeviceOptions:
    """No noise, known blank, constant pump bias and delay, a culture that grows with mu (1/min)."""
    fixed: dict[str, Any] = dict.fromkeys(("noise_fraction", "common_fraction", "outlier_rate", "stir_noise"), 0.0)
    fixed |= {"blank": (BLANK, BLANK), "on_time_bias_s": (BIAS_S, BIAS_S), "pump_start_s": (START_S, START_S)}
    plant = PlantConfig(growth=GrowthConfig(mu=mu), pump=PumpConfig(dosing="pulse"))
    return DeviceOptions(vial=VialConfig(**fixed | vial), plant=plant)


class Lab:
    """A device on a virtual clock and a client that asks it."""

    def __init__(self, reactors: tuple[str, ...] = ("M0", "M1"), mu: float = 0.0, seed: int = 0, **kwargs: Any) -> None:
        options = kwargs.pop("options", None) or quiet(mu)
        self.clock = VirtualClock()
        self.device = ChiBioDevice(reactors, self.clock, np.random.default_rng(seed), options, **kwargs)

    def post(self, path: str) -> int:
        """Status of a POST."""
        return self.device.handle("POST", path)[0]

    def pump(self, pump: str, target: float, on: bool = True, reactor: str = "M0") -> None:
        """Set a pump's target and switch it on."""
        self.post(f"/SetOutputTarget/{pump}/{reactor}/{target}")
        if on:
            self.post(f"/SetOutputOn/{pump}/1/{reactor}")

    def state(self, reactor: str = "M0") -> dict[str, Any]:
        """sysData of a reactor, as a client gets it."""
        assert self.post(f"/changeDevice/{reactor}") == 204
        status, body = self.device.handle("GET", "/getSysdata/")
        assert status == 200
        data: dict[str, Any] = json.loads(body)
        assert data["UIDevice"] == reactor
        return data

    def peek(self, reactor: str = "M0") -> dict[str, Any]:
        """sysData without asking for it: takes no device time."""
        self.device.run_until(self.clock.now())
        return self.device.apps[reactor].data

    def wait(self, seconds: float) -> None:
        """Let time pass."""
        self.clock.sleep(seconds)
        self.device.run_until(self.clock.now())

    def wait_until(self, at: float) -> None:
        """Let time pass up to device second `at`."""
        self.wait(at - self.clock.now())

    def doses(self, reactor: str = "M0", pump: str = "Pump1") -> list[tuple[float, float]]:
        """(start, length) of what the pump's motor did, s."""
        self.device.run_until(self.clock.now())
        return [(d.start_s, d.seconds) for d in self.device.vials[reactor].doses if d.pump == pump]


def running(*args: Any, wait: float = 0.0, **kwargs: Any) -> Lab:
    """A lab whose first reactor's experiment began `wait` seconds ago."""
    lab = Lab(*args, **kwargs)
    lab.post("/Experiment/1/M0")
    lab.wait(wait)
    return lab
