"""Limits and declared responses of the interlock, and the remedy for each of its reasons."""

import math
from dataclasses import dataclass
from enum import IntEnum

from conf.schema import check, part, require, setting
from envs.bench import Bench

__all__ = [
    "DONE", "MAX_SETPOINT", "RAW_MAX", "RAW_MIN", "REMEDIES", "RESPONSES", "WORDS", "Response", "Responses",
    "SafetyConfig",
]  # fmt: skip


class Response(IntEnum):
    """What is to be done with a reactor, in order of severity.

    PASS: dose as allowed. HOLD: no dose for this sample. PUMPS_OFF: no dose, and switch its pumps off, verified.
    REGULATE: hand over to the device's own OD regulation for good. STOP: no further dose in this run, pumps off.
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

REMEDIES = {
    "setpoint": "correct the schedule: setpoints are OD over 0 and at most the configured maximum",
    "controller": "look at the policy's input and output in the journal",
    "controller_lost": "replace the policy, then start a new run",
    "limit": "nothing if the controller asked too much; else raise bench.max_rate",
    "budget": "check for a leak or wash-out; if the flow is right, raise safety.ml_per_hour or ml_per_run",
    "bottle": "fill the bottle, then: python -m experiments.mark run=RUN reactor=NAME bottle_ml=ML",
    "overflow": "check waste pump and tube",
    "undosed": "look at the run's notes for why doses are not given: link too slow, device not as set",
    "impossible": "check cable, vial and blank",
    "spectrometer": "check the spectrometer's cable; restart the device if it persists",
    "frozen": "look at the device's terminal: its measuring thread may be dead",
    "jump": "check for bubbles, foam and a moved vial",
    "no_dilution": "check bottle (filled: mark it, bottle_ml=ML), feed tube, gasket; clean the vial's wall",
    "cannot_hold": "the culture outgrows the pump, or the pump has become weak: weigh its doses, check gasket and tube",
    "falls": "check for a pump that runs on, a leak, a stopped stirrer",
    "stale": "check link and device",
    "lost": "check link and device; pumps are swept off as soon as it answers",
    "silent": "repair the link or the device, then start a new run; a stopped reactor stays so when resumed",
    "hot": "check heater and thermometer; heating stays off in this run",
    "thermometer": "check that the vial is seated; heating stays off in this run",
    "device": "see the text",
    "fluorescence": "check LED, spectrometer and the slot's gain",
    "fluorescence_lost": "what it tells is not seen: check LED and spectrometer, then look at the device's FP slot",
    "command_limit": "nothing if the law asked for too much; else set safety.composition_low and composition_high",
}
RESPONSES = {
    "setpoint": "hold",  # outside (0, MAX_SETPOINT]
    "controller": "hold",  # proposed rate negative or no number
    "controller_lost": "regulate",  # too many unusable proposals in a row
    "limit": "report",  # proposed more than max_rate: cut
    "budget": "hold",  # a feed budget is used up
    "bottle": "hold",  # the bottle is empty by the ledger
    "overflow": "pumps_off",  # the vial overflows by the ledger
    "undosed": "report",  # doses are allowed but the device gets none
    "impossible": "hold",  # OD or counts that no culture has
    "spectrometer": "pumps_off",  # OD 12 to 14
    "frozen": "hold",  # the same reading again and again
    "jump": "hold",  # a step that neither growth nor dose explains
    "no_dilution": "hold",  # the pump ran but OD did not fall
    "cannot_hold": "report",  # full feed does not bring OD to the setpoint; lasts as long as that
    "falls": "pumps_off",  # OD falls without pump
    "stale": "hold",  # the newest sample is older than stale_s
    "lost": "pumps_off",  # and older than lost_s
    "silent": "stop",  # nothing for `silent` minutes
    "hot": "hold",  # too warm; the heater is switched off as well
    "thermometer": "report",  # reads nonsense; the heater is switched off
    "fluorescence": "report",  # none, none at all, full scale or frozen
    "fluorescence_lost": "report",  # and for more than light_lost minutes
    "command_limit": "report",  # what a signal asked of an actuator was out of range: cut
    # kinds of `reactor.Fault`
    "link": "hold",  # no answer
    "selection": "hold",  # the device addresses another reactor
    "identity": "stop",  # another device than the run began with
    "absent": "hold",  # no reactor at this position
    "restarted": "hold",  # the device lost its memory
    "stopped": "pumps_off",  # the experiment no longer runs
    "stalled": "hold",  # the experiment takes no samples
    "mode": "hold",  # the device regulates or runs something by itself
    "blank": "hold",  # the blank is not the run's
    "pump": "pumps_off",  # a pump runs that should not
    "overflow_pump": "hold",  # an overflow pump is configured and cannot be verified on
}
"""The declared response to every reason, a word of `WORDS`.

