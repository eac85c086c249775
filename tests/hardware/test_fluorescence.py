"""Fluorescence from an emulated culture to a measurement: slot, sample, preflight, faults, interlock."""

import json
import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from envs.plant.plant import Plant
from hardware.board.board_agent import reduce_sysdata
from hardware.chibio import messages
from hardware.chibio.config import ChiBioConfig
from hardware.chibio.dosing import ReactorCalibration
from hardware.chibio.fluorescence import FluorescenceSlotConfig
from hardware.chibio.preflight import preflight
from hardware.chibio.protocol import Permitted, check_command, parse_state
from hardware.emulator.device import DeviceOptions, plant_preset
from hardware.family import Check
from hardware.reactor import Measurement
from hardware.safety.config import Response, Responses, SafetyConfig
from hardware.safety.interlock import Interlock, Ruling
from hardware.simulated import SimulatedConfig, SimulatedReactors
from tests.hardware.driver_lab import DriverLab
from tests.hardware.emulator_lab import Lab
from tests.hardware.script import state

ON = FluorescenceSlotConfig(measure=True)
COMMAND = "/SetFPMeasurement/FP1/LEDA/CLEAR/nm440/OFF/x10"
PLANT = plant_preset("coculture")
EXACT = replace(PLANT, fluorescence=replace(PLANT.fluorescence, noise_sd=0.0))


def lab(names: tuple[str, ...] = ("M0",), plant=PLANT, **config: Any) -> DriverLab:
    settings = {"fluorescence": ON, "temperature": 33.0} | config
    found = DriverLab(names, options=DeviceOptions(plant=plant), **settings)
    found.law.rate = 0.005
    return found


def begun(*args: Any, **config: Any) -> DriverLab:
    found = lab(*args, **config)
    found.reactors.begin()
    return found


def sample(bench: DriverLab) -> np.ndarray:
    """Fluorescence of the next new sample."""
    while True:
        m = bench.reactors.measure()
        if m.fresh.any():
            assert m.fluorescence is not None
            return m.fluorescence


def slot(bench: DriverLab, name: str = "M0", which: str = "FP1") -> dict[str, Any]:
    data: dict[str, Any] = bench.device.apps[name].data[which]
    return data


def toggles(bench: DriverLab) -> int:
    return sum(path.startswith("/SetFPMeasurement") for _, path in bench.wire.posts)


# -- the simulated reactor and the emulated device ---------------------------------------------------------------------


def test_simulated_reactors_measure_it_where_the_plant_fluoresces() -> None:
    two = SimulatedReactors(Plant(EXACT, 1, np.random.default_rng(0)), SimulatedConfig())
    f = two.plant.fluorescence
    assert f is not None
    np.testing.assert_allclose(two.measure().fluorescence, f.pigment + 150.0 * 0.5 + 214.0)
    one = SimulatedReactors(Plant(plant_preset("healthy"), 1, np.random.default_rng(0)), SimulatedConfig())
    assert one.measure().fluorescence is None


@pytest.mark.parametrize(
    ("command", "seen"),
    [(COMMAND, True), (COMMAND.replace("LEDA", "LEDD"), False), (COMMAND.replace("nm440", "nm510"), False)],
)
def test_the_device_shows_emissions_over_the_base_and_a_pigment_in_its_light_alone(command: str, seen: bool) -> None:
    emulated = Lab(("M0",), options=DeviceOptions(plant=EXACT), od=0.5, temperature=33.0)
    assert emulated.post("/changeDevice/M0") == emulated.post(command) == emulated.post("/MeasureFP/M0") == 204
    fp, plant = emulated.state()["FP1"], emulated.device.vials["M0"].plant
    assert plant.fluorescence is not None
    expected = seen * float(plant.fluorescence.apparent(plant.culture.od, plant.minutes)[0])
    assert fp["Base"] > 0.0
    assert fp["Base"] * fp["Emit1"] == pytest.approx(expected, abs=seen)
    assert fp["Emit2"] == 0.0
    assert fp["Emit1"] < 1.0


# -- the driver --------------------------------------------------------------------------------------------------------


def test_a_sample_brings_the_counts_of_its_own_cycle() -> None:
    bench = begun(plant=EXACT)
    assert slot(bench)["ON"] == 1
    for _ in range(3):
        counts = sample(bench)[0]
        plant = bench.device.vials["M0"].plant
        assert plant.fluorescence is not None
        assert counts == pytest.approx(plant.fluorescence.apparent(plant.culture.od, plant.minutes)[0], rel=0.02)
        assert bench.of("sample")[-1]["fluorescence"] == counts
    assert toggles(bench) == 1


