"""One position, M0 to M7, and its outputs: lights, laser, stirrer, heater, pumps."""

import math

from hardware.emulator.computer import AppError, Computer, ProcessDied, Steps
from hardware.emulator.sysdata import LIGHTS, PUMPS, SysData, add_terminal, fresh_sysdata
from hardware.emulator.vial import Vial, VialConfig

BUS_S = 0.02  # a register written and read back
PERIOD_FACTOR = 1.05  # pump period over cycle time: 63 s
OFF_SHARE, QUIET_SHARE = 0.2, 0.8  # of a pump's start delay: until a running motor stops; until the period begins


class Position:
    """State that outputs, optics and experiment of one reactor share; `data` is its sysData.

    Args: name: M0 to M7. vial: the plugged vial, None for an empty position. device_id: identity that its IR
      thermometer reports. selected: position that the web page shows.
    """

    def __init__(self, name: str, computer: Computer, vial: Vial | None, device_id: str, selected: str) -> None:
        self.name, self.computer, self.vial, self.device_id = name, computer, vial, device_id
        self.forget(selected)

    @property
    def answers(self) -> bool:
        return self.vial is not None and not self.vial.faults.unplugged

    def forget(self, selected: str) -> None:
        """Reset sysData as after power-on. A running thread keeps its parts of the old sysData, as on the device."""
        self.data: SysData = fresh_sysdata(self.device_id if self.answers else "", selected)
        self.terminal("System Initialised")

    def terminal(self, text: str) -> None:
        add_terminal(self.data, self.computer.stamp(), text)

    def spawn(self, steps: Steps, what: str) -> None:
        self.computer.spawn(steps, f"{self.name}/{what}")

    def hardware(self) -> Vial:
        """Return the reactor behind the bus. Raises: BusStuck, ProcessDied (absent or unplugged reactor)."""
        self.computer.bus(self.name)
        if self.data["present"] == 0 or self.vial is None or self.vial.faults.unplugged:
            raise ProcessDied(f"access to absent reactor {self.name}")
        return self.vial

    def measure_temperature(self, which: str) -> None:
        """Run `MeasureTemp`. Raises: AppError for an unknown name or an internal thermometer that does not answer."""
        if which not in ("IR", "Internal", "External"):
            raise AppError(f"no thermometer {which}")
        meter = self.data[f"Thermometer{which}"]
        self.computer.bus(self.name)
        if which == "Internal" and self.data["present"] and not self.answers:
            self.data["present"] = 0
            raise AppError("internal thermometer does not answer")
        if which == "Internal" and self.hardware().faults.internal_zero:
            self.hardware().faults.internal_zero -= 1
            raise AppError("invalid literal for int() with base 2: ''")  # bin(0)[6:] is empty
        value = self.hardware().temperature(which, self.computer.now())
        meter["current"] = value if value <= 100.0 else meter["current"]


def store_target(output: SysData, value: float) -> None:
    """Store a target within its limits; nan passes them, as it does on the device."""
    value = output["min"] if value < output["min"] else value
    output["target"] = output["max"] if value > output["max"] else value


