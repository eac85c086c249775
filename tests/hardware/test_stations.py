"""What every family shares: stations that are commanded one by one, a run that is opened, and vials in this process."""

import logging
import math
import time
from collections.abc import Mapping, Sequence
from contextlib import closing, contextmanager, nullcontext
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from conf.messages import Message
from envs.bench import Bench
from envs.plant.culture import GrowthConfig
from envs.plant.plant import Plant, PlantConfig
from envs.plant.pump import PumpConfig
from hardware.chibio import family as chibio
from hardware.chibio.config import ChiBioConfig, EmulatorConfig
from hardware.chibio.dosing import PumpCalibration, ReactorCalibration, SupplyConfig
from hardware.chibio.overflow_pump import OverflowPumpConfig
from hardware.clock import DeviceClock, VirtualClock
from hardware.emulator.family import _words
from hardware.errors import DeviceStateError, RecordingError, UnfitError
from hardware.family import Opening
from hardware.logbook import Logbook
from hardware.messages import LinkFault, NoNewSample, OpenDose, PumpsNotOff
from hardware.pioreactor import family as pioreactor
from hardware.pioreactor.config import PioreactorConfig
from hardware.reactor import Command
from hardware.simulated import FAMILY, SimulatedConfig, SimulatedReactors
from hardware.stations import Stations
from hardware.storage.doses import Given
from hardware.storage.journal import Journal
from hardware.storage.messages import JournalMissing

NAN = math.nan


class One:
    """A reactor that does what it is told and remembers it."""

    def __init__(self, name: str, clock: VirtualClock, log: Any, blank: float | None = 15000.0) -> None:
        self.name, self.clock, self.asked = name, clock, list[tuple[Any, ...]]()
        self.book = Logbook(name, log, log, clock.now)
        self.doses = SimpleNamespace(extra=[], carry_ml=0.0)
        self.at, self.arrived_s, self.od, self.blank = NAN, 0.0, NAN, blank
        self.next_look, self.handed_over, self.fails = math.inf, False, ""
        self.temperature, self.raw, self.fluorescence, self.sampling = 36.0, 9000.0, None, self

    def poll(self) -> bool:
        self.at, self.arrived_s, self.od = self.clock.now() - 3.0, self.clock.now(), 0.4
        self.next_look = math.inf
        return True

    def set_temperature(self, target: float) -> None:
        self.asked.append(("temperature", target))

    def dose(self, rate: float, number: int) -> SimpleNamespace:
        self.asked.append(("dose", rate, number))
        self.doses.carry_ml += 0.01 * number
        self.book.tell(Message(f"pump {number}"))
        return SimpleNamespace(feed_ml=60.0 * rate, waste_ml=200.0 * rate)

    def regulate(self, setpoint: float) -> None:
        self.asked.append(("regulate", setpoint))
        if self.fails:
            raise DeviceStateError(self.fails)

    def heat_off(self) -> None:
        self.asked.append(("heat off",))

    give_up = pumps_off = heat_off


class Three(Stations[Any, Any]):
    """Three of them; `silenced` holds whose pumps a stop switched off."""

    def __init__(self) -> None:
        self.clock, self.rows, self.full = VirtualClock(50.0), list[dict[str, Any]](), False
        super().__init__(self.clock, 100.0, self._keep)
        self.stations = [One(name, self.clock, self.note_down) for name in ("M0", "M3", "M5")]
        self.silenced = list[str]()

    def _keep(self, kind: str, fields: Mapping[str, Any]) -> None:
        if self.full:
            raise RecordingError("disk full")
        self.rows.append({"kind": kind, **fields})

    def _take_over(self, histories: Mapping[str, Any]) -> None:
        pass

    def _wait(self, longest_s: float) -> None:
        self.clock.sleep(max(min(longest_s, 5.0), 0.5))

    def _silence(self, stations: Sequence[Any]) -> dict[Any, Any]:
        self.silenced = [station.name for station in stations]
        return {station: DeviceStateError(station.fails) for station in stations if station.fails}


