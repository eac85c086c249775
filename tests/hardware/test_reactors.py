"""The driver against the emulated device in virtual time: doses, timing, traps, recovery, resume."""

import math
from typing import Any

import numpy as np
import pytest

from envs.bench import Bench
from envs.scenario import Scenario
from hardware.chibio import messages
from hardware.chibio.dosing import PumpCalibration, ReactorCalibration
from hardware.chibio.reactors import ChiBioReactors
from hardware.emulator.device import DeviceOptions
from hardware.errors import RecordingError
from hardware.messages import PumpsNotOff
from hardware.reactor import Command
from tests.hardware.driver_lab import DriverLab, begun
from tests.hardware.emulator_lab import BIAS_S, quiet


def doses(lab: DriverLab, name: str = "M0", pump: str = "Pump1") -> list[tuple[float, float]]:
    """(start, length) of every run of a motor, device s."""
    lab.device.run_until(lab.clock.now())
    return [(d.start_s, d.seconds) for d in lab.device.vials[name].doses if d.pump == pump]


# -- a healthy run ---------------------------------------------------------------------------------------------------


def test_three_reactors_are_held_without_a_missed_or_doubled_minute() -> None:
    """Starts lie a third of a minute apart, and each dose between two measurements of its own reactor."""
    lab = begun(("M0", "M1", "M2"), minutes=16)
    lab.clock.sleep(12.0)  # a dose under way ends
    lab.reactors.stop()
    assert np.all(lab.samples >= 14)
    begins = [t for t, path in lab.wire.posts if path.startswith("/Experiment/1")]
    assert np.diff(begins) == pytest.approx([20.0, 20.0], abs=1.5)
    waits = [row["fields"]["seconds"] for row in lab.of("note") if row["name"] == "StartsInTurn"]
    assert waits == pytest.approx([20.0, 40.0])
    assert np.abs(np.array([step.od for step in lab.steps[-20:]]) - 0.5).mean() < 0.01
    for i, name in enumerate(lab.names):
        starts = [t for t, _ in doses(lab, name)]
        assert np.diff(starts).min() > 35.0  # the first is late: the start of the others was waited for
        assert np.diff(starts)[2:].min() > 55.0
        acted = [tuple(r["sample"]) for r in lab.of("intent") if r["reactor"] == name]
        assert len(set(acted)) == len(acted)
        assert lab.truth(name)["feed_ml"] == pytest.approx(lab.fed[i], rel=0.08)
        assert lab.truth(name)["peak_ml"] < 20.5
        cycles = np.array(lab.peek_cycles(name))
        for start, length in doses(lab, name) + doses(lab, name, "Pump2"):
            phase = (start - cycles[cycles <= start][-1]) % 60.07
            assert phase > 12.5
            assert phase + length < 55.0
    assert lab.motors_off()
    assert lab.of("fault") == []
    assert "undosed" not in lab.kinds()


LATE = quiet(pump_start_s=(0.2, 0.7))


@pytest.mark.parametrize(
    ("names", "options", "rate", "slow_s"),
    [*((("M0",), quiet(), 0.01, slow_s) for slow_s in (0.0, 0.4, 0.6, 0.9)), (("M0", "M1", "M2"), LATE, 0.02, 0.0)],
)
def test_motors_run_their_whole_dose_and_the_waste_before_fluid_comes_and_until_after_it(
    names: tuple[str, ...], options: DeviceOptions, rate: float, slow_s: float
) -> None:
    """Over a slow link, and where each starts 0.2 to 0.7 s after its answer, drawn anew."""
    lab = begun(names, options=options, rate=rate)
    lab.fault("slow_s", slow_s)
    lab.run(10)
    for name in names:
        feeds, wastes = doses(lab, name), doses(lab, name, "Pump2")
        assert len(feeds) >= 8
        for (feed_s, feed), (waste_s, waste) in zip(feeds, wastes, strict=False):
            assert waste_s < feed_s < feed_s + feed < waste_s + waste
        asked = [row for row in lab.of("intent") if row["reactor"] == name]
        for given, key in ((feeds, "feed_duty"), (wastes, "waste_duty")):
            expected = [63.0 * row[key] + BIAS_S for row in asked[: len(given)]]
            assert [length for _, length in given] == pytest.approx(expected, abs=0.01)
        assert lab.truth(name)["peak_ml"] < 20.0 + 1e-6


