"""The recording format: written so that a crash costs one row, read so that nothing bad passes in silence."""

import gzip
import time
from collections.abc import Callable, Iterable
from dataclasses import replace
from datetime import UTC, datetime, timedelta, timezone
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from experiments.recordings.reader import Recording, read_recording
from hardware.errors import RecordingError
from hardware.storage import messages
from hardware.storage.marks import Mark, add_mark, read_marks
from hardware.storage.recorder import Recorder
from tests.real_recording import DITHER, needs_dither

Read = Callable[..., Recording]
COLUMNS = ("time_min", "od", "pump_rate_ml_s")
T = np.arange(40.0)
OD = 0.1 * np.exp(0.02 * T)
U = np.where(T > 20, 0.02, 0.0)

CHIBIO_HEADER = (
    "exp_time,od_measured,od_setpoint,od_zero_setpoint,thermostat_setpoint,heating_rate,internal_air_temp,"
    "external_air_temp,media_temp,opt_gen_act_int,pump_1_rate,pump_2_rate,pump_3_rate,pump_4_rate,media_vol,"
    "stirring_rate,LED_395nm_setpoint,LED_457nm_setpoint,LED_500nm_setpoint,LED_523nm_setpoint,LED_595nm_setpoint,"
    "LED_623nm_setpoint,LED_6500K_setpoint,LED_600nm_setpoint,LED_550nm_setpoint,LED_White_setpoint,laser_setpoint,"
    "LED_UV_int,FP1_base,FP1_emit1,FP1_emit2,FP2_base,FP2_emit1,FP2_emit2,FP3_base,FP3_emit1,FP3_emit2,"
    "custom_prog_param1,custom_prog_param2,custom_prog_param3,custom_prog_status,zigzag_target,growth_rate"
)
CHIBIO = CHIBIO_HEADER.split(",")


def chibio(names: list[str] = CHIBIO, header: bool = True, **columns: np.ndarray) -> str:
    """A file of the vendor's software with these columns; nothing in the others."""
    table = {name: np.zeros(len(T)) for name in names} | {"exp_time": 60.0 * T, "od_measured": OD} | columns
    rows = [names] * header + [map(repr, row) for row in np.array([table[name] for name in names]).T.tolist()]
    return "".join(f"{','.join(row)}\n" for row in rows)


FED = {"pump_1_rate": U, "pump_2_rate": 4.0 * U, "media_temp": 37.0 + 0.01 * T}


def tidy(od: np.ndarray = OD, t: np.ndarray = T, u: np.ndarray = U, header: str = ",".join(COLUMNS)) -> str:
    body = "".join(f"{a!r},{b!r},{c!r}\n" for a, b, c in zip(t.tolist(), od.tolist(), u.tolist(), strict=True))
    return (header + "\n" if header else "") + body


GZ = gzip.compress(tidy().encode())


def changed(values: np.ndarray, where: object, to: object) -> np.ndarray:
    copy = values.copy()
    copy[where] = to  # type: ignore[index]
    return copy


@pytest.fixture
def read(tmp_path: Path) -> Read:
    def write_and_read(content: str | bytes, **options: Any) -> Recording:
        path = tmp_path / "recording.csv"
        path.write_bytes(content if isinstance(content, bytes) else content.encode())
        return read_recording(path, **options)

    return write_and_read


# ---------------------------------------------------------------- writing


def test_what_is_written_is_read_to_the_bit(tmp_path: Path) -> None:
    path = tmp_path / "run.csv"
    with Recorder(path, (*COLUMNS, "temperature_degc", "decision")) as recorder:
        for t, y, u in zip(T, OD, U, strict=True):
            recorder.write(
                {"time_min": t, "od": y, "pump_rate_ml_s": u, "temperature_degc": None, "decision": 'pass, "ok"'}
            )
    back = read_recording(path)
    np.testing.assert_array_equal(back.time_min, T)
    np.testing.assert_array_equal(back.od, OD)
    np.testing.assert_array_equal(back.pump_rate, U)
    assert np.isnan(back.temperature).all()
    assert back.notes == ()


