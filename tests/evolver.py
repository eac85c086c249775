"""A family of one's own, as `extend=` loads it: an eVOLVER, sixteen vials behind one HTTP server.

The device of the tests is `tests/evolver_stub.py`; this file is all that the program is given.
"""

import json
import math
import urllib.request
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any
from urllib.parse import urlencode

import numpy as np

from conf.schema import check, require, setting
from envs.bench import Bench
from hardware import family
from hardware.errors import DeviceStateError, LinkError, ProtocolError
from hardware.family import Can, Family, Opening
from hardware.logbook import Log
from hardware.messages import Fault, LinkFault
from hardware.reactor import Array, Command, Mask, Measurement, Reactor, Receipt, Vitals, left_off
from hardware.storage.doses import Ending, damaged

VIALS = 16


class NoServer(LinkFault, says="{error}", remedy="check server and network"):
    """The server of the vials does not answer."""


@dataclass(frozen=True)
class EvolverConfig:
    """`backend=evolver`. Raises: ValueError naming key, value and allowed range."""

    kind: str = setting("evolver", "which backend")
    url: str = setting("http://evolver.local:8081", "of the device's server")
    reactors: tuple[str, ...] = setting(tuple(f"v{n}" for n in range(VIALS)), "names of the sixteen vials", some=True)
    temperature: float = setting(37.0, "of all vials at the start", "degC", within=(15, 42))

    def __post_init__(self) -> None:
        check(self, "backend")
        require(len(set(self.reactors)) == VIALS, "backend.reactors", self.reactors, f"{VIALS} different names")


@dataclass
class Past:
    """What the journal says: the newest sample, when the run began by the device's clock, and a dose that is open.

    open: intents without an end by vial, mL; dose: their id. fed: whether they were asked of the device.
    """

    k: int = 0
    zero_s: float = math.nan
    dose: str = ""
    on_s: float = 0.0
    open: dict[str, float] = field(default_factory=dict)
    fed: bool = False


def past(rows: list[dict[str, Any]]) -> Past:
    """Args: rows: of the journal, oldest first. Raises: RecordingError for a damaged row."""
    known = Past()
    for row in rows:
        try:
            if row["kind"] == "device":
                known.zero_s = float(row["zero_s"])
            elif row["kind"] == "sample":
                known.k = int(row["k"])
            elif row["kind"] == "intent":
                if row["id"] != known.dose:
                    known = Past(known.k, known.zero_s, str(row["id"]), float(row["on_s"]))
                known.open[str(row["reactor"])] = float(row["feed_ml"])
            elif row["kind"] == "feed_on":
                known.fed = True
            elif row["kind"] == "dose_end":
                known.open.pop(str(row["reactor"]), None)
        except (KeyError, TypeError, ValueError) as error:
            raise damaged(row, error) from None
    return known