def test_doses_of_several_reactors_overlap() -> None:
    lab = DriverLab(("M0", "M1", "M2", "M3"))
    lab.law.rate = 0.02
    for name in lab.names:  # all in one phase: four waste doses of 9 to 16 s do not fit one after another
        lab.device.handle("POST", f"/Experiment/1/{name}")
    lab.reactors.begin()
    lab.run(4)
    assert lab.samples.min() >= 3
    running = [doses(lab, name, "Pump2")[-1] for name in lab.names]
    ends = [start + length for start, length in running]
    assert min(ends) > max(start for start, _ in running)


# -- start -----------------------------------------------------------------------------------------------------------


def test_a_running_experiment_is_adopted_not_started_again() -> None:
    lab = DriverLab()
    lab.device.handle("POST", "/Experiment/1/M0")
    lab.clock.sleep(200.0)
    lab.reactors.begin()
    assert not [p for _, p in lab.wire.posts if p.startswith("/Experiment")]
    first = lab.step()
    assert first.rows[0]
    assert lab.of("sample")[0]["sample"][0] > 180.0  # the one that was there already is not delivered


def test_a_start_whose_answer_is_lost_is_not_repeated_before_the_state_was_read() -> None:
    lab = DriverLab()
    lab.reactors.stations[0].connection.read()

    def losing(path: str, real: Any) -> Any:
        if path == "/Experiment/1/M0":
            lab.fault("lost_reply", 1)
        return real(path)

    lab.on_post(losing)
    lab.reactors.begin()
    lab.run(3)
    assert len([p for _, p in lab.wire.posts if p == "/Experiment/1/M0"]) == 1
    assert lab.samples[0] >= 2


def test_a_thermostat_lost_to_the_restart_trap_is_switched_on_again() -> None:
    lab = DriverLab()
    for force, pause in ((1, 90.0), (0, 1.0), (1, 5.0)):
        lab.device.handle("POST", f"/Experiment/{force}/M0")
        lab.clock.sleep(pause)
    lab.reactors.begin()
    lab.run(4)
    assert lab.device.apps["M0"].data["Thermostat"]["ON"] == 1
    assert [note for note in lab.notes(messages.PutRight) if note["item"] == "Thermostat"]


@pytest.mark.parametrize("phase_s", [1.0, 6.0, 9.0, 30.0])
def test_a_device_that_regulates_itself_gives_no_dose_of_its_own_once_taken_over(phase_s: float) -> None:
    lab = DriverLab(od=0.6)
    lab.device.handle("POST", "/SetOutputOn/OD/1/M0")
    lab.device.handle("POST", "/Experiment/1/M0")
    lab.clock.sleep(4 * 60.07 + phase_s)
    assert doses(lab)
    for path in ("/SetOutputTarget/Pump3/M0/0.02", "/SetOutputOn/Pump3/1/M0"):  # and one that it does not use
        lab.device.handle("POST", path)
    taken_over = lab.clock.now()
    lab.reactors.begin()
    lab.clock.sleep(20.0)
    assert not [start for start, _ in doses(lab) if start > taken_over]
    assert lab.motors_off()
    assert lab.device.apps["M0"].data["OD"]["ON"] == 0