@pytest.mark.parametrize(("torn", "kept"), [(b"time_min,o", 0), (None, 1)])
def test_a_torn_line_is_cut_and_a_torn_header_begun_anew(tmp_path: Path, torn: bytes | None, kept: int) -> None:
    path, row = tmp_path / "run.csv", dict(zip(COLUMNS, (0.0, 0.5, 0.0), strict=True))
    header, line = b"time_min,od,pump_rate_ml_s\n", b"0.0,0.5,0.0\n"
    path.write_bytes(torn or header + line + b"99999.0,0.")
    with Recorder(path, COLUMNS) as recorder:
        assert recorder.repaired is not None
        assert recorder.repaired.fields["length"] == 10
        recorder.write(row)
    assert path.read_bytes() == header + line * (kept + 1)


def test_misuse_is_named(tmp_path: Path) -> None:
    with pytest.raises(messages.NotOpened):
        Recorder(tmp_path / "absent" / "run.csv", COLUMNS)
    with pytest.raises(ValueError, match="unique"):
        Recorder(tmp_path / "run.csv", ("od", "od"))
    recorder = Recorder(tmp_path / "run.csv", COLUMNS, fsync=False)
    with pytest.raises(messages.WrongRow):
        recorder.write({"time_min": 0.0, "odd": 0.5, "pump_rate_ml_s": 0.0})
    recorder.close()
    recorder.close()
    with pytest.raises(messages.NotWritten):
        recorder.write({"time_min": 0.0, "od": 0.5, "pump_rate_ml_s": 0.0})


# ---------------------------------------------------------------- reading what is good


@pytest.mark.parametrize(
    "content",
    [
        pytest.param(chibio(**FED), id="chibio-43"),
        pytest.param(chibio(header=False, **FED), id="chibio-43-no-header"),
        pytest.param(chibio([c for c in CHIBIO if "600" not in c], False, **FED), id="chibio-42-no-header"),
        pytest.param(chibio([*CHIBIO[:3], "od_raw", *CHIBIO[3:]], od_raw=OD + 1.0, **FED), id="chibio-extra-column"),
        pytest.param(chibio(**FED).replace("\n", "\r\n"), id="chibio-windows"),
        pytest.param(tidy(), id="tidy"),
        pytest.param(tidy(header=""), id="tidy-no-header"),
        pytest.param("\ufeff" + tidy(header="Time (min),OD,Pump rate (mL/s)").replace(",", ";"), id="tidy-semicolon"),
        pytest.param("# a comment\n\n" + tidy().replace(",", "\t"), id="tidy-tab"),
        pytest.param(tidy(t=60 * T, header="time_s,od,pump_rate"), id="seconds"),
        pytest.param(tidy(t=T / 60, header="time_h,od,pump_rate"), id="hours"),
    ],
)
def test_every_layout_reads_alike(read: Read, content: str) -> None:
    r = read(content)
    np.testing.assert_allclose(r.time_min, T)
    np.testing.assert_allclose(r.od, OD)
    np.testing.assert_allclose(r.pump_rate, U)
    assert r.notes == ()


def test_pump_flow_turns_duty_into_rate_but_leaves_rates_alone(read: Read) -> None:
    duty = read(chibio(**FED), pump_ml_s=0.8)
    np.testing.assert_allclose(duty.pump_rate, 0.8 * U)
    np.testing.assert_allclose(duty.temperature, 37.0 + 0.01 * T)
    np.testing.assert_allclose(read(tidy(), pump_ml_s=0.8).pump_rate, U)


def test_another_pump_that_ran_is_not_counted_unless_it_is_asked_for(read: Read) -> None:
    assert read(chibio(pump_3_rate=U)).pump_rate.max() == 0.0
    both = read(chibio(pump_1_rate=U, pump_2_rate=4 * U, pump_3_rate=0.5 * U), pumps=(1, 3))
    np.testing.assert_allclose(both.pump_rate, 1.5 * U)
    assert both.notes == ()
    with pytest.raises(RecordingError, match=r"pumps = \[5\]: allowed one or more of 1, 2, 3, 4"):
        read(chibio(), pumps=(5,))


def test_a_row_that_is_amended_takes_the_place_of_the_last_one(tmp_path: Path) -> None:
    path = tmp_path / "a.csv"
    with Recorder(path, ("time_min", "od")) as recorder:
        for minute in range(3):
            recorder.write({"time_min": float(minute), "od": 0.5 + minute})
        recorder.amend({"time_min": 2.0, "od": 9.25})
        recorder.write({"time_min": 3.0, "od": 0.75})
    assert path.read_text().splitlines() == ["time_min,od", "0.0,0.5", "1.0,1.5", "2.0,9.25", "3.0,0.75"]


