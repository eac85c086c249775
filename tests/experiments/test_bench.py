"""The bench is said once: a law of one volume decides for every volume, and a slow bench is fed as a fast one is."""

import json
from pathlib import Path

import numpy as np
import pytest

from experiments.control import run
from experiments.deploy import main


def error(folder: Path, *words: str) -> dict[str, float]:
    """Mean distance from the setpoint of each reactor's last window, OD."""
    folder.mkdir()
    shape = ["scenario=hold", "scenario.setpoints=[0.6]", "scenario.minutes=[60]", "fsync=false"]
    run.deploy(main.config([*shape, *words]), folder)
    windows = json.loads((folder / "summary.json").read_text())["windows"]
    return {w["reactor"]: w["steady_abs_error"] for w in windows}


@pytest.mark.parametrize("law", ["inverse", "pi_tuned", "dqn"])
def test_a_law_of_one_volume_decides_for_every_volume(law: str, tmp_path: Path) -> None:
    vials = ["plant=nominal_noise", "backend.reactors=[M0,M1,M2]", f"controller={law}"]
    found = error(tmp_path / "each", *vials, "bench.volumes_ml.M1=9", "bench.volumes_ml.M2=31")
    usual = error(tmp_path / "all", *vials)
    assert max(found.values()) < 1.5 * max(usual.values())


def test_a_slow_bench_is_fed(tmp_path: Path) -> None:
    assert error(tmp_path / "slow", "controller=inverse", "bench.period_s=240")["M0"] < 0.03


def test_a_vial_that_differs_is_said_also_of_one_reactor(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    words = ["backend.reactors=[M0,M1]", "bench.volumes_ml.M1=14", "plant.vessel.volume_ml=20", "controller=pi"]
    with caplog.at_level("INFO"):
        assert np.isfinite(list(error(tmp_path / "run", *words).values())).all()
    assert "plant.vessel.volume_ml = 20 mL differs from bench.volume_ml = 20 mL or bench.volumes_ml" in caplog.text
