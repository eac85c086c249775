"""Conversion of volumes to pump times: only here mL become a duty (docs/device.md, Pumps and Waste)."""

import math
from dataclasses import dataclass, fields
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from conf.schema import build, check, require, setting
from hardware.chibio.protocol import CONTROL_S, FEED, PERIOD_S, SPARE
from hardware.stations import Plan

Array = NDArray[np.float64]

MAX_FEED_DUTY = 0.05  # docs/device.md, Client rules; the lowest layer (`protocol.check_command`) refuses more
DOSE_ML = 0.5  # smallest dose of a spare pump, envs/scenario.py
WASTE_FACTOR, WASTE_EXTRA_S = 4.0, 4.4  # the device's own; longer does no harm, as the waste tube sets the level
CLEAR_EVERY, CLEAR_DUTY = 5, 0.25  # every so many doses the waste pump clears its tube, fraction of 63 s
MAX_WASTE_DUTY = 0.5  # 63 s * duty must end before the next measurement


@dataclass(frozen=True)
class PumpCalibration:
    """Volume of one dose: v = flow_ml_s * (63 s * duty + bias_s), with a relative spread from dose to dose.

    bias_s: negative if the motor delivers nothing for this time. Raises: ValueError naming key, value and range.
    """

    flow_ml_s: float = setting(1.0, "flow at full power", "mL/s", within=(0.05, 5.0))
    bias_s: float = setting(0.0, "time by which the motor runs longer than requested", "s", within=(-1.0, 1.0))
    spread: float = setting(0.1, "sd of a single dose relative to its volume", within=(0.0, 1.0))
    min_on_s: float = setting(0.3, "shortest reliable on-time", "s", within=(0.0, 2.0))
    date: str = setting("", "date of the weighing; '': never, nominal values")
    device_id: str = setting("", "unit on which the pump was weighed")

    def __post_init__(self) -> None:
        check(self, "pump calibration")

    def on_time(self, volume_ml: float) -> float:
        """Return the on-time that delivers `volume_ml`, s; not below 0."""
        return max(volume_ml / self.flow_ml_s - self.bias_s, 0.0)

    def volume(self, on_s: float) -> float:
        """Return the mL that `on_s` seconds deliver; not below 0."""
        return max(self.flow_ml_s * (on_s + self.bias_s), 0.0) if on_s > 0.0 else 0.0

    @property
    def min_dose_ml(self) -> float:
        return self.volume(self.min_on_s)

    @classmethod
    def from_dict(cls, values: dict[str, Any]) -> Self:
        """Invert `asdict`; ignore other keys, such as the weighings. Raises: ValueError naming key and range."""
        known = {f.name: values[f.name] for f in fields(cls) if f.name in values}
        texts = {key: str(known[key]) for key in ("date", "device_id") if key in known}  # YAML parses a date
        return build(cls(), known | texts, "pump calibration")


@dataclass(frozen=True)
class ReactorCalibration:
    """Bench calibration of one reactor: its two pumps and its blank.

    blank: raw counts of clear medium under run conditions; nan: use the device's blank.
    """

    feed: PumpCalibration = PumpCalibration()
    waste: PumpCalibration = PumpCalibration()
    blank: float = math.nan

    @property
    def calibrated(self) -> bool:
        return bool(self.feed.date and self.waste.date)


@dataclass(frozen=True)
class SupplyConfig:
    """Spare pumps for a second medium, an inducer or a stressor; a standard reactor has no tubes on them."""

    pump3_ml_s: float = setting(0.0, "weighed flow of Pump3 at full power; 0: no tube", "mL/s", within=(0, 1.5))
    pump4_ml_s: float = setting(0.0, "weighed flow of Pump4 at full power; 0: no tube", "mL/s", within=(0, 1.5))
    bias_s: float = setting(0.0, "weighed extra time for which both pumps run", "s", within=(-0.2, 0.5))

    def __post_init__(self) -> None:
        check(self, "backend.supply")
        for pump in self.pumps:  # a dose that is too small for the pump would block the feed for ever
            key, flow = f"backend.supply.{pump.lower()}_ml_s", self.flow_ml_s(pump)
            least = self.calibration(pump).min_dose_ml
            require(flow >= 0.2, key, flow, "0 or 0.2 to 1.5 mL/s")
            require(least <= DOSE_ML, key, flow, f"a flow that gives at most {DOSE_ML:g} mL in 0.3 s plus bias_s")

    def calibration(self, pump: str) -> PumpCalibration:
        return PumpCalibration(flow_ml_s=self.flow_ml_s(pump), bias_s=self.bias_s)

    def flow_ml_s(self, pump: str) -> float:
        """Return the flow of a spare pump, mL/s; 0 for other pumps."""
        return {"Pump3": self.pump3_ml_s, "Pump4": self.pump4_ml_s}.get(pump, 0.0)

    def most_ml(self, pump: str) -> float:
        """Return the largest dose of a spare pump, mL."""
        return self.calibration(pump).volume(PERIOD_S * MAX_FEED_DUTY)

    @property
    def pumps(self) -> tuple[str, ...]:
        return tuple(pump for pump in SPARE if self.flow_ml_s(pump) > 0.0)


@dataclass(frozen=True)
class DosePlan(Plan):
    """One dose as the device receives it: duties of feed and waste pump.

    shortfall_ml: volume that the limit of the feed duty cut off; it is not carried over. pump: pump that feeds.
    """

    feed_duty: float = 0.0
    waste_duty: float = 0.0
    shortfall_ml: float = 0.0
    pump: str = FEED

    @property
    def feed_s(self) -> float:
        return PERIOD_S * self.feed_duty

    @property
    def waste_s(self) -> float:
        return PERIOD_S * self.waste_duty