def test_a_mark_is_one_that_measures_where_a_level_or_a_share_was(tmp_path: Path) -> None:
    marks = [
        Mark(12.3456, "M3", "moved"), Mark(60.0, "M0", "read", level_ml=17.5),
        Mark(61.5, "", 'counted, "twice"', share=0.3, sd=0.02),
    ]  # fmt: skip
    assert [mark.measured for mark in marks] == [False, True, True]
    for mark in marks:
        add_mark(tmp_path, mark)
    assert read_marks(tmp_path) == [replace(marks[0], time_min=12.346), *marks[1:]]


def test_a_file_cut_by_a_power_loss_is_read_up_to_there(read: Read) -> None:
    """The file system leaves a block of NUL bytes; rows written after the restart follow it on the same line."""
    lines = tidy().splitlines(keepends=True)
    cut = read("".join(lines).encode() + bytes(3000))
    np.testing.assert_allclose(cut.od, OD)
    assert "3000 NUL bytes" in cut.notes[0]
    went_on = read("".join(lines[:20]).encode() + bytes(500) + "".join(lines[20:]).encode())
    assert went_on.row.size == 39
    assert any("line 21: holds control characters" in n for n in went_on.notes)


def test_only_the_asked_rows_are_judged(read: Read) -> None:
    """A pump run backwards to flush the tubing at the end does not condemn the rows before."""
    flushed = tidy(u=changed(U, slice(35, 40), -0.02))
    with pytest.raises(RecordingError, match="row 35: pump rate -0.02"):
        read(flushed)
    asked = read(flushed, rows=(0, 35))
    assert asked.row.tolist() == list(range(35))
    one = read(tidy(u=changed(U, 25, -0.02)))
    assert one.row.tolist() == [i for i in range(40) if i != 25]
    assert one.notes == ("row 25: pump ran backwards: dropped; the rate before is assumed to continue",)
    for rows, said in (((38, 60), "38:60: selects 2"), ((35, None), "35:: selects 5"), ((0, 5), "0:5: selects 5")):
        with pytest.raises(RecordingError, match=f"rows = {said} rows; the file has rows 0:40"):
            read(tidy(), rows=rows)


@needs_dither
def test_real_chibio_file() -> None:
    r = read_recording(DITHER)
    assert (r.source, len(r.od), r.runs, r.notes) == ("Chi.Bio CSV", 1209, ((0, 1208),), ())
    assert int(np.argmax(r.pump_rate > 0)) == 279
    assert np.unique(r.pump_rate).tolist() == [0.0, 0.02]
    assert np.median(np.diff(r.time_min)) * 60 == pytest.approx(60.06, abs=0.02)
    assert 36 < np.median(r.temperature) < 38


@pytest.mark.parametrize("header", [",".join(COLUMNS), ""])
def test_concatenated_runs(read: Read, header: str) -> None:
    short = tidy(OD[:12], T[:12], U[:12], header)
    longest = read(short + tidy(header=header) + short)
    assert longest.row.tolist() == list(range(12, 52))
    assert longest.runs == ((0, 11), (12, 51), (52, 63))
    assert "3 runs" in longest.notes[0]
    third = read(short + tidy(header=header) + short, run=2)
    assert third.row.tolist() == list(range(52, 64))
    with pytest.raises(RecordingError, match="run = 3: allowed 0 to 2"):
        read(short + tidy(header=header) + short, run=3)
    assert "19: rows 228-239 and 3 more); run 0 is used" in read(23 * short).notes[0]
    if header:  # begins a run however short
        assert read(tidy() + tidy(OD[:3], T[:3], U[:3]) + f"{header}\n").runs == ((0, 39), (40, 42))


def test_one_reactor_of_several_is_taken_by_its_name_and_a_row_cut_off_before_it_noted(read: Read) -> None:
    lines = [f"{t!r},{y + 0.1 * m!r},0.0,M{m}" for t, y in zip(T.tolist(), OD.tolist(), strict=True) for m in (0, 1)]
    content = "\n".join(["time_min,od,pump_rate_ml_s,reactor", *lines]) + "\n"
    np.testing.assert_allclose(read(content, reactor="M1").od, OD + 0.1)
    first = read(content)
    np.testing.assert_allclose(first.od, OD)
    assert first.notes == ("reactor M0 used; the file also has M1",)
    cut = read(content.replace(lines[5], lines[5].rsplit(",", 2)[0]), reactor="M1")
    assert cut.row.tolist() == [i for i in range(1, 80, 2) if i != 5]
    assert cut.notes[:2] == ("reactor M1 used; the file also has M0", "row 5: fewer than 4 columns: dropped")
    with pytest.raises(RecordingError, match="reactor = M5: allowed one of M0, M1, the reactors in the file"):
        read(content, reactor="M5")


