"""Fit growth curves and pigment of a pair: `python -m experiments.calibrate_pair 'first=[A.csv]' 'second=[B.csv]'`.

Record each species alone, at three or more temperatures. A mixed run with marked shares corrects both curves.
"""

import logging
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np
import yaml  # type: ignore[import-untyped]

from conf.schema import check, require, setting
from envs.bench import Bench
from envs.coculture.pair import PairConfig, PigmentConfig, SpeciesConfig
from envs.identification import curves
from envs.identification.curves import Plateau, Polynomial
from envs.identification.screening import Series
from experiments.cli import files, frame
from experiments.coculture.estimator import CompositionEstimator, CompositionEstimatorConfig
from experiments.recordings.reader import read_recording
from hardware.errors import RecordingError
from hardware.storage.atomic import write
from hardware.storage.marks import read_marks

log = logging.getLogger(__name__)

FEWEST = 3  # temperatures that a curve needs
LAGS = 4.0  # time constants to wait after a change of temperature: 2 % of the change is then left
STRAY = 0.02  # relative sd of growth rates between cultures, added to the sd from the recording


@dataclass(frozen=True)
class CalibratePairConfig:
    """Config of a calibration of two species. Raises: ValueError with key, value and allowed range."""

    first: tuple[str, ...] = setting((), "recordings of the first species alone, at several temperatures")
    second: tuple[str, ...] = setting((), "recordings of the second species, whose pigment is measured")
    names: tuple[str, ...] = setting(("first", "second"), "names of the two species in figures")
    mixed: str | None = setting(
        None, "recording of a deployment with both species; the marked shares of its run correct both curves"
    )
    pump_ml_s: float = setting(0.02, "flow at pump rate 1 in a Chi.Bio's own CSV", "mL/s", above=0.0, at_most=1.0)
    volume_ml: float = setting(Bench.volume_ml, "culture volume of all these recordings", "mL", within=(1, 2000))
    degree: int = setting(2, "polynomial degree of both curves; lowered for few temperatures", within=(1, 4))
    settle_min: float = setting(
        120.0, "time ignored after a change of temperature; at least four times lags_min", "min", within=(0, 600)
    )
    least_min: float = setting(60.0, "shortest time at one temperature after settle_min", "min", within=(30, 2000))
    lags_min: tuple[float, ...] = setting((2.0, 60.0), "time constants of growth after a change of temperature", "min")
    factor: float = setting(0.99, "factor in light = factor (pigment + od_term OD) + offset", within=(0.05, 20))
    offset: float = setting(214.0, "offset of the light", "counts", within=(0, 20_000))
    od_term: float = setting(150.0, "light scattered by cells of both species", "counts/OD", within=(0, 5000))

    def __post_init__(self) -> None:
        check(self)
        for key in ("names", "lags_min"):
            require(len(getattr(self, key)) == 2, key, getattr(self, key), "two values, one for each species")
        require(self.names[0] != self.names[1], "names", self.names, "two different names")
        first, second = self.lags_min
        require(0.0 <= first <= second <= 600.0, "lags_min", self.lags_min, "0 to 600 min, the smaller one first")


def _plateaus(paths: tuple[str, ...], lag_min: float, config: CalibratePairConfig) -> list[Plateau]:
    """List the times of a species at one temperature, coldest first. Raises: UserError without temperatures."""
    settle_min = max(config.settle_min, LAGS * lag_min)
    found: list[Plateau] = []
    for path in paths:
        with frame.refusing(ValueError, RecordingError):
            r = read_recording(path, pump_ml_s=config.pump_ml_s)
        if not np.isfinite(r.temperature).any():
            raise frame.UserError(f"{path}: no temperatures; give a recording with a column temperature_degc")
        low, high = np.nanmin(r.temperature), np.nanmax(r.temperature)
        if not 4.0 <= low <= high <= 60.0:
            raise frame.UserError(
                f"{path}: temperatures from {low:g} to {high:g}: allowed 4 to 60 degC; check that the unit is degC"
            )
        series = Series(r.time_min, r.od, r.pump_rate, r.row)
        mine, left = curves.plateaus(
            series, r.temperature, r.fluorescence, config.volume_ml / 60.0, settle_min, config.least_min, config.offset
        )
        log.info("%s: %d temperature(s) held long enough", path, len(mine))
        for line in left:
            log.warning("%s: ignored: %s", path, line)
        found += mine
    return sorted(found, key=lambda p: p.temperature)