def plan_dose(rate: float, carry_ml: float, doses: int, calibration: ReactorCalibration) -> DosePlan:
    """Plan the dose that gives `rate` over one control period plus the volume carried over from earlier periods.

    feed duty = (v / q - bias) / 63 with v = rate * period + carry. While v is below the smallest dose, nothing is dosed
    and v becomes the new carry, so the mean flow is right even if single doses are too small for the pump.
    Args: rate: mean feed rate, mL/s. carry_ml: carry of the previous plan, mL. doses: number of doses given so far;
      every `CLEAR_EVERY`-th dose clears the waste tube.
    Raises: ValueError if the rate is negative or not finite.
    """
    if not (math.isfinite(rate) and rate >= 0.0):
        raise ValueError(f"pump rate = {rate} mL/s: allowed a finite number >= 0")
    feed, waste = calibration.feed, calibration.waste
    volume = rate * CONTROL_S + carry_ml
    # at a rate of 0 the carry waits until the controller requests feed again
    if rate == 0.0 or volume < feed.min_dose_ml or volume == 0.0:
        return DosePlan(carry_ml=min(volume, feed.min_dose_ml))
    duty = math.floor(feed.on_time(volume) / PERIOD_S * 1e6) / 1e6  # digits of the URL
    feed_duty = min(duty, MAX_FEED_DUTY)
    feed_s = PERIOD_S * feed_duty
    feed_ml = feed.volume(feed_s)
    # factor * feed time + extra, and at least 1.5 times the fed volume if the waste pump is weaker
    waste_s = max(WASTE_FACTOR * feed_s + WASTE_EXTRA_S, waste.on_time(1.5 * feed_ml))
    if (doses + 1) % CLEAR_EVERY == 0:
        waste_s = max(waste_s, PERIOD_S * CLEAR_DUTY)
    waste_duty = min(math.ceil(waste_s / PERIOD_S * 1e6) / 1e6, MAX_WASTE_DUTY)
    left = max(volume - feed_ml, 0.0)
    return DosePlan(
        feed_duty=feed_duty,
        waste_duty=waste_duty,
        feed_ml=feed_ml,
        waste_ml=waste.volume(PERIOD_S * waste_duty),
        shortfall_ml=left if duty > feed_duty else 0.0,
    )


@dataclass(frozen=True)
class PumpFit:
    """A fitted calibration with the uncertainty of its parameters (one standard error)."""

    calibration: PumpCalibration
    flow_se: float
    bias_se: float


def fit_pump(on_s: Array, doses: Array, grams: Array, date: str = "", device_id: str = "") -> PumpFit:
    """Least-squares fit of v = q (t + bias) to weighed series of doses; water or medium, 1 g = 1 mL.

    Each series of n doses of t seconds weighs g grams, so its mean dose g/n has variance proportional to 1/n: weighted
    linear regression of g/n on t with weights n. The spread of a single dose follows from the weighted residuals. The
    shortest reliable on-time is the shortest weighed one whose mean dose is at least 0.7 of the fitted line, and at
    least 0.3 s (docs/device.md, Pumps).

    Args: on_s: requested on-time of each series, s, > 0, at least two different values. doses: number of doses of each
      series. grams: weight of each series, g. All of shape (K,).
    Raises: ValueError if the series cannot determine a line, or the fitted pump is out of range.
    """
    t, n, y = (np.asarray(a, dtype=np.float64) for a in (on_s, doses, grams))
    if not (t.shape == n.shape == y.shape and t.ndim == 1 and t.size >= 2):
        raise ValueError(f"pump calibration needs at least 2 series of equal length, got {t.size}, {n.size}, {y.size}")
    if not (np.all(np.isfinite(t + n + y)) and np.all(t > 0.0) and np.all(n >= 1) and np.all(y >= 0.0)):
        raise ValueError("pump calibration: on-times must be > 0 s, doses >= 1, grams >= 0, all finite")
    if np.ptp(t) < 0.2:
        raise ValueError(f"pump calibration: on-times {t.min():.2f} to {t.max():.2f} s: allowed a range of 0.2 s")
    dose = y / n
    (flow, at_0), covariance = np.polyfit(t, dose, 1, w=np.sqrt(n), cov="unscaled")
    if flow <= 1e-9:
        raise ValueError(f"pump calibration: fitted flow {flow:.3f} mL/s: longer doses weighed less; weigh again")
    bias = float(at_0 / flow)
    residual = dose - flow * (t + bias)
    freedom = t.size - 2
    sigma = math.sqrt(float(np.sum(n * residual**2)) / freedom) if freedom > 0 else math.nan  # mL, of one dose
    slopes = np.array([-bias, 1.0]) / flow  # of the bias, in flow and in dose at 0 s
    flow_se, bias_se = sigma * math.sqrt(covariance[0, 0]), sigma * math.sqrt(slopes @ covariance @ slopes)
    spread = min(sigma / float(np.mean(dose)), 1.0) if math.isfinite(sigma) else 0.1
    useful = t[dose >= 0.7 * flow * np.maximum(t + bias, 1e-9)]
    min_on = float(np.clip(useful.min() if useful.size else t.max(), 0.3, 2.0))
    calibration = PumpCalibration(float(flow), bias, spread, min_on, date, device_id)
    return PumpFit(calibration, flow_se, bias_se)
