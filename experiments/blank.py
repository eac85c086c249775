"""Measure the blank of clear medium under run conditions and store it: `python -m experiments.blank`."""

import logging
from dataclasses import dataclass, replace
from datetime import date
from pathlib import Path

from conf.schema import check, part, setting
from experiments.cli import files, frame
from experiments.cli.stop import one_interrupt
from hardware.chibio.calibrations import save_calibration
from hardware.chibio.config import ChiBioConfig
from hardware.chibio.family import linked
from hardware.chibio.procedures import measure_blanks, warm_up
from hardware.chibio.protocol import POSITIONS
from hardware.chibio.reactors import ChiBioReactors
from hardware.errors import ReactorError

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class BlankConfig:
    """Config of a blank measurement. Raises: ValueError with key, value and allowed range."""

    backend: ChiBioConfig = part(ChiBioConfig, "the device and its reactors")
    reactor: str | None = setting(None, "reactor position; null: those of backend.reactors", choices=POSITIONS)
    warm_up: float = setting(90.0, "longest time for the medium to reach its temperature", "min", within=(0, 600))
    tolerance: float = setting(1.0, "largest allowed difference from the thermostat's target", "degC", within=(0.2, 15))
    samples: int = setting(6, "time over which readings are averaged", "min", within=(3, 60), note="one a minute")

    def __post_init__(self) -> None:
        check(self)


def blank(config: BlankConfig, folder: Path) -> None:
    """Stir and heat clear medium, average its counts, set the averages as blanks, store them. Raises: UserError."""
    backend = replace(config.backend, reactors=(config.reactor,)) if config.reactor else config.backend
    what = "clear medium in %s: heating to %g degC, then measuring for %d minutes"
    log.info(what, ", ".join(backend.reactors), backend.temperature, config.samples + 1)
    with frame.refusing(ReactorError):
        with one_interrupt(), linked(backend) as (transport, clock):
            reactors = ChiBioReactors(transport, clock, backend)
            try:
                reactors.begin()
                for minute, farthest in warm_up(reactors, config.tolerance, config.warm_up):
                    log.info("minute %.0f: %.1f degC, waiting for %g", minute, farthest, backend.temperature)
                mean, spread = measure_blanks(reactors, config.samples)
                stored = [s.connection.device_id for s in reactors.stations]
                reactors.end()
            except BaseException:
                reactors.stop()
                raise
        rows = {}
        for name, identity, raw, sd in zip(reactors.names, stored, mean, spread, strict=True):
            when = {"date": date.today().isoformat(), "device_id": identity}
            values = {"blank": float(raw), "sd": float(sd), "samples": config.samples, **when}
            path = save_calibration(Path(backend.calibration), name, "blank", values)
            rows[name] = {**values, "file": str(path)}
            log.info("%s: blank %.0f +- %.0f counts, stored in %s", name, raw, sd, path)
    files.write_json(folder / "summary.json", rows)


main = frame.EntryPoint("blank", BlankConfig(), blank)


if __name__ == "__main__":
    main()
