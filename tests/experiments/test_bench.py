"""The bench is said once: a law of one volume decides for every volume; a plant from a file, in every command."""

import json
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from envs.bench import Bench
from envs.plant.plant import Plant, PlantConfig
from experiments import benchmark
from experiments.cli import frame
from experiments.cli.calibrated import read_plant_file
from experiments.comparison.run import benchmark as run_benchmark
from experiments.comparison.run import with_twin
from experiments.control import assemble, run
from experiments.control.assemble import unpack
from experiments.control.messages import VolumesDiffer
from experiments.deploy import main
from experiments.laws import registry
from experiments.loop.signals import Density
from experiments.record.record import Record
from hardware.chibio.config import EmulatorConfig
from hardware.emulator.family import _words
from hardware.emulator.server import build, parser
from hardware.safety.interlock import kinds_of
from hardware.storage.journal import read_journal
from tests.hardware.script import logged


def error(folder: Path, *words: str) -> dict[str, float]:
    """Mean distance from the setpoint of each reactor's last window, OD."""
    folder.mkdir()
    shape = ["scenario=hold", "scenario.setpoints=[0.6]", "scenario.minutes=[40]", "fsync=false"]
    run.deploy(main.config([*shape, *words]), folder)
    windows = json.loads((folder / "summary.json").read_text())["windows"]
    return {w["reactor"]: w["steady_abs_error"] for w in windows}


def test_a_law_decides_in_shares_of_the_bench_s_own_volume(tmp_path: Path) -> None:
    """The law that only balances growth learns nothing: scaled wrongly it lets the culture go."""
    words = ["plant=nominal_noise", "backend.reactors=[M0,M1]", "controller=hold", "plant.start_od=0.6"]
    found = error(tmp_path / "run", *words, "bench.volume_ml=9", "bench.volumes_ml.M1=18")
    assert max(found.values()) < 0.03


@pytest.mark.parametrize(("words", "gain"), [((), 14 / 24), (("plant.vessel.volume_ml=18",), 18 / 24)])
def test_a_calibrated_model_is_that_of_laws_and_of_the_simulated_vials(words, gain, tmp_path):
    """tau = V / (60 g), so that g = V / 24 with tau = 0.4; the laws have the bench's period and the slower cap."""
    (tmp_path / "calibrated.yaml").write_text("mu: 0.021\ntau: 0.4\nmax_pump_rate: 0.018\n")
    bench = "bench.volume_ml=14", "bench.period_s=120", "bench.max_rate=0.015", "plant=nominal_noise", "controller=mpc"
    setup = unpack(main.config([f"env_file={tmp_path}/calibrated.yaml", *bench, *words]), tmp_path)
    model, plant = setup.model, setup.plant
    assert (model.mu, model.tau, model.control_min, model.max_pump_rate) == (0.021, 0.4, 2.0, 0.015)
    assert (plant.growth.mu, plant.pump.gain_ml_s) == (0.021, pytest.approx(gain))
    usual = unpack(main.config([*bench, "bench.max_rate=0.022"]), tmp_path)
    assert (usual.model.tau, usual.model.max_pump_rate) == (pytest.approx(14 / 60), 0.02)
    assert usual.plant.growth.mu == 0.03


def test_the_oracle_knows_what_the_simulated_driver_takes_its_pump_for(tmp_path: Path) -> None:
    """Growth of 3 % a minute is diluted by as much, within half of a 129th of the rates, 0.03 %, and not by 4 %."""
    words = ["plant=nominal", "controller=oracle", "backend.pump_ml_s=0.7", "bench.volume_ml=16"]
    assert error(tmp_path / "run", *words)["M0"] < 0.6 * 0.001


def test_the_device_s_own_law_is_told_the_volume_of_each_vial(tmp_path: Path) -> None:
    """P = 0.7 ln(x / r) V / 240 in the first minute in which it doses, when all vials are still alike."""
    tmp_path.joinpath("run").mkdir()
    vials = ["plant=nominal", "plant.start_od=0.55", "backend.reactors=[M0,M1,M2]", "controller=pi", "fsync=false"]
    vials += ["bench.volume_ml=16", "bench.volumes_ml.M1=9", "bench.volumes_ml.M2=31"]
    shape = ["scenario=hold", "scenario.setpoints=[0.5]", "scenario.minutes=[3]", "scenario.recovery_od=0"]
    run.deploy(main.config([*vials, *shape]), tmp_path / "run")
    rows = [row for row in read_journal(tmp_path / "run" / "journal.jsonl")[0] if row["kind"] == "decision"]
    first = {row["reactor"]: row for row in reversed(rows) if row["why"]["p"] > 0.0}
    for name, volume_ml in (("M0", 16.0), ("M1", 9.0), ("M2", 31.0)):
        by_hand = 0.7 * np.log(first[name]["row"]["od"] / 0.5) * volume_ml / 240.0
        assert first[name]["why"]["p"] == pytest.approx(by_hand, rel=1e-3)