def _growth(name: str, points: list[Plateau], lag_min: float, config: CalibratePairConfig) -> Polynomial:
    t = np.array([p.temperature for p in points])
    apart = np.unique(np.round(t)).size
    if apart < FEWEST:
        minutes = max(config.settle_min, LAGS * lag_min) + config.least_min
        raise frame.UserError(
            f"{name}: growth at {apart} temperature(s); record at least {FEWEST}, each held for {minutes:g} min after "
            "the change, or lower settle_min or least_min"
        )
    if apart <= config.degree + 1:
        log.warning("%s: the curve meets all %d points: its error is unknown; record more temperatures", name, apart)
    value = np.array([p.growth.value for p in points])
    sd = np.hypot([p.growth.half_width / 1.96 for p in points], STRAY * value)
    return curves.fit(t, value, sd, min(config.degree, apart - 1))


def _pigment(points: list[Plateau], config: CalibratePairConfig) -> PigmentConfig:
    """Fit the production of pigment, which balances dilution: g_ss = mu ((light - offset) / (k OD) - od_term).

    Raises: UserError if no recording of the second species has fluorescence, or if it is too low.
    """
    lit = [(p, p.light.value) for p in points if p.light is not None]
    if not lit:
        where = ", ".join(config.second)
        raise frame.UserError(f"second={where}: no fluorescence; record with backend.fluorescence.measure=true")
    if dark := [p for p, light in lit if light <= 0.0]:
        at = f"second: light at {dark[0].temperature:.1f} degC is not above offset={config.offset:g} counts"
        raise frame.UserError(f"{at}; check that these are recordings of the second species, and the sensor's offset")
    t, growth, light = np.array([(p.temperature, p.growth.value, light) for p, light in lit]).T
    made = np.maximum(light / config.factor - config.od_term, 0.0) * growth
    degree, centre = min(4, np.unique(np.round(t)).size - 1), float(np.round(t.mean(), 1))
    found = curves.fit(t, made, np.maximum(0.03 * made, 30.0), degree, centre)
    return PigmentConfig(found.coefficients, centre)


def _corrected(pair: PairConfig, config: CalibratePairConfig) -> tuple[PairConfig, dict[str, float]]:
    """Correct both growth curves by a mixed run; return the pair, and the two relative corrections with their sds.

    The estimator replays the run from its beginning, with every marked share. Raises: UserError for a run without
    marked shares.
    """
    assert config.mixed is not None
    path = Path(config.mixed)
    name, run = path.stem, path.parent.parent
    with frame.refusing(ValueError, RecordingError):
        r, every = read_recording(config.mixed, pump_ml_s=config.pump_ml_s), read_marks(run)
    marks = [m for m in every if m.reactor == name and m.share is not None and m.sd is not None]
    if not marks:
        how = f"python -m experiments.mark run={run} reactor={name} share=SHARE sd=SD minute=MINUTE"
        raise frame.UserError(f"mixed={path}: no marked share for {name} in {run}; mark some: {how}")
    guess = CompositionEstimatorConfig(  # this bench's thermometer and pump also measured the curves: no error between
        factor=config.factor, offset=config.offset, od_term=config.od_term, thermometer_sd=0.0, gain_sd=0.01
    )
    estimator = CompositionEstimator(guess, config.volume_ml, pair)
    yes, waiting = np.ones(1, dtype=np.bool_), sorted(marks, key=lambda m: m.time_min)
    for k, minute in enumerate(r.time_min):
        od, light, warm, now = (np.array([v]) for v in (r.od[k], r.fluorescence[k], r.temperature[k], minute))
        estimator.watch(od, light, warm, now, yes)
        while waiting and waiting[0].time_min <= minute:
            m = waiting.pop(0)
            estimator.sample(np.array([m.share]), np.array([m.sd]), yes)
        if k + 1 < len(r.time_min):
            estimator.dosed(np.array([r.pump_rate[k] * 60.0 * (r.time_min[k + 1] - minute)]))
    (off,), (sd,) = (errors.tolist() for errors in estimator.growth_errors())
    first, second = (
        replace(s, polynomial=tuple(c * (1.0 + e) for c in s.polynomial))
        for s, e in zip((pair.first, pair.second), off, strict=True)
    )
    return replace(pair, first=first, second=second), {
        "first": off[0], "first_sd": sd[0], "second": off[1], "second_sd": sd[1], "even_c_alone": pair.even_c,
    }  # fmt: skip