def test_each_reactor_gets_its_own_rate_target_and_pump_and_only_those_that_are_meant() -> None:
    lab = Three()
    rows, nothing = np.array([True, False, True]), np.array([NAN, 31.0, 33.0])
    command = Command(rows, np.array([0.01, 0.5, 0.003]), nothing, np.array([1, 1, 4]))
    receipt = lab.actuate(command)
    first, second, third = lab.stations
    assert first.asked[1] == ("dose", 0.01, 1)
    assert second.asked == []
    assert third.asked == [("temperature", 33.0), ("dose", 0.003, 4)]
    np.testing.assert_allclose(receipt.volume_ml, [0.6, 0.0, 0.18])
    np.testing.assert_allclose(receipt.waste_ml, [2.0, 0.0, 0.6])
    np.testing.assert_allclose(receipt.kept_ml, [0.01, 0.0, 0.04])
    assert receipt.notes == ("M0: pump 1", "M5: pump 4")
    assert lab.actuate(replace(command, rows=np.zeros(3, bool))).notes == ()
    again = lab.actuate(replace(command, pump=None))
    assert again.notes == ("M0: pump 1", "M5: pump 1")
    np.testing.assert_allclose(again.kept_ml, [0.01, 0.0, 0.01])  # by how much it has grown


def test_what_was_given_beside_is_told_once_in_order_by_reactor_and_pump() -> None:
    lab = Three()
    lab.stations[2].doses.extra = [Given(300.0, 0.5, 0.2, 0.1, 3), Given(90.0, -0.3, -0.4, 0.0)]
    lab.stations[0].doses.extra = [Given(120.0, 0.0, 0.0, 1.5)]
    told = lab.repeated()
    assert [at for at, _ in told] == [90.0, 120.0, 300.0]
    assert [receipt.pump for _, receipt in told] == [0, 0, 3]
    np.testing.assert_allclose([r.volume_ml for _, r in told], [[0, 0, -0.3], [0, 0, 0], [0, 0, 0.5]])
    np.testing.assert_allclose([r.low_ml for _, r in told], [[0, 0, -0.4], [0, 0, 0], [0, 0, 0.2]])
    np.testing.assert_allclose([r.waste_ml for _, r in told], [[0, 0, 0], [1.5, 0, 0], [0, 0, 0.1]])
    assert lab.repeated() == []


def test_a_sample_of_a_resumed_run_has_run_time_and_its_own_age() -> None:
    """An hour into the run: the second reactor's sample is 3 s old as it is seen, the first's came 25 s earlier."""
    lab = Three()
    lab.begin(elapsed_s=3600.0)
    lab.stations[0].next_look = lab.clock.now()
    m = lab.measure()
    assert m.fresh.tolist() == [True, False, False]
    lab.clock.sleep(25.0)
    lab.stations[1].next_look = lab.clock.now()
    m = lab.measure()
    assert m.fresh.tolist() == [False, True, False]
    np.testing.assert_allclose(m.time_s, [3597.0, 3622.0, NAN])
    assert m.vitals is not None
    np.testing.assert_allclose(m.vitals.age_s[:2], [25.0, 0.0])
    assert m.vitals.blank is not None
    lab.stations[2].blank = None
    lab.stations[0].next_look = lab.clock.now()
    assert lab.measure().vitals.blank is None  # type: ignore[union-attr]
    assert lab.rows == []


def test_without_a_sample_measure_returns_when_the_newest_is_stale_and_every_20_s_from_then_on() -> None:
    lab = Three()
    lab.stations[1].arrived_s = 80.0
    returned = []
    for _ in range(3):
        lab.measure()
        returned.append(lab.clock.now())
    assert returned == pytest.approx([180.0, 200.0, 220.0], abs=0.6)
    lab.stations[2].book.report(LinkFault("no answer"))
    m = lab.measure()
    assert lab.clock.now() == returned[-1]  # a fault that appears is told at once, and once
    assert [fault and fault.kind for fault in m.vitals.faults] == [None, None, "link"]  # type: ignore[union-attr]
    lab.measure()
    assert lab.clock.now() == pytest.approx(returned[-1] + 20.0, abs=0.6)


