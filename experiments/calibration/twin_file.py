"""twin.yaml: the plant behind a recording, in the form of a preset of conf/plant, with bands beside the values."""

from dataclasses import replace
from textwrap import wrap

import numpy as np
from numpy.typing import NDArray

from conf.schema import Entry, entries
from envs.bench import Bench
from envs.identification.twin import Course, Twin
from envs.plant.culture import GrowthConfig
from envs.plant.plant import PlantConfig
from envs.plant.pump import PumpConfig
from envs.plant.sensor import SensorConfig
from envs.plant.vessel import VesselConfig

__all__ = ["plant_of", "twin_yaml", "yaml_line"]

Array = NDArray[np.float64]

DIGITS, WIDTH = 5, 120
LEFT = (
    "What one recording cannot show stays at its default: dead time, shortest pulse and priming of the pump (its flow "
    "holds for pulses as long as the recorded ones), spread between vials, slope and blank of the sensor, substrate, "
    "temperature, wall."
)


def plant_of(found: Twin) -> PlantConfig:
    """Convert the twin to a plant. Raises: ValueError with the value that is out of range for a plant."""
    volume = Bench.volume_ml  # a recording determines only flow over volume: the file has both
    flow, knots = volume / (60.0 * found.tau.value), _numbers(found.knot_min)
    growth = GrowthConfig(mu=_mean(found.mu.value), knots_min=knots, knots_mu=_numbers(found.mu.value))
    pump = PumpConfig(dosing="pulse", gain_ml_s=_mean(flow), pulse_cv=_rounded(found.noise.dose_cv))
    if found.drifts:
        pump = replace(pump, knots_min=knots, knots_ml_s=_numbers(flow))
    noise = found.noise
    sensor = SensorConfig(
        noise_floor=_rounded(noise.floor),
        noise_relative=_rounded(noise.relative),
        lag1=_rounded(noise.lag1),
        outlier_rate=_rounded(noise.outlier_rate),
    )
    return PlantConfig(growth, pump, sensor, VesselConfig(volume), start_od=_rounded(found.start_od), integrator="rk4")


def twin_yaml(found: Twin, source: str) -> str:
    """Write the file's text: all values that differ from a plant's defaults, with meaning and unit.

    Raises: ValueError naming the value that no plant may have.
    """
    plant, (first, end) = plant_of(found), found.rows
    hours = found.knot_min[-1] / 60.0
    tau = "at the knots" if found.drifts else "constant, since the recording does not show its drift"
    said = (
        "The plant behind a recording, written by calibrate, for deploy plant_file=FILE and benchmark plant_file=FILE.",
        f"Recording {source}, rows {first}:{end}, {hours:.1f} h, a reading every {found.row_min:.3g} min. Age 0 is the "
        "first of these rows; start_min begins later.",
        f"mu at the knots, 95 %: {_band(found.mu)} 1/min.",
        f"tau {tau}, 95 %: {_band(found.tau if found.drifts else _first(found.tau))}; flow = volume / (60 tau).",
        LEFT,
    )
    lines = [line for text in said for line in wrap(text, WIDTH, initial_indent="# ", subsequent_indent="# ")]
    nominal = PlantConfig()
    for own, usual in zip(entries(plant), entries(nominal), strict=True):
        if own.value == usual.value:
            continue
        if own.name in ("growth", "pump", "sensor", "vessel"):
            lines.append(f"{own.name}:")
            changed = zip(entries(own.value), entries(usual.value), strict=True)
            lines += [f"  {yaml_line(e)}" for e, was in changed if e.value != was.value]
        else:
            lines.append(yaml_line(own))
    return "\n".join(lines) + "\n"


def yaml_line(entry: Entry) -> str:
    """Write a value with its meaning and unit behind it."""
    value = entry.value
    if isinstance(value, tuple):
        text = "[" + ", ".join(_plain(v) for v in value) + "]"
    else:
        text = _plain(value) if isinstance(value, float) else str(value)
    return f"{entry.name}: {text} # " + ", ".join(filter(None, (entry.said.what, entry.said.unit)))


def _plain(value: float) -> str:
    """Write a number so that YAML reads it back: 5e-05 would be a string there."""
    return np.format_float_positional(value, trim="0")


def _rounded(value: float) -> float:
    return float(f"{value:.{DIGITS}g}")


def _numbers(values: Array) -> tuple[float, ...]:
    return tuple(_rounded(float(v)) for v in values)


def _mean(values: Array) -> float:
    """Over the time between evenly spaced knots."""
    return _rounded(float(np.trapezoid(values) / (len(values) - 1)))


def _first(course: Course) -> Course:
    return Course(course.value[:1], course.low[:1], course.high[:1])


def _band(course: Course) -> str:
    return ", ".join(f"{low:.3g} to {high:.3g}" for low, high in zip(course.low, course.high, strict=True))
