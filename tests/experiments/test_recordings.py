"""Recordings of other devices and labs: each format tells the same, and nothing wrong is accepted."""

import io
import json
import os
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from envs.identification.calibration import calibrate
from envs.identification.open_loop import OpenLoop, open_loop
from envs.identification.screening import Series, merged
from experiments.recordings.reader import Recording, read_recording
from hardware.errors import RecordingError

MU, TAU, HOURS = 0.02, 1 / 3, 6.0
Table = list[list[str]]
START = np.datetime64("2026-07-01T08:00:00.000")


def recorded() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Minutes, OD and the dose after each reading, mL, of the paper's protocol."""
    time, od, rate = open_loop(OpenLoop(mu=MU, tau=TAU, hours=HOURS), np.random.default_rng(3))
    return time, od[0], np.append(60.0 * rate[0, :-1] * np.diff(time), 0.0)


TIME, OD, DOSE = recorded()
DOSED = np.flatnonzero(DOSE)


def moment(minutes: float) -> str:
    return f"{START + np.timedelta64(round(6e4 * minutes), 'ms')}Z"


def events(total: bool = False) -> Table:
    """Readings, and between them doses, in the rows of one table."""
    rows = [["time_min", "od", "fed_ml" if total else "dose_ml"]]
    for t, od, dose, fed in zip(TIME.tolist(), OD.tolist(), DOSE.tolist(), np.cumsum(DOSE).tolist(), strict=True):
        rows += [[f"{t:.4f}", repr(od), ""]] + [[f"{t + 0.1:.4f}", "", repr(fed if total else dose)]] * bool(dose)
    return rows


def activity() -> Table:
    names = (
        "experiment,pioreactor_unit,timestamp,od_reading,temperature_c,add_media_ml,remove_waste_ml,add_alt_media_ml,"
        "timestamp_localtime,hours_since_experiment_created"
    )
    rows = [names.split(",")]
    for t, od, dose in events()[1:]:
        hours = f"{round(60.0 * float(t)) / 3600.0:.12g}"  # of whole seconds
        rows.append(["e", "pio1", moment(float(t)), od, "", dose, dose, "", "2026-07-01 10:00:00.000", hours])
    return rows


def readings() -> Table:
    rows = [["experiment", "pioreactor_unit", "timestamp", "od_reading", "angle", "channel"]]
    rows += [["e", "pio1", moment(t), repr(od), "90", "2"] for t, od in zip(TIME.tolist(), OD.tolist(), strict=True)]
    return rows


def dosings() -> Table:
    rows = [["experiment", "pioreactor_unit", "timestamp", "event", "volume_change_ml", "source_of_event"]]
    for i in DOSED:
        rows += [
            ["e", "pio1", moment(TIME[i] + 0.1), kind, repr(float(DOSE[i])), "x"] for kind in ("add_media", "waste")
        ]
    return rows


def log(values: np.ndarray, late: float = 0.0) -> Table:
    """An eVOLVER's: hours and OD, or hours and seconds of a pump."""
    rows = [["Experiment: e vial 0", " Tue Jun 30 13:13:45 2026"]]
    return rows + [
        [f"{(t + late) / 60:.6f}", repr(v)] for t, v in zip(TIME.tolist(), values.tolist(), strict=True) if v
    ]


def csv(rows: Table) -> bytes:
    return "".join(",".join(row) + "\n" for row in rows).encode()


def export(**tables: Table) -> bytes:
    """A Pioreactor's export: a folder for each table, manifest and schema beside."""
    with zipfile.ZipFile(buffer := io.BytesIO(), "w") as archive:
        for name, rows in tables.items():
            archive.writestr(f"{name}/schema.json", json.dumps({"schema_version": 1, "dataset_name": name}))
            archive.writestr(f"{name}/{name}-e-pio1-20260701.csv", csv(rows))
        archive.writestr("manifest.json", json.dumps({"schema_version": 1, "selected_datasets": list(tables)}))
    return buffer.getvalue()


EVENTS = events()
Make = Callable[[Callable[[Table], Table]], dict[str, Any]]
FORMATS: dict[str, Make] = {
    "events": lambda spoil: {"data": csv(spoil(events()))},
    "totals": lambda spoil: {"data": csv(spoil(events(total=True)))},
    "named": lambda spoil: {
        "data": csv([["Elapsed hours", "scatter", "pump s"], *([f"{float(t) / 60:.6f}", *c] for t, *c in EVENTS[1:])]),
        "columns": {"od": "scatter", "dose": "pump s"},
    },
    "export": lambda spoil: {"data": export(pioreactor_unit_activity_data=spoil(activity()))},
    "tables": lambda spoil: {"data": export(dosing_events=dosings(), od_readings=spoil(readings()))},
    "evolver": lambda spoil: {"data": csv(spoil(log(OD))), "doses": csv(log(DOSE, 0.1))},
}  # fmt: skip


def read(folder: Path, data: bytes, doses: bytes | None = None, **options: Any) -> Recording:
    for name, content in (("data", data), ("doses", doses or b"")):
        (folder / name).write_bytes(content)
    return read_recording(folder / "data", doses=folder / "doses" if doses else None, **options)