# ---------------------------------------------------------------- reading what is bad


@pytest.mark.parametrize(
    ("content", "missing", "dropped", "note"),
    [
        pytest.param(tidy(changed(OD, [5, 6, 9], np.nan)), [5, 6, 9], [], "3 rows: 5-6, 9: ", id="nan"),
        pytest.param(tidy(changed(OD, 7, np.inf)), [7], [], "row 7: ", id="inf"),
        pytest.param(tidy(changed(OD, 7, -0.3)), [7], [], "row 7: OD below -0.05", id="negative"),
        pytest.param(tidy(changed(OD, 7, 14.06)), [7], [], "row 7: OD above 10", id="dead-spectrometer"),
        pytest.param(tidy().replace(repr(float(OD[3])), "broken"), [3], [], "row 3: ", id="text"),
        pytest.param(tidy(t=changed(T, 8, 7.0)), [], [8], "row 8: ", id="duplicate"),
        pytest.param(tidy(t=changed(T, [8, 9], [3.0, 4.0])), [], [8, 9], "2 rows: 8-9: ", id="backward"),
        pytest.param(tidy(t=changed(T, 8, np.nan)), [], [8], "row 8: ", id="time-nan"),
        pytest.param(tidy(u=changed(U, 8, np.nan)), [], [8], "row 8: ", id="pump-nan"),
        pytest.param(tidy().replace("\n8.0,", "\n8.0;"), [], [8], "row 8: fewer than 3 columns", id="short-row"),
        pytest.param(
            tidy() + "40.0,0.2,0.0", [], [], "line 42: has no line end, so it may be incomplete: dropped", id="torn"
        ),
        pytest.param(tidy(changed(OD, [7, 9], [-0.02, -0.3])), [9], [], "row 9: ", id="noise-of-a-sensor"),
    ],
)
def test_unusable_readings_are_missing_unusable_rows_dropped_and_both_reported(
    read: Read, content: str, missing: list[int], dropped: list[int], note: str
) -> None:
    r = read(content)
    assert r.row.max() < 40
    assert r.row[np.isnan(r.od)].tolist() == missing
    assert sorted(set(range(40)) - set(r.row.tolist())) == dropped
    assert len(r.notes) == 1
    assert r.notes[0].startswith(note)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        pytest.param("", "is empty", id="empty"),
        pytest.param(" \n\n", "is empty", id="blank"),
        pytest.param("# only a comment\n", "has no data", id="comment"),
        pytest.param(",".join(COLUMNS) + "\n", "no complete data row", id="header-only"),
        pytest.param(b"\x7fELF\x02\x01\x00\x00", "not a text file", id="binary"),
        pytest.param(np.random.default_rng(0).bytes(4000), "not a text file", id="random-bytes"),
        pytest.param(GZ[: len(GZ) // 2], "cannot be read: Compressed file ended", id="half-a-gz"),
        pytest.param(GZ[:20] + bytes(30) + GZ[50:], "cannot be read", id="a-damaged-gz"),
        pytest.param("hello world\n1 2\n", "no column for the time.*hello, world", id="words"),
        pytest.param("time_min,od\n1,0.1\n", "no column for the pump rate", id="no-pump"),
        pytest.param("1,2,3,4\n1,2,3,4\n", "4 columns and no header", id="four-columns"),
        pytest.param(tidy(OD[:7], T[:7], U[:7]), "recording.csv: only 7 data rows; at least 10", id="short"),
        pytest.param(tidy(13000 * 10**-OD), "raw detector counts", id="counts"),
        pytest.param(tidy(np.full(40, np.nan)), "only 0 of 40 rows", id="all-nan"),
        pytest.param(tidy(-OD), "only 0 of 40 rows.*below -0.05", id="all-negative"),
        pytest.param(tidy(t=T[::-1]), "only 1 of 1 rows.*time does not advance", id="time-backward"),
        pytest.param(tidy(t=np.zeros(40)), "only 1 of 1 rows.*time does not advance", id="time-still"),
        pytest.param(tidy(t=np.full(40, np.nan)), "no row has a finite time", id="time-nan"),
        pytest.param(
            tidy(u=changed(U, slice(4, 7), -0.01)), "row 4: pump rate -0.01 mL/s: allowed 0 to 1", id="pump-reversed"
        ),
        pytest.param(tidy(u=1200 * U), "pump rate 24 mL/s.*mL/min", id="pump-unit"),
    ],
)
def test_what_is_no_recording_is_refused_in_one_line(read: Read, content: str | bytes, message: str) -> None:
    with pytest.raises(RecordingError, match=message) as caught:
        read(content)
    assert "\n" not in str(caught.value)


