"""Simulated vials with the interface of the vendor's software: photodiode volts, duties of pins, a temperature."""

import json
import math
import os
import socket
import threading
import time
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from conf.presets import load
from conf.schema import build
from envs.plant.plant import Plant, PlantConfig
from hardware.pioreactor.config import vial_ml
from hardware.rig.files import PINS, flows

VOLTS_PER_OD = 0.1  # of the photodiode at 90 degrees: with a reference of 0.1 V one unit of the reading is one OD
PUMPS = {PINS[pump]: pump for pump in ("media", "alt_media", "waste")}  # a pin stays on when its process is killed
MEDIA, ALT, WASTE = PUMPS
HEATER = PINS["heating"]  # off when its process is killed
VIAL_C, PLATE_C = 0.8, 0.48  # degC per percent of the heater's duty: vial above the room, plate above the vial
PLATE_S = 70.0  # time constant of the plate; the vendor's estimate of the vial is then right within 0.4 degC


@dataclass(frozen=True)
class Pulse:
    """One run of a pump: unit, pump, start (s since 1970), duration, s, and fresh fluid moved, mL."""

    unit: str
    pump: str
    start: float
    seconds: float
    feed_ml: float


def vial_preset(name: str, volume_ml: float, od: float, flow: Mapping[str, float], growth_x: float) -> PlantConfig:
    """Build the preset `conf/plant/NAME.yaml` in the vendor's vial, with pump flows, mL/s. Raises: ValueError."""
    plant = build(PlantConfig(), load(f"plant/{name}"), "plant")
    vessel = replace(plant.vessel, volume_ml=volume_ml, capacity_ml=float(vial_ml(volume_ml)))
    pump = replace(plant.pump, dosing="pulse", gain_ml_s=flow["media_pump"], waste_ml_s=flow["waste_pump"])
    cooling = min(plant.thermal.cooling_min * growth_x, 600.0)  # heat moves in real time
    return replace(plant, pump=pump, vessel=vessel, start_od=od, thermal=replace(plant.thermal, cooling_min=cooling))


class _Vial:
    """One culture with its pumps and its heater in real time; only growth is `growth_x` times faster.

    The vial keeps its temperature until the heater is first driven; then the heater sets the temperature.

    Attributes: offset_od: OD added to every reading. held_od: constant OD of all readings, nan: the culture's OD.
      heat: duty of the heater, %, nan before its first use. plate_c: temperature of the plate above the vial, degC.
    """

    def __init__(self, unit: str, plant: Plant, growth_x: float, log: Any, alt_ml_s: float = 0.0) -> None:
        self._alt_ml_s, self.alt_ml = alt_ml_s, 0.0
        self.unit, self.plant, self._growth_x, self._log = unit, plant, growth_x, log
        self.at = time.time()
        self.duty = dict.fromkeys(PUMPS, 0.0)
        self._since: dict[int, tuple[float, float]] = {}
        self.pulses: list[Pulse] = []
        self.peak_ml = float(plant.vessel.volume_ml[0])
        self.offset_od, self.held_od = 0.0, math.nan
        self.heat, self.plate_c, self._heated_by = math.nan, 0.0, 0

    @property
    def seen_od(self) -> float:
        true = float(self.plant.apparent_od[0]) if math.isnan(self.held_od) else self.held_od
        return true + self.offset_od

    def sync(self, now: float) -> None:
        """Advance the vial to the time `now`; the heater is off if its process is gone."""
        seconds = now - self.at
        if seconds <= 1e-4:
            return
        on = {pin: np.array([duty / 100.0 * seconds]) for pin, duty in self.duty.items()}
        minutes, thermal = seconds * self._growth_x / 60.0, self.plant.thermal
        alt_ml = on[ALT] * self._alt_ml_s
        self.plant.advance(minutes, on[MEDIA], on[WASTE], supply_ml=alt_ml)
        self.alt_ml += float(alt_ml[0])
        if self.heat >= 0.0:
            self.heat *= self.heat == 0.0 or _alive(self._heated_by)
            thermal.temperature = thermal.temperature + VIAL_C * self.heat * minutes / thermal.config.cooling_min
            self.plate_c += (PLATE_C * self.heat - self.plate_c) * -math.expm1(-seconds / PLATE_S)
        self.at = now
        self.peak_ml = max(self.peak_ml, float(self.plant.vessel.volume_ml[0]))

    def drive(self, pin: int, duty: float, pid: int, now: float) -> None:
        """Set a pin's duty, %, for the process `pid`."""
        self.sync(now)
        if pin == HEATER:
            self.heat, self._heated_by = duty, pid
            self.plant.thermal.set_target(0.0)
        if pin not in self.duty:
            return
        was = self.duty[pin]
        fed = {MEDIA: float(self.plant.feed.delivered_ml[0]), ALT: self.alt_ml, WASTE: 0.0}[pin]
        if duty > 0.0 and was == 0.0:
            self._since[pin] = (now, fed)
        if duty == 0.0 and was > 0.0:
            start, had = self._since.pop(pin)
            run = Pulse(self.unit, PUMPS[pin], start, now - start, fed - had)
            self.pulses.append(run)
            self._log({"unit": self.unit, "pump": run.pump, "start": start, "s": run.seconds, "ml": run.feed_ml})
        self.duty[pin] = duty

    def truth(self) -> dict[str, Any]:
        """Return the true state of the vial and the true volumes moved."""
        return {
            "od": float(self.plant.apparent_od[0]),
            "volume_ml": float(self.plant.vessel.volume_ml[0]),
            "peak_ml": self.peak_ml,
            "fed_ml": float(self.plant.feed.delivered_ml[0]),
            "alt_ml": self.alt_ml,
            "duty": {str(pin): duty for pin, duty in self.duty.items()},
            "temperature": float(self.plant.thermal.temperature[0]),
        }