@pytest.mark.parametrize("named", [0, 1])
@pytest.mark.parametrize(("rest_s", "waits"), [(90.0, False), (10.0, True), (0.0, True)])
def test_a_stopped_experiment_is_started_at_once_if_it_has_ended(named: int, rest_s: float, waits: bool) -> None:
    """Newer apps name the reactor in the line that says so. Before that its last cycle would end the new one's heat."""
    lab = DriverLab()
    lab.fault("terminal_named", named)
    lab.device.handle("POST", "/Experiment/1/M0")
    lab.clock.sleep(80.0)
    lab.device.handle("POST", "/Experiment/0/M0")
    lab.clock.sleep(rest_s)
    before = lab.clock.now()
    lab.reactors.begin()
    assert (lab.clock.now() - before > 65.0) is waits
    assert bool(lab.notes(messages.OldCycle)) is waits
    lab.run(3)
    assert lab.samples[0] >= 2
    data = lab.device.apps["M0"].data
    assert data["Thermostat"]["ON"] == data["Stir"]["ON"] == 1
    assert not lab.notes(messages.PutRight)


def test_zigzag_is_refused_with_the_remedy() -> None:
    lab = DriverLab()
    lab.device.handle("POST", "/SetOutputOn/Zigzag/1/M0")
    with pytest.raises(messages.ModeOn):
        lab.reactors.begin()


# -- samples ---------------------------------------------------------------------------------------------------------


def test_a_lost_link_is_a_fault_not_an_exception_and_hours_of_it_does_no_harm() -> None:
    lab = begun(minutes=5)
    lab.fault("crash")
    lab.run(150)
    assert {"link", "stale", "lost", "silent"} <= lab.kinds()
    assert len(lab.of("fault")) < 5  # not a row per try


# -- failures of requests --------------------------------------------------------------------------------------------


@pytest.mark.parametrize("fault", ["lost_reply", "lost_request", "reset_before", "reset_after", "malformed"])
@pytest.mark.parametrize("request_number", range(14))
def test_no_failed_request_doubles_a_dose_or_leaves_a_pump_on(fault: str, request_number: int) -> None:
    """Whichever request of a dose, from its targets to its verification, goes wrong."""
    lab = begun(options=quiet(mu=0.025), rate=0.0, minutes=3)
    assert not doses(lab)
    lab.law.rate = 0.02
    asked = 0
    inner = lab.wire.inner
    real = inner._request

    def failing(method: str, path: str) -> Any:
        nonlocal asked
        if (asked := asked + 1) == request_number + 1:
            lab.fault(fault, 1)
        return real(method, path)

    while not (m := lab.reactors.measure()).fresh[0]:
        pass
    inner._request = failing  # type: ignore[method-assign]
    receipt = lab.reactors.actuate(Command(m.fresh, np.array([0.02]), np.array([37.0])))
    for _ in range(4):  # it also returns to tell of a link in trouble
        lab.reactors.measure()
    given = doses(lab)
    assert len(given) <= 1
    assert sum(length for _, length in given) <= receipt.volume_ml[0] + 0.1
    assert lab.motors_off()
    assert lab.of("dose_end")


def test_targets_changed_by_someone_are_set_back() -> None:
    lab = begun(minutes=3)
    data = lab.device.apps["M0"].data
    for stir in (0.1, math.nan):
        data["Thermostat"]["target"], data["Stir"]["target"] = 30.0, stir
        lab.run(3)
        assert (data["Thermostat"]["target"], data["Stir"]["target"]) == (37.0, 0.5)
    assert len(lab.notes(messages.PutRight)) == 4


def test_a_pump_that_no_command_reaches_is_reported() -> None:
    lab = begun(stop_s=10.0, rate=0.02)
    while not lab.step().rows.any():
        pass
    lab.fault("lying", -1)
    lab.run(3)
    assert "pump" in lab.kinds()
    assert len(lab.of("intent")) == 1
    with pytest.raises(PumpsNotOff):
        lab.reactors.stop()


def test_a_bus_that_hangs_while_pumping_is_ended_within_a_minute() -> None:
    lab = begun(rate=0.02, minutes=3)
    lab.fault("bus_stuck_when_pumping")
    lab.run(5)
    assert max(length for _, length in doses(lab)) < 45.0
    assert lab.device.supervisor.restarts == 1
    lab.run(5)
    assert lab.reactors.stations[0].book.fault is None
    assert lab.truth()["peak_ml"] < 25.0