A reason that means the sensor cannot be believed may not regulate: the device would pump by the same reading.
"""

MAX_SETPOINT = 1.5  # OD; a larger one is a typing error
RAW_MIN, RAW_MAX = 5.0, 65534.0  # counts: a failed spectrometer reads 1, a saturated one 65535


@dataclass(frozen=True)
class Responses:
    """Responses of which a lab may choose others: report | hold | pumps_off | regulate | stop.

    report: dose as allowed. hold: no dose. pumps_off: no dose and the pumps off, verified. regulate: hand over to the
    device's own regulation for good. stop: no dose in this run any more.
    """

    budget: str = setting(RESPONSES["budget"], "a feed budget is used up", choices=tuple(WORDS)[1:])
    jump: str = setting(RESPONSES["jump"], "a step that neither growth nor a dose explains", choices=NOT_REGULATE)
    no_dilution: str = setting(RESPONSES["no_dilution"], "the pump ran but the OD did not fall", choices=NOT_REGULATE)
    falls: str = setting(RESPONSES["falls"], "the OD falls without a dose", choices=NOT_REGULATE[1:])
    fluorescence_lost: str = setting(
        RESPONSES["fluorescence_lost"], "no valid fluorescence for more than light_lost minutes",
        choices=tuple(WORDS),
    )  # fmt: skip

    def __post_init__(self) -> None:
        check(self, "safety.responses")


@dataclass(frozen=True)
class SafetyConfig:
    """Limits of the interlock between every controller and every pump, beside what the bench says; its own ledger."""

    ml_per_minute: float | None = setting(
        None,
        "feed budget per minute; null: 2.5 of the largest doses, since 60 s can contain two",
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
    jump: float = setting(
        0.04, "largest step that is not explained by growth and dose", "OD", above=0.0, below=math.inf
    )
    jump_fraction: float = setting(
        0.08, "the same as a fraction of the OD; 0.6 % of readings are such outliers", within=(0, 1)
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
    lost_s: float | None = setting(None, "age at which it is lost; null: three control periods", "s", at_most=14400.0)
    silent: float = setting(120.0, "silence after which the run ends a reactor", "min", above=0.0, below=math.inf)
    cooling: float = setting(
        90.0, "slowest time constant of cooling to a lower target", "min", above=0.0, below=math.inf
    )
    light_min: float = setting(1.0, "fluorescence below is a dead LED or spectrometer", "counts", within=(0, 65534))
    frozen_light: int = setting(5, "equal fluorescence readings in a row that count as frozen", within=(2, 60))
    light_lost: float = setting(
        15.0, "time without a valid fluorescence until it is reported", "min", above=0.0, below=math.inf
    )
    composition_low: float = setting(
        29.0, "lowest target of a composition controller; composition_high or less", "degC", within=(15, 42)
    )
    composition_high: float = setting(36.0, "highest target of a composition controller", "degC", within=(15, 42))
    controller_patience: int = setting(5, "unusable proposals in a row until it counts as failed", within=(1, 60))
    responses: Responses = part(
        Responses, "what is done about some reasons; about all others what docs/three_am.md says"
    )

    def __post_init__(self) -> None:
        check(self, "safety")
        low, high = self.targets
        require(low <= high, "safety.composition_high", high, f"{low:g} to 42")

    def response(self, kind: str) -> Response:
        """Return the response to a reason. Raises: KeyError if there is none of that name."""
        return WORDS[getattr(self.responses, kind, RESPONSES[kind])]

    def ml_a_minute(self, bench: Bench) -> float:
        """Feed budget of a minute, mL."""
        return 2.5 * (bench.max_rate * bench.period_s) if self.ml_per_minute is None else self.ml_per_minute

    @property
    def targets(self) -> tuple[float, float]:
        """Lowest and highest target of the thermostat that a signal may set, degC."""
        return self.composition_low, self.composition_high

    def ages_s(self, bench: Bench) -> tuple[float, float]:
        """Ages of a newest sample that is stale and that is lost, s.

        Raises: ValueError for an age that is over before the next sample comes.
        """
        stale_s = bench.stale_s if self.stale_s is None else self.stale_s
        lost_s = max(3.0 * bench.period_s, stale_s) if self.lost_s is None else self.lost_s
        require(stale_s >= 1.1 * bench.period_s, "safety.stale_s", stale_s, f"{1.1 * bench.period_s:g} to 7200")
        require(lost_s >= stale_s, "safety.lost_s", lost_s, f"{stale_s:g} to 14400")
        return stale_s, lost_s