def test_paths_that_cannot_be_read(tmp_path: Path) -> None:
    for name, flow, words in (("a", 1.0, "No such file"), (".", 1.0, "Is a directory"), ("a", 0.0, "pump_ml_s = 0")):
        with pytest.raises(RecordingError, match=words):
            read_recording(tmp_path / name, pump_ml_s=flow)


def test_fluorescence_is_read_where_it_was_measured(read: Read) -> None:
    counts = 1000.0 + 5.0 * np.arange(len(T))
    own = ["time_min,od,pump_rate_ml_s,interlock,fluorescence"]
    own += [
        f"{t!r},{od!r},{u!r},,{c!r}" for t, od, u, c in zip(*map(np.ndarray.tolist, (T, OD, U, counts)), strict=True)
    ]
    own[4] = own[4].rsplit(",", 1)[0] + ","  # a row without
    found = read("\n".join(own) + "\n").fluorescence
    np.testing.assert_array_equal(found, changed(counts, 3, np.nan))
    assert np.isnan(read(tidy()).fluorescence).all()


def test_the_device_s_own_file_gives_base_times_emission(read: Read) -> None:
    base = changed(np.full(len(T), 20000.0), 3, 0.0)  # switched off in the fourth cycle
    found = read(chibio(FP1_base=base, FP1_emit1=changed(np.full(len(T), 0.1), 3, 0.0))).fluorescence
    np.testing.assert_allclose(found, changed(np.full(len(T), 2000.0), 3, np.nan))


# ---------------------------------------------------------------- one recording in many clothes

SLOW_T = 2.0 * np.arange(60.0)  # a row every two minutes
KNOWN_OD = 0.2 + 0.003 * SLOW_T + 0.01 * np.sin(SLOW_T)
KNOWN_U = 0.7 * np.where(SLOW_T % 34 < 12, 0.02, 0.0)  # mL/s of a pump that gives 0.7 at full power
START = datetime(2024, 4, 10, 23, 58, 30, tzinfo=UTC)  # runs over midnight


def known(times: Iterable[object] = SLOW_T.tolist(), header: str = "time_min,od,pump_rate_ml_s") -> str:
    rows = zip(times, KNOWN_OD.tolist(), KNOWN_U.tolist(), strict=True)
    return "".join(f"{line}\n" for line in [*filter(None, [header]), *(f"{t},{y!r},{u!r}" for t, y, u in rows)])


def moments(form: Callable[[datetime], object]) -> list[object]:
    return [form(START + timedelta(minutes=t)) for t in SLOW_T.tolist()]


IN_SECONDS = moments(lambda m: m.timestamp())
IN_MS = moments(lambda m: round(1000 * m.timestamp()))
EAST = timezone(timedelta(hours=5, minutes=30))
DATE = "time is a date or counts s since 1970"
MS = "time counts ms since 1970"
COMMAS = "commas are read as decimal points"


