"""Limits and declared responses of the interlock, and the remedy for each of its reasons."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, fields
from enum import IntEnum

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


WORDS = {
    "report": Response.PASS,
    "hold": Response.HOLD,
    "pumps_off": Response.PUMPS_OFF,
    "regulate": Response.REGULATE,
    "stop": Response.STOP,
}
DONE = {
    Response.PASS: "reported",
    Response.HOLD: "no dose",
    Response.PUMPS_OFF: "pumps off",
    Response.REGULATE: "handed over to the on-board regulation",
    Response.STOP: "stopped",
}

REMEDIES = {
    "setpoint": "correct the schedule: setpoints are OD over 0 and at most the configured maximum",
    "controller": "look at the policy's input and output in the journal",
    "controller_lost": "replace the policy, then start a new run",
    "limit": "nothing if the controller asked too much; else raise the limit in conf/safety",
    "budget": "check for a leak or wash-out; raise the budget in conf/safety if the flow is right",
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
    "silent": "repair the link or the device, then resume the run",
    "hot": "check heater and thermometer; heating stays off in this run",
    "thermometer": "check that the vial is seated; heating stays off in this run",
    "device": "see the text",
}
MAY_BE_REPORTED = ("limit", "undosed", "no_dilution", "cannot_hold", "thermometer", "hot", "jump", "stale")
SENSOR_REASONS = ("impossible", "spectrometer", "frozen", "jump", "no_dilution", "falls", "stale", "lost", "silent")


@dataclass(frozen=True)
class Responses:
    """The declared response to every reason: report | hold | pumps_off | regulate | stop.

    link to overflow_pump are the kinds of `reactor.Fault`. A reason that means the sensor cannot be believed may not
    regulate: the device would pump by the same reading.
    """

    setpoint: str = "hold"
    controller: str = "hold"
    controller_lost: str = "regulate"
    limit: str = "report"
    budget: str = "hold"
    bottle: str = "hold"
    overflow: str = "pumps_off"
    undosed: str = "report"
    impossible: str = "hold"
    spectrometer: str = "pumps_off"
    frozen: str = "hold"
    jump: str = "hold"
    no_dilution: str = "hold"
    cannot_hold: str = "report"
    falls: str = "pumps_off"
    stale: str = "hold"
    lost: str = "pumps_off"
    silent: str = "stop"
    hot: str = "hold"
    thermometer: str = "report"
    link: str = "hold"
    selection: str = "hold"
    identity: str = "stop"
    absent: str = "hold"
    restarted: str = "hold"
    stopped: str = "pumps_off"
    stalled: str = "hold"
    mode: str = "hold"
    blank: str = "hold"
    pump: str = "pumps_off"
    overflow_pump: str = "hold"

    def __post_init__(self) -> None:
        for f in fields(self):
            word = getattr(self, f.name)
            if word not in WORDS:
                raise ValueError(f"safety.responses.{f.name} = {word}: allowed {', '.join(WORDS)}")
            if word == "regulate" and f.name in (*SENSOR_REASONS, "blank", "stalled", "restarted", "link"):
                raise ValueError(
                    f"safety.responses.{f.name} = regulate: not allowed, the device would pump by the reading that is "
                    "not to be believed; use hold, pumps_off or stop"
                )
            if word == "report" and f.name not in MAY_BE_REPORTED:
                raise ValueError(f"safety.responses.{f.name} = report: at least hold is needed for this reason")


@dataclass(frozen=True)
class SafetyConfig:
    """Values of `conf/safety/default.yaml`. Volumes mL, rates 1/min or mL/s, times min unless the name says s.

    max_rate: largest feed rate that passes, mL/s. period_s: control period a rate stands for, s.
    ml_per_minute, ml_per_hour, ml_per_run: feed budgets of one reactor; bottle_ml: fresh medium at the start.
    volume_ml: level the waste tube keeps; max_volume_ml: more than this by the ledger is an overflow.
    max_setpoint: a larger one is a typing error. od_min, od_max: readings outside are impossible. raw_min, raw_max:
      likewise, counts. frozen_samples: this many equal readings are a dead thread.
    mu_max: no culture grows faster. gain_min, gain_max: what a dose can deliver relative to its calibration; death:
      fastest decline without a dose. jump, jump_fraction: a step of more than max(jump, jump_fraction * OD) beyond
      what growth and dose explain is no culture. accept_up, accept_down: consistent readings after which a step is
      believed (bubbles last up to 5 readings).
    drift: unexplained change of ln OD that trips no_dilution or falls once it has lasted for `persistence` samples;
      noise_od, noise_fraction: sensor noise, of which six standard deviations are added to it.
    cooldown: no dose for so long after no_dilution, falls. stale_s, lost_s: age of the newest sample, s; silent: age
      at which a reactor is given up.
    hot_excess: allowed above the thermostat target, degC; max_temperature: absolute limit, degC; cooling: a vial
      cools to a lower target with at most this time constant.
    controller_patience: so many unusable proposals in a row mean that the controller is lost.
    """

    max_rate: float = 0.02
    period_s: float = 60.0
    ml_per_minute: float = 3.0
    ml_per_hour: float = 75.0
    ml_per_run: float = 10000.0
    bottle_ml: float = 2000.0
    volume_ml: float = 20.0
    max_volume_ml: float = 25.0
    max_setpoint: float = 1.5
    od_min: float = -0.1
    od_max: float = 4.0
    raw_min: float = 5.0
    raw_max: float = 65534.0
    frozen_samples: int = 3
    mu_max: float = 0.04
    gain_min: float = 0.5
    gain_max: float = 1.6
    death: float = 0.005
    jump: float = 0.04
    jump_fraction: float = 0.08
    accept_up: int = 6
    accept_down: int = 3
    drift: float = 0.05
    persistence: int = 3
    noise_od: float = 0.005
    noise_fraction: float = 0.005
    cooldown: float = 5.0
    stale_s: float = 100.0
    lost_s: float = 180.0
    silent: float = 120.0
    hot_excess: float = 2.0
    max_temperature: float = 42.0
    cooling: float = 90.0
    controller_patience: int = 5
    responses: Responses = field(default_factory=Responses)

    def __post_init__(self) -> None:
        ranges = {
            "max_rate": (0.0, 0.05),
            "period_s": (10.0, 600.0),
            "volume_ml": (10.0, 30.0),
            "max_volume_ml": (self.volume_ml, 30.0),
            "max_setpoint": (0.05, 4.0),
            "od_max": (self.max_setpoint, 10.0),
            "frozen_samples": (2, 60),
            "mu_max": (0.001, 0.1),
            "gain_min": (0.05, 1.0),
            "gain_max": (1.0, 5.0),
            "accept_up": (2, 60),
            "accept_down": (2, 60),
            "drift": (0.01, 1.0),
            "persistence": (1, 30),
            "stale_s": (self.period_s * 1.1, 3600.0),
            "lost_s": (self.stale_s, 7200.0),
            "max_temperature": (20.0, 45.0),
            "controller_patience": (1, 60),
        }
        for key, (low, high) in ranges.items():
            if not low <= getattr(self, key) <= high:
                raise ValueError(f"safety.{key} = {getattr(self, key)}: allowed {low:g} to {high:g}")
        for key in ("ml_per_minute", "ml_per_hour", "ml_per_run", "bottle_ml", "jump", "cooldown", "silent", "cooling"):
            if not 0.0 < getattr(self, key) < math.inf:
                raise ValueError(f"safety.{key} = {getattr(self, key)}: allowed a finite number over 0")
