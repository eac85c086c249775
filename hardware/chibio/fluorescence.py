"""Fluorescence of a culture: one slot of the device measures it in every cycle while the slot is on.

The only route that switches a slot toggles it, on the selected reactor (docs/device.md, Fluorescence). The slot is
therefore read first, toggled only if needed, and read back. A slot takes about a second of each cycle.
"""

import math
from dataclasses import dataclass

from conf.schema import check, require, setting
from hardware.chibio.connection import Connection
from hardware.chibio.messages import PutRight, SlotAmiss
from hardware.chibio.protocol import BANDS, LEDS, SLOTS, DeviceState, Slot
from hardware.logbook import Logbook

HIDDEN = "not shown with its settings: update the device's software or the agent on its board"


@dataclass(frozen=True)
class FluorescenceSlotConfig:
    """Settings of the fluorescence measurement; off by default.

    The defaults are for pyoverdine (excitation 395 nm, emission 440 nm), as in Lee, Morlock, Allan, Steel, Cell Reports
    Methods 5:101009 (2025) and their device software Janmorlock/ChiBio.
    Raises: ValueError naming key, value and allowed range.
    """

    measure: bool = setting(False, "measure fluorescence with every sample")
    slot: str = setting("FP1", "fluorescence slot of the device; the others must be off", choices=SLOTS)
    led: str = setting("LEDA", "excitation: LEDA 395 nm, LEDB 457, LEDC 500, LEDD 523, LEDE 595", choices=LEDS)
    base_band: str = setting("CLEAR", "base band: the device divides by its counts", choices=BANDS)
    band: str = setting("nm440", "emission band; not the base band", choices=BANDS)
    gain: str = setting("x10", "gain code of the spectrometer", choices=tuple(f"x{k}" for k in range(11)))

    def __post_init__(self) -> None:
        check(self, "backend.fluorescence")
        require(self.band != self.base_band, "backend.fluorescence.band", self.band, "another than base_band")

    @property
    def command(self) -> str:
        settings = (self.slot, self.led, self.base_band, self.band, "OFF", self.gain)
        return f"/SetFPMeasurement/{'/'.join(settings)}" if self.measure else ""

    def own(self, state: DeviceState) -> Slot | None:
        """Return the configured slot; None if the device does not show it, or shows it on without its settings."""
        return next((s for s in state.slots if s.name == self.slot and (s.led or not s.on)), None)

    def wrong(self, state: DeviceState) -> str:
        """Return what is wrong with the slot in a read; "" if nothing is wrong or nothing is measured."""
        if not self.measure:
            return ""
        slot = self.own(state)
        if slot is None:
            return HIDDEN
        if not slot.on:
            return "off"
        found = (slot.led, slot.base_band, slot.band, slot.gain)
        return "" if found == (self.led, self.base_band, self.band, self.gain) else f"set to {', '.join(found)}"

    def others_on(self, state: DeviceState) -> tuple[str, ...]:
        """List the modes that are on, without the slot that this run uses."""
        return tuple(m for m in state.modes if not (self.measure and m == self.slot))


class Fluorescence:
    """The fluorescence slot of one reactor: checked with every read, corrected, read back.

    Attributes: trouble: why the slot could not be verified on, None if it was.
    """

    def __init__(self, connection: Connection, config: FluorescenceSlotConfig, book: Logbook) -> None:
        self.trouble: SlotAmiss | None = None
        self._connection, self._config, self._book = connection, config, book
        self._was_on = False
        self._switched_in = -1  # cycle of the last toggle; its measurement may have been before

    def keep_on(self, state: DeviceState) -> DeviceState:
        """Switch the slot on as configured if needed; return the new state. Sets `trouble`. Raises: as `read`."""
        found = still = self._config.wrong(state)
        if found not in ("", HIDDEN):
            self._switched_in = state.cycles
            state, still = self._toggle()
            if found != "off" and still == "off":  # a slot takes settings only when it goes on
                state, still = self._toggle()
        slot = self._config.slot
        self.trouble = SlotAmiss(slot=slot, found=still) if still else None
        if found and not still and self._was_on:
            self._book.tell(PutRight(item=f"fluorescence slot {slot}", found=found, done="switched on again"))
        self._was_on = self._was_on or not still
        return state

    def _toggle(self) -> tuple[DeviceState, str]:
        state = self._connection.toggle(self._config.command)
        return state, self._config.wrong(state)

    def reading(self, state: DeviceState) -> float:
        """Return the counts of the band in the sample of `state`; nan if there are none."""
        slot, old = self._config.own(state), state.cycles == self._switched_in
        if old or slot is None or not self._config.measure or self._config.wrong(state):
            return math.nan
        return slot.counts
