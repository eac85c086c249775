"""Fluids of a schedule step besides the feed: a second medium, an inducer or a stressor, by a spare pump."""

import re
from dataclasses import dataclass

from conf.schema import require

__all__ = ["DOSE_ML", "MADE_UP_MIN", "PUMPS", "Output", "outputs_of"]

PUMPS = (3, 4)
DOSE_ML = (
    0.5  # smallest dose: more than any pump of up to 1.5 mL/s delivers dependably in 0.3 s (docs/device.md, Pumps)
)
MADE_UP_MIN = 5.0  # of a pause of the program or of the samples; the volume due in a longer one is omitted
MOST_ML_H, MOST_ML = 20.0, 20.0
GIVEN = re.compile(r"pump([34])\s+(\d*\.?\d+)\s*(mL/h|mL)", re.IGNORECASE)
WORDS = "'pump3 2 mL/h', 'pump4 1.5 mL' (at its start), both with a comma between, or null"


@dataclass(frozen=True)
class Output:
    """Output of one spare pump in a step: a volume per hour, or a volume at its start."""

    pump: int
    ml_h: float = 0.0
    ml: float = 0.0


def outputs_of(text: str | None) -> tuple[Output, ...]:
    """Parse the outputs of a step, one per pump. Raises: ValueError for any other text, with the allowed forms."""
    found = []
    for part in (text or "").split(",") if text else []:
        said = GIVEN.fullmatch(part.strip())
        require(said is not None, "scenario.outputs", repr(text), WORDS)
        assert said is not None
        amount, hourly = float(said[2]), said[3].lower() == "ml/h"
        low, high = (0.1, MOST_ML_H) if hourly else (DOSE_ML, MOST_ML)
        require(low <= amount <= high, "scenario.outputs", repr(text), f"{low:g} to {high:g} {said[3]}")
        found.append(Output(int(said[1]), amount if hourly else 0.0, 0.0 if hourly else amount))
    pumps = [output.pump for output in found]
    require(len(set(pumps)) == len(pumps), "scenario.outputs", repr(text), "each pump once in a step")
    return tuple(found)