def test_each_is_handed_over_at_its_own_setpoint_and_who_failed_is_named() -> None:
    lab = Three()
    lab.stations[2].fails, lab.stations[1].fails = "regulates nothing", "is deaf"
    assert lab.regulate(np.array([True, False, True]), np.array([0.4, 0.5, 0.7])) == ["M5: regulates nothing"]
    assert [station.asked for station in lab.stations] == [[("regulate", 0.4)], [], [("regulate", 0.7)]]
    assert lab.heat_off(np.array([False, True, False])) == []
    assert lab.stations[1].asked == [("heat off",)]


def test_a_stop_leaves_who_was_handed_over_and_says_whose_pumps_it_could_not_verify() -> None:
    lab = Three()
    lab.begin(elapsed_s=600.0)
    lab.stations[0].handed_over = True
    lab.stations[2].fails = "Pump1 still on"
    with pytest.raises(PumpsNotOff) as error:
        lab.stop()
    assert error.value.fields == {"failed": "M5: Pump1 still on"}
    assert lab.silenced == ["M3", "M5"]
    (row,) = lab.rows
    assert row == {
        "kind": "stop", "time_s": 600.0, "reactors": ("M0", "M3", "M5"), "not_verified": ["M5: Pump1 still on"],
    }  # fmt: skip


def test_a_row_that_is_not_taken_stops_no_pump_off_and_is_raised_once_later() -> None:
    lab = Three()
    lab.full = True
    lab.stop()
    assert lab.silenced == ["M0", "M3", "M5"]
    with pytest.raises(RecordingError, match="disk full"):
        lab.raise_late()
    lab.raise_late()
    with pytest.raises(RecordingError, match="disk full"):
        lab.write("intent", {})


def test_what_a_logbook_tells_shows_and_reports(caplog: pytest.LogCaptureFixture) -> None:
    rows: list[tuple[str, Any]] = []
    book = Logbook("M4", lambda kind, fields: rows.append((kind, fields)), lambda *_: None, lambda: 0.0)
    with caplog.at_level(logging.INFO):
        book.tell(note := NoNewSample())
        book.say(wait := OpenDose(ml=1.0))
    assert book.notes == [note]
    assert [record.getMessage() for record in caplog.records] == [f"M4: {wait}"]
    assert [fields["note"] for _, fields in rows] == [str(note), str(wait)]
    assert [(fields["name"], fields["fields"]) for _, fields in rows] == [
        ("NoNewSample", {}),
        ("OpenDose", {"ml": 1.0}),
    ]
    for fault, news in ((None, False), (LinkFault("a"), True), (LinkFault("c"), False), (None, True)):
        book.news = False
        book.report(fault)
        assert (book.news, book.fault) == (news, fault)
    assert [fields["fault"] for kind, fields in rows if kind == "fault"] == ["link: a", None]


# -- opened for a run --------------------------------------------------------------------------------------------------


def opening(
    folder: Path, backend: Any, bench: Bench | None = None, ago_s: float = 0.0, resumed: bool = True, plant: Any = None
) -> Opening:
    """Of a run that began so long ago, or of a new one."""
    path = folder / "journal.jsonl"
    if ago_s:
        with_wall = Journal(path, wall=lambda: time.time() - ago_s)
        with_wall.append("start", {})
        with_wall.append("device", {"reactor": backend.reactors[-1], "temperature": 31.5})
        with_wall.close()
    with closing(Journal(path)) as journal:  # one program at a time
        return Opening(backend, bench or Bench(), plant or PlantConfig(), journal, folder, resumed)


class Begun:
    """Reactors that remember what they were made with and how they began."""

    def __init__(self, *given: Any) -> None:
        self.given, self.began = given, list[tuple[Any, float]]()

    def bounds_s(self, rows: Any) -> tuple[float, float]:
        return 0.0, math.inf

    def begin(self, histories: Any, elapsed_s: float) -> None:
        self.began.append((histories, elapsed_s))

    def stop(self) -> None:
        pass

    close = stop


