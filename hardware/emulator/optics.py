"""Optical measurement: laser and spectrometer, OD from counts, the blank."""

import math
from collections.abc import Generator

from hardware.emulator.computer import AppError, Steps
from hardware.emulator.outputs import Outputs, Position, store_target
from hardware.emulator.sysdata import SLOTS

EXPOSURE_S = 0.97  # one spectrometer reading
FLUORESCENCE_S = 1.0  # LED on, one reading, LED off
PYOVERDINE = ("LEDA", "nm440")  # excitation 395 nm, emission 440 nm (docs/plant.md)
DARK_BASE = 120.0  # counts of the base band if the culture does not fluoresce
BASE = 20000.0  # counts of the base band if the culture fluoresces


class Optics:
    def __init__(self, position: Position, outputs: Outputs) -> None:
        self._position, self._outputs = position, outputs

    def expose(self, seconds: float) -> Generator[float, None, int]:
        """Return the counts of one reading with the laser on; a simultaneous reading of another thread spoils it."""
        yield from self._outputs.set_on("LASER650", 1)
        self._position.hardware().spectrometer.begin_exposure(self._position.computer.now())
        yield seconds
        raw = self._position.hardware().counts(self._position.computer.now(), seconds)
        yield from self._outputs.set_on("LASER650", 0)
        self._position.data["AS7341"]["current"]["ADC0"] = raw
        return raw

    def measure_od(self) -> Steps:
        """Run `MeasureOD`: OD = b r + a r^2, r = log10(blank / raw); 0 if raw is 0. Raises: AppError if blank is 0."""
        raw = yield from self.expose(EXPOSURE_S)
        zero, od = self._position.data["OD0"], self._position.data["OD"]
        zero["raw"] = float(raw)
        if abs(raw) <= 0.001:
            od["current"] = 0
            return
        if not zero["target"] > 0.0:
            raise AppError("logarithm of a zero of 0")
        r = math.log10(zero["target"] / raw)
        od["current"] = r * zero["LASERb"] + r * r * zero["LASERa"]

    def measure_fluorescence(self) -> Steps:
        """Run `MeasureFP`: about a second per slot that is on; emissions are divided by the base."""
        for slot in (self._position.data[name] for name in SLOTS):
            if slot["ON"] == 1:
                self._position.hardware()
                yield FLUORESCENCE_S
                base, light = self._light()
                bands = (slot["Emit1Band"], slot["Emit2Band"])
                first, second = (light if (slot["LED"], band) == PYOVERDINE else 0.0 for band in bands)
                slot.update({"Base": base, "Emit1": first / base, "Emit2": second / base})

    def _light(self) -> tuple[float, float]:
        """Return the counts of the base band and of pyoverdine's band; a dead spectrometer gives 1 and 0."""
        vial = self._position.hardware()
        if vial.faults.spectrometer_dead:
            return 1.0, 0.0
        light = vial.fluorescence(self._position.computer.now())
        return (DARK_BASE, 0.0) if math.isnan(light) else (BASE, light)

    def calibrate(self, item: str, raw: float, od: float) -> None:
        """Run `CalibrateOD`: store the blank with which `raw` reads as `od` (docs/device.md, OD measurement)."""
        od0 = self._position.data["OD0"]
        a, b = od0["LASERa"], od0["LASERb"]
        od = 0 if od < 0 else od
        zero = raw * 10.0 ** (math.sqrt(od / a + (b / (2 * a)) ** 2) - b / (2 * a))
        store_target(self._position.data[item], zero)