def test_without_it_nothing_is_switched_and_nothing_measured() -> None:
    bench = begun(fluorescence=FluorescenceSlotConfig())
    while not (m := bench.reactors.measure()).fresh.any():
        pass
    assert m.fluorescence is None
    assert toggles(bench) == 0
    assert "fluorescence" not in bench.of("sample")[-1]


@pytest.mark.parametrize(("found", "set_anew"), [(COMMAND, 0), (COMMAND.replace("LEDA", "LEDB"), 1)])
def test_a_slot_that_is_on_is_toggled_only_if_its_settings_are_others(found: str, set_anew: int) -> None:
    bench = lab()
    bench.wire.inner.post("/changeDevice/M0")
    bench.wire.inner.post(found)
    for _ in range(2):  # a resumed run finds it on, too
        bench.client()
        bench.reactors.begin()
        fp = slot(bench)
        assert (fp["ON"], fp["LED"], fp["Gain"], fp["Emit1Band"], fp["Emit2Band"]) == (1, "LEDA", "x10", "nm440", "OFF")
        assert toggles(bench) == 2 * set_anew


@pytest.mark.parametrize(
    ("key", "value"), [("LED", "LEDC"), ("BaseBand", "nm670"), ("Emit1Band", "nm510"), ("Gain", "x4")]
)
def test_any_setting_of_the_slot_that_somebody_changes_is_seen(key: str, value: str) -> None:
    def wrong(**changes: Any) -> str:
        settings = {"ON": 1, "LED": "LEDA", "BaseBand": "CLEAR", "Emit1Band": "nm440", "Gain": "x10"} | changes
        read = state(**{f"FP2__{name}": setting for name, setting in settings.items()})
        return replace(ON, slot="FP2").wrong(parse_state(json.dumps(read).encode()))

    assert (wrong(), wrong(ON=0)) == ("", "off")
    said = wrong(**{key: value})
    assert said.startswith("set to ")
    assert value in said


def test_a_toggle_selects_its_reactor_itself() -> None:
    bench = begun(("M0", "M1"))
    bench.wire.inner.post("/changeDevice/M1")
    bench.reactors.stations[0].connection.toggle(COMMAND)
    assert [slot(bench, m)["ON"] for m in ("M0", "M1")] == [0, 1]


def test_each_reactor_s_own_slot_is_switched() -> None:
    bench = begun(("M0", "M3"))
    assert [slot(bench, m)["ON"] for m in ("M0", "M1", "M3")] == [1, 0, 1]
    bench.run(3.0)
    newest = {row["reactor"]: row["fluorescence"] for row in bench.of("sample")}
    assert all(counts > 300.0 for counts in newest.values())
    assert len(newest) == 2


@pytest.mark.parametrize(
    ("key", "value", "toggled", "found"), [("ON", 0, 1, "off"), ("LED", "LEDB", 2, "set to LEDB, CLEAR, nm440, x10")]
)
def test_what_somebody_changes_is_put_right_and_not_shown(key: str, value: Any, toggled: int, found: str) -> None:
    bench = begun()
    sample(bench)
    before, slot(bench)[key] = toggles(bench), value
    assert math.isnan(sample(bench)[0])
    assert (slot(bench)["ON"], slot(bench)["LED"], toggles(bench)) == (1, "LEDA", before + toggled)
    assert sample(bench)[0] > 300.0
    assert [note["found"] for note in bench.notes(messages.PutRight)] == [found]


def test_a_worker_that_lost_its_memory_gets_it_back() -> None:
    bench = begun()
    bench.run(3.0)
    bench.fault("worker_wipe")
    bench.run(10.0)
    assert slot(bench)["ON"] == 1
    assert bench.of("sample")[-1]["fluorescence"] > 300.0


def test_somebody_who_selects_reactors_leaves_it_on_in_the_end() -> None:
    bench = begun(("M0", "M1"))
    bench.fault("fp_off")
    bench.fault("foreign_selects", 0.2)
    bench.run(6.0)
    bench.fault("foreign_selects", 0.0)
    bench.run(3.0)
    assert [slot(bench, m)["ON"] for m in ("M0", "M1")] == [1, 1]


def test_a_run_does_not_begin_where_it_cannot_be_had() -> None:
    bench = lab()

    def refuse(path: str) -> Any:
        bench.wire.posts.append((bench.clock.now(), path))
        return bench.wire.inner.post("/changeDevice/M0" if path == COMMAND else path)

    bench.wire.post = refuse
    with pytest.raises(messages.NotReady) as error:
        bench.reactors.begin()
    assert error.value.fields["trouble"].row == messages.SlotAmiss(slot="FP1", found="off").row


