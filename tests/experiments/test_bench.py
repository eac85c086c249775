"""The bench is said once: a law of one volume decides for every volume, and a slow bench is fed as a fast one is."""

import json
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from envs.bench import Bench
from experiments.control import run
from experiments.control.assemble import unpack
from experiments.control.messages import VolumesDiffer
from experiments.deploy import main
from experiments.loop.signals import Density
from hardware.chibio.config import EmulatorConfig
from hardware.emulator.family import _words
from hardware.emulator.server import build, parser
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
