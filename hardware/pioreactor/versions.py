"""What differs between versions of the vendor's software: one row per release that changed something for a client."""

import re
from dataclasses import dataclass, replace
from typing import Any

__all__ = ["TESTED", "Facts", "facts"]

TESTED = ("25.11.19", "26.7.2")  # versions that the tests run against


@dataclass(frozen=True)
class Facts:
    """What a client of one version must know; the defaults are those of 25.11.12.

    curve_struct: a calibration's curve is {type, coefficients}, not a list. stop_in_body: a stop names its job in a
    JSON body, not in the query. succeeded: state of a task that is over; failure: HTTP status of one that failed. kept:
    a task's result can be asked for again. ends: a job that ended at once is a success if its exit code is 0, and else
    a failure; before, its result was False. purge: command that clears an entry of a cache; forget: that takes a dead
    job off the list, "" where only a reboot does. target: option, and signal: further ones, of the turbidostat. ledger:
    the unit keeps the vial's volume, told by MQTT and changed by HTTP, and refuses a dose by it; tube: its name for the
    level of the efflux tube.
    """

    curve_struct: bool = False
    stop_in_body: bool = False
    succeeded: str = "complete"
    failure: int = 500
    kept: bool = False
    ends: bool = False
    purge: str = "pio cache clear"
    forget: str = ""
    target: str = "target-od"
    signal: tuple[tuple[str, str], ...] = ()
    ledger: bool = False
    tube: str = "max_working_volume_ml"


CHANGES: tuple[tuple[str, dict[str, Any]], ...] = (
    ("25.12.10", {"stop_in_body": True, "forget": "pio jobs remove"}),
    ("26.1.30", {"curve_struct": True}),
    ("26.2.23", {"purge": "pio cache purge", "forget": "pio jobs purge"}),
    ("26.2.23", {"target": "target-biomass", "signal": (("biomass-signal", "od"),)}),
    ("26.3.0", {"ledger": True}),
    ("26.4.0", {"tube": "efflux_tube_volume_ml"}),
    ("26.4.3", {"kept": True}),
    ("26.4.4", {"succeeded": "succeeded", "failure": 200, "ends": True}),
)


def _number(version: str) -> tuple[int, ...]:
    return tuple(int(part) for part in re.findall(r"\d+", version)[:3])


def facts(version: str) -> Facts:
    """Of a version; of one that is newer than the table those of its last row.

    Args: version: as the unit says it, e.g. "26.7.2"; text without a number is older than all.
    """
    known = Facts()
    for since, changed in CHANGES:
        if _number(version) >= _number(since):
            known = replace(known, **changed)
    return known
