"""Every fault of a Pioreactor, against the vendor's own software in the rig: `python -m tests.campaigns.faults`.

Real client processes (`experiments.deploy`) control simulated vials through the vendor's web server, task queue, jobs
and broker. What the program recorded is compared with what the vials felt.
"""

import logging
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

from conf.schema import check, setting
from experiments.cli import files, frame
from experiments.reporting.tables import markdown
from hardware.errors import ReactorError
from hardware.pioreactor.config import PUBLISHED
from tests.campaigns.pioreactor_case import Trial
from tests.campaigns.pioreactor_faults import KILLS, MOMENTS, RigFault, rig_faults_named
from tests.campaigns.pioreactor_judged import RigOutcome, judged

__all__ = ["RigFaultsConfig", "rig_faults"]

log = logging.getLogger(__name__)

LATE_S = 240.0  # real seconds in which a run must dose again after a fault
KILL_NAMES = tuple(fault.name for fault in KILLS)


@dataclass(frozen=True)
class RigFaultsConfig:
    """Which faults to try, how often and how many at a time. Raises: ValueError naming key, value and allowed range."""

    faults: tuple[str, ...] = setting((), "names, as in docs/pioreactor.md; empty: all")
    moments: tuple[str, ...] = setting(MOMENTS, "before the start; between doses; in one", choices=MOMENTS, some=True)
    kills: int = setting(5, "times that each kill is repeated in its run", within=(1, 100))
    speed: float = setting(5.0, "growth faster than real time", within=(1, 30))
    workers: int = setting(2, "rigs at a time", within=(1, 16))
    settle: int = setting(2, "doses after the last fault before the run is ended", within=(1, 100))
    seed: int = setting(0, "of the vials", at_least=0)
    package: str = setting(PUBLISHED, "version of the vendor's software on the package index, or a wheel's path")

    def __post_init__(self) -> None:
        check(self)
        rig_faults_named(self.faults)


def one_trial(config: RigFaultsConfig, fault: RigFault, moment: str, folder: Path, stop: threading.Event) -> RigOutcome:
    """One fault in a rig of its own. Raises: ReactorError if the rig does not start."""
    folder.mkdir(parents=True)
    with Trial(folder, config.speed, config.seed, config.package, stop) as trial:
        times = config.kills if fault.name in KILL_NAMES else 1
        struck: list[float] = []
        trouble = ""
        if moment == "start":
            struck.append(time.time())
            fault.act(trial)
            trial.start()
            status = _ended(trial) if fault.refused else None
        else:
            trial.start()
            trouble = "" if trial.doses(2) else "no dose within the first minutes"
            status = None
        if not (fault.refused or trouble):
            for _ in range(times if moment != "start" else 1):
                trouble = trouble or _strike(trial, fault, moment, struck, stop)
            if not (trouble or trial.doses(config.settle, LATE_S)) and not stop.is_set():
                trouble = "no dose any more after it"
            status = trial.end()
        time.sleep(1.2)  # the truth of the last second
        found = judged(fault, moment, struck, trial.seen(status))
    if trouble:
        found.wrong.insert(0, trouble)
    (folder / "outcome.md").write_text(_table([found]), encoding="utf-8")
    return found


def _ended(trial: Trial) -> int | None:
    client = trial.client
    assert client is not None
    trial.until(lambda: False, 90.0)  # until it has ended
    return client.poll() if client.poll() is not None else trial.end()


def _strike(trial: Trial, fault: RigFault, moment: str, struck: list[float], stop: threading.Event) -> str:
    """Bring a fault about at its moment and mend it; what kept it from being done."""
    if moment == "in" and not trial.until(trial.pumping):
        return "no dose to strike"
    if moment == "between" and not trial.until(lambda: not trial.pumping()):
        return "a dose without an end"
    if moment != "start":
        struck.append(time.time())
        fault.act(trial)
    stop.wait(fault.seconds)
    if stop.is_set():
        return "stopped"
    if fault.mend is not None:
        fault.mend(trial)
    if not trial.doses(2, LATE_S):
        return "no dose any more after it"
    trial.until(trial.near, LATE_S)
    return ""


