"""What every part of one reactor's driver works with."""

from collections.abc import Callable
from dataclasses import dataclass

from hardware.chibio.agenda import Agenda
from hardware.chibio.config import ChiBioConfig
from hardware.chibio.connection import Connection
from hardware.chibio.dosing import ReactorCalibration
from hardware.chibio.resume import ReactorHistory
from hardware.logbook import Logbook

__all__ = ["Context"]


@dataclass(frozen=True)
class Context:
    """One reactor's surroundings.

    connection: its verified conversation. volume_ml: of its culture. calibration: of its pumps and its zero. config,
    agenda: shared by all reactors; what must happen later is put on the agenda. book: what it reports. past: gives what
    this run knows of the reactor by the rows that it wrote, those of earlier lives too.
    """

    connection: Connection
    volume_ml: float
    calibration: ReactorCalibration
    config: ChiBioConfig
    agenda: Agenda
    book: Logbook
    past: Callable[[], ReactorHistory]
