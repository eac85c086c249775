"""A deployment on the rig judged by its truth, beside the vendor's turbidostat: `python -m tests.campaigns.rig_study`.

The conf file says what is written.
"""

import json
import logging
import time
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from experiments.cli import files, frame
from experiments.reporting.tables import markdown, number
from hardware.errors import ReactorError, RecordingError
from hardware.storage.journal import read_journal
from tests.campaigns import rig_truth
from tests.campaigns.rig_run import LOOK_S, RigStudyConfig, run_on_rig
from tests.campaigns.rig_truth import Span, UnitTruth
from tests.entry import command

__all__ = ["rig_study"]

log = logging.getLogger(__name__)

BESIDE = ("dosing_events.jsonl", "vendor.jsonl")  # which only this command's own runs have


@dataclass(frozen=True)
class Recorded:
    """A run on the rig, as its folder has it; events: None where none were recorded."""

    reactors: tuple[str, ...]
    speed: float
    volume_ml: Mapping[str, float]
    journal: Sequence[Mapping[str, Any]]
    truth: Sequence[Mapping[str, Any]]
    events: Sequence[Mapping[str, Any]] | None
    vendor: Sequence[Mapping[str, Any]]

    @property
    def spans(self) -> dict[str, list[Span]]:
        """The windows of each unit; the vendor's last."""
        found = {unit: rig_truth.phases(self.journal, unit) for unit in self.reactors}
        return found | {str(row["unit"]): rig_truth.targets(self.vendor) for row in self.vendor[:1]}


def recorded(folder: Path) -> Recorded:
    """The run in a folder, or in `run` of the folder of this command. Raises: UserError naming what it lacks."""
    folder = folder / "run" if (folder / "run" / "journal.jsonl").is_file() else folder
    try:
        config: Any = files.load_yaml(folder / "config.yaml")
        reactors, speed, bench = tuple(config.backend.reactors), float(config.backend.speed), config.bench
        volume = {u: float(bench.volumes_ml.get(u, bench.volume_ml)) for u in reactors}
        journal, _ = read_journal(folder / "journal.jsonl")
        truth = _rows(folder / "truth.jsonl")
        events, vendor = (_rows(path) if (path := folder / name).exists() else None for name in BESIDE)
    except (OSError, ValueError, TypeError, AttributeError, RecordingError) as error:
        remedy = "give the folder of a run of backend=pioreactor_rig, which has config.yaml, journal.jsonl, truth.jsonl"
        raise frame.UserError(f"run={folder}: {error}; {remedy}") from None
    return Recorded(reactors, speed, volume, journal, truth, events, vendor or [])


def _rows(path: Path) -> list[dict[str, Any]]:
    """JSON lines; what follows the last line end is left out. Raises: OSError, ValueError."""
    return [json.loads(line) for line in path.read_text(encoding="utf-8").split("\n")[:-1]]


def found_in(run: Recorded) -> list[UnitTruth]:
    """Every unit, the judged ones first."""
    found = []
    for unit, spans in run.spans.items():
        windows = tuple(rig_truth.held(span, run.truth, unit, run.speed) for span in spans)
        judged = unit in run.reactors
        doses = rig_truth.account(run.journal, run.truth, run.events, unit) if judged else None
        found.append(UnitTruth(unit, windows, rig_truth.vial(run.truth, unit), doses))
    return found


def table(run: Recorded, found: Sequence[UnitTruth]) -> str:
    """table.md: how the setpoints were held, and what became of the doses."""
    look = LOOK_S * run.speed / 60.0
    lines = [f"Growth {run.speed:g} times faster than real time.", ""]
    if run.vendor:
        lines[0] += f" The vendor's turbidostat looks every {LOOK_S:g} s of real time: {look:g} min of the culture."
    last = f"last {rig_truth.LAST_MIN:.0f} min"
    head = ("unit", "setpoint", "mean error", f"mean error, {last}", f"bias, {last}", "media, mL")
    rows = [
        (u.unit, f"{h.setpoint:g}", *(f"{v:.4f}" for v in (h.error_od, h.last_error_od)), f"{h.last_bias_od:+.4f}",
         f"{h.media_ml:.2f}") for u in found for h in u.held
    ]  # fmt: skip
    doses = ("unit", "doses", "runs of the pump", "error, mL: mean", "largest", "outside of the bound, mL",
             "cut short", "without intent", "twice", "missing", "ids told", "given, mL", "booked, mL", "difference",
             "volume, mL: peak", "end")  # fmt: skip
    return "\n".join([*lines, markdown(head, rows), markdown(doses, map(_dose_row, found))])


