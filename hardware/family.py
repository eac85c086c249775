"""A family of reactors as one object: its config, how to open and check it, its abilities and its limits.

The families that come with the program are loaded at their first use; `add` registers a further family.
"""

import logging
import math
import tempfile
import time
from collections.abc import Iterator, Mapping, Sequence, Set
from contextlib import AbstractContextManager, closing, contextmanager
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np

from conf import presets
from envs.bench import Bench
from envs.plant.plant import Plant, PlantConfig
from envs.scenario import DOSE_ML, MADE_UP_MIN, Scenario
from hardware import messages
from hardware.actuator import FEED, SPARE, THERMOSTAT, Actuator
from hardware.clock import run_time
from hardware.errors import LinkError, ReactorError, UnfitError
from hardware.reactor import Array, Reactor
from hardware.storage.journal import Journal
from hardware.storage.messages import JournalMissing

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Check:
    """One check before a run: name, result, what was seen, remedy. If it is `required`, its failure stops the run."""

    name: str
    ok: bool
    detail: str
    remedy: str = ""
    required: bool = True

    def __str__(self) -> str:
        mark = "pass" if self.ok else ("FAIL" if self.required else "note")
        return f"{mark}  {self.name}: {self.detail}" + ("" if self.ok else f" -> {self.remedy}")


def report(checks: Sequence[Check]) -> None:
    """Log the lines of a preflight. Raises: DeviceStateError if a required check failed."""
    for one in checks:
        log.log(logging.INFO if one.ok else logging.WARNING, "%s", one)
    failed = [one for one in checks if one.required and not one.ok]
    if failed:
        raise messages.PreflightFailed(count=len(failed), of=len(checks), first=failed[0])


@dataclass(frozen=True)
class Can:
    """What the reactors of a family can do.

    fluorescence: measure fluorescence. spare_pumps: numbers of the pumps that can give another fluid.
    thermostat: hold the temperature of a scenario step. regulation: hold an OD without this program. resume: continue a
    run after the program was killed.
    """

    fluorescence: bool = False
    spare_pumps: tuple[int, ...] = ()
    thermostat: bool = False
    regulation: bool = False
    resume: bool = False


@dataclass(frozen=True)
class Opening:
    """Everything that a family needs to open its reactors.

    backend: the family's config. bench: volume, period and pump. plant: config of simulated vials. journal: the run's
    journal. A driver writes every command into it before sending the command; `journal.rows` holds the rows written
    before an interruption. folder: the run's folder. resumed: whether this run continues an earlier run.
    """

    backend: Any
    bench: Bench
    plant: PlantConfig
    journal: Journal
    folder: Path
    resumed: bool

    def earlier(self) -> list[dict[str, Any]]:
        """Return the rows written before a resume, none in a new run. Raises: RecordingError if they are missing."""
        if self.resumed and not self.journal.rows:
            raise JournalMissing(path=self.journal.path)
        return self.journal.rows

    @property
    def began(self) -> float:
        return float(self.journal.rows[0]["wall"]) if self.journal.rows else time.time()

    def elapsed_s(self, speed: float = 1.0, low_s: float = 0.0, high_s: float = math.inf) -> float:
        """Return the run time that has passed, s; 0 in a new run; warn of a doubtful clock. Args: as in `run_time`."""
        found = run_time(self.journal.rows, speed, low_s, high_s)
        if found.step_s:
            log.warning(messages.ClockMoved(by_min=found.step_s / 60.0, minute=found.s / 60.0))
            self.journal.append("clock", {"step_s": found.step_s, **found._asdict()})
        elif math.isinf(found.high_s):
            log.warning(messages.ClockDoubtful())
        return found.s