@pytest.mark.parametrize("form", FORMATS)
def test_every_format_tells_the_same_readings_and_doses(tmp_path: Path, form: str) -> None:
    r = read(tmp_path, **FORMATS[form](lambda rows: rows))
    np.testing.assert_allclose(r.time_min, TIME - (TIME[0] if form in ("export", "tables") else 0), atol=1e-3)
    np.testing.assert_array_equal(r.od, OD)
    np.testing.assert_allclose(60.0 * r.pump_rate[:-1] * np.diff(r.time_min), DOSE[:-1], atol=1e-9)


def test_a_dose_at_the_time_of_a_reading_counts_from_that_reading_on(tmp_path: Path) -> None:
    r = read(tmp_path, data=csv(log(OD)), doses=csv(log(DOSE)))
    np.testing.assert_allclose(60.0 * r.pump_rate[:-1] * np.diff(r.time_min), DOSE[:-1], atol=1e-9)


@pytest.mark.parametrize("form", ["beside", "dose", "fed"])
def test_a_dose_in_seconds_of_a_pump_lasts_so_long(tmp_path: Path, form: str) -> None:
    """A reading every 10 s: 25 s from a reading on are in three rows, and their volume is kept."""
    rows = [[f"{10 * k}", "0.5", f"{25.0 * (k >= 5) if form == 'fed' else 25.0 * (k == 5)}"] for k in range(20)]
    given: dict[str, Any] = {"data": csv([["time_s", "od", "pump_s"], *rows]), "columns": {form: "pump_s"}}
    if form == "beside":
        hours = [f"{int(t) / 3600:.9f}" for t, *_ in rows]
        head = log(OD)[:1]
        given = {"data": csv(head + [[t, "0.5"] for t in hours]), "doses": csv([*head, [hours[5], "25.0"]])}
    r = read(tmp_path, pump_ml_s=0.8, **given)
    np.testing.assert_allclose(10.0 * r.pump_rate[5:8], [8.0, 8.0, 4.0], atol=0.81)
    assert 10.0 * r.pump_rate.sum() == pytest.approx(20.0)


def column(change: Callable[[float], float], *names: str) -> Callable[[Table], Table]:
    """Change the numbers of the columns with these names; of a table without names the first or the second."""

    def spoil(rows: Table) -> Table:
        at = [rows[0].index(name) for name in names if name in rows[0]] or [0 if "time_min" in names else 1]
        changed = [list(row) for row in rows]
        for row in changed[1:]:
            for i in at:
                if row[i].replace(".", "").isdigit():
                    row[i] = repr(change(float(row[i])))
        return changed

    return spoil


def swapped(rows: Table) -> Table:
    return [
        rows[0],
        *([row[1], row[0], *row[2:]] if len(row) < 4 else [*row[:3], row[5], "", row[3], *row[6:]] for row in rows[1:]),
    ]


def shuffled(rows: Table) -> Table:
    return [rows[0], *(rows[i] for i in 1 + np.random.default_rng(0).permutation(len(rows) - 1))]


BROKEN: dict[str, Callable[[Table], Table]] = {
    "truncated": lambda rows: [*rows[: len(rows) // 2], rows[len(rows) // 2][:1]],
    "shuffled": shuffled,
    "swapped": swapped,
    "two runs": lambda rows: [*rows, *rows[1:]],
    "times 100": column(lambda od: 100.0 * od, "od", "od_reading"),
    "other unit": column(lambda t: 60.0 * t, "time_min"),
    "finer unit": column(lambda t: t / 60.0, "time_min"),
}  # fmt: skip


@pytest.mark.slow
@pytest.mark.numeric
@pytest.mark.parametrize("form", ["events", "totals", "export", "evolver"])
@pytest.mark.parametrize("broken", BROKEN)
def test_of_a_broken_recording_nothing_wrong_is_accepted(tmp_path: Path, form: str, broken: str) -> None:
    """One line says what is wrong; what is accepted all the same holds the truth."""
    given, said = FORMATS[form](BROKEN[broken]), ""
    try:
        r = read(tmp_path, **given)
        found = calibrate(merged(Series(r.time_min, r.od, r.pump_rate, r.row)))
    except (RecordingError, ValueError) as error:
        said = str(error)
    assert "\n" not in said
    assert said or found.mu.low * 0.95 <= MU <= found.mu.high * 1.05
    assert said or found.tau.low * 0.95 <= TAU <= found.tau.high * 1.05


OTHERS = os.environ.get("OTHER_RECORDINGS", "")
EYESPY = {"columns": {"od": "Eyespy_sct_V", "fed": "pump_inflow_time_s"}, "pump_ml_s": 1 / 75}


@pytest.mark.slow
@pytest.mark.skipif(not OTHERS, reason="OTHER_RECORDINGS names no folder with the recordings of other labs")
@pytest.mark.parametrize(
    ("path", "options", "low", "high"),
    [
        ("livingphysics/bioreactor_data.csv", EYESPY, 0.17, 0.22),
        ("livingphysics/ekf_bioreactor_data.csv", EYESPY, 0.17, 0.22),
        ("lanl/example_data/example_data.csv", {}, 0.21, 0.26),
    ],
)
def test_recordings_of_other_labs_give_the_tau_that_is_known_of_them(
    path: str, options: dict[str, Any], low: float, high: float
) -> None:
    r = read_recording(Path(OTHERS) / path, **options)
    assert low <= calibrate(merged(Series(r.time_min, r.od, r.pump_rate, r.row))).tau.value <= high