def test_the_growth_that_a_law_learns_is_the_culture_s_in_vials_of_every_volume(tmp_path: Path) -> None:
    """All grow by 3 % a minute on calibrated pumps; doses taken for another vial's leave it 2.7 % in 14 mL."""
    words = ["plant=nominal", "plant.start_od=0.55", "backend.reactors=[M0,M1,M2]", "controller=inverse"]
    error(tmp_path / "run", *words, "bench.volumes_ml.M1=14", "bench.volumes_ml.M2=27",
          "scenario.minutes=[60]")  # fmt: skip
    rows = [row for row in read_journal(tmp_path / "run" / "journal.jsonl")[0] if row["kind"] == "decision"]
    last = {row["reactor"]: row["why"] for row in rows}
    assert {name: why["mu"] for name, why in last.items()} == pytest.approx(dict.fromkeys(last, 0.03), rel=0.01)
    assert {name: why["gain"] for name, why in last.items()} == pytest.approx(dict.fromkeys(last, 1.0), rel=0.01)
    assert len(last) == 3


def test_no_rate_for_a_larger_volume_passes_the_cap() -> None:
    law = SimpleNamespace(act=lambda *_given: np.array([0.004, 0.015, 0.02]))
    yes, none = np.ones(3, dtype=bool), np.zeros(3)
    sample = SimpleNamespace(
        measured=SimpleNamespace(od=none), rows=yes, believed=yes, setpoint=none, minute=none, phase=none,
        following=None, left_min=None,
    )  # fmt: skip
    rate = Density(law, np.array([1.5, 1.5, 0.5]), 0.02).decide(sample)  # type: ignore[arg-type]
    assert rate.tolist() == pytest.approx([0.006, 0.02, 0.01])


def test_each_emulated_vial_has_its_own_volume() -> None:
    bench = Bench(volume_ml=12.0, volumes_ml={"M2": 21.5})
    device = build(parser().parse_args(_words(EmulatorConfig(reactors=("M0", "M2")), bench)))
    assert [float(vial.plant.vessel.volume_ml[0]) for vial in device.vials.values()] == [12.0, 21.5]


def test_a_slow_bench_is_fed(tmp_path: Path) -> None:
    assert error(tmp_path / "slow", "controller=inverse", "bench.period_s=240")["M0"] < 0.03