class Family:
    """One kind of reactor. A new family must define `config` and `open`; the rest has defaults.

    Attributes: config: dataclass of the family's settings, with fields made by `conf.schema.setting`; it needs `kind`,
      the family's name, and `reactors`, the reactors' names. can: abilities of the reactors. called: name of the
      reactors in texts. at_stake: a culture is at risk, so a doubtful or uncertified policy is refused. simulated: the
      vials are those of `plant`, in this process and in virtual time, and their true state is known.
    """

    config: type[Any]
    can = Can()
    called = "the reactors"
    at_stake = True
    simulated = False

    def open(self, opening: Opening) -> AbstractContextManager[Reactor]:
        """Open the reactors of a run: ready inside the context, released after it. Raises, on entering: ReactorError.

        A dose must be in the journal before it begins, and `Reactor.pumps_off` must return what it could not verify.
        A new run is checked first; a resumed run continues from `opening.earlier()`.
        """
        raise NotImplementedError

    def preflight(self, backend: Any, bench: Bench, folder: Path) -> list[Check]:
        """Check everything that a run in `folder` needs; return one line for each check. Raises: ReactorError.

        By default the reactors are opened as for a run, with a temporary journal; each reactor is sampled once, and its
        pumps are verified off.
        """
        checks: list[Check] = []
        with tempfile.TemporaryDirectory() as name, closing(Journal(Path(name) / "journal.jsonl", fsync=False)) as rows:
            try:
                with self.open(Opening(backend, bench, PlantConfig(), rows, Path(name), resumed=False)) as reactors:
                    checks += _looked_at(reactors)
            except ReactorError as error:
                checks.append(Check("reactors", False, str(error), "check power, cable and address"))
        return checks

    def fits(self, backend: Any, bench: Bench, scenarios: Sequence[Scenario], ends: Sequence[str]) -> None:
        """Check that the reactors can do what a run requests, before the program contacts a device.

        Args: scenarios, ends: one per reactor; ends as in deploy's `at_end`.
        Raises: UnfitError naming the backend, the missing ability or wrong value, and the remedy.
        """
        where = f"backend={backend.kind}"
        asked = sorted({t for s in scenarios for t in s.temperatures if t is not None and math.isfinite(t)})
        if len(asked) > 1 and (lack := self.no_thermostat(backend)) is not None:
            degrees = f"{asked[0]:g} to {asked[-1]:g} degC"
            raise UnfitError(f"scenario.temperatures ask for {degrees}: {where} controls none{lack}")
        if "regulate" in ends and not (self.can.regulation or self.simulated):
            raise UnfitError(f"at_end = regulate: {where} has no regulation of its own; allowed hold, stop")
        self.doses(backend, bench)
        self.gives(backend, bench, [s.supplied for s in scenarios], "scenario.outputs")

    def no_thermostat(self, backend: Any) -> str | None:
        """Return None if the temperature is controlled, else what is missing, as a text to follow "controls none"."""
        return None if self.can.thermostat else ""

    def doses(self, backend: Any, bench: Bench) -> None:
        """Check that the bench's period, volumes and largest rate suit the reactors. Raises: UnfitError."""

    def gives(self, backend: Any, bench: Bench, pumps: Sequence[Set[int]], who: str) -> None:
        """Check that each reactor has the spare pumps, by number, that the key `who` needs. Raises: UnfitError."""
        if not any(pumps):
            return
        most_ml, needed = bench.max_rate * bench.period_s, 2.0 * DOSE_ML
        if most_ml < needed:
            remedy = f"allowed {needed / bench.period_s:.4f} mL/s or more with {who}"
            raise UnfitError(f"bench.max_rate = {bench.max_rate:g} mL/s: {remedy}")
        if bench.control_min > MADE_UP_MIN:
            remedy = f"allowed at most {60.0 * MADE_UP_MIN:g} s with {who}"
            raise UnfitError(f"bench.period_s = {bench.period_s:g} s: {remedy}")
        for name, asked in zip(backend.reactors, pumps, strict=True):
            for number in sorted(asked):
                if number not in self.can.spare_pumps:
                    raise UnfitError(f"{who}: backend={backend.kind} has no spare pump {number}; remove it")
                self.tube(backend, number, most_ml, f"{who} of {name}")

    def tube(self, backend: Any, number: int, most_ml: float, who: str) -> None:
        """Check that a spare pump has a tube and can give doses of `most_ml`. Raises: UnfitError, naming `who`."""

    def actuators(self, backend: Any) -> tuple[Actuator, ...]:
        """List the actuators that signals of the control loop may command."""
        heat = (THERMOSTAT,) if self.no_thermostat(backend) is None else ()
        return (FEED, *heat, *(SPARE[number] for number in self.can.spare_pumps))

    def holding(self, backend: Any, preset: str, **values: Any) -> Any:
        """Return a config with a plant preset and values, if it simulates its own vials and none were chosen."""
        return backend

    def vials(self, backend: Any, plant: PlantConfig) -> tuple[str, PlantConfig] | None:
        """Return the config key of simulated cultures and their config, or None. Args: plant: deploy's plant config."""
        return None

    def sees_fluorescence(self, backend: Any) -> bool:
        return False

    def seeing_fluorescence(self, backend: Any) -> Any:
        """Return the config with the measurement of fluorescence on."""
        return backend

    def rim_ml(self, volumes_ml: Array) -> Array | float:
        """Return the capacity of the vials, mL, inf if unknown. Args: volumes_ml: volumes of the cultures, (N,)."""
        return math.inf

    def truth(self, reactors: Reactor) -> tuple[Plant | None, float]:
        """Return the simulated vials, or None, and the flow that a run assumes of their feed pump, mL/s."""
        return None, 1.0

    def address(self, backend: Any) -> str:
        """Return where the reactors are, as a text for the user."""
        return str(getattr(backend, "url", "")) or "unknown address"

    def start_od(self, backend: Any, plant: PlantConfig) -> float:
        """Return the OD at which the cultures start, 0 if unknown."""
        return 0.0

    def unmeasured(self, backend: Any) -> str:
        """Return a line with the values that are assumed, not measured on the bench; "" if none. Raises: UnfitError."""
        return ""


