"""Limits and declared responses of the interlock, and the remedy for each of its reasons."""

import math
from dataclasses import dataclass, fields
from enum import IntEnum

from conf.schema import check, part, require, setting
from envs.bench import Bench

__all__ = ["DONE", "REMEDIES", "WORDS", "Response", "Responses", "SafetyConfig"]


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
_DONE = ("reported", "no dose", "pumps off", "handed over to the on-board regulation", "stopped")
DONE = dict(zip(Response, _DONE, strict=True))

REMEDIES = {
    "setpoint": "correct the schedule: setpoints are OD over 0 and at most the configured maximum",
    "controller": "look at the policy's input and output in the journal",
    "controller_lost": "replace the policy, then start a new run",
    "limit": "nothing if the controller asked too much; else raise bench.max_rate",
    "budget": "check for a leak or wash-out; if the flow is right, raise safety.ml_per_hour or ml_per_run",
    "bottle": "fill the bottle and start a new run with its content",
    "overflow": "check waste pump and tube",
    "undosed": "look at the run's notes for why doses are not given: link too slow, device not as set",
    "impossible": "check cable, vial and blank",
    "spectrometer": "check the spectrometer's cable; restart the device if it persists",
    "frozen": "look at the device's terminal: its measuring thread may be dead",
    "jump": "check for bubbles, foam and a moved vial",
    "no_dilution": "check feed tube, bottle and gasket; clean the vial's wall",
    "cannot_hold": "the culture outgrows the pump, or the pump has become weak: weigh its doses, check gasket and tube",
    "falls": "check for a pump that runs on, a leak, a stopped stirrer",
    "stale": "check link and device",
    "lost": "check link and device; pumps are swept off as soon as it answers",
    "silent": "repair the link or the device, then start a new run; a stopped reactor stays so when resumed",
    "hot": "check heater and thermometer; heating stays off in this run",
    "thermometer": "check that the vial is seated; heating stays off in this run",
    "device": "see the text",
    "fluorescence": "check LED, spectrometer and the slot's gain",
    "fluorescence_lost": "composition is not seen: check LED and spectrometer, then look at the device's FP slot",
    "temperature_limit": "nothing if the law asked for too much; else set safety.composition_low and composition_high",
}
MAY_BE_REPORTED = (
    "limit",
    "undosed",
    "no_dilution",
    "cannot_hold",
    "thermometer",
    "hot",
    "jump",
    "stale",
    "fluorescence",
    "fluorescence_lost",
    "temperature_limit",
)
SENSOR_REASONS = ("impossible", "spectrometer", "frozen", "jump", "no_dilution", "falls", "stale", "lost", "silent")
CHOICES = tuple(WORDS)