def test_a_vial_that_differs_is_said_also_of_one_reactor(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    words = ["backend.reactors=[M0,M1]", "bench.volumes_ml.M1=14", "plant.vessel.volume_ml=20", "controller=pi"]
    with caplog.at_level("INFO"):
        assert np.isfinite(list(error(tmp_path / "run", *words).values())).all()
    assert logged(caplog, VolumesDiffer) == [{"other_ml": 20.0, "volume_ml": 20.0}]


IN_PROPORTION = {
    "bench.volume_ml": 14.0, "bench.volumes_ml.M1": 9.0, "bench.max_rate": 0.011, "bench.bottle_ml": 3.5,
    "backend.pump_ml_s": 0.7, "plant.pump.gain_ml_s": 0.7, "safety.ml_per_hour": 2.5, "safety.overflow_ml": 2.0,
}  # fmt: skip
WORDS = [
    "plant=nominal_noise", "plant.start_od=0.9", "backend.reactors=[M0,M1]", "scenario=hold", "fsync=false",
    "scenario.setpoints=[0.5]", "scenario.minutes=[60]", "scenario.recovery_od=0",
]  # fmt: skip


def decisions(folder: Path, law: str, scale: float) -> tuple[Any, Any, list[list[str]]]:
    """OD and rate / scale of each reactor, minute by minute, and the interlock's kinds of reasons."""
    folder.mkdir()
    of_bench = [f"{key}={scale * value!r}" for key, value in IN_PROPORTION.items()]
    setup = assemble.unpack(main.config([*WORDS, *of_bench, f"controller={law}"]), folder)
    record = Record(folder, setup.backend.reactors, False, setup.columns)
    with assemble.opened(setup, record) as loop:
        steps = [loop.step() for _ in range(45)]
    record.close()
    kinds = [[kind for reason in step.reasons for kind in kinds_of(reason or "")] for step in steps]
    return np.array([step.od for step in steps]), np.array([step.rate for step in steps]) / scale, kinds


LAWS = [kind for kind in registry.KINDS if not registry.takes(kind, "volume_ml")]
"""All but the device's own, whose integral gains are of a vial of 20 mL and a pump of 1 mL/s."""


@pytest.mark.parametrize("law", LAWS)
def test_volume_scaled_with_flow_changes_nothing(law: str, tmp_path: Path) -> None:
    (od, rate, kinds), scaled = decisions(tmp_path / "one", law, 1.0), decisions(tmp_path / "scaled", law, 1.7)
    np.testing.assert_allclose(scaled[0], od, rtol=1e-9)
    np.testing.assert_allclose(scaled[1], rate, rtol=1e-9, atol=1e-15)
    assert scaled[2] == kinds
    assert "budget" in {kind for row in kinds for kind in row}


TWIN = """# as calibrate writes one
growth:
  mu: 0.012
  knots_min: [0.0, 600.0] # min
  knots_mu: [0.01, 0.014]
pump: {dosing: pulse, gain_ml_s: 1.0, pulse_cv: 0.2}
sensor: {noise_floor: 0.00005, lag1: 0.3}
start_od: 0.03
"""


@pytest.fixture
def file(tmp_path: Path) -> str:
    path = tmp_path / "twin.yaml"
    path.write_text(TWIN)
    return str(path)


def test_a_file_says_what_differs_from_the_defaults(file: str) -> None:
    plant = read_plant_file(file)
    assert plant.growth.knots_mu == (0.01, 0.014)
    assert (plant.sensor.noise_floor, plant.start_od) == (5e-5, 0.03)
    assert replace(plant.growth, mu=0.03, knots_min=(), knots_mu=()) == PlantConfig().growth
    assert plant.vessel == PlantConfig().vessel


def test_a_deployment_has_the_plant_of_the_file(file: str, tmp_path: Path) -> None:
    config = main.config([f"plant_file={file}", "plant=bench", "controller=pi"])
    assert assemble.unpack(config, tmp_path).plant == read_plant_file(file)


@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        (["env_file=calibrated.yaml"], "env_file = calibrated.yaml: allowed null with plant_file"),
        (["backend=chibio"], "backend.kind = chibio: allowed sim with plant_file"),
    ],
)
def test_what_does_not_go_with_a_plant_file_is_one_line(file: str, overrides: list[str], message: str) -> None:
    with pytest.raises(frame.UserError, match=message):
        main.config([f"plant_file={file}", "controller=pi", *overrides])


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (None, "No such file or directory"), ("", "no key: value pairs"), ("- 1\n", "no key: value pairs"),
        ("mu: 0.03\ntau: 0.3\n", "plant.mu: no such key"), ("a: &a 1\nb: *a\n", "an alias"),
        ("growth: {mu: 7}\n", "plant.growth.mu = 7.0 1/min: allowed 0 to 0.1"),
        ("growth: {knots_min: [0, 5], knots_mu: [0.01]}\n", "plant.growth.knots_mu = .*one value for each"),
    ],
)  # fmt: skip
def test_a_bad_file_is_one_line_with_the_remedy(tmp_path: Path, text: str | None, message: str) -> None:
    path = tmp_path / "bad.yaml"
    if text is not None:
        path.write_text(text)
    with pytest.raises(frame.UserError, match=f"plant_file={path}: .*{message}.*give the twin.yaml") as caught:
        read_plant_file(str(path))
    assert "\n" not in str(caught.value)


def test_no_vial_of_a_benchmark_begins_beyond_the_recording_s_end(tmp_path: Path) -> None:
    """The last knot is that of the pump here, at minute 660; the twin itself begins at 150, or after them all."""
    words = ["+experiment=comparison", "studies.comparison.plants=[twin]", f"plant_file={tmp_path / 'later.yaml'}"]
    (tmp_path / "later.yaml").touch()
    config = benchmark.main.config(words)
    for start, spread in ((150.0, 510.0), (700.0, 0.0)):
        later = TWIN.replace("pulse_cv: 0.2", "pulse_cv: 0.2, knots_min: [0.0, 660.0], knots_ml_s: [1.0, 0.9]")
        (tmp_path / "later.yaml").write_text(f"{later}start_min: {start}\n")
        twin = with_twin(config).plants["twin"]
        assert (twin.start_min, twin.start_spread_min) == (start, spread)
        ages = Plant(twin, 200, np.random.default_rng(0)).age_min
        assert start <= ages.min() <= ages.max() <= max(start, 660.0)


@pytest.mark.slow
def test_a_benchmark_meets_all_hours_of_the_twin(file: str, tmp_path: Path) -> None:
    overrides = ["+experiment=comparison", "studies.comparison.plants=[nominal_noise,twin]", "replicates=40",
                 "studies.comparison.controllers=[pi]", f"plant_file={file}", "workers=1"]  # fmt: skip
    config = benchmark.main.config(overrides)
    twin = with_twin(config).plants["twin"]
    assert (twin.start_min, twin.start_spread_min, twin.start_od) == (0.0, 600.0, 0.5)
    assert twin.growth == read_plant_file(file).growth
    run_benchmark(config, tmp_path)
    rows = json.loads((tmp_path / "summary.json").read_text())["rows"]
    assert [row["plant"] for row in rows] == ["nominal_noise", "twin"]
    with np.load(tmp_path / "trajectories.npz") as stored:
        rate = stored["regulation/twin/pi/rate"][:, -30:].mean(axis=1)
    # at 0.5 the pump balances growth of 0.010 to 0.014 1/min: u = mu tau, tau = 1/3
    assert 0.0030 < rate.min() < 0.0038
    assert 0.0042 < rate.max() < 0.0050
