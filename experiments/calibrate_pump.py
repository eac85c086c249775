"""Weigh a pump's doses and store its calibration: `python -m experiments.calibrate_pump`."""

import csv
import logging
import math
import sys
from collections.abc import Callable
from dataclasses import asdict, dataclass
from datetime import date
from pathlib import Path

import numpy as np

from conf.schema import check, part, require, setting
from experiments.cli import files, frame
from experiments.cli.stop import one_interrupt
from hardware.chibio.calibrations import save_calibration
from hardware.chibio.config import ChiBioConfig
from hardware.chibio.connection import Connection
from hardware.chibio.dosing import PumpFit, fit_pump
from hardware.chibio.family import linked
from hardware.chibio.procedures import dose_series
from hardware.chibio.protocol import FEED, PERIOD_S, POSITIONS, WASTE, Permitted
from hardware.errors import ReactorError
from hardware.logbook import no_log

log = logging.getLogger(__name__)

PUMP_OF = {"feed": FEED, "waste": WASTE}
LIMITS = {"feed": 0.05, "waste": 0.5}


@dataclass(frozen=True)
class Weighing:
    """One weighing: mass `grams` of `doses` doses together; the pump was on for the fraction `duty` of 63 s in each."""

    duty: float
    doses: int
    grams: float


@dataclass(frozen=True)
class CalibratePumpConfig:
    """Config of a weighing. Raises: ValueError with key, value and allowed range."""

    backend: ChiBioConfig = part(ChiBioConfig, "the device")
    reactor: str = setting("M0", "reactor position", choices=POSITIONS)
    pump: str = setting("feed", "pump to weigh", choices=tuple(PUMP_OF))
    duties: tuple[float, ...] = setting(
        (0.006, 0.01, 0.02, 0.04),
        "on-times to weigh, as fractions of 63 s: two or more of the later sizes, 0.003 to 0.05 (feed) or 0.5 (waste)",
    )
    doses: int = setting(20, "doses per weighing", within=(3, 200))
    csv: str | None = setting(None, "file of existing weighings, columns duty,doses,grams; with it no pump runs")

    def __post_init__(self) -> None:
        check(self)
        limit = LIMITS[self.pump]
        usable = len(set(self.duties)) >= 2 and all(0.003 <= d <= limit for d in self.duties)
        require(usable, "duties", self.duties, f"at least two different ones from 0.003 to {limit}")


def read_weighings(path: Path) -> list[Weighing]:
    """Read weighings from a CSV file with the columns duty, doses, grams. Raises: UserError with the line."""
    try:
        with open(path, newline="", encoding="utf-8") as f:
            rows = list(csv.DictReader(f))
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise frame.UserError(
            f"csv={path}: not readable ({error}); give a file with columns duty,doses,grams"
        ) from None
    found = []
    for number, row in enumerate(rows, 2):
        try:
            series = Weighing(float(row["duty"]), int(row["doses"]), float(row["grams"]))
            if not (0.0 < series.duty <= 1.0 and series.doses >= 1 and 0.0 <= series.grams < 10_000.0):
                raise ValueError("allowed duty 0 to 1, doses at least 1, grams at least 0")
        except (KeyError, TypeError, ValueError) as error:
            raise frame.UserError(f"csv={path}, line {number}: {error}; columns duty,doses,grams") from None
        found.append(series)
    return found


def _number(ask: Callable[[str], str], question: str) -> float:
    while True:
        answer = ask(question).strip().replace(",", ".")
        try:
            value = float(answer)
            if 0.0 <= value < 10_000.0:
                return value
        except ValueError:
            pass
        print(f"  {answer!r} is not a mass in grams; type a number from 0 to 10000")


def weigh(config: CalibratePumpConfig, ask: Callable[[str], str] = input) -> tuple[list[Weighing], str]:
    """Guide the operator through all series; return the weighings and the unit's identity.

    Args: ask: function that asks a question and returns the answer.
    Raises: ReactorError.
    """
    found = []
    with one_interrupt(), linked(config.backend) as (transport, clock):
        connection = Connection(config.reactor, Permitted([config.reactor]), transport, clock, no_log)
        identity = connection.read().device_id
        print(
            f"{config.reactor} {config.pump} pump, unit {identity}. Put its inlet into water, prime the tube, and let"
        )
        print("its outlet drip into a beaker on a balance, the tube not touching the beaker.")
        for duty in config.duties:
            ask(f"\n{config.doses} doses of {PERIOD_S * duty:.2f} s: tare the balance, then press Enter ")
            for given in dose_series(connection, clock, PUMP_OF[config.pump], duty, config.doses):
                print(f"\r  dose {given} of {config.doses}", end="", flush=True)
            found.append(Weighing(duty, config.doses, _number(ask, "\n  grams on the balance: ")))
        transport.disarm()
    return found, identity


def report(fit: PumpFit, found: list[Weighing]) -> str:
    """Describe the fit for a person to judge."""
    c = fit.calibration
    lines = [f"{'on, s':>8} {'doses':>6} {'mL/dose':>9} {'fitted':>9}"]
    lines += [
        f"{PERIOD_S * s.duty:8.3f} {s.doses:6d} {s.grams / s.doses:9.4f} {c.volume(PERIOD_S * s.duty):9.4f}"
        for s in found
    ]
    smallest = f"smallest useful dose {c.min_dose_ml:.3f} mL ({c.min_on_s:.2f} s)"
    if math.isfinite(fit.flow_se):
        lines.append(
            f"flow {c.flow_ml_s:.4f} +- {fit.flow_se:.4f} mL/s, bias {c.bias_s:+.3f} +- {fit.bias_se:.3f} s, "
            f"spread of a dose {100.0 * c.spread:.1f} %, {smallest}"
        )
    else:
        lines.append(f"flow {c.flow_ml_s:.4f} mL/s, bias {c.bias_s:+.3f} s, {smallest}")
        lines.append(
            f"a line fits two series exactly, so the spread is unknown ({100.0 * c.spread:.0f} % is assumed): weigh a "
            "third series with another duty (duties=[...]), or give all three with csv=FILE"
        )
    return "\n".join(lines)


def calibrate(config: CalibratePumpConfig, folder: Path) -> None:
    """Weigh doses or read weighings, then fit and store the calibration. Raises: UserError."""
    with frame.refusing(ReactorError, ValueError):
        if config.csv is not None:
            found, identity = read_weighings(Path(config.csv)), ""
        elif sys.stdin.isatty():
            found, identity = weigh(config)
        else:
            raise frame.UserError("no terminal to ask for the weights; give csv=FILE with columns duty,doses,grams")
        on_s, doses, grams = np.array([[PERIOD_S * s.duty, s.doses, s.grams] for s in found]).reshape(-1, 3).T
        fit = fit_pump(on_s, doses, grams, date.today().isoformat(), identity)
        weighings = [{"duty": s.duty, "doses": s.doses, "grams": s.grams} for s in found]
        uncertainty = {"flow_se": fit.flow_se, "bias_se": fit.bias_se}
        values = {**asdict(fit.calibration), **uncertainty, "weighings": weighings}
        path = save_calibration(Path(config.backend.calibration), config.reactor, config.pump, values)
    files.write_json(folder / "summary.json", {**values, "file": str(path)})
    log.info("%s %s pump\n%s\nstored in %s", config.reactor, config.pump, report(fit, found), path)


main = frame.EntryPoint("calibrate_pump", CalibratePumpConfig(), calibrate)


if __name__ == "__main__":
    main()
