"""What a command is told of a recording."""

import re
from dataclasses import dataclass
from typing import Any

from conf.schema import check, require, setting
from experiments.recordings.layout import COLUMNS, UNITS
from experiments.recordings.reader import Recording, read_recording

__all__ = ["Source"]


@dataclass(frozen=True)
class Source:
    """Where a recording is, and what its file does not tell."""

    data: str | None = setting(
        None,
        "recording: CSV of a Chi.Bio, of this project or of a lab, a Pioreactor's export (zip) or one of its tables, "
        "an eVOLVER's OD; null: the simulated recording of the project",
    )
    doses: str | None = setting(
        None, "second file, with the doses: an eVOLVER's pump log, a Pioreactor's dosing_events"
    )
    columns: dict[str, Any] = setting(
        {}, f"names in the file that are not understood: columns.od=NAME, also {', '.join(COLUMNS)}"
    )
    time_unit: str | None = setting(
        None, "of times without date whose column names no unit, or a wrong one", choices=tuple(UNITS)
    )
    rows: str | None = setting(None, "FIRST:END, data rows from 0, without END; null: all")
    run: int | None = setting(None, "run in a file of several concatenated runs, from 0; null: the longest")
    reactor: str | None = setting(None, "reactor in a file with several of them; null: the first")
    pump_ml_s: float = setting(
        1.0,
        "flow of the feed pump at full power, where a file holds a Chi.Bio's duties or the seconds that a pump ran",
        "mL/s",
        above=0.0,
        at_most=10.0,
    )
    pumps: tuple[int, ...] = setting(
        (1,), "pumps in the Chi.Bio's CSV that feed the vial (1 to 4); their flows are added", within=(1, 4), some=True
    )

    def __post_init__(self) -> None:
        check(self)
        spans = self.rows is None or re.fullmatch(r"\d*:\d*", self.rows)
        require(bool(spans), "rows", self.rows, "FIRST:END, e.g. 0:700 (data rows from 0, END excluded)")
        for key in self.columns:
            require(key in COLUMNS, f"columns.{key}", self.columns[key], ", ".join(f"columns.{one}" for one in COLUMNS))

    def read(self, path: str) -> Recording:
        """Read a file as it is told here. Raises: RecordingError."""
        first, end = (self.rows or ":").split(":")
        return read_recording(
            path,
            pump_ml_s=self.pump_ml_s,
            pumps=self.pumps,
            run=self.run,
            reactor=self.reactor,
            rows=(int(first or 0), int(end) if end else None),
            doses=self.doses,
            columns={key: str(name) for key, name in self.columns.items()},
            time_unit=self.time_unit,
        )