def test_another_client_that_switches_regulation_on_is_not_fought() -> None:
    lab = begun(rate=0.02, minutes=3)
    lab.device.handle("POST", "/SetOutputOn/OD/1/M0")
    lab.run(2)
    mine = len(lab.wire.posts)
    lab.run(5)
    assert "mode" in lab.kinds()
    assert not [p for _, p in lab.wire.posts[mine:] if p.startswith("/SetOutputTarget/Pump")]


@pytest.mark.parametrize("blank", [9000.0, math.nan])
def test_a_blank_changed_by_someone_stops_dosing(blank: float) -> None:
    lab = begun(minutes=3)
    lab.device.apps["M0"].data["OD0"]["target"] = blank
    lab.clock.sleep(20.0)
    fed = lab.truth()["feed_ml"]  # the dose under way has ended
    lab.run(5)
    assert "blank" in lab.kinds()
    assert lab.truth()["feed_ml"] == fed
    assert "from 1" in next(row["fault"] for row in lab.of("fault") if row["fault"])  # to what, and from what


def test_exchanged_reactors_end_control_of_both() -> None:
    lab = begun(("M0", "M1"), minutes=3)
    apps = lab.device.apps
    a, b = apps["M0"].data, apps["M1"].data
    a["DeviceID"], b["DeviceID"] = b["DeviceID"], a["DeviceID"]
    mine = len(lab.wire.posts)
    lab.run(5)
    assert "identity" in lab.kinds()
    assert {p.split("/")[1] for _, p in lab.wire.posts[mine + 30 :]} == {"changeDevice"}


# -- recovery --------------------------------------------------------------------------------------------------------


def test_a_device_that_lost_its_memory_is_restored() -> None:
    lab = begun(("M0", "M1"), scenario=Scenario((0.5, 0.5), (10.0, 600.0), (37.0, 34.0)), minutes=10)
    blanks = [lab.device.apps[n].data["OD0"]["target"] for n in lab.names]
    lab.run(3)
    lab.fault("worker_wipe")
    lab.run(10)
    assert "restarted" in lab.kinds()
    for name, blank in zip(lab.names, blanks, strict=True):
        data = lab.device.apps[name].data
        assert data["OD0"]["target"] == pytest.approx(blank)
        assert data["Thermostat"]["target"] == 34.0
        assert data["Experiment"]["ON"] == 1
        assert data["Experiment"]["cycles"] >= 7
    assert lab.samples.min() >= 20


@pytest.mark.parametrize("minutes", [1, 5, 20])
def test_a_device_started_again_without_one_of_its_reactors_is_not_ended_by_this_program(minutes: float) -> None:
    lab = begun(("M0", "M1"), minutes=5)
    lab.fault("unplugged", 1.0, "M1")
    lab.run(2)  # the next access to it ends the software
    assert "link" in lab.kinds()
    lab.run(minutes)
    lab.fault("restart")
    before = lab.samples.copy()
    lab.run(10)
    assert lab.device.supervisor.alive
    assert "absent" in lab.kinds()
    assert (lab.samples - before)[0] >= 8
    assert (lab.samples - before)[1] == 0


def test_an_experiment_that_this_program_ended_is_started_again_and_one_that_somebody_ended_is_not() -> None:
    lab = begun(("M0", "M1"), rate=0.02)
    while not [row for row in lab.of("feed_on") if row["reactor"] == "M0"]:
        lab.step()
    lab.fault("foreign_selects", 1.0)  # no read shows this reactor, so the end of the dose cannot be verified
    lab.run(3)
    assert [path for _, path in lab.wire.posts].count("/Experiment/0/M0") == 1
    lab.fault("foreign_selects", 0.0)
    over_s = lab.clock.now()
    lab.run(8)
    starts = [t for t, path in lab.wire.posts if path == "/Experiment/1/M0"]
    assert len(starts) == 2  # the first one began the run
    data = lab.device.apps["M0"].data
    assert data["Experiment"]["ON"] == data["Thermostat"]["ON"] == data["Stir"]["ON"] == 1
    assert [start for start, _ in doses(lab) if start > over_s]
    lab.device.submit("POST", "/Experiment/0/M0")
    lab.run(8)
    assert [t for t, path in lab.wire.posts if path == "/Experiment/1/M0"] == starts
    assert isinstance(lab.reactors.stations[0].book.fault, messages.EndedBySomebody)