class Outputs:
    def __init__(self, position: Position) -> None:
        self._position = position
        self.forget()

    def forget(self) -> None:
        """Reset the thread counts, as `initialise()` does; earlier threads stay alive, as on the device."""
        self._thermostats, self._pump_threads = 0, dict.fromkeys(PUMPS, 0)

    def set_target(self, item: str, value: float) -> Steps:
        """Run `SetOutputTarget`: clamp and store the target, restart the output if it is on."""
        output = self._position.data[item]
        store_target(output, value)
        if output["ON"] == 1 and item not in ("OD", "Thermostat"):
            yield from self.set_on(item, 0)
            yield from self.set_on(item, 1)

    def set_on(self, item: str, force: int) -> Steps:
        """Run `SetOutputOn`: 1 switches on, 0 off, any other value toggles."""
        output = self._position.data[item]
        output["ON"] = force if force in (0, 1) else int(output["ON"] == 0)
        yield from self._apply(item)

    def _apply(self, item: str) -> Steps:
        """Run `SetOutput`: apply `ON` and `target` to the electronics. Raises: AppError for an item without output."""
        output, now = self._position.data[item], self._position.computer.now()
        if item == "Stir":
            yield from self._stir()
        elif item == "Heat":
            self._position.hardware().set_heat(float(output["target"] * output["ON"]), now)
        elif item in LIGHTS or item == "UV":
            self._position.hardware()
        elif item == "LASER650":
            self._position.hardware().spectrometer.set_laser(output["target"] * output["ON"] > 0, now)
        elif item == "Thermostat":
            self._position.spawn(self._thermostat(), item)
        elif item in PUMPS:
            if output["target"] == 0:
                output["ON"] = 0
            self._position.spawn(self._period(item), item)
        elif item == "OD":
            yield from self.set_on("Pump1", 0)
            yield from self.set_on("Pump2", 0)
        elif item != "Zigzag":
            raise AppError(f"{item} is no output")

    def _stir(self) -> Steps:
        """Start the stirrer at full power, then go down to the target; switch off at once."""
        stir = self._position.data["Stir"]
        if stir["target"] * stir["ON"] > 0:
            self._position.hardware().set_stirrer(1.0, self._position.computer.now())
            yield 1.5
            for above in (0.4, 0.8):
                if stir["target"] > above and stir["ON"] == 1:
                    yield 0.75
        self._position.hardware().set_stirrer(stir["target"] * stir["ON"], self._position.computer.now())

    def everything_off(self) -> Steps:
        """Run `turnEverythingOff`: lights, laser, pumps, stirrer, heater, thermostat."""
        for item in (*LIGHTS, "LASER650", *PUMPS, "Stir", "Heat", "UV"):
            self._position.data[item]["ON"] = 0
        vial, now = self._position.hardware(), self._position.computer.now()
        for pump in PUMPS:
            vial.drive(pump, 0, now)
        vial.spectrometer.set_laser(False, now)
        yield BUS_S
        for item in ("Stir", "Thermostat", "Heat", "UV", *PUMPS):
            yield from self.set_on(item, 0)

    def _thermostat(self) -> Steps:
        """Run `Thermostat`: one step of PI control with feed-forward, every 30 s (docs/device.md, Thermostat)."""
        data, thermostat, heat = self._position.data, self._position.data["Thermostat"], self._position.data["Heat"]
        mine = self._thermostats = (self._thermostats + 1) % 100
        if thermostat["ON"] == 0:
            yield from self.set_on("Heat", 0)
            return
        self._position.measure_temperature("IR")
        temperature, outside = data["ThermometerIR"]["current"], data["ThermometerExternal"]["current"]
        feed_forward = 0.0
        if outside > 0.0:
            feed = data["Pump1"]["target"] * data["Pump1"]["ON"] * data["OD"]["ON"]
            feed_forward = 2.5 * (temperature - outside) * feed
        error, step = thermostat["target"] - temperature, thermostat["cycleTime"]
        near = abs(error) < 2.0
        integral = thermostat["Integral"] + (0.0005 * step * error if near else 0.0)
        moved = abs(thermostat["target"] - thermostat["last"]) > 2.0
        thermostat["Integral"] = 0.0 if moved else min(max(integral, 0.0), 1.0)
        duty = (0.25 if near else 0.5) * error + thermostat["Integral"] + feed_forward
        heat["ON"] = int(not duty < 0.0)
        heat["target"] = min(max(duty, 0.0), 1.0)
        thermostat["last"] = thermostat["target"]
        yield from self._apply("Heat")
        yield step
        if thermostat["ON"] == 1 and mine == self._thermostats:
            self._position.spawn(self._thermostat(), "Thermostat")
        else:
            heat["ON"], heat["target"] = 0, 0
            yield from self._apply("Heat")

    def _period(self, item: str) -> Steps:
        """Run `PumpModulation`: one period of 63 s; a newer thread of the same pump replaces this one.

        Five registers are written one after another: In1, In2, In1, In2 to off, then the one that drives to on.
        """
        pump, computer = self._position.data[item], self._position.computer
        mine = self._pump_threads[item] = (self._pump_threads[item] + 1) % 100
        config = self._position.vial.config if self._position.vial is not None else VialConfig()
        delay = computer.rng.uniform(*config.pump_start_s)
        yield OFF_SHARE * delay
        if abs(pump["target"] * pump["ON"]) != 1 and mine == self._pump_threads[item]:
            self._position.hardware().drive(item, 0, computer.now())
        yield (QUIET_SHARE - OFF_SHARE) * delay
        if pump["ON"] == 0:
            return
        began = computer.wall()
        period = PERIOD_FACTOR * self._position.data["Experiment"]["cycleTime"]
        on_s = period * abs(pump["target"])
        if math.isnan(on_s):
            raise AppError("sleep length is not a number")
        yield (1.0 - QUIET_SHARE) * delay
        vial = self._position.hardware()
        if mine == self._pump_threads[item] and pump["target"] != 0:
            vial.drive(item, 1 if pump["target"] > 0 else -1, computer.now())
        yield on_s + computer.rng.uniform(*vial.config.on_time_bias_s)
        if abs(pump["target"]) != 1 and mine == self._pump_threads[item]:
            self._position.hardware().drive(item, 0, computer.now())
        pause = period - round(computer.wall() - began, 2)
        if pause > 0.0:
            yield pause
        if pump["ON"] == 1 and mine == self._pump_threads[item]:
            self._position.spawn(self._period(item), item)