@pytest.mark.parametrize(
    ("content", "note"),
    [
        pytest.param(known(IN_SECONDS, "time,od,pump_rate"), DATE, id="epoch-s"),
        pytest.param(known(IN_SECONDS, "time_min,od,pump_rate"), DATE, id="epoch-s-called-minutes"),
        pytest.param(known(IN_MS, "timestamp,od,pump_rate"), MS, id="epoch-ms"),
        pytest.param(known(IN_MS, "exp_time,od,pump_rate"), MS, id="epoch-ms-called-seconds"),
        pytest.param(known(IN_MS, ""), MS, id="epoch-ms-no-header"),
        pytest.param(known(moments(lambda m: f"{m:%Y-%m-%dT%H:%M:%S}"), "time,od,pump_rate"), DATE, id="iso"),
        pytest.param(known(moments(lambda m: f"{m:%Y-%m-%d %H:%M:%S}"), ""), DATE, id="iso-blank-no-header"),
        pytest.param(known(moments(lambda m: f"{m:%Y-%m-%dT%H:%M:%S.%fZ}"), "time_s,od,pump_rate"), DATE, id="iso-z"),
        pytest.param(
            known(moments(lambda m: f'"{m.astimezone(EAST).isoformat()}"'), "Time,OD,pump_rate"), DATE, id="iso-offset"
        ),
        pytest.param(known().replace(",", ";").replace(".", ","), COMMAS, id="semicolon-decimal-comma"),
        pytest.param(known(header="").replace(",", ";").replace(".", ","), COMMAS, id="decimal-comma-no-header"),
        pytest.param(known().replace(",", "\t").replace(".", ","), COMMAS, id="tab-decimal-comma"),
        pytest.param("time, min;od;pump_rate\n" + known(header="").replace(",", ";"), None, id="comma-in-a-name"),
        pytest.param(gzip.compress(known().encode()), None, id="gz"),
        pytest.param(known().replace("\n", "\r\n").encode("utf-16"), None, id="utf-16"),
        pytest.param(b"\xfe\xff" + known().encode("utf-16-be"), None, id="utf-16-big"),
        pytest.param(
            gzip.compress(known().replace(",", ";").replace(".", ",").encode("utf-16")), COMMAS, id="gz-utf-16-commas"
        ),
    ],
)
def test_one_recording_in_many_clothes(read: Read, content: str | bytes, note: str | None) -> None:
    r = read(content)
    np.testing.assert_allclose(r.time_min, SLOW_T, atol=1e-6)
    np.testing.assert_array_equal(r.od, KNOWN_OD)
    np.testing.assert_array_equal(r.pump_rate, KNOWN_U)
    assert [n.split(":")[0] for n in r.notes] == [n for n in [note] if n]


def test_a_time_without_unit_is_refused(read: Read) -> None:
    with pytest.raises(RecordingError, match="column time has 0 to 118, neither dates nor .*time_min, time_s or"):
        read(known(header="time,od,pump_rate"))


def test_a_clock_that_was_not_yet_set_costs_its_rows(read: Read) -> None:
    """Single rows that count from 1970 among dates, or that hold a date among minutes, do not part the recording."""
    unset = read(known([*IN_MS[:2], 5000, *IN_MS[3:]], "time,od,pump_rate"))
    np.testing.assert_allclose(unset.time_min, np.delete(SLOW_T, 2), atol=1e-6)
    assert unset.notes[-1].startswith("row 2: time or pump rate is not a finite number")
    dated = read(known([*SLOW_T[:7].tolist(), "2024-04-10 12:00", *SLOW_T[8:].tolist()]))
    np.testing.assert_array_equal(dated.time_min, np.delete(SLOW_T, 7))
    assert len(dated.runs) == 1


def test_a_quoted_cell_may_hold_the_separator_and_a_stray_quote_costs_one_row(read: Read) -> None:
    lines = known(header="").splitlines()
    quoted = ["note,time_min,od,pump_rate", *(f'"fed, then ""rested""",{line}' for line in lines)]
    np.testing.assert_array_equal(read("\n".join(quoted) + "\n").od, KNOWN_OD)
    quoted[4] = f'"torn,{lines[3]}'
    stray = read("\n".join(quoted) + "\n")
    assert stray.row.tolist() == [i for i in range(60) if i != 3]
    assert stray.notes == ("row 3: fewer than 4 columns: dropped",)


@pytest.mark.parametrize("lost", [3, 4, 29])
@pytest.mark.parametrize("how", ["nan", "empty", "cut off", "cut off behind"])
def test_rows_without_a_pump_rate_are_dropped_if_few(read: Read, lost: int, how: str) -> None:
    """Of 60 rows three are 5 %."""
    lines = [line + ",0.5" * (how == "cut off behind") for line in known().splitlines()]
    for i in range(1, 2 * lost, 2):
        lines[i + 1] = lines[i + 1].rsplit(",", 1)[0] + {"nan": ",nan", "empty": ","}.get(how, "")
    content = "\n".join(lines) + "\n"
    if lost == 3:
        r = read(content)
        assert sorted(set(range(60)) - set(r.row.tolist())) == [1, 3, 5]
        assert len(r.notes) == 1
        assert r.notes[0].startswith("3 rows: 1, 3, 5: ")
    else:
        share = {4: "6.67", 29: "48.3"}[lost]
        with pytest.raises(RecordingError, match=rf"{lost} rows: 1, 3, 5, 7.*{share} % .*allowed 5 %; write the rate"):
            read(content)