@pytest.mark.parametrize("ago_s", [0.0, 100.0])
def test_a_fast_device_s_run_goes_on_by_its_time(monkeypatch: pytest.MonkeyPatch, tmp_path: Path, ago_s: float) -> None:
    """A hundred seconds ago at four times real time: 400 s into the run; what is new is checked first."""

    @contextmanager
    def linked(backend: Any, own_url: str = "") -> Any:
        yield None, DeviceClock(4.0)

    checked: list[str] = []
    monkeypatch.setattr(chibio, "linked", linked)
    monkeypatch.setattr(pioreactor, "DeviceLock", lambda name: SimpleNamespace(close=lambda: None))
    for module, made in ((chibio, "ChiBioReactors"), (pioreactor, "PioreactorReactors")):
        monkeypatch.setattr(module, made, Begun)
        monkeypatch.setattr(module, "preflight", lambda *_given: checked.append("looked") or [])
    backends = ChiBioConfig(reactors=("M0", "M2"), speed=4.0), PioreactorConfig(reactors=("pio01",), speed=4.0)
    for k, (module, backend) in enumerate(zip((chibio, pioreactor), backends, strict=True)):
        folder = tmp_path / str(k)
        folder.mkdir()
        with module.FAMILY.open(opening(folder, backend, ago_s=ago_s, resumed=bool(ago_s))) as reactors:
            ((histories, elapsed_s),) = reactors.began  # type: ignore[attr-defined]
        assert elapsed_s == pytest.approx(4.0 * ago_s, abs=20.0)
        known = {name: history.temperature for name, history in histories.items()}
        assert known == ({backend.reactors[-1]: 31.5} if ago_s else {})
    assert len(checked) == (0 if ago_s else 2)


def test_a_resumed_run_without_its_journal_is_not_a_new_one(tmp_path: Path) -> None:
    with pytest.raises(JournalMissing):
        opening(tmp_path, ChiBioConfig()).earlier()
    assert opening(tmp_path, ChiBioConfig(), resumed=False).earlier() == []


@pytest.mark.parametrize(
    ("bench", "words"),
    [
        (Bench(volume_ml=14.0, volumes_ml={"M5": 29.9}), None),
        (
            Bench(volume_ml=20.0, volumes_ml={"M5": 30.0}),
            "bench.volume_ml = 30 mL of M5: allowed 10 .* to less than 30",
        ),
        (Bench(volume_ml=20.0, volumes_ml={"M0": 9.9}), "bench.volume_ml = 9.9 mL of M0"),
        (Bench(volume_ml=40.0 - 2.5, volumes_ml={"M0": 12.0, "M5": 12.0}), None),
        (Bench(period_s=61.0), "bench.period_s = 61 s: allowed 60, .*backend=chibio"),
    ],
)
def test_every_culture_fits_its_own_vial(bench: Bench, words: str | None) -> None:
    backend = ChiBioConfig(reactors=("M0", "M5"))
    with pytest.raises(UnfitError, match=words) if words else nullcontext():
        chibio.FAMILY.doses(backend, bench)


def test_pumps_are_measured_where_both_of_a_reactor_were_weighed(monkeypatch: pytest.MonkeyPatch) -> None:
    dated = PumpCalibration(date="2026-02-03")
    found = [ReactorCalibration(dated, dated), ReactorCalibration(dated), ReactorCalibration(waste=dated)]
    monkeypatch.setattr(chibio, "load_calibrations", lambda *_given: found)
    backend = ChiBioConfig(reactors=("M0", "M1", "M7"))
    assert chibio.FAMILY.unmeasured(backend) == "pumps not weighed, taken as 1 mL/s: M1, M7"
    found[:] = [ReactorCalibration(dated, dated)] * 3
    assert chibio.FAMILY.unmeasured(backend) == ""


