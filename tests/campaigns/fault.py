"""What befalls a run, and what is expected of the program then: one declaration for reactors of every family.

Either words are declared of which one must be told (`by`), or why no detection is needed or possible (`why_not`).
Sources: docs/device.md, Failures; docs/biology.md, Faults; docs/pioreactor.md, Peculiarities of the vendor's software.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from tests.campaigns.tracking import BAND_OD, undosed

__all__ = ["FAMILIES", "MOMENTS", "Fault"]

VIRTUAL, REAL = ("recovery", "steady", "step", "dose"), ("start", "between", "in")
MOMENTS = (*VIRTUAL, *REAL)
FAMILIES = ("chibio", "pioreactor")


@dataclass(frozen=True)
class Fault:
    """One fault and what is declared about it.

    name, what: for tables. begin, end: bring it about and mend it, given the bench: a `Rehearsal` of an emulated
      Chi.Bio in virtual time, or a `Trial` on the Pioreactor rig in real time. minutes: of the bench's clock until it
      is mended; inf = never. family: of the bench. moments: of a run, in which it is tried. often: a kill, which is
      repeated in its run.
    by: it must be told by one of these. Chi.Bio: a reason of the interlock, or `note:TEXT`, `end:TEXT`, `repair:TEXT`
      for words in a note of the driver, in the run's outcome or among the repairs of a resumed run. Pioreactor: words
      in the journal or, where it is `refused`, on the screen.
    why_not: why it need not, or cannot, be detected; empty if it must be.
    within_s: real time beyond one control period until it is told.
    wide: it strikes the whole board or program, not only the reactor that falls sick.
    blind: samples made meanwhile cannot be read, or none are made.
    program: the program ends; it is resumed after `minutes`.
    rogue: something else than this program moves the feed pump, so its runs say nothing about doubled doses. foreign:
      so many runs of it that somebody else starts are counted, each time, and no more.
    flow: what the pump moves is not what it is told, so volumes are not compared.
    refused: the program must not start, with one line and status 1.
    error: largest distance, OD, of the faulty culture from what the schedule asks and the pump can do; by default it
      gets no dose for three minutes. recovery_min: within so many minutes after the end of the fault (of a lasting one:
      after its begin) it is back, and stays, within `band`, OD, of what growth and full dilution can reach from where
      it was at the first dose after the fault (`tracking.FIRST_DOSE_MIN`). Neighbours are held to all three if the
      fault is `wide`, else to those of a healthy run. Of a reactor that is `gone` none is judged.
    unheld: why the culture does not come back; only `error` is judged then.
    stops: why no dose is right from its detection on; neither is judged then, but that nothing is dosed.
    stuck: a motor that runs whatever it is told cannot be at rest at the end.
    gone: the reactor is absent at the end: its pumps rest without power, which cannot be verified and must be told.
    overflow: why it overflows on a rig without an overflow pump, on which it is run as well; empty if there must be no
      overflow on either.
    of_overflow_pump: it is a fault of that pump, run only where there is one.
    """

    name: str
    what: str
    begin: Callable[[Any], None]
    by: tuple[str, ...] = ()
    end: Callable[[Any], None] | None = None
    minutes: float = math.inf
    why_not: str = ""
    wide: bool = False
    blind: bool = False
    program: bool = False
    rogue: bool = False
    error: float = undosed(3.0)
    recovery_min: float = 10.0
    band: float = BAND_OD
    unheld: str = ""
    stops: str = ""
    stuck: bool = False
    gone: bool = False
    overflow: str = ""
    of_overflow_pump: bool = False
    family: str = "chibio"
    moments: tuple[str, ...] = VIRTUAL
    often: bool = False
    within_s: float = math.inf
    foreign: int = 0
    flow: bool = False
    refused: bool = False

    def __post_init__(self) -> None:
        if bool(self.by) == bool(self.why_not):
            raise ValueError(f"fault {self.name}: needs either `by` or `why_not`")
        if self.unheld and self.stops:
            raise ValueError(f"fault {self.name}: `stops` says already that the culture is not held")
