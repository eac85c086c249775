"""A plant from a file, in a deployment and in a benchmark."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from envs.plant.plant import Plant, PlantConfig
from experiments import benchmark
from experiments.cli import frame
from experiments.cli.calibrated import read_plant_file
from experiments.comparison.run import benchmark as run_benchmark
from experiments.comparison.run import with_twin
from experiments.control import assemble
from experiments.deploy import main

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
    ("volume", "ml"), [([], 20.0), (["plant.vessel.volume_ml=14"], 14.0), (["bench.volume_ml=28"], 28.0)]
)
def test_a_calibrated_model_dilutes_the_simulated_vial_as_it_says(volume: list[str], ml: float, tmp_path: Path) -> None:
    """tau = .25: 1 mL/s for a minute takes 1 / .25 off ln OD, so 60 g / V = 4 a minute in a vial of any volume."""
    model = tmp_path / "calibrated.yaml"
    model.write_text("mu: 0.02\ntau: 0.25\n")
    config = main.config([f"env_file={model}", "controller=pi", "plant=nominal", *volume])
    plant = assemble.unpack(config, tmp_path / "run").plant
    assert (plant.growth.mu, 60.0 * plant.pump.gain_ml_s / ml) == pytest.approx((0.02, 4.0))


@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        (["env_file=calibrated.yaml"], "env_file = calibrated.yaml: allowed null beside plant_file"),
        (["backend=chibio"], "backend.kind = chibio: allowed sim with plant_file"),
    ],
)
def test_what_does_not_go_with_a_plant_file_is_one_line(file: str, overrides: list[str], message: str) -> None:
    with pytest.raises(frame.UserError, match=message):
        main.config([f"plant_file={file}", "controller=pi", *overrides])


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (None, "No such file or directory"),
        ("", "holds no key: value pairs"),
        ("- 1\n", "holds no key: value pairs"),
        ("mu: 0.03\ntau: 0.3\n", "plant.mu: no such key"),
        ("growth: {mu: 7}\n", "plant.growth.mu = 7.0 1/min: allowed 0 to 0.1"),
        ("growth: {knots_min: [0, 5], knots_mu: [0.01]}\n", "plant.growth.knots_mu = .*one value for each"),
        ("a: &a 1\nb: *a\n", "an alias"),
    ],
)
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