def test_an_emulated_device_is_started_with_all_that_is_said_of_it() -> None:
    backend = EmulatorConfig(
        reactors=("M0", "M4"), speed=30.0, od=0.7, plant="bench", seed=5, pair="ecoli_psyringae",
        overflow_pump=OverflowPumpConfig("Pump3", 0.4, 1.7), supply=SupplyConfig(pump4_ml_s=0.8),
    )  # fmt: skip
    words = _words(backend, Bench(volume_ml=20.0, volumes_ml={"M4": 13.5}))
    assert dict(zip(words[::2], words[1::2], strict=True)) == {
        "--reactors": "M0,M4", "--speed": "30.0", "--seed": "5", "--od": "0.7", "--plant": "bench",
        "--pair": "ecoli_psyringae", "--volume": "20,13.5", "--overflow-pump": "Pump3", "--overflow-flow": "1.7",
        "--pump4-flow": "0.8",
    }  # fmt: skip


# -- vials in this process ---------------------------------------------------------------------------------------------


def test_simulated_vials_are_dosed_row_by_row_by_what_their_pump_is_believed_to_give() -> None:
    """Every 2 min; 0.8 mL/s believed, 1 mL/s true: 0.6 mL are asked for, 0.75 mL flow into 20 mL."""
    config = PlantConfig(pump=PumpConfig(dosing="pulse"), growth=GrowthConfig(mu=0.0))
    plant = Plant(config, 3, np.random.default_rng(0))
    reactors = SimulatedReactors(plant, SimulatedConfig(reactors=("a", "b", "c"), pump_ml_s=0.8), control_min=2.0)
    assert reactors.measure().time_s.tolist() == [0.0] * 3
    rows, target = np.array([True, False, True]), np.array([NAN, 40.0, 38.0])
    receipt = reactors.actuate(Command(rows, np.array([0.005, 0.005, 0.005]), target))
    np.testing.assert_allclose(receipt.volume_ml, [0.6, 0.0, 0.6])
    assert reactors.pumps_off(np.array([False, False, True])) == []
    m = reactors.measure()
    assert (m.time_s[0], reactors.elapsed()) == (120.0, 120.0)
    np.testing.assert_allclose(plant.feed.delivered_ml, [0.75, 0.0, 0.0])
    np.testing.assert_allclose(m.od, [0.5 * np.exp(-0.75 / 20.0), 0.5, 0.5])
    np.testing.assert_allclose(m.temperature, [37.0, 37.0, 38.0], atol=0.3)
    reactors.measure()
    np.testing.assert_allclose(plant.feed.delivered_ml, [0.75, 0.0, 0.0])  # a dose is given once
    reactors.heat_off(np.array([False, True, False]))
    for _ in range(3):
        m = reactors.measure()
    assert m.temperature[1] < 36.0 < m.temperature[0]
    said = reactors.regulate(np.array([False, True, True]), np.full(3, 0.5))
    assert [line.split(":")[0] for line in said] == ["b", "c"]
    reactors.actuate(Command(rows, np.full(3, 0.005), np.full(3, NAN)))
    reactors.stop()
    reactors.measure()
    np.testing.assert_allclose(plant.feed.delivered_ml, [0.75, 0.0, 0.0])


def test_a_simulated_run_has_the_bench_s_volumes_period_and_seed(tmp_path: Path) -> None:
    backend = SimulatedConfig(reactors=("x", "y"), seed=4, pump_ml_s=0.9)
    bench = Bench(volume_ml=18.0, volumes_ml={"y": 25.0}, period_s=90.0)
    with FAMILY.open(opening(tmp_path, backend, bench, resumed=False)) as reactors:
        plant, believed = FAMILY.truth(reactors)
        assert plant is not None
        assert plant.vessel.volume_ml.tolist() == [18.0, 25.0]
        assert believed == 0.9
        for _ in range(3):
            reactors.measure()
        assert reactors.elapsed() == 180.0
    drawn = []
    for seed in (4, 4, 5):
        spread = PlantConfig(growth=GrowthConfig(mu_cv=0.1))
        with FAMILY.open(opening(tmp_path, replace(backend, seed=seed), resumed=False, plant=spread)) as reactors:
            drawn.append(FAMILY.truth(reactors)[0].draws["mu"].tolist())  # type: ignore[union-attr]
    assert drawn[0] == drawn[1] != drawn[2]