def rig_faults(config: RigFaultsConfig, folder: Path) -> None:
    """All trials; table.md and summary.json. Raises: UserError if one did not go as declared."""
    began, stop = time.monotonic(), threading.Event()
    cases = [(f, m) for f in rig_faults_named(config.faults) for m in f.moments if m in config.moments]
    if not cases:
        raise frame.UserError(f"faults = {config.faults}, moments = {config.moments}: no fault has such a moment")
    found: list[RigOutcome] = []

    def run(fault: RigFault, moment: str) -> RigOutcome:
        place = folder / f"{fault.name}-{moment}"
        try:
            outcome = one_trial(config, fault, moment, place, stop)
        except (ReactorError, OSError, RuntimeError) as error:
            outcome = RigOutcome(fault.name, moment, wrong=[f"{type(error).__name__}: {error}"])
        found.append(outcome)
        log.info("%d of %d: %s, %s: %s", len(found), len(cases), fault.name, moment, "; ".join(outcome.wrong) or "ok")
        return outcome

    log.info("%d trials of one to ten minutes, %d at a time", len(cases), config.workers)
    with ThreadPoolExecutor(config.workers) as executor:
        futures = [executor.submit(run, *case) for case in cases]
        try:
            outcomes = [future.result() for future in futures]
        except BaseException:  # rigs and clients have sessions of their own: nobody else ends them
            stop.set()
            executor.shutdown(cancel_futures=True)
            _write(folder, found, time.monotonic() - began)
            raise
    _write(folder, outcomes, time.monotonic() - began)
    log.info("table %s", folder / "table.md")
    if wrong := [o for o in outcomes if not o.ok]:
        raise frame.UserError(
            f"{len(wrong)} of {len(outcomes)} trials did not go as declared; see {folder / 'table.md'}"
        )


COLUMNS = (
    "fault", "moment", "times", "told within, s", "doses", "doubled", "fed on record, mL", "true, mL", "rows lost",
    "volume at most, mL", "error at the end, OD", "not as declared",
)  # fmt: skip


def _table(outcomes: list[RigOutcome]) -> str:
    rows = [
        (
            o.fault, o.moment, o.times, f"{o.told_s:.1f}" if o.told_s == o.told_s else "–", o.doses, o.doubled,
            f"{o.low_ml:.2f} to {o.high_ml:.2f}", f"{o.true_ml:.2f}", o.rows_lost, f"{o.peak_ml:.1f}",
            f"{o.error_od:.3f}" if o.error_od == o.error_od else "–", "; ".join(o.wrong) or "–",
        )
        for o in outcomes
    ]  # fmt: skip
    return markdown(COLUMNS, rows)


def _write(folder: Path, outcomes: list[RigOutcome], wall_s: float) -> None:
    (folder / "table.md").write_text(_table(outcomes), encoding="utf-8")
    kills = sum(o.times for o in outcomes if o.fault in KILL_NAMES)
    total = {
        "trials": len(outcomes), "faults": len({o.fault for o in outcomes}), "kills": kills,
        "not_as_declared": sum(not o.ok for o in outcomes), "doses": sum(o.doses for o in outcomes),
        "doubled": sum(o.doubled for o in outcomes), "rows": sum(o.rows for o in outcomes),
        "rows_lost": sum(o.rows_lost for o in outcomes), "wall_s": round(wall_s, 1),
    }  # fmt: skip
    files.write_json(folder / "summary.json", {**total, "trials_list": [o.as_dict() for o in outcomes]})
    log.info("%s", ", ".join(f"{key.replace('_', ' ')} {value}" for key, value in total.items()))


main = frame.Command("rig_faults", RigFaultsConfig(), rig_faults)


if __name__ == "__main__":
    main()