def test_a_frozen_sensor_repeats_exactly() -> None:
    bench = begun()
    first = [sample(bench)[0] for _ in range(2)]
    bench.fault("fp_frozen")
    later = [sample(bench)[0] for _ in range(3)]
    assert first[0] != first[1]
    assert later[0] == later[1] == later[2]


# -- what may be sent, what is read ------------------------------------------------------------------------------------


def test_only_the_configured_toggle_may_be_sent() -> None:
    check_command(COMMAND, Permitted(("M0",), slot_command=COMMAND))
    for other in (COMMAND.replace("FP1", "FP2"), COMMAND.replace("x10", "x9")):
        with pytest.raises(messages.Forbidden):
            check_command(other, Permitted(("M0",), slot_command=COMMAND))
    with pytest.raises(messages.Forbidden):
        check_command(COMMAND, Permitted(("M0",)))
    with pytest.raises(messages.Forbidden):
        check_command("", Permitted(("M0",)))


def test_the_board_agent_passes_what_the_driver_reads() -> None:
    emulated = Lab(("M0",), options=DeviceOptions(plant=EXACT), od=0.5)
    emulated.post("/changeDevice/M0")
    emulated.post(COMMAND)
    emulated.post("/MeasureFP/M0")
    body = emulated.device.handle("GET", "/getSysdata/")[1]
    whole, reduced = parse_state(body), parse_state(reduce_sysdata(body))
    assert reduced.slots == whole.slots
    assert whole.slots[0].counts > 300.0
    old = json.loads(body)
    old["FP1"] = {"ON": 1}
    assert ON.own(parse_state(json.dumps(old).encode())) is None
    assert "update" in ON.wrong(parse_state(json.dumps(old).encode()))


def test_a_band_is_not_its_own_base() -> None:
    with pytest.raises(ValueError, match=r"backend\.fluorescence\.band = CLEAR: allowed another than base_band"):
        FluorescenceSlotConfig(band="CLEAR")


# -- preflight ---------------------------------------------------------------------------------------------------------


def checked(bench: DriverLab, name: str = "M0 fluorescence", config: ChiBioConfig | None = None) -> Check:
    checks = preflight(bench.wire, bench.clock, config or bench.config, [ReactorCalibration()])
    return next(c for c in checks if c.name == name)


def test_preflight_says_that_the_run_switches_it_on_and_reads_a_slot_that_is_on() -> None:
    bench = lab()
    assert checked(bench).ok
    assert "FP1 is off: the run switches it on" in checked(bench).detail
    assert toggles(bench) == 0
    bench.reactors.begin()
    sample(bench)
    assert checked(bench).ok
    assert "counts of nm440" in checked(bench).detail
    assert checked(bench, "M0 modes").ok


@pytest.mark.parametrize(("fault", "counts"), [("fp_dead", 0), ("fp_saturated", 65535), ("spectrometer_dead", 0)])
def test_a_sensor_that_fails_shows_what_it_reads_and_preflight_refuses_it(fault: str, counts: int) -> None:
    bench = begun()
    sample(bench)
    bench.fault(fault)
    sample(bench)
    assert sample(bench)[0] == pytest.approx(counts)
    found = checked(bench)
    assert (found.ok, found.required) == (False, True)
    assert f"{counts} counts" in found.detail
    assert "gain" in found.remedy


def test_preflight_still_refuses_every_other_slot() -> None:
    bench = begun()
    slot(bench, which="FP2")["ON"] = 1
    modes = checked(bench, "M0 modes")
    assert not modes.ok
    assert modes.detail == "FP2"
    without = replace(bench.config, fluorescence=FluorescenceSlotConfig())
    assert checked(bench, "M0 modes", without).detail == "FP1, FP2"


NAN = np.nan


class Bench:
    """An interlock of N reactors that hold OD 0.5 and are not dosed, a sample a minute."""

    def __init__(self, n: int = 1, **config) -> None:
        self.n, self.minute = n, 0
        self.interlock = Interlock(n, SafetyConfig(mu_max=0.04, **config))

    def step(self, *counts: float | None, fresh: bool = True) -> tuple[np.ndarray | None, Ruling]:
        """Believed counts and verdict of a sample with these counts; None: fluorescence is not measured."""
        self.minute += 1
        light = None if counts == (None,) else np.array(counts, dtype=float)
        od = np.full(self.n, 0.5 + 1e-4 * (self.minute % 7))
        rows = np.full(self.n, fresh)
        m = Measurement(np.full(self.n, 60.0 * self.minute), od, np.full(self.n, 33.0), rows, None, light)
        believed = self.interlock.fluorescence(m)
        zero, setpoint = np.zeros(self.n), np.full(self.n, 0.5)
        return believed, self.interlock.check(m, zero, setpoint, np.full(self.n, 33.0), 60.0 * self.minute)


