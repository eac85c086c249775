"""A second plant with two species, from the published equations; it shares no code with the package's plant.

N vials of E. coli (e) and P. putida (p) run side by side under an estimator and a law of the share r = p / (e + p).
Model: Lee, Morlock, Allan, Steel, Cell Reports Methods 5:101009 (2025), CompEst3000:
e' = m_e e - D e, p' = m_p p - D p, f' = g p - D f, g' = 1.6/h (g_ss(T) - g(t - 30 min)), and the rates m follow their
curves first order. Cells feel the true temperature; thermostat, estimator and record see the thermometer.

OD and counts are the units of e, p and of the pigment f; rates are per hour, doses in mL, temperatures in degC.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from experiments.coculture.base import Array, Wanted

DAY = 1440  # minutes
VOLUME = 20.0  # mL, constant: what comes in pushes as much out
DOSE_ML = 1.2  # of a minute in which the turbidostat doses
DOSE_UP, DOSE_DOWN = 0.53, 0.46  # OD above which it begins, and below which it ends
PUMP_ML_S = 1.0  # flow of the pump while it turns
START_OD = 0.5
HEATER = 2.0  # degC/min at full power, before the loss to the air
LAG_MIN = np.array([[2.0], [60.0]])  # of the rates of e and p
CURVES = np.array([[[0.0], [-0.02208]], [[0.07727], [1.3796]], [[-1.66954], [-20.56996]]])  # (power, species, 1)
VALID_C = (29.0, 36.0)  # the curves take the nearer end outside
PIGMENT = (44.49572512791427, 31.820479677943325, -917.5864128224449, -886.6854718162117, 6318.711894680335)
PIGMENT_FLOOR, PIGMENT_PER_H, PIGMENT_DELAY_MIN = 20.0, 1.6, 30
GLOW = 150.0  # counts per OD of cells, whatever their species
OD_SD, OD_RELATIVE_SD, LIGHT_SD, THERMOMETER_SD = 0.005, 0.01, 30.0, 0.05
STEP_S, STEPS = 5.0, 12  # of a minute
BAND_C = 0.5  # of the thermostat, proportional
PREVIEW_MIN = 360.0  # before which a change of the setpoint is announced
FACTOR_SD, OFFSET_SD = 0.02, 5.0  # of a calibration: relative, counts
SWAP = np.array([[0.9], [1.1]])  # growth of e and p in the next bottle, relative

Value = Array | float


@dataclass(frozen=True, eq=False)
class Conditions:
    """What is true of n vials and hidden from the rig. A number stands for all vials; fields become (n,)."""

    n: int
    offset_c: Value = 0.0  # thermometer minus truth
    scale_e: Value = 1.0  # of each growth curve
    scale_p: Value = 1.0
    flow: Value = 1.0  # true / calibrated
    dose_spread: Value = 0.1  # relative sd of a dose
    light: Value = 1.0  # k at the start
    bias: Value = 214.0  # counts
    light_walk: Value = 0.0  # relative sd of k after a day
    cooling_min: Value = 39.0  # time constant
    ambient_c: Value = 24.0
    start_share: Value = 0.5
    start_c: Value = 33.2  # true temperature at minute 0
    bottle_swap: Value = np.nan  # hour; nan: never
    factor_error: Value = 0.0  # of the calibration, in sd
    bias_error: Value = 0.0
    calibrated: bool = False  # whether the estimator is told k and the offset

    def __post_init__(self) -> None:
        """Spread numbers over the vials."""
        for name, value in vars(self).items():
            if name not in ("n", "calibrated"):
                object.__setattr__(self, name, np.broadcast_to(np.asarray(value, dtype=np.float64), (self.n,)))


def nominal(n: int) -> Conditions:
    """Return n vials that are as the equations say; only noise and a dose spread of 10 % remain."""
    return Conditions(n)


def draw(n: int, seed: int, **fixed: Any) -> Conditions:
    """Return n drawn vials. Fields in fixed replace their draw and leave all others as they are."""
    rng = np.random.default_rng(seed)
    drawn = Conditions(
        n,
        offset_c=0.2 * rng.standard_normal(n),
        scale_e=np.clip(1 + 0.1 * rng.standard_normal(n), 0.7, 1.3),
        scale_p=np.clip(1 + 0.1 * rng.standard_normal(n), 0.7, 1.3),
        flow=1 + 0.05 * rng.standard_normal(n),
        dose_spread=rng.uniform(0.1, 0.2, n),
        light=rng.uniform(0.75, 1.19, n),
        bias=rng.uniform(151, 339, n),
        light_walk=0.005,
        cooling_min=rng.uniform(30, 60, n),
        ambient_c=rng.uniform(18, 26, n),
        start_share=rng.uniform(0.02, 0.98, n),
        factor_error=rng.standard_normal(n),
        bias_error=rng.standard_normal(n),
    )
    return replace(drawn, **fixed)


class Vials:
    """The true state: temperature (n,), rates and cells of both species (2, n), pigment f and production g (n,)."""

    def __init__(self, conditions: Conditions) -> None:
        """Start all in balance at the first temperature."""
        c = self.c = conditions
        self.minute = 0
        self.cool: Array = np.exp(-STEP_S / 60 / c.cooling_min)
        self.memory: Array = np.exp(-STEP_S / 60 / LAG_MIN)
        self.scale: Array = np.stack([np.asarray(c.scale_e), np.asarray(c.scale_p)])
        self.temperature: Array = np.array(c.start_c)
        self.rate = self.curve(self.temperature)
        self.cells: Array = START_OD * np.stack([1 - c.start_share, np.asarray(c.start_share)])
        self.production = production_steady(self.temperature)
        self.pigment: Array = self.production * self.cells[1] * START_OD / (self.rate * self.cells).sum(0)  # g p / D
        self.past = np.tile(self.production, (PIGMENT_DELAY_MIN * STEPS, 1))  # ring: slot k holds step k - length
        self.slot = 0
        self.light: Array = np.array(c.light)

    @property
    def share(self) -> Array:
        """True r, (n,)."""
        share: Array = self.cells[1] / self.cells.sum(0)
        return share

    def curve(self, temperature: Array) -> Array:
        """Rates of e and p that a temperature leads to, 1/h, (2, n)."""
        valid = np.minimum(np.maximum(temperature, VALID_C[0]), VALID_C[1])
        curve: Array = ((CURVES[0] * valid + CURVES[1]) * valid + CURVES[2]) * self.scale
        return curve

    def read(self, noise: Array) -> tuple[Array, Array, Array]:
        """OD, counts k (f + 150 OD) + offset, and thermometer; noise (3, n) is standard normal."""
        density = self.cells.sum(0)
        od = density + np.hypot(OD_SD, OD_RELATIVE_SD * density) * noise[0]
        counts = self.light * (self.pigment + GLOW * density) + self.c.bias + LIGHT_SD * noise[1]
        return od, counts, self.temperature + self.c.offset_c + THERMOMETER_SD * noise[2]

    def pass_minute(self, target: Array, dose: Array, noise: Array) -> None:
        """One minute with a thermostat target and a true dose, pumped in a pulse from its first second on.

        noise (STEPS + 1, n), standard normal: of the thermostat's looks and of the light.
        """
        c, hours, half = self.c, STEP_S / 3600, STEP_S / 7200
        left, heat = dose.copy(), HEATER * c.cooling_min
        if np.any(swapped := self.minute >= 60 * c.bottle_swap):
            self.scale = np.stack([np.asarray(c.scale_e), np.asarray(c.scale_p)]) * np.where(swapped, SWAP, 1.0)
        seen_from = target - c.offset_c
        for k in range(STEPS):
            if left.any():
                pumped = np.minimum(left, PUMP_ML_S * STEP_S)
                keep = np.exp(-pumped / VOLUME)
                left, self.cells, self.pigment = left - pumped, self.cells * keep, self.pigment * keep
            power = (seen_from - THERMOMETER_SD * noise[k] - self.temperature) / BAND_C
            settled = c.ambient_c + heat * np.minimum(np.maximum(power, 0.0), 1.0)
            temperature = settled + (self.temperature - settled) * self.cool
            middle = 0.5 * (self.temperature + temperature)
            curve = self.curve(middle)
            rate = curve + (self.rate - curve) * self.memory
            cells = self.cells * np.exp(half * (self.rate + rate))
            following = self.slot + 1 if self.slot + 1 < len(self.past) else 0
            delayed = 0.5 * (self.past[self.slot] + self.past[following])
            production = self.production + PIGMENT_PER_H * hours * (production_steady(middle) - delayed)
            production = np.maximum(production, PIGMENT_FLOOR)
            self.pigment = self.pigment + half * (self.production * self.cells[1] + production * cells[1])
            self.past[self.slot] = self.production
            self.slot, self.temperature, self.rate = following, temperature, rate
            self.cells, self.production = cells, production
        self.light = self.light * np.exp(c.light_walk / np.sqrt(DAY) * noise[STEPS])
        self.minute += 1


def production_steady(temperature: Array) -> Array:
    """g_ss(T), counts/(OD h), (n,)."""
    x = np.minimum(np.maximum(temperature, VALID_C[0]), VALID_C[1]) - 32.5
    value: Array = (((PIGMENT[0] * x + PIGMENT[1]) * x + PIGMENT[2]) * x + PIGMENT[3]) * x + PIGMENT[4]
    return np.maximum(value, PIGMENT_FLOOR)


@dataclass(frozen=True)
class Program:
    """Steps (minutes, share), all of which are repeated after the last one."""

    steps: tuple[tuple[float, float], ...]

    def ahead(self, minute: float) -> tuple[float, float, float]:
        """Return the share in force, the announced one and the minutes until it."""
        length, count = sum(step[0] for step in self.steps), len(self.steps)
        left, now = minute % length, 0
        while left >= self.steps[now][0]:
            left, now = left - self.steps[now][0], now + 1
        share, until = self.steps[now][1], self.steps[now][0] - left
        for step in range(now + 1, now + count):
            if until > PREVIEW_MIN:
                break
            minutes, following = self.steps[step % count]
            if following != share:
                return share, following, until
            until += minutes
        return share, share, 0.0

    def wanted(self, minute: float, n: int) -> Wanted:
        """Return the same for n vials."""
        share, following, until = self.ahead(minute)
        return Wanted(np.full(n, share), np.full(n, following), np.full(n, float(until)))


PROGRAMS = {
    "ratio_steps": Program(((60, 0.5), (360, 0.3), (600, 0.7), (600, 0.3))),
    "small_steps": Program(((240, 0.5), (240, 0.55), (240, 0.5), (240, 0.45))),
    "quick": Program(((480, 0.5), (180, 0.3), (120, 0.6), (60, 0.4), (240, 0.5))),
    "hold": Program(((60, 0.5),)),
}


@dataclass(frozen=True, eq=False)
class Trace:
    """A run, a row per minute, taken at the reading; each (T, n). Shares are of p."""

    share: Array  # true
    estimate: Array
    low: Array  # of the 95 % band
    high: Array
    temperature: Array  # true
    thermometer: Array  # as read
    target: Array  # of the thermostat from this row on
    od: Array  # as read
    counts: Array  # as read
    setpoint: Array
    told_ml: Array  # dose after this row, by the calibrated flow
    true_ml: Array


def run(
    conditions: Conditions,
    estimator: Any,
    law: Any,
    program: Program,
    hours: float,
    *,
    seed: int = 0,
    samples: Sequence[float] = (),
    sample_sd: float = 0.03,
) -> Trace:
    """Run all vials. The same seed gives the same luck, minute by minute, whatever estimator and law do.

    samples: hours at which r is measured offline with sd sample_sd and told, if the estimator takes samples.
    """
    c, n = conditions, conditions.n
    rng, offline = np.random.default_rng(seed).spawn(2)
    vials, on = Vials(c), np.zeros(n, dtype=np.bool_)
    rows, minutes = np.ones(n, dtype=np.bool_), round(60 * hours)
    sampled = {round(60 * hour) for hour in samples}
    trace = {name: np.empty((minutes, n)) for name in Trace.__dataclass_fields__}
    estimator.reset(n)
    law.reset(n)
    if c.calibrated:
        factor: Array = c.light * (1 + FACTOR_SD * np.asarray(c.factor_error))
        told_bias: Array = c.bias + OFFSET_SD * np.asarray(c.bias_error)
        estimator.calibrate(factor, FACTOR_SD * factor, told_bias, OFFSET_SD)
    for row in range(minutes):
        minute, noise = np.full(n, float(row)), rng.standard_normal((STEPS + 5, n))
        od, counts, thermometer = vials.read(noise[:3])
        estimator.watch(od, counts, thermometer, minute, rows)
        if row in sampled and (sample := getattr(estimator, "sample", None)) is not None:
            seen = np.clip(vials.share + sample_sd * offline.standard_normal(n), 0.001, 0.999)
            sample(seen, np.full(n, sample_sd), float(row), rows)
        wanted, belief = program.wanted(row, n), estimator.explain()
        target = law.act(estimator.estimate(), wanted, minute, rows)
        on = (od > DOSE_UP) | (on & (od > DOSE_DOWN))
        told = np.where(on, DOSE_ML, 0.0)
        true = told * c.flow * np.maximum(0.0, 1 + c.dose_spread * noise[3])
        now = (
            vials.share, belief["ratio"], belief["ratio_low"], belief["ratio_high"], vials.temperature, thermometer,
            target, od, counts, wanted.setpoint, told, true,
        )  # fmt: skip
        for column, values in zip(trace.values(), now, strict=True):
            column[row] = values
        estimator.dosed(told)
        vials.pass_minute(target, true, noise[4:])
    return Trace(**trace)


def _daily(values: Array) -> Array:
    """Return the mean of each day that has begun, (days, n)."""
    return np.stack([values[row : row + DAY].mean(0) for row in range(0, len(values), DAY)])


def coverage(trace: Trace) -> Array:
    """Share of the minutes in which the band holds the true share, (days, n); .mean(1) is that of all vials."""
    return _daily(((trace.low <= trace.share) & (trace.share <= trace.high)).astype(np.float64))


def estimate_error(trace: Trace) -> Array:
    """Mean |estimated - true share|, (days, n)."""
    return _daily(np.abs(trace.estimate - trace.share))