def test_what_was_read_and_noted_stands_beside_a_refusal(read: Read) -> None:
    lines = chibio(pump_3_rate=U, od_measured=np.full(len(T), np.nan)).splitlines()
    with pytest.raises(RecordingError, match=r"only 0 of 39 rows.*\(line 41: has no line end.*pump 3 ran and is not"):
        read("\n".join(lines))


@pytest.mark.parametrize(
    ("rates", "names", "remedy"),
    [
        pytest.param({1: 1.0, 3: 0.3}, "3", "set pumps=[1,3]", id="a-second-feed"),
        pytest.param({1: 1.0, 2: 0.6}, "2", "set pumps=[1,2]", id="no-waste"),
        pytest.param({1: 1.0, 2: 0.9}, "2", "set pumps=[1,2]", id="no-waste-in-the-flow-of-both"),
        pytest.param({1: 1.0, 2: 1.1}, None, "", id="waste"),
        pytest.param({1: 1.0, 2: 4.0}, None, "", id="more-waste"),
        pytest.param({3: 1.0}, "3", "set pumps=[3]", id="a-third"),
        pytest.param({1: 1.0, 2: 1.4, 4: 0.3}, "4", "set pumps=[1,4]", id="waste-of-two-feeds"),
        pytest.param({2: -1.1, 3: 1.0}, "3", "set pumps=[3]", id="another-feed-and-a-waste-written-backwards"),
        pytest.param({2: 1.1}, "2", "set pumps=[2]", id="no-feed"),
        pytest.param({1: 1.0, 4: np.nan}, None, "", id="a-pump-that-is-not-there"),
    ],
)
def test_two_pumps_that_feed_are_told_from_feed_and_waste(
    read: Read, rates: dict[int, float], names: str | None, remedy: str
) -> None:
    r = read(chibio(**{f"pump_{pump}_rate": share * U for pump, share in rates.items()}), pump_ml_s=0.8)
    np.testing.assert_allclose(r.pump_rate, 0.8 * rates.get(1, 0.0) * U)
    if names is None:
        assert (r.notes, r.doubts) == ((), ())
        return
    assert r.doubts == ((f"pump {names} ran and is not counted", remedy),)
    assert [n for n in r.notes if f"pump {names} ran and is not counted" in n] == list(r.notes)


def test_dates_without_an_offset_know_no_summer_time(read: Read, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("TZ", "CET-1CEST,M3.5.0,M10.5.0/3")
    time.tzset()
    try:
        march = [datetime(2024, 3, 31, 1, 20) + timedelta(minutes=t) for t in SLOW_T.tolist()]
        r = read(known(march, "time,od,pump_rate"))
    finally:
        monkeypatch.undo()
        time.tzset()
    np.testing.assert_allclose(r.time_min, SLOW_T, atol=1e-6)


def test_a_clock_that_restarts_parts_a_recording_whatever_stood_behind_it_before(read: Read) -> None:
    """Dense reference: rows that do not pass the latest time are stale, until five rise without passing it."""
    rng = np.random.default_rng(7)
    for _ in range(100):
        time = np.cumsum(rng.choice([-9.0, -1.0, 0.0, 1.0, 2.0], 50, p=[0.08, 0.05, 0.05, 0.6, 0.22]))
        runs: list[list[int]] = [[0]]
        for i in range(1, 50):
            latest, coming = time[runs[-1][-1]], time[i : i + 5]
            if time[i] > latest:
                runs[-1].append(i)
            elif len(coming) == 5 and (np.diff(coming) > 0).all() and coming[-1] <= latest:
                runs.append([i])
        longest = max(runs, key=len)
        if len(longest) >= 10:
            r = read(tidy(np.linspace(0.2, 0.3, 50), time, np.zeros(50)))
            assert r.row.tolist() == longest
            assert r.runs == tuple((run[0], run[-1]) for run in runs)