@pytest.mark.parametrize("counts", [0.0, 65535.0, NAN])
def test_what_no_working_sensor_gives_is_not_believed_and_said(counts) -> None:
    believed, verdict = Bench().step(None)  # where it is not measured nothing is said
    assert (believed, verdict.reasons) == (None, [None])
    believed, verdict = Bench(2).step(1500.0, 1.0)
    np.testing.assert_array_equal(believed, [1500.0, 1.0])
    assert verdict.reasons == [None, None]
    believed, verdict = Bench(2).step(1500.0, counts)
    np.testing.assert_array_equal(believed, [1500.0, NAN])
    assert verdict.kinds == ((), ("fluorescence",))
    np.testing.assert_equal(verdict.faults[1][0].fields, {"counts": counts, "samples": 1.0})
    assert verdict.response.tolist() == [Response.PASS, Response.PASS]


@pytest.mark.parametrize(("config", "n"), [({}, 5), *(({"frozen_light": n}, n) for n in (2, 3, 9))])
def test_the_same_reading_is_believed_until_the_nth(config: dict[str, int], n: int) -> None:
    bench = Bench(2, **config)
    seen = [bench.step(1500.0, 700.0 + k) for k in range(n + 1)]
    assert [np.isfinite(believed).tolist() for believed, _ in seen] == [[True, True]] * (n - 1) + [[False, True]] * 2
    assert seen[n - 1][1].faults[0][0].fields == {"counts": 1500.0, "samples": n}
    believed, verdict = bench.step(1501.0, 701.0)
    assert believed.tolist() == [1501.0, 701.0]
    assert verdict.reasons == [None, None]


def test_the_least_light_is_that_which_is_set() -> None:
    for least, passes in ((1.0, True), (50.0, False)):
        assert np.isfinite(Bench(light_min=least).step(40.0)[0][0]) == passes


def test_a_row_that_is_not_fresh_is_neither_believed_nor_counted() -> None:
    bench = Bench()
    bench.step(1500.0)
    for _ in range(6):
        believed, verdict = bench.step(1500.0, fresh=False)
        assert np.isnan(believed[0])
        assert "fluorescence" not in verdict.kinds[0]
    assert bench.step(1500.0)[0][0] == 1500.0


def test_after_a_quarter_of_an_hour_it_is_lost_until_it_comes_back() -> None:
    bench = Bench()
    bench.step(1500.0)
    kinds = [bench.step(0.0)[1].kinds[0] for _ in range(17)]
    assert kinds == [("fluorescence",)] * 15 + [("fluorescence_lost",)] * 2
    assert bench.step(1400.0)[1].kinds == ((),)
    assert bench.step(0.0)[1].kinds == (("fluorescence",),)


def test_one_that_never_came_is_lost_too_and_may_be_declared_to_hold() -> None:
    bench = Bench(light_lost=3.0, responses=Responses(fluorescence_lost="hold"))
    verdicts = [bench.step(NAN)[1] for _ in range(5)]
    assert [v.kinds[0] for v in verdicts] == [("fluorescence",)] * 4 + [("fluorescence_lost",)]
    assert [v.response[0] for v in verdicts] == [Response.PASS] * 4 + [Response.HOLD]


def test_a_resumed_run_remembers_repeats_and_silence() -> None:
    bench = Bench(light_lost=3.0)
    for _ in range(5):
        bench.step(1500.0)
    bench.minute = 6
    state = json.loads(json.dumps(bench.interlock.state()).replace("-Infinity", "null").replace("NaN", "null"))
    bench.interlock = Interlock(1, bench.interlock.config)
    bench.interlock.restore(state)
    believed, verdict = bench.step(1500.0)
    assert np.isnan(believed[0])
    assert verdict.reasons[0].count("in 6 samples") == 1


def test_limits_of_the_temperature_leave_a_range() -> None:
    with pytest.raises(ValueError, match=r"safety\.composition_high = 30\.0: allowed 31 to 42"):
        SafetyConfig(composition_low=31.0, composition_high=30.0)
