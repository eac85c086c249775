"""The study of two species, small: rows and cells where they belong, and a law that is worse for all to see."""

import json
from pathlib import Path

import numpy as np
import pytest

from tests.studies.two_species import (
    CELLS,
    RIVALS,
    STEPS,
    TwoSpeciesConfig,
    better,
    compared,
    daily,
    difference,
    two_species,
)

pytestmark = pytest.mark.numeric


def test_a_day_and_a_few_hours(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("tests.studies.two_species.CELLS", {key: CELLS[key] for key in ("nominal", "mu_e x 1.2")})
    monkeypatch.setattr("tests.studies.two_species.STEPS", ("quick",))
    two_species(TwoSpeciesConfig(vials=3, days=1, hours=9.0, workers=1), tmp_path)
    week, laws = ((tmp_path / f"{name}.md").read_text().splitlines() for name in ("week", "laws"))
    assert [line.split("|")[1].strip() for line in week[2:]] == [
        "calibrated, hold", "calibrated, ratio_steps", "not calibrated, hold", "not calibrated, ratio_steps",
        "not calibrated, hold, 2 samples a day",
    ]  # fmt: skip
    assert [line.split("|")[1:3] for line in laws[2:]] == [[" quick ", " nominal "], [" quick ", " mu_e x 1.2 "]]
    found = json.loads((tmp_path / "summary.json").read_text())
    assert np.mean(found["errors"][1]["pi"]) > np.mean(found["errors"][1]["midpoint"])
    assert all(len(each[law]) == 3 for each in found["errors"] for law in RIVALS)
    assert len(STEPS) * len(CELLS) == 24


def test_better_is_an_interval_that_excludes_none() -> None:
    found = {law: [0.05, 0.06, 0.07, 0.05] for law in RIVALS}
    found["pi"] = [0.06, 0.08, 0.08, 0.06]
    found["receding"] = [0.04, 0.05, 0.06, 0.03]
    found["dqn_preview"] = [0.01, 0.06, 0.09, 0.05]
    mean, half = difference(found, "receding")
    assert mean == pytest.approx(-0.0125)
    assert half == pytest.approx(1.96 * 0.005 / 2.0)  # sd of -.01, -.01, -.01, -.02
    assert [law for law in RIVALS if better(found, law)] == ["receding"]
    assert compared(found)[0] == "0.0575"
    assert compared(found)[1] == "0.0450 (-0.0125 ± 0.0049)"
    assert daily({"coverage_pct": [95.4, 90.0], "error": [0.01, 0.0204]}) == ["95 %, 0.010", "90 %, 0.020"]