def test_a_stop_that_never_reached_the_device_does_not_excuse_a_later_one() -> None:
    lab = begun(rate=0.02)
    while not lab.of("feed_on"):
        lab.step()
    lab.fault("lying", -1)
    lab.run(2)
    assert [path for _, path in lab.wire.posts].count("/Experiment/0/M0") == 1
    lab.fault("lying", 0)
    lab.run(3)
    assert lab.reactors.stations[0].book.fault is None
    lab.device.submit("POST", "/Experiment/0/M0")
    lab.run(5)
    assert [path for _, path in lab.wire.posts].count("/Experiment/1/M0") == 1
    assert isinstance(lab.reactors.stations[0].book.fault, messages.EndedBySomebody)


def test_the_hot_guard_switches_heating_off_for_good() -> None:
    lab = begun(minutes=5)
    lab.reactors.heat_off(np.array([True]))
    lab.run(5)
    data = lab.device.apps["M0"].data
    assert data["Thermostat"]["ON"] == data["Heat"]["ON"] == 0
    lab.fault("worker_wipe")
    lab.run(5)
    assert lab.device.apps["M0"].data["Thermostat"]["ON"] == 0


def test_each_reactor_is_dosed_by_its_own_pumps_and_has_its_own_volume_and_blank_and_the_run_s_heat() -> None:
    """0.6 mL of a pump of 0.8 mL/s take 0.75 s, of one of 1.2 mL/s 0.5 s; the waste pump 4 times that and 4.4 s."""
    lab = DriverLab(("M0", "M3"), options=quiet(), temperature=33.5, stir=0.7)
    weak = ReactorCalibration(PumpCalibration(flow_ml_s=0.8), PumpCalibration(flow_ml_s=1.5))
    strong = ReactorCalibration(PumpCalibration(flow_ml_s=1.2), PumpCalibration(flow_ml_s=0.9), blank=13000.0)
    bench = Bench(volume_ml=18.0, volumes_ml={"M3": 15.0})
    reactors = ChiBioReactors(lab.wire, lab.clock, lab.config, [weak, strong], lab.log, bench)
    reactors.begin()
    waste_ml = np.zeros(2)
    while not waste_ml.all():
        fresh = reactors.measure().fresh
        receipt = reactors.actuate(Command(fresh, np.full(2, 0.01), np.full(2, np.nan)))
        waste_ml = np.where(fresh & (waste_ml == 0.0), receipt.waste_ml, waste_ml)
        np.testing.assert_allclose(receipt.volume_ml, 0.6 * fresh, atol=1e-3)
    reactors.stop()
    sent = [path.split("/")[1:] for _, path in lab.wire.posts]
    for name, feed_s, own in (("M0", 0.75, 1.5 * 7.4), ("M3", 0.5, 0.9 * 6.4)):
        duties = {item: float(value) for verb, item, where, value in (s for s in sent if len(s) == 4 and s[2] == name)
                  if verb == "SetOutputTarget" and item.startswith("Pump")}  # fmt: skip
        assert 63.0 * duties["Pump1"] == pytest.approx(feed_s, abs=1e-3)
        assert 63.0 * duties["Pump2"] == pytest.approx(4.0 * feed_s + 4.4, abs=1e-3)
        assert waste_ml[lab.names.index(name)] == pytest.approx(own, abs=5e-3)
    for name, volume_ml in (("M0", 18.0), ("M3", 15.0)):
        data = lab.device.apps[name].data
        assert [data[item]["target"] for item in ("Thermostat", "Stir", "Volume")] == [33.5, 0.7, volume_ml]
    assert [row["temperature"] for row in lab.of("device")] == [33.5, 33.5]
    assert [s[2:4] for s in sent if s[0] == "CalibrateOD"] == [["M3", "13000.000000"]]