class VialServer:
    """All vials behind one UDP port, served by a thread; every run of a pump is written to truth.jsonl in `folder`.

    Args: plants: plant config of each vial, by its unit's name. growth_x: growth rate over that of real time.
    """

    def __init__(self, plants: Mapping[str, PlantConfig], growth_x: float, folder: Path, seed: int = 0) -> None:
        self._file = (folder / "truth.jsonl").open("a", encoding="utf-8", buffering=1)
        streams = iter(np.random.default_rng(seed).spawn(len(plants)))
        self.vials = {
            unit: _Vial(unit, Plant(plant, 1, [next(streams)]), growth_x, self._log, flows(k)["alt_media_pump"])
            for k, (unit, plant) in enumerate(plants.items())
        }
        self._wire = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._wire.bind(("127.0.0.1", 0))
        self._wire.settimeout(0.05)
        self.port = int(self._wire.getsockname()[1])
        self._lock = threading.Lock()
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._serve, name="vials", daemon=True)
        self._thread.start()

    def _log(self, row: Mapping[str, Any]) -> None:
        self._file.write(json.dumps({"wall": round(time.time(), 3), **row}) + "\n")

    def _serve(self) -> None:
        logged = 0.0
        while not self._ended.is_set():
            try:
                data, sender = self._wire.recvfrom(4096)
                with self._lock:
                    answer = self._answer(json.loads(data))
                self._wire.sendto(json.dumps(answer).encode(), sender)
            except TimeoutError:
                pass
            except (OSError, ValueError, KeyError, TypeError) as error:
                self._log({"error": f"{type(error).__name__}: {error}"})
            now = time.time()
            with self._lock:
                for vial in self.vials.values():
                    vial.sync(now)
                    if now - logged >= 1.0:
                        self._log({"unit": vial.unit, **vial.truth()})
            logged = now if now - logged >= 1.0 else logged

    def _answer(self, asked: Mapping[str, Any]) -> dict[str, Any]:
        now = time.time()
        if asked.get("ask") == "truth":
            return {unit: vial.truth() for unit, vial in self.vials.items()}
        vial = self.vials[asked["unit"]]
        vial.sync(now)
        if "pin" in asked:
            vial.drive(int(asked["pin"]), float(asked["dc"]), int(asked["pid"]), now)
            return {"ok": True}
        if asked.get("ask") == "temperature":
            shown = vial.plant.thermal.temperature[0] + vial.plant.thermal.offset[0]
            return {"temperature": float(shown) + vial.plate_c}
        return {"volts": VOLTS_PER_OD * vial.seen_od}

    def power_cut(self, unit: str) -> None:
        with self._lock:
            for pin in self.vials[unit].duty:
                self.vials[unit].drive(pin, 0.0, 0, time.time())

    def close(self) -> None:
        self._ended.set()
        self._thread.join(2.0)
        self._wire.close()
        self._file.close()


def _alive(pid: int) -> bool:
    """Return whether a process runs: it is neither gone nor a zombie."""
    try:
        os.kill(pid, 0)
        state = Path(f"/proc/{pid}/stat").read_text(encoding="utf-8").rpartition(")")[2].split()[0]
    except (OSError, IndexError):
        return False
    return state != "Z"