def _dose_row(u: UnitTruth) -> tuple[str, ...]:
    volumes, a = (f"{u.vial.peak_ml:.2f}", f"{u.vial.end_ml:.2f}"), u.account
    if a is None:
        return u.unit, "–", str(u.vial.doses), *["–"] * 8, f"{u.vial.media_ml:.2f}", "–", "–", *volumes
    told = "not recorded" if a.ids_untold is None else f"{a.asked - a.missing - a.ids_untold} of {a.asked - a.missing}"
    return (
        u.unit, str(a.asked), str(a.runs), f"{a.error_mean_ml:+.4f}", f"{a.error_max_ml:.4f}", number(a.outside_ml, 2),
        str(a.cut), str(a.without_intent), str(a.twice), str(a.missing), told,
        f"{a.given_ml:.2f}", f"{a.booked_ml:.2f}", f"{a.total_pct:+.2f} %", *volumes,
    )  # fmt: skip


def draw(run: Recorded, folder: Path) -> None:
    """True OD of every unit over setpoint, above the doses that its media pump gave."""
    from experiments.reporting.charts import COLOURS, new_figure, save

    spans = run.spans
    zero = min((span.start for each in spans.values() for span in each), default=0.0)
    figure, (top, bottom) = new_figure(8.0, 4.8, 2, 1, sharex=True, height_ratios=[2.2, 1.0])
    for k, (unit, mine) in enumerate(spans.items()):
        seen = [(row["wall"], row["od"]) for row in rig_truth.of_unit(run.truth, unit) if "od" in row]
        wall, od = np.array(seen).reshape(-1, 2).T
        starts, volumes = rig_truth.media_runs(run.truth, unit)
        label = unit if unit in run.reactors else f"{unit}: the vendor's turbidostat"
        top.plot((wall - zero) * run.speed / 60.0, od, color=COLOURS[k], linewidth=1.1, label=label, zorder=3 - k)
        bottom.plot((starts - zero) * run.speed / 60.0, volumes, ".", color=COLOURS[k], markersize=4.5)
        for n, span in enumerate(mine if k == 0 else []):
            edges = [(at - zero) * run.speed / 60.0 for at in (span.start, span.end)]
            style: dict[str, Any] = {"color": "black", "linewidth": 0.9, "linestyle": "--", "zorder": 4}
            top.plot(edges, [span.setpoint] * 2, label=None if n else "setpoint", **style)
    held = [row["od"] for unit in run.reactors for row in rig_truth.of_unit(run.truth, unit) if "od" in row]
    top.set(ylabel="true OD", ylim=(0.0, 1.3 * max(held, default=1.0)))  # a vendor's unit that escapes leaves the axes
    top.legend(handles=sorted(top.get_legend_handles_labels()[0], key=lambda line: line.get_label() == "setpoint"))
    bottom.set(ylabel="dose, mL", xlabel="time, min of the culture", ylim=(0.0, None))
    save(figure, folder / "figures", "rig_study")


def rig_study(config: RigStudyConfig, folder: Path) -> None:
    """Run, or take a run that is there; table, figure, summary.json. Raises: UserError where a limit is not met."""
    began = time.monotonic()
    try:
        run = recorded(Path(config.run) if config.run else run_on_rig(config, folder))
    except ReactorError as error:
        raise frame.UserError(str(error)) from None
    found = found_in(run)
    wrong = [line for u in found if u.account for line in rig_truth.trouble(u, config.limits, run.volume_ml[u.unit])]
    units = {u.unit: {key: value for key, value in asdict(u).items() if key != "unit"} for u in found}
    summary = {"met": not wrong, "speed": run.speed, "vendor_look_min": LOOK_S * run.speed / 60.0, "not_met": wrong}
    files.write_json(folder / "summary.json", {**summary, "units": units, "wall_s": round(time.monotonic() - began, 1)})
    (folder / "table.md").write_text(table(run, found), encoding="utf-8")
    draw(run, folder)
    log.info("table %s, figure %s", folder / "table.md", folder / "figures" / "rig_study.png")
    if wrong:
        raise frame.UserError(f"not met: {'; '.join(wrong)}")


main = command(__file__, RigStudyConfig(), rig_study)


if __name__ == "__main__":
    main()