def calibrate_pair(config: CalibratePairConfig, folder: Path) -> None:
    """Write pair.yaml, the figure and the summary. Raises: UserError if the recordings do not determine a pair."""
    for key in ("first", "second"):
        if not getattr(config, key):
            raise frame.UserError(f"{key}=[]: give one or more recordings of that species alone, {key}=[FILE.csv]")
    lags = config.lags_min
    points = [_plateaus(paths, lag, config) for paths, lag in zip((config.first, config.second), lags, strict=True)]
    found = [_growth(name, mine, lag, config) for name, mine, lag in zip(config.names, points, lags, strict=True)]
    every = [[p.temperature for p in mine] for mine in points]
    span = float(np.ceil(10.0 * max(map(min, every))) / 10.0), float(np.floor(10.0 * min(map(max, every))) / 10.0)
    if not span[0] < span[1]:
        each = " and ".join(
            f"{n} at {min(t):.1f} to {max(t):.1f} degC" for n, t in zip(config.names, every, strict=True)
        )
        raise frame.UserError(f"{each}: the temperatures must overlap; record both species at the same temperatures")
    with frame.refusing(ValueError):
        species = [
            SpeciesConfig(name, curve.coefficients, (), lag)
            for name, curve, lag in zip(config.names, found, lags, strict=True)
        ]
        pair, told = PairConfig(species[0], species[1], _pigment(points[1], config), span), None
        if config.mixed is not None:
            pair, told = _corrected(pair, config)
    head = "# Two species, written by calibrate_pair; for pair=FILE of train, deploy and benchmark.\n"
    plain = yaml.safe_dump(files.plain(asdict(pair)), sort_keys=False, allow_unicode=True)
    write(folder / "pair.yaml", head + plain)
    from experiments.coculture.charts import pair_figure
    from experiments.reporting import charts

    charts.save(pair_figure(pair, points), folder / "figures", "pair")
    rows = [[asdict(p) for p in mine] for mine in points]
    off = [curve.off.tolist() for curve in found]
    files.write_json(
        folder / "summary.json",
        {"pair": asdict(pair), "even_c": pair.even_c, "plateaus": rows, "off_sd": off, "mixed": told},
    )
    _say(config, pair, points, found, told, folder)


def _say(
    config: CalibratePairConfig, pair: PairConfig, points: list[list[Plateau]], found: list[Polynomial],
    told: dict[str, float] | None, folder: Path,
) -> None:  # fmt: skip
    for name, mine, curve in zip(config.names, points, found, strict=True):
        print(f"{name}: temperature in degC, growth rate in 1/h (95 % interval), distance from the curve in sds")
        for p, off in zip(mine, curve.off, strict=True):
            light = "" if p.light is None else f"   light per OD {p.light.value:.0f}"
            between = f"{p.growth.low:.4f} to {p.growth.high:.4f}"
            print(f"  {p.temperature:6.2f}  {p.growth.value:.4f} ({between})  {off:+.1f}{light}")
    if told is not None:
        off = [f"{told[key]:+.3f} +- {told[f'{key}_sd']:.3f}" for key in ("first", "second")]
        print(f"mixed: curves corrected by {' and '.join(off)}; before, they met at {told['even_c_alone']:.2f} degC")
    low, high = pair.temperatures
    ends = pair.faster(np.array([low, high]))
    print(f"both grow alike at {pair.even_c:.2f} degC; growth of {pair.second.name} minus {pair.first.name}: "
          f"{ends[0]:+.3f} 1/h at {low:g} degC and {ends[1]:+.3f} 1/h at {high:g} degC")  # fmt: skip
    print(f"files {folder / 'pair.yaml'}, {folder / 'figures' / 'pair.png'}")
    print(f"next: python -m experiments.deploy scenario=ratio_steps pair={folder / 'pair.yaml'}")


main = frame.EntryPoint("calibrate_pair", CalibratePairConfig(), calibrate_pair)


if __name__ == "__main__":
    main()