@dataclass(frozen=True)
class Responses:
    """The declared response to every reason: report | hold | pumps_off | regulate | stop.

    report: dose as allowed. hold: no dose. pumps_off: no dose and the pumps off, verified. regulate: hand over to the
    device's own regulation for good. stop: no dose in this run any more. The fields from link to overflow_pump are
    kinds of `reactor.Fault`. A reason that means the sensor cannot be believed may not regulate: the device would pump
    by the same reading.
    """

    setpoint: str = setting("hold", "outside (0, max_setpoint]", choices=CHOICES)
    controller: str = setting("hold", "proposed rate negative or no number", choices=CHOICES)
    controller_lost: str = setting("regulate", "too many unusable proposals in a row", choices=CHOICES)
    limit: str = setting("report", "proposed more than max_rate: cut", choices=CHOICES)
    budget: str = setting("hold", "a feed budget is used up", choices=CHOICES)
    bottle: str = setting("hold", "the bottle is empty by the ledger", choices=CHOICES)
    overflow: str = setting("pumps_off", "the vial overflows by the ledger", choices=CHOICES)
    undosed: str = setting("report", "doses are allowed but the device gets none", choices=CHOICES)
    impossible: str = setting("hold", "OD or counts that no culture has", choices=CHOICES)
    spectrometer: str = setting("pumps_off", "OD 12 to 14", choices=CHOICES)
    frozen: str = setting("hold", "the same reading again and again", choices=CHOICES)
    jump: str = setting("hold", "a step that neither growth nor dose explains", choices=CHOICES)
    no_dilution: str = setting("hold", "the pump ran but OD did not fall", choices=CHOICES)
    cannot_hold: str = setting(
        "report", "full feed does not bring OD to the setpoint; lasts as long as that", choices=CHOICES
    )
    falls: str = setting("pumps_off", "OD falls without pump", choices=CHOICES)
    stale: str = setting("hold", "the newest sample is older than stale_s", choices=CHOICES)
    lost: str = setting("pumps_off", "and older than lost_s", choices=CHOICES)
    silent: str = setting("stop", "nothing for `silent` minutes", choices=CHOICES)
    hot: str = setting("hold", "too warm; the heater is switched off as well", choices=CHOICES)
    thermometer: str = setting("report", "reads nonsense; the heater is switched off", choices=CHOICES)
    fluorescence: str = setting("report", "none, none at all, full scale or frozen", choices=CHOICES)
    fluorescence_lost: str = setting("report", "and for more than light_lost minutes", choices=CHOICES)
    temperature_limit: str = setting("report", "a composition's temperature was out of range: cut", choices=CHOICES)
    link: str = setting("hold", "no answer", choices=CHOICES)
    selection: str = setting("hold", "the device addresses another reactor", choices=CHOICES)
    identity: str = setting("stop", "another device than the run began with", choices=CHOICES)
    absent: str = setting("hold", "no reactor at this position", choices=CHOICES)
    restarted: str = setting("hold", "the device lost its memory", choices=CHOICES)
    stopped: str = setting("pumps_off", "the experiment no longer runs", choices=CHOICES)
    stalled: str = setting("hold", "the experiment takes no samples", choices=CHOICES)
    mode: str = setting("hold", "the device regulates or runs something by itself", choices=CHOICES)
    blank: str = setting("hold", "the blank is not the run's", choices=CHOICES)
    pump: str = setting("pumps_off", "a pump runs that should not", choices=CHOICES)
    overflow_pump: str = setting("hold", "an overflow pump is configured and cannot be verified on", choices=CHOICES)

    def __post_init__(self) -> None:
        check(self, "safety.responses")
        for f in fields(self):
            word = getattr(self, f.name)
            if word == "regulate" and f.name in (*SENSOR_REASONS, "blank", "stalled", "restarted", "link"):
                raise ValueError(
                    f"safety.responses.{f.name} = regulate: not allowed, the device would pump by the reading that is "
                    "not to be believed; use hold, pumps_off or stop"
                )
            if word == "report" and f.name not in MAY_BE_REPORTED:
                raise ValueError(f"safety.responses.{f.name} = report: at least hold is needed for this reason")


