"""A deployment on the rig judged by the truth of its vials: `python -m tests.campaigns.rig_study`.

The conf file says what is written.
"""

import json
import logging
import time
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from conf.schema import check, part, setting
from experiments.cli import files, frame
from experiments.reporting.tables import markdown, number
from hardware.errors import RecordingError
from hardware.storage.journal import read_journal
from tests.campaigns import rig_truth
from tests.campaigns.client import Client
from tests.campaigns.rig_truth import Limits, UnitTruth
from tests.entry import command

__all__ = ["RigStudyConfig", "rig_study"]

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class RigStudyConfig:
    """What is run and what it has to keep. Raises: ValueError naming key, value and allowed range."""

    run: str = setting("", "folder of a run of backend=pioreactor_rig, which is judged; empty: run one")
    speed: float = setting(
        4.0, "growth faster than real time: device seconds per real second", within=(1, 60), note="10 on idle cores"
    )
    overrides: tuple[str, ...] = setting(
        ("scenario.recovery_od=0.7", "bench.volumes_ml.pio02=14"), "further words of the deploy command"
    )
    limits: Limits = part(Limits, "what the deployment has to keep")

    def __post_init__(self) -> None:
        check(self)


@dataclass(frozen=True)
class Recorded:
    """A run on the rig, as its folder has it."""

    speed: float
    volume_ml: Mapping[str, float]
    journal: Sequence[Mapping[str, Any]]
    truth: Sequence[Mapping[str, Any]]


def recorded(folder: Path) -> Recorded:
    """The run in a folder. Raises: UserError naming what it lacks."""
    try:
        config: Any = files.load_yaml(folder / "config.yaml")
        reactors, speed, bench = tuple(config.backend.reactors), float(config.backend.speed), config.bench
        volume = {u: float(bench.volumes_ml.get(u, bench.volume_ml)) for u in reactors}
        journal, _ = read_journal(folder / "journal.jsonl")
        lines = (folder / "truth.jsonl").read_text(encoding="utf-8").split("\n")[:-1]
        return Recorded(speed, volume, journal, [json.loads(line) for line in lines])
    except (OSError, ValueError, TypeError, AttributeError, RecordingError) as error:
        remedy = "give the folder of a run of backend=pioreactor_rig, which has config.yaml, journal.jsonl, truth.jsonl"
        raise frame.UserError(f"run={folder}: {error}; {remedy}") from None


def deployed(config: RigStudyConfig, folder: Path) -> Path:
    """Deploy on a rig until the schedule's end; returns the folder. Raises: UserError."""
    said = folder / "deployment.log"
    words = ["backend=pioreactor_rig", f"backend.speed={config.speed}", "scenario=setpoint_steps", *config.overrides]
    client = Client([*words, f"hydra.run.dir={folder / 'run'}"], said)
    try:
        while client.status is None:
            time.sleep(0.2)
    finally:
        client.end(60.0)
    if client.status:
        last = said.read_text(encoding="utf-8", errors="replace").strip().splitlines()[-1:] or ["no word"]
        raise frame.UserError(f"the deployment ended with status {client.status}: {last[0]}; {said} has all")
    return folder / "run"


def table(run: Recorded, found: Sequence[UnitTruth]) -> str:
    """table.md: how the setpoints were held, and what became of the doses."""
    head = ("unit", "setpoint", f"mean error, last {rig_truth.LAST_MIN:.0f} min")
    rows = [(u.unit, f"{setpoint:g}", f"{error:.4f}") for u in found for setpoint, error in u.held]
    doses = (
        "unit", "doses", "runs of the pump", "error, mL: mean", "largest", "outside of the bound, mL", "cut short",
        "without intent", "twice", "missing", "given, mL", "booked, mL", "difference", "largest volume, mL",
    )  # fmt: skip
    said = [f"Growth {run.speed:g} times faster than real time.", ""]
    return "\n".join([*said, markdown(head, rows), markdown(doses, map(_dose_row, found))])


def _dose_row(u: UnitTruth) -> tuple[str, ...]:
    a = u.account
    return (
        u.unit, str(a.asked), str(a.runs), f"{a.error_mean_ml:+.4f}", f"{a.error_max_ml:.4f}", number(a.outside_ml, 2),
        str(a.cut), str(a.without_intent), str(a.twice), str(a.missing), f"{a.given_ml:.2f}", f"{a.booked_ml:.2f}",
        f"{a.total_pct:+.2f} %", f"{u.peak_ml:.2f}",
    )  # fmt: skip


def rig_study(config: RigStudyConfig, folder: Path) -> None:
    """Run, or take a run that is there; table, summary.json. Raises: UserError where a limit is not met."""
    began = time.monotonic()
    run = recorded(Path(config.run) if config.run else deployed(config, folder))
    found = [rig_truth.found_in(run.journal, run.truth, unit, run.speed) for unit in run.volume_ml]
    wrong = [line for u in found for line in rig_truth.trouble(u, config.limits, run.volume_ml[u.unit])]
    units = {u.unit: {key: value for key, value in asdict(u).items() if key != "unit"} for u in found}
    summary = {"met": not wrong, "speed": run.speed, "not_met": wrong}
    files.write_json(folder / "summary.json", {**summary, "units": units, "wall_s": round(time.monotonic() - began, 1)})
    (folder / "table.md").write_text(table(run, found), encoding="utf-8")
    log.info("table %s", folder / "table.md")
    if wrong:
        raise frame.UserError(f"not met: {'; '.join(wrong)}")


main = command(__file__, RigStudyConfig(), rig_study)


if __name__ == "__main__":
    main()
