"""Measure the blank of clear medium under run conditions and store it: `python -m experiments.blank`."""

import logging
from dataclasses import dataclass
from datetime import date
from pathlib import Path

from conf.schema import check, part, setting
from experiments.cli import files, frame
from experiments.control.device import linked, save_calibration
from hardware.chibio.config import ChiBioConfig
from hardware.chibio.procedures import measure_blanks
from hardware.chibio.reactors import ChiBioReactors
from hardware.errors import ReactorError

__all__ = ["BlankConfig", "blank"]

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class BlankConfig:
    """Which reactors to measure, and for how long. Raises: ValueError naming key, value and allowed range."""

    backend: ChiBioConfig = part(ChiBioConfig, "the device and its reactors")
    samples: int = setting(6, "to average, one reading each", "min", within=(3, 60), note="one a minute")

    def __post_init__(self) -> None:
        check(self)


def blank(config: BlankConfig, folder: Path) -> None:
    """Stir and heat clear medium, average its counts, set them as blanks, store them. Raises: UserError."""
    backend = config.backend
    log.info("clear medium in %s; this takes %d minutes", ", ".join(backend.reactors), config.samples + 1)
    try:
        with linked(backend) as (transport, clock):
            reactors = ChiBioReactors(transport, clock, backend)
            try:
                reactors.begin()
                mean, spread = measure_blanks(reactors, config.samples)
                stored = [s.connection.device_id for s in reactors.stations]
                reactors.end()
            except BaseException:
                reactors.stop()
                raise
    except ReactorError as error:
        raise frame.UserError(str(error)) from None
    rows = {}
    for name, identity, raw, sd in zip(reactors.names, stored, mean, spread, strict=True):
        when = {"date": date.today().isoformat(), "device_id": identity}
        values = {"blank": float(raw), "sd": float(sd), "samples": config.samples, **when}
        path = save_calibration(Path(backend.calibration), name, "blank", values)
        rows[name] = {**values, "file": str(path)}
        log.info("%s: blank %.0f +- %.0f counts, stored in %s", name, raw, sd, path)
    files.write_json(folder / "summary.json", rows)


main = frame.Command("blank", BlankConfig(), blank)


if __name__ == "__main__":
    main()
