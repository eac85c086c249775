"""What a reactor's outputs do when they are switched: lights, laser, stirrer, heater, thermostat, pumps."""

from __future__ import annotations

from hardware.emulator.computer import AppError
from hardware.emulator.events import Steps
from hardware.emulator.position import Position
from hardware.emulator.pump_outputs import PumpOutputs
from hardware.emulator.sysdata import LIGHTS, PUMPS

__all__ = ["BUS_S", "Outputs"]

BUS_S = 0.02  # a register written and read back


class Outputs:
    """The outputs of one reactor."""

    def __init__(self, position: Position) -> None:
        self._position, self._pumps = position, PumpOutputs(position)
        self._thermostats = 0

    def forget(self) -> None:
        """As after `initialise()`: no thread counted."""
        self._pumps.forget()
        self._thermostats = 0

    def set_target(self, item: str, value: float) -> Steps:
        """`SetOutputTarget`: clamp, store, and restart the output if it is on."""
        output = self._position.data[item]
        if value < output["min"]:
            value = output["min"]
        if value > output["max"]:
            value = output["max"]
        output["target"] = value
        if output["ON"] == 1 and item not in ("OD", "Thermostat"):
            yield from self.set_on(item, 0)
            yield from self.set_on(item, 1)

    def set_on(self, item: str, force: int) -> Steps:
        """`SetOutputOn`: 1 on, 0 off, anything else toggles."""
        output = self._position.data[item]
        output["ON"] = force if force in (0, 1) else int(output["ON"] == 0)
        yield from self._apply(item)

    def _apply(self, item: str) -> Steps:
        """`SetOutput`: make the electronics do what `ON` and `target` say.

        Raises: AppError for an item that drives nothing; its flag is set by then.
        """
        output, now = self._position.data[item], self._position.computer.now()
        if item == "Stir":
            yield from self._stir()
        elif item == "Heat":
            self._position.hardware().set_heat(float(output["target"] * output["ON"]), now)
        elif item in LIGHTS or item == "UV":
            self._position.hardware()
        elif item == "LASER650":
            self._position.hardware().spectrometer.set_laser(
                output["target"] * output["ON"] > 0, self._position.computer.now()
            )
        elif item == "Thermostat":
            self._start_thermostat()
        elif item in PUMPS:
            if output["target"] == 0:
                output["ON"] = 0
            self._pumps.start(item)
        elif item == "OD":
            yield from self.set_on("Pump1", 0)
            yield from self.set_on("Pump2", 0)
        elif item == "Zigzag":
            output["target"] = 5.0
            output["SwitchPoint"] = self._position.data["Experiment"]["cycles"]
        else:
            raise AppError(f"{item} is no output")

    def _stir(self) -> Steps:
        """Kick at full power, then down to the target; off at once."""
        stir = self._position.data["Stir"]
        if stir["target"] * stir["ON"] > 0:
            self._position.hardware().set_stirrer(1.0, self._position.computer.now())
            yield 1.5
            for above in (0.4, 0.8):
                if stir["target"] > above and stir["ON"] == 1:
                    yield 0.75
        self._position.hardware().set_stirrer(stir["target"] * stir["ON"], self._position.computer.now())

    def everything_off(self) -> Steps:
        """`turnEverythingOff`: lights, laser, pumps, stirrer, heater, thermostat."""
        for item in (*LIGHTS, "LASER650", *PUMPS, "Stir", "Heat", "UV"):
            self._position.data[item]["ON"] = 0
        vial, now = self._position.hardware(), self._position.computer.now()
        for pump in PUMPS:
            vial.drive(pump, 0, now)
        vial.spectrometer.set_laser(False, now)
        yield BUS_S
        for item in ("Stir", "Thermostat", "Heat", "UV", *PUMPS):
            yield from self.set_on(item, 0)

    def _start_thermostat(self) -> None:
        self._position.computer.spawn(self._thermostat(), f"{self._position.name}/Thermostat")

    def _thermostat(self) -> Steps:
        """`Thermostat`: one step of the PI law with feed-forward, every 30 s (docs/device.md, Thermostat)."""
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
            self._start_thermostat()
        else:
            heat["ON"], heat["target"] = 0, 0
            yield from self._apply("Heat")
