"""The study of the two-chamber rig as a user runs it: what it leaves behind, and how it ends."""

import csv
import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from envs.dual_chamber.rig import RigCase
from experiments.cli import frame
from experiments.dual_chamber import DualChamberConfig, Trial, closed_loop, laws, main, row

ROOT = Path(__file__).parents[2]
SHORT = ["replicates=3", "window_min=12", "ratios=[0.5,0.6]", "laws=[proportional,myopic,optimum]"]


def study(*overrides: str) -> subprocess.CompletedProcess[str]:
    environment = {**os.environ, "OMP_NUM_THREADS": "1", "PYTHONPATH": str(ROOT)}
    command = [sys.executable, "-m", "experiments.dual_chamber", *overrides]
    return subprocess.run(command, capture_output=True, text=True, env=environment, timeout=280, check=False)


def test_a_study_leaves_summary_table_and_figures(tmp_path: Path) -> None:
    folder = tmp_path / "study"
    done = study(*SHORT, "~plants", "+plants={nominal: {}, weak: {reservoir_gain: 0.6}}", f"hydra.run.dir={folder}")
    assert done.returncode == 0, done.stderr
    rows = json.loads((folder / "summary.json").read_text())["rows"]
    assert [r["plant"] for r in rows] == ["nominal"] * 9 + ["weak"] * 9
    assert {(r["law"], r["observed"]) for r in rows} == {
        (law, seen) for law in ("proportional", "myopic", "optimum") for seen in ("state", "fluorescence", "od")
    }
    assert set(rows[0]) == {
        "law", "observed", "plant", "ratio_abs_error_mean", "od_abs_error_mean", "cost", "settled_min",
        "settled_share", "ekf_mse_od", "ekf_mse_ratio", "n",
    }  # fmt: skip
    for r in rows:
        assert (r["ekf_mse_ratio"] == 0.0) == (r["observed"] == "state")
        assert r["n"] == 3
        assert len(r["settled_min"]) == 2
    with open(folder / "table.csv", newline="") as f:
        assert [r["law"] for r in csv.DictReader(f)] == [r["law"] for r in rows]
    for name in ("nominal", "weak"):
        assert (folder / "figures" / f"{name}.png").stat().st_size > 5000


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("laws=[best]", "laws = ['best']: allowed one or more, each one of feed_forward"),
        ("ratios=[0.5,1.5]", "ratios = [0.5, 1.5]: allowed one or more, each 0.05 to 0.95"),
        ("plants.nominal.smallest_ml=1.5", "plants.nominal.smallest_ml = 1.5: allowed below rig.largest_ml = 1.2"),
        ("rig.mu_slow=0.05", "rig.mu_fast = 0.03: allowed greater than rig.mu_slow = 0.05"),
        ("window_min=0", "window_min = 0 min: allowed 10 to 1440"),
    ],
)
def test_mistakes_are_named(override: str, message: str) -> None:
    with pytest.raises(frame.UserError) as caught:
        main.config([override])
    assert message in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_mistake_is_one_line(tmp_path: Path) -> None:
    done = study("replicates=0", f"hydra.run.dir={tmp_path}")
    assert done.returncode == 1
    assert done.stderr == "error: replicates = 0: allowed 1 to 10000\n"


def test_a_row_by_hand() -> None:
    """Two windows of ten minutes, two rigs: one .1 off in share all the time, one .2 off in OD for three minutes."""
    config = DualChamberConfig(replicates=2, window_min=10, ratios=(0.25, 0.75))
    wanted = np.repeat([0.25, 0.75], 10)[:, None]
    od, ratio = np.full((20, 2), 0.5), wanted + np.array([0.1, 0.0])
    od[:3, 1] = 0.7
    found = row(config, Trial(od, ratio, od + 0.01, ratio - 0.02, np.zeros((20, 2, 3))))
    assert found["ratio_abs_error_mean"] == pytest.approx(0.05)
    assert found["od_abs_error_mean"] == pytest.approx(0.2 * 3 / 40)
    assert found["cost"] == pytest.approx((20 * 0.01 + 3 * 0.16) / 40)
    assert found["settled_share"] == [0.5, 0.5]
    assert (found["ekf_mse_od"], found["ekf_mse_ratio"]) == (pytest.approx(1e-4), pytest.approx(4e-4))


def test_laws_meet_the_same_rigs_and_noise() -> None:
    config = main.config([*SHORT, "laws=[proportional,pi]"])
    trials = {name: closed_loop(config, RigCase(), made(), "state") for name, made in laws(config, RigCase()).items()}
    first = [t.ratio[0] for t in trials.values()]
    assert np.abs(first[0] - first[1]).max() < 0.02
    again = closed_loop(config, RigCase(), laws(config, RigCase())["pi"](), "state")
    np.testing.assert_array_equal(again.od, trials["pi"].od)
    more = closed_loop(
        main.config([*SHORT, "replicates=5"]), RigCase(), laws(config, RigCase())["proportional"](), "od"
    )
    fewer = closed_loop(config, RigCase(), laws(config, RigCase())["proportional"](), "od")
    np.testing.assert_array_equal(more.od[:, :3], fewer.od)


def test_without_carry_over_small_doses_are_lost() -> None:
    config = DualChamberConfig(replicates=8, ratios=(0.5,), window_min=120, laws=("feed_forward",))
    share = {}
    for carry in (True, False):
        case = RigCase(carry_over=carry, growth_cv=0.0, gain_cv=0.0, dose_cv=0.0)
        law = laws(config, case)["feed_forward"]()
        share[carry] = closed_loop(config, case, law, "state")
    assert share[True].dose[..., 1].sum(axis=0) == pytest.approx(120 * 0.1005, rel=0.03)
    assert share[False].dose[..., 1].max() < 0.2
    assert share[False].ratio[-1].max() < share[True].ratio[-1].min()
