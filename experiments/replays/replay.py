"""Replay of a recording: estimator, controller and interlock process its readings, but cannot act on it."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from envs.identification.screening import Series
from envs.scenario import Scenario
from envs.task import EnvConfig
from experiments.laws.base import Array, Controller, Estimates
from experiments.laws.density.estimator import FIXED, Estimator
from experiments.laws.density.estimators import WithEstimator
from experiments.loop.loop import ClosedLoop
from hardware.reactor import Measurement
from hardware.safety.interlock import Interlock
from hardware.watched import Watched

AHEAD = 10  # readings from a prediction to the predicted one
INSIDE = 1.96  # half width of the 95 % band of a prediction, in its sds


class _Recorded(Watched):
    """A recording in place of a reactor. Args: series: its readings, (K,). temperature: degC, (K,)."""

    def __init__(self, series: Series, temperature: Array) -> None:
        super().__init__(("recording",))
        self._series, self._temperature, self._k = series, temperature, -1
        self.fed_ml = 60.0 * series.pump_rate[:-1] * np.diff(series.time)

    def measure(self) -> Measurement:
        """Return the next reading. `repeated` then returns the doses before this reading."""
        if self._k >= 0:
            self.seen(self.elapsed(), self.fed_ml[self._k : self._k + 1])
        self._k += 1
        one = slice(self._k, self._k + 1)
        od = self._series.od[one]
        return Measurement(60.0 * self._series.time[one], od, self._temperature[one], np.ones(1, dtype=np.bool_))

    def elapsed(self) -> float:
        return float(60.0 * self._series.time[max(self._k, 0)])


@dataclass(frozen=True, eq=False)
class Replayed:
    """Readings of a recording, and estimates and decisions of a run on these readings, (K,) each.

    believed: whether the interlock accepts the reading. decided_ml: dose of the controller until the next reading.
    given_ml: dose of the device. mu: 1/min. gain: pump flow over its setting. low, high: 95 % band of the OD predicted
    `AHEAD` readings before, nan if unknown. one, ten: whether the reading is in the band predicted 1 or 10 readings
    before, nan if unknown. acted: whether the supervisor acted. reasons: alarms of the interlock, "" for none.
    """

    setpoint: float
    minutes: Array
    od: Array
    believed: NDArray[np.bool_]
    decided_ml: Array
    given_ml: Array
    mu: Array
    gain: Array
    low: Array
    high: Array
    one: Array
    ten: Array
    acted: Array
    reasons: tuple[str, ...]

    @property
    def doses(self) -> dict[str, float]:
        """Per cent of readings after which both device and controller dose, neither does, or only one of them does."""
        ours, theirs = self.decided_ml[:-1] > 0.0, self.given_ml[:-1] > 0.0  # the last reading has no dose after it
        each = {
            "both": ours & theirs,
            "neither": ~ours & ~theirs,
            "device": theirs & ~ours,
            "controller": ours & ~theirs,
        }
        return {name: 100.0 * float(rows.mean()) for name, rows in each.items()}


def replay(
    series: Series, temperature: Array, law: Controller, interlock: Interlock, setpoint: float, model: EnvConfig
) -> Replayed:
    """Replay a recording. A dose that was decided but not given is not added to later doses.

    Args: series: readings, with times from 0, min. law: the controller. interlock: a `WatchedInterlock` of one reactor.
      model: initial model of the estimator that is added to a controller without one.
    """
    law = law if isinstance(law, Estimates) else WithEstimator(law, model)
    device, n = _Recorded(series, temperature), len(series.time)
    warm = float(np.clip(np.nanmedian(temperature), 15.0, 42.0)) if np.isfinite(temperature).any() else 37.0
    schedule = Scenario((setpoint,), (series.time[-1] + 1.0,), (warm,))
    loop = ClosedLoop(device, law, interlock, schedule, at_end="hold", model=model)
    apart = np.diff(series.time, append=series.time[-1] + interlock.bench.control_min)
    found = {key: np.full(n, np.nan) for key in ("rate", "believed", "mu", "gain", "alarm", "square")}
    ahead, reasons = np.full((n + AHEAD, 2), np.nan), []
    for k in range(n):
        step = loop.step()
        known: dict[str, Any] = step.explanation | {"rate": step.rate, "believed": step.believed}
        for key, values in found.items():
            values[k] = known[key][0] if key in known else np.nan
        reasons.append(step.reasons[0] or "")
        if isinstance(law.estimator, Estimator) and known["believed"][0]:
            steps = slice(k, min(k + AHEAD, n - 1))
            expected = law.estimator.ahead(apart[steps], device.fed_ml[steps])
            found["square"][k] = law.estimator.square[0]
            if len(expected) == AHEAD:
                ahead[k + AHEAD] = expected[-1]
    believed = found["believed"] > 0.0
    middle, sd = ahead[:n].T
    off = (np.log(np.maximum(series.od, FIXED.lowest_od)) - middle) / sd
    one, ten = (np.where(np.isfinite(z) & believed, z <= INSIDE**2, np.nan) for z in (found["square"], off**2))
    return Replayed(
        setpoint, series.time, series.od, believed, 60.0 * found["rate"] * apart,
        np.append(device.fed_ml, 0.0), found["mu"], found["gain"], np.exp(middle - INSIDE * sd),
        np.exp(middle + INSIDE * sd), one, ten, np.nan_to_num(found["alarm"]), tuple(reasons),
    )  # fmt: skip
