"""What differs between versions of the vendor's software: one row per release that changed something for a client."""

import re
from dataclasses import dataclass, replace
from typing import Any

__all__ = ["TESTED", "Facts", "facts", "number"]

TESTED = ("25.11.19", "26.7.2", "26.11.1")  # versions that the tests run against


@dataclass(frozen=True)
class Facts:
    """What a client of one version must know; the defaults are those of 25.11.12.

    curve_struct: a calibration's curve is {type, coefficients}, not a list. purge: command that clears an entry of a
    cache; forget: that takes a dead job off the list, "" where only a reboot does. target: option, and signal: further
    ones, of the turbidostat. ledger: the unit keeps the vial's volume, told by MQTT and changed by HTTP, and refuses a
    dose by it; tube: its name for the level of the efflux tube. What differs in a message is read by its content.
    """

    curve_struct: bool = False
    purge: str = "pio cache clear"
    forget: str = ""
    target: str = "target-od"
    signal: tuple[tuple[str, str], ...] = ()
    ledger: bool = False
    tube: str = "max_working_volume_ml"


CHANGES: tuple[tuple[str, dict[str, Any]], ...] = (
    ("25.12.10", {"forget": "pio jobs remove"}),
    ("26.1.30", {"curve_struct": True}),
    ("26.2.23", {"purge": "pio cache purge", "forget": "pio jobs purge", "target": "target-biomass"}),
    ("26.2.23", {"signal": (("biomass-signal", "od"),)}),
    ("26.3.0", {"ledger": True}),
    ("26.4.0", {"tube": "efflux_tube_volume_ml"}),
)


def number(version: str) -> tuple[int, ...]:
    """By which versions are older or newer."""
    return tuple(int(part) for part in re.findall(r"\d+", version)[:3])


def facts(version: str) -> Facts:
    """Of a version as the unit says it; without a number it is older than all, and a newer one is the last row's."""
    known = Facts()
    for since, changed in CHANGES:
        if number(version) >= number(since):
            known = replace(known, **changed)
    return known
