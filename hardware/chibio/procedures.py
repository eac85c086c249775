"""Work on the bench before a run: series of doses to weigh, and the blank of clear medium under run conditions."""

from collections.abc import Iterator

import numpy as np

from hardware.chibio.connection import Connection
from hardware.chibio.messages import ExperimentRuns, FaultsStand, NoBlank, NotWarm
from hardware.chibio.protocol import PERIOD_S
from hardware.chibio.reactors import ChiBioReactors
from hardware.clock import Clock
from hardware.reactor import Array, Measurement

PAUSE_S = 2.0  # between two doses, so that the fluid comes to rest
LATE_S = 2.0  # a pump starts a little after the answer, and later on a busy bus; its dose must not be cut short


def dose_series(connection: Connection, clock: Clock, pump: str, duty: float, doses: int) -> Iterator[int]:
    """Give `doses` single doses of 63 s * `duty`, one per step, verified off after each; yield the number so far.

    Raises: DeviceStateError if an experiment runs or a dose did not begin; LinkError, ProtocolError.
    """
    state = connection.read()
    if state.running:
        raise ExperimentRuns(reactor=connection.name)
    try:
        connection.pumps_off()
        connection.target(pump, duty)
        for given in range(1, doses + 1):
            connection.switch(pump, True)
            clock.sleep(PERIOD_S * duty + LATE_S)
            connection.pumps_off()
            yield given
            clock.sleep(PAUSE_S)
    finally:
        connection.pumps_off()


def warm_up(
    reactors: ChiBioReactors, tolerance: float, limit_min: float, every_min: float = 5.0
) -> Iterator[tuple[float, float]]:
    """Wait until every reactor is within `tolerance` degC of its thermostat in two samples in a row.

    Yields, every `every_min` minutes, the minutes passed and the temperature farthest from the target, degC.
    Raises: SensorError after `limit_min` minutes; ReactorError.
    """
    target, start, reached = reactors.config.temperature, reactors.elapsed(), np.zeros(len(reactors.names))
    due = 0.0
    while True:
        m = _sound(reactors)
        off = np.abs(m.temperature - target)
        reached = np.where(m.fresh, np.where(off <= tolerance, reached + 1, 0), reached)  # nan is not reached
        if (reached >= 2).all():
            return
        minutes = (reactors.elapsed() - start) / 60.0
        worst = int(np.argmax(np.where(reached >= 2, -1.0, np.nan_to_num(off, nan=np.inf))))
        if minutes > limit_min:
            name, warm = reactors.names[worst], m.temperature[worst]
            raise NotWarm(reactor=name, temperature=warm, minutes=minutes, target=target, tolerance=tolerance)
        if minutes >= due and np.isfinite(m.temperature).all():
            due = minutes + every_min
            yield minutes, float(m.temperature[worst])


def _sound(reactors: ChiBioReactors) -> Measurement:
    m = reactors.measure()
    assert m.vitals is not None
    faults = [f"{n}: {f}" for n, f in zip(reactors.names, m.vitals.faults, strict=True) if f is not None]
    if faults:
        raise FaultsStand(faults="; ".join(faults))
    return m


def measure_blanks(reactors: ChiBioReactors, samples: int) -> tuple[Array, Array]:
    """Average the raw counts of `samples` cycles of clear medium, set them as blanks; return mean and sd, shape (N,).

    Needs stirred, heated vials and `reactors.begin()`. The experiment itself measures the counts, so they are valid
    under run conditions (docs/device.md, Blank).
    Raises: SensorError for counts outside 3000 to 60000 or with a scatter above 2 %; ReactorError.
    """
    rows: list[list[float]] = [[] for _ in reactors.names]
    while min(map(len, rows)) < samples:
        m = _sound(reactors)
        assert m.vitals is not None
        for i in np.flatnonzero(m.fresh):
            rows[i].append(float(m.vitals.raw[i]))
    counts = np.array([row[:samples] for row in rows])
    mean, sd = counts.mean(axis=1), counts.std(axis=1, ddof=1)
    for name, value, spread in zip(reactors.names, mean, sd, strict=True):
        if not 3000.0 <= value <= 60000.0 or spread > 0.02 * value:
            raise NoBlank(reactor=name, counts=value, sd=spread)
    for station, value in zip(reactors.stations, mean, strict=True):
        station.set_blank(float(value))
    return mean, sd
