"""Limits and responses of the interlock."""

import math
from dataclasses import dataclass
from enum import IntEnum

from conf.schema import check, part, require, setting
from envs.bench import Bench
from hardware.messages import Fault
from hardware.safety.messages import BudgetFault, FallsFault, FluorescenceLostFault, JumpFault, NoDilutionFault


class Response(IntEnum):
    """Action of the interlock on a reactor, in order of severity.

    PASS: dose as allowed. HOLD: no dose for this sample. PUMPS_OFF: no dose, and switch the pumps off, verified.
    REGULATE: hand over to the device's own OD regulation for this run. STOP: no further dose in this run, pumps off.
    """

    PASS = 0
    HOLD = 1
    PUMPS_OFF = 2
    REGULATE = 3
    STOP = 4


WORDS = dict(zip(("report", "hold", "pumps_off", "regulate", "stop"), Response, strict=True))
NOT_REGULATE = ("report", "hold", "pumps_off", "stop")
_DONE = ("reported", "no dose", "pumps off", "handed over to the on-board regulation", "stopped")
DONE = dict(zip(Response, _DONE, strict=True))

MAX_SETPOINT = 1.5  # OD; a larger setpoint is a typing error
RAW_MIN, RAW_MAX = 5.0, 65534.0  # counts: a failed spectrometer reads 1, a saturated one 65535


@dataclass(frozen=True)
class Responses:
    """Responses to faults that a lab may change; with `report`, doses continue."""

    budget: str = setting(BudgetFault.response, "a feed budget is used up", choices=tuple(WORDS)[1:])
    jump: str = setting(JumpFault.response, "a step that neither growth nor a dose explains", choices=NOT_REGULATE)
    no_dilution: str = setting(NoDilutionFault.response, "the pump ran but the OD did not fall", choices=NOT_REGULATE)
    falls: str = setting(FallsFault.response, "the OD falls without a dose", choices=NOT_REGULATE[1:])
    fluorescence_lost: str = setting(
        FluorescenceLostFault.response, "no valid fluorescence for more than light_lost minutes",
        choices=tuple(WORDS),
    )  # fmt: skip

    def __post_init__(self) -> None:
        check(self, "safety.responses")


@dataclass(frozen=True)
class SafetyConfig:
    """Limits of the interlock, which stands between every controller and every pump and keeps its own ledger."""

    ml_per_minute: float | None = setting(
        None,
        "feed budget per minute; null: full feed and 1.5 of the largest doses, as 60 s can contain one dose more",
        "mL",
        above=0.0,
        below=math.inf,
    )
    ml_per_hour: float = setting(75.0, "feed budget per hour", "mL", above=0.0, below=math.inf)
    ml_per_run: float = setting(10000.0, "feed budget per run", "mL", above=0.0, below=math.inf)
    overflow_ml: float = setting(
        5.0, "volume above the waste tube that counts as an overflow, also limited by the vial", "mL", within=(0, 10)
    )
    od_min: float = setting(-0.1, "lowest possible reading", "OD", within=(-1, 0.05))
    od_max: float = setting(4.0, "highest possible reading", "OD", within=(MAX_SETPOINT, 10))
    mu_max: float = setting(0.04, "fastest possible growth (LB at 37 degC: 0.031)", "1/min", within=(0.001, 0.1))
    death: float = setting(0.005, "fastest possible decline without a dose", "1/min", within=(0, 0.1))
    jump: float = setting(0.04, "largest step of the OD beyond growth and dose", "OD", above=0.0, below=math.inf)
    jump_fraction: float = setting(
        0.08, "largest step as a fraction of the OD, if above jump; 0.6 % of readings exceed it", within=(0, 1)
    )
    drift: float = setting(
        0.05,
        "unexplained change of ln OD, beyond six sd of the sensor, that causes no_dilution or falls if three samples "
        "in a row show it",
        within=(0.01, 1),
    )
    noise_od: float = setting(0.005, "constant part of the sensor's sd", "OD", within=(0, 0.5))
    noise_fraction: float = setting(0.005, "part of the sensor's sd that is proportional to the OD", within=(0, 0.5))
    cooldown: float = setting(5.0, "time without a dose after no_dilution or falls", "min", above=0.0, below=math.inf)
    stale_s: float | None = setting(
        None, "age at which the newest sample is stale; null: a control period plus 40 s", "s", at_most=7200.0
    )
    lost_s: float | None = setting(
        None, "age at which the sample is lost; null: three control periods", "s", at_most=14400.0
    )
    silent: float = setting(120.0, "age of a sample at which its reactor is stopped", "min", above=0.0, below=math.inf)
    cooling: float = setting(
        90.0, "slowest time constant of cooling to a lower target", "min", above=0.0, below=math.inf
    )
    light_min: float = setting(1.0, "smallest fluorescence of a working LED and sensor", "counts", within=(0, 65534))
    frozen_light: int = setting(5, "equal fluorescence readings in a row that count as frozen", within=(2, 60))
    light_lost: float = setting(
        15.0, "time without a valid fluorescence until it is reported", "min", above=0.0, below=math.inf
    )
    composition_low: float = setting(
        29.0, "lowest target of a composition controller; composition_high or less", "degC", within=(15, 42)
    )
    composition_high: float = setting(36.0, "highest target of a composition controller", "degC", within=(15, 42))
    controller_patience: int = setting(5, "unusable proposals in a row that count as a failure", within=(1, 60))
    responses: Responses = part(Responses, "responses to some faults; docs/three_am.md has those to all others")

    def __post_init__(self) -> None:
        check(self, "safety")
        low, high = self.targets
        require(low <= high, "safety.composition_high", high, f"{low:g} to 42")

    def response(self, fault: Fault | type[Fault]) -> Response:
        """Return the response to a fault: the lab's choice, else that of the fault's class."""
        return WORDS[getattr(self.responses, fault.kind, fault.response)]

    def ml_a_minute(self, bench: Bench) -> float:
        """Return the feed budget of a minute, mL."""
        doses = max(1.0, 60.0 / bench.period_s) + 1.5
        return doses * bench.max_rate * bench.period_s if self.ml_per_minute is None else self.ml_per_minute

    @property
    def targets(self) -> tuple[float, float]:
        """Lowest and highest target of the thermostat that a signal may set, degC."""
        return self.composition_low, self.composition_high

    def ages_s(self, bench: Bench) -> tuple[float, float]:
        """Return the ages, s, at which a sample is stale and lost. Raises: ValueError below a control period."""
        stale_s = bench.stale_s if self.stale_s is None else self.stale_s
        lost_s = max(3.0 * bench.period_s, stale_s) if self.lost_s is None else self.lost_s
        require(stale_s >= 1.1 * bench.period_s, "safety.stale_s", stale_s, f"{1.1 * bench.period_s:g} to 7200")
        require(lost_s >= stale_s, "safety.lost_s", lost_s, f"{stale_s:g} to 14400")
        return stale_s, lost_s