@dataclass(frozen=True)
class SafetyConfig:
    """Limits of the interlock between every controller and every pump, beside what the bench says; its own ledger."""

    ml_per_minute: float = setting(
        3.0, "feed budget; two doses may fall into 60 s when a sample is late", "mL", above=0.0, below=math.inf
    )
    ml_per_hour: float = setting(75.0, "feed budget", "mL", above=0.0, below=math.inf)
    ml_per_run: float = setting(10000.0, "feed budget", "mL", above=0.0, below=math.inf)
    overflow_ml: float = setting(
        5.0, "so much above the waste tube is an overflow, and whatever a vial cannot hold", "mL", within=(0, 10)
    )
    max_setpoint: float = setting(1.5, "a larger setpoint is a typing error", "OD", within=(0.05, 4))
    od_min: float = setting(-0.1, "readings below are impossible", "OD")
    od_max: float = setting(4.0, "readings above are impossible; max_setpoint or more", "OD", at_most=10.0)
    raw_min: float = setting(5.0, "impossible below; a failed spectrometer reads 1", "counts")
    raw_max: float = setting(65534.0, "impossible above; a saturated spectrometer reads 65535", "counts")
    frozen_samples: int = setting(3, "equal readings in a row that no noisy sensor gives", within=(2, 60))
    mu_max: float = setting(0.04, "no culture grows faster (LB at 37 degC: 0.031)", "1/min", within=(0.001, 0.1))
    gain_min: float = setting(0.5, "least that a dose delivers, of what its calibration says", within=(0.05, 1))
    gain_max: float = setting(1.6, "and most", within=(1, 5))
    death: float = setting(0.005, "fastest decline without a dose", "1/min")
    jump: float = setting(
        0.04, "a step beyond growth and dose of more than this is no culture", "OD", above=0.0, below=math.inf
    )
    jump_fraction: float = setting(0.08, "or of more than this fraction of OD; 0.6 % of readings are such outliers")
    accept_up: int = setting(
        6, "consistent readings after which a step up is believed; bubbles last up to 5", within=(2, 60)
    )
    accept_down: int = setting(3, "and a step down", within=(2, 60))
    drift: float = setting(
        0.05,
        "unexplained change of ln OD, on top of six sd of the sensor, that trips no_dilution or falls",
        within=(0.01, 1),
    )
    persistence: int = setting(3, "in so many samples in a row", within=(1, 30))
    noise_od: float = setting(0.005, "sd of the sensor", "OD")
    noise_fraction: float = setting(0.005, "its part that is proportional to OD")
    cooldown: float = setting(5.0, "without a dose after no_dilution or falls", "min", above=0.0, below=math.inf)
    stale_s: float | None = setting(
        None, "age of a newest sample that is stale; null: 40 s more than a control period", "s", at_most=7200.0
    )
    lost_s: float | None = setting(None, "and that is lost; null: three control periods", "s", at_most=14400.0)
    silent: float = setting(120.0, "after which a reactor is given up", "min", above=0.0, below=math.inf)
    hot_excess: float = setting(2.0, "above the thermostat's target, in 3 samples", "degC")
    max_temperature: float = setting(42.0, "absolute limit, in 2 samples", "degC", within=(20, 45))
    cooling: float = setting(
        90.0, "slowest time constant of cooling to a lower target", "min", above=0.0, below=math.inf
    )
    light_min: float = setting(1.0, "fluorescence below is a dead LED or spectrometer", "counts", within=(0, 65534))
    frozen_light: int = setting(5, "equal readings of fluorescence in a row that no noisy sensor gives", within=(2, 60))
    light_lost: float = setting(
        15.0, "without a believed fluorescence, then that is said until it comes back", "min", above=0.0, below=math.inf
    )
    composition_low: float = setting(
        29.0, "lowest target that a composition controller may set; composition_high or less", "degC", within=(15, 42)
    )
    composition_high: float = setting(36.0, "and highest", "degC", within=(15, 42))
    controller_patience: int = setting(5, "unusable proposals in a row: the controller is lost", within=(1, 60))
    responses: Responses = part(Responses, "what is done about each reason")

    def __post_init__(self) -> None:
        check(self, "safety")
        self._reaches("od_max", self.max_setpoint, 10.0)
        self._reaches("composition_high", self.composition_low, 42.0)

    def _reaches(self, key: str, low: float, high: float) -> None:
        given = getattr(self, key)
        require(low <= given, f"safety.{key}", given, f"{low:g} to {high:g}")

    def ages_s(self, bench: Bench) -> tuple[float, float]:
        """Ages of a newest sample that is stale and that is lost, s.

        Raises: ValueError for an age that is over before the next sample comes.
        """
        stale_s = bench.stale_s if self.stale_s is None else self.stale_s
        lost_s = max(3.0 * bench.period_s, stale_s) if self.lost_s is None else self.lost_s
        require(stale_s >= 1.1 * bench.period_s, "safety.stale_s", stale_s, f"{1.1 * bench.period_s:g} to 7200")
        require(lost_s >= stale_s, "safety.lost_s", lost_s, f"{stale_s:g} to 14400")
        return stale_s, lost_s