class Evolver:
    """Sixteen vials (implements `hardware.reactor.Reactor`); run time is the device's own."""

    def __init__(self, config: EvolverConfig, bench: Bench, log: Log) -> None:
        self.names, self._config, self._bench, self._log = config.reactors, config, bench, log
        self._k, self._now_s, self._zero_s = 0, 0.0, 0.0
        self._last = {key: np.full(VIALS, np.nan) for key in ("od", "celsius", "raw")}
        self._extra: list[tuple[float, Receipt]] = []

    def _ask(self, path: str, values: Mapping[str, Any], post: bool = True) -> dict[str, Any]:
        """One request. Raises: LinkError, ProtocolError."""
        url = f"{self._config.url}{path}" + ("" if post else f"?{urlencode(values)}")
        try:
            with urllib.request.urlopen(url, json.dumps(values).encode() if post else None, 30.0) as answer:
                found: dict[str, Any] = json.load(answer)
                return found
        except ValueError as error:
            raise ProtocolError(f"{url}: {error}; check that this is the device's server") from None
        except OSError as error:
            raise LinkError(f"no answer from {url} ({getattr(error, 'reason', error)}); check cable") from None

    def begin(self, known: Past) -> None:
        """Pumps off, and, of an earlier life, its clock and the end of its open dose. Raises: ReactorError."""
        if failed := self._off(range(VIALS)):
            raise DeviceStateError("; ".join(failed))
        self._k, self._zero_s = known.k, known.zero_s
        if known.open:
            given = self._ask("/dose", {"id": known.dose}, post=False) if known.fed else {}
            for name in known.open:
                self._end(name, known.on_s, float(given.get(str(self.names.index(name)), 0.0)))
        if math.isnan(known.zero_s):
            first = self._ask("/sample", {"after": 0}, post=False)
            self._k, self._zero_s = int(first["k"]), float(first["t"])
            self._log("device", {"zero_s": self._zero_s})
            for n in range(VIALS):
                self._ask("/heat", {"vial": n, "celsius": self._config.temperature})
        self._now_s = 60.0 * known.k

    def _end(self, name: str, on_s: float, ml: float) -> None:
        self._log("dose_end", {"reactor": name, "time_s": self.elapsed(), **Ending(on_s, ml, ml).row()})

    def measure(self) -> Measurement:
        """The next sample of all vials; with none fresh and a fault where the device does not answer."""
        fault: Fault | None = None
        try:
            new = self._ask("/sample", {"after": self._k}, post=False)
            self._k, self._now_s = int(new["k"]), float(new["t"])
            self._last = {key: np.array(new[key]) for key in self._last}
        except LinkError as error:
            fault = NoServer(error=error)
        for n, name in enumerate(self.names if fault is None else ()):
            seen = {"od": self._last["od"][n], "temperature": self._last["celsius"][n], "raw": self._last["raw"][n]}
            self._log("sample", {"reactor": name, "time_s": self.elapsed(), "k": self._k, **seen})
        return Measurement(
            np.full(VIALS, self.elapsed()), self._last["od"], self._last["celsius"], np.full(VIALS, fault is None),
            Vitals(np.zeros(VIALS), self._last["raw"], (fault,) * VIALS),
        )  # fmt: skip

    def actuate(self, command: Command) -> Receipt:
        """All doses in one request, each written down before it."""
        ml = np.where(command.rows, command.pump_rate, 0.0) * self._bench.period_s
        given = {name: float(v) for name, v in zip(self.names, ml, strict=True) if v > 0.0}
        number, on_s = str(self._k), self.elapsed()
        for name, volume in given.items():
            of = {"id": number, "on_s": on_s, "feed_ml": volume, "waste_ml": volume, "carry_ml": 0.0}
            self._log("intent", {"reactor": name, "time_s": on_s, **of})
        for name in given:
            self._log("feed_on", {"reactor": name, "time_s": on_s, "on_s": on_s})
        notes: tuple[str, ...] = ()
        if given:
            try:
                self._ask("/dose", {"id": number, "ml": {str(self.names.index(n)): v for n, v in given.items()}})
                for name, volume in given.items():
                    self._end(name, on_s, volume)
            except LinkError as error:  # whether they were given is unknown: they are booked
                notes = (f"doses not answered: {error}",)
        return Receipt(ml, notes, ml)

    def repeated(self) -> list[tuple[float, Receipt]]:
        """None ever is."""
        return []

    def elapsed(self) -> float:
        """Run time by the device's clock, s."""
        return self._now_s - self._zero_s

    @property
    def handed_over(self) -> Mask:
        """It does not regulate."""
        return np.zeros(VIALS, dtype=np.bool_)

    def _off(self, vials: Iterable[int]) -> list[str]:
        """Their pumps off; which are not, a line each. Raises: LinkError."""
        running = self._ask("/off", {"vials": list(vials)})["running"]
        return [f"{self.names[n]}: pumps still on; switch them off by hand" for n in running]

    def pumps_off(self, rows: Mask) -> list[str]:
        """As asked of the device."""
        try:
            return self._off(np.flatnonzero(rows).tolist())
        except LinkError as error:
            return [f"{name}: {error}" for name, r in zip(self.names, rows, strict=True) if r]

    def give_up(self, rows: Mask) -> list[str]:
        """As `pumps_off`."""
        return self.pumps_off(rows)

    def heat_off(self, rows: Mask) -> list[str]:
        """A target below every room."""
        for n in map(int, np.flatnonzero(rows)):
            self._ask("/heat", {"vial": n, "celsius": 4.0})
        return []

    def regulate(self, rows: Mask, setpoint: Array) -> list[str]:
        """It does not."""
        failed = self.pumps_off(rows)
        return failed + [f"{n}: no regulation of its own" for n, r in zip(self.names, rows, strict=True) if r]

    def stop(self) -> None:
        """All pumps off. Raises: DeviceStateError."""
        if failed := self.pumps_off(np.ones(VIALS, dtype=np.bool_)):
            raise DeviceStateError(f"pumps not verified off: {'; '.join(failed)}")


class EvolverFamily(Family):
    """Sixteen vials behind one server."""

    config = EvolverConfig
    can = Can(thermostat=True, resume=True)

    @contextmanager
    def open(self, opening: Opening) -> Iterator[Reactor]:
        """The device, its pumps off."""
        vials = Evolver(opening.backend, opening.bench, opening.journal.append)
        vials.begin(past(opening.earlier()))
        with left_off(vials):
            yield vials


family.add(EvolverFamily(), "An eVOLVER, sixteen vials behind one server.")