# -- end and resume --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("after_s", "running"), [(0.05, False), (1.0, True)])
def test_stop_in_the_middle_of_a_dose_is_verified_and_idempotent(after_s: float, running: bool) -> None:
    """Also while the motor has not started yet."""
    lab = begun(("M0", "M1"), rate=0.02, minutes=2)
    while not lab.step().rows.any():
        pass
    lab.clock.sleep(after_s)
    assert not lab.motors_off()
    assert any(lab.truth(name)["motors"]["Pump1"] for name in lab.names) is running
    lab.reactors.stop()
    assert lab.motors_off()
    lab.reactors.stop()
    assert lab.device.apps["M0"].data["Experiment"]["ON"] == 1
    lab.clock.sleep(300.0)
    assert lab.motors_off()
    lab.reactors.end()
    assert all(lab.device.apps[name].data["Experiment"]["ON"] == 0 for name in lab.names)


@pytest.mark.parametrize("begun_dose", [False, True])
def test_a_full_disk_prevents_a_dose_and_does_not_stand_in_the_way_of_pumps_off(begun_dose: bool) -> None:
    """Full before the intent is written, or from the midst of a dose on."""
    lab = DriverLab()
    lab.reactors.begin()
    dose = Command(lab.reactors.measure().fresh, np.array([0.02]), np.array([37.0]))
    if begun_dose:
        lab.reactors.actuate(dose)

    def full(kind: str, fields: Any) -> None:
        if begun_dose or kind == "intent":
            raise RecordingError("journal: No space left on device")

    lab.reactors._log = full
    with pytest.raises(RecordingError):
        lab.reactors.measure() if begun_dose else lab.reactors.actuate(dose)
    assert bool(doses(lab)) is begun_dose
    lab.reactors.stop()
    assert lab.motors_off()


@pytest.mark.parametrize("seed", range(8))
def test_killed_at_a_random_request_and_resumed_no_sample_is_dosed_twice(seed: int) -> None:
    rng = np.random.default_rng(seed)
    lab = begun(options=quiet(mu=0.025), rate=0.02, minutes=4)
    fatal = len(lab.wire.posts) + int(rng.integers(1, 60))
    real = lab.wire.inner.post

    class Killed(BaseException):
        pass

    def dying(path: str) -> Any:
        if len(lab.wire.posts) >= fatal:
            raise Killed
        return real(path)

    lab.wire.inner.post = dying  # type: ignore[method-assign]
    with pytest.raises(Killed):
        lab.run(60)
    lab.wire.inner.post = real  # type: ignore[method-assign]
    began = lab.reactors.elapsed()
    dead_s = float(rng.uniform(1.0, 200.0))
    rows = list(lab.rows)
    lab.resume(dead_s)
    assert lab.motors_off()
    lab.run(5)
    lab.reactors.stop()
    acted = [tuple(r["sample"]) for r in lab.of("intent")]
    assert len(set(acted)) == len(acted)
    runs = len(doses(lab))
    repeats = math.floor(dead_s / 63.0) + 1
    given = [r for r in lab.of("intent") if r["feed_ml"] > 0]
    assert len(given) - 2 <= runs  # the kill may have cut one off before it began, and so did the stop at the end
    assert runs <= len(acted) + repeats
    intended_ml = sum(r["feed_ml"] for r in rows if r["kind"] == "intent")
    assert lab.truth()["feed_ml"] <= lab.fed[0] + intended_ml + 1.5 * repeats
    assert lab.reactors.elapsed() == pytest.approx(began + dead_s + 300.0, abs=70.0)