def _looked_at(reactors: Reactor) -> Iterator[Check]:
    n = len(reactors.names)
    yield Check("reactors", True, f"{', '.join(reactors.names)} opened")
    try:
        od, seen = np.full(n, np.nan), np.zeros(n, dtype=np.bool_)
        for _ in range(2 * n):  # one sample may come for each reactor alone
            if not seen.all():
                m = reactors.measure()
                od, seen = np.where(m.fresh, m.od, od), seen | m.fresh
        for name, value, here in zip(reactors.names, od, seen, strict=True):
            word = f"OD {value:.3f}" if here else "none came"
            yield Check(f"{name} sample", bool(here and np.isfinite(value)), word, "check the reactor and its sensor")
        failed = reactors.pumps_off(np.ones(n, dtype=np.bool_))
        for name in reactors.names:
            said = "; ".join(line for line in failed if line.startswith(f"{name}:"))
            yield Check(f"{name} pumps", not said, said or "verified off", "switch them off by hand")
    finally:
        reactors.stop()


@contextmanager
def not_looked_at(resumed: bool) -> Iterator[None]:
    """Warn, on Ctrl-C or a failed resume, that the pumps were not checked and may still be on."""
    try:
        yield
    except (KeyboardInterrupt, LinkError) as error:
        if resumed or not isinstance(error, LinkError):
            log.warning(messages.PumpsNotLookedAt())
        raise


SHIPPED: Mapping[str, str] = {
    "sim": "hardware.simulated",
    "chibio": "hardware.chibio.family",
    "emulator": "hardware.emulator.family",
    "pioreactor": "hardware.pioreactor.family",
    "pioreactor_rig": "hardware.rig.family",
}
"""Module of each family that comes with the program; its FAMILY is the family."""
_loaded: dict[str, Family] = {}


def known() -> list[str]:
    return list(dict.fromkeys([*SHIPPED, *_loaded]))


def family(kind: str) -> Family:
    """Return the family of this name. Raises: ValueError naming the known families."""
    if kind not in known():
        raise ValueError(f"backend.kind = {kind}: allowed {', '.join(known())}")
    if kind not in _loaded:
        _loaded[kind] = import_module(SHIPPED[kind]).FAMILY
    return _loaded[kind]


def family_of(backend: Any) -> Family:
    return family(backend.kind)


def add(one: Family, what: str) -> None:
    """Register a family as `backend=KIND`.

    Args: one: the family; KIND is the default of `kind` in its config. what: the sentence that the help shows.
    Raises: ValueError if the kind exists.
    """
    kind = one.config().kind
    presets.add(f"backend/{kind}", {"kind": kind}, what)
    _loaded[kind] = one
