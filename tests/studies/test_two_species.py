"""The study of two species, small: rows and cells where they belong, and a law that is worse for all to see."""

import json
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from tests.studies import second_vials
from tests.studies.second_vials import Conditions, nominal
from tests.studies.two_species import (
    CELLS,
    COMPOSITION,
    RIVALS,
    STEPS,
    WARM_UP_MIN,
    TwoSpeciesConfig,
    better,
    compared,
    daily,
    difference,
    flown,
    two_species,
)

pytestmark = pytest.mark.numeric


def test_each_row_and_cell_is_of_its_own_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Runs of a known error: .01 for the first law, .02 for the second ..., twice that where E. coli grows faster.

    In the first table the estimate is off by .04 with samples, .02 without a calibration, else by .01; the band holds
    the truth in every minute of a program with steps, and in a quarter of another one. The first hour counts for none.
    """

    def flown(conditions: Conditions, law: str, program: str, hours: float, seed: int, samples: int = 0) -> Any:
        minutes, zero = round(60.0 * hours), np.zeros((round(60.0 * hours), conditions.n))
        off = 0.01 * (1 + RIVALS.index(law)) * np.where(np.asarray(conditions.scale_e) == 1.2, 2.0, 1.0)
        off = np.where(np.arange(minutes)[:, None] < WARM_UP_MIN, 0.9, zero + off)
        error = 0.04 if samples else 0.01 if conditions.calibrated else 0.02
        inside = zero + (np.arange(minutes)[:, None] % 4 == 0) * 1.0 if program == "hold" else zero + 1.0
        told.append((law, program, hours, seed, samples))
        return SimpleNamespace(share=off, setpoint=zero, estimate=off + error, low=off, high=off + 2.0 * inside - 1.0)

    told: list[tuple[str, str, float, int, int]] = []
    study = "tests.studies.two_species"
    monkeypatch.setattr(f"{study}.CELLS", {key: CELLS[key] for key in ("nominal", "mu_e x 1.2")})
    monkeypatch.setattr(f"{study}.STEPS", ("quick",))
    monkeypatch.setattr(f"{study}.flown", flown)
    monkeypatch.setattr(f"{study}.Workers", ThreadPoolExecutor)  # in this process
    two_species(TwoSpeciesConfig(vials=3, days=2, hours=9.0, workers=1, seed=4), tmp_path)
    days = [(COMPOSITION, program, 48.0, 4, samples) for program, samples in
            (("hold", 0), ("ratio_steps", 0), ("hold", 0), ("ratio_steps", 0), ("hold", 2))]  # fmt: skip
    assert told == days + [(law, "quick", 9.0, 4, 0) for _ in range(2) for law in RIVALS]
    lines = [(tmp_path / f"{name}.md").read_text().splitlines() for name in ("week", "laws")]
    week, laws = ([[cell.strip() for cell in line.split("|")[1:-1]] for line in table] for table in lines)
    hold, steps = (["25 %, {}"] * 2, ["100 %, {}"] * 2)
    rows = (("calibrated, hold", hold, ".010"), ("calibrated, ratio_steps", steps, ".010"),
            ("not calibrated, hold", hold, ".020"), ("not calibrated, ratio_steps", steps, ".020"),
            ("not calibrated, hold, 2 samples a day", hold, ".040"))  # fmt: skip
    assert week[2:] == [[name, *(cell.format(f"0{error}") for cell in cells)] for name, cells, error in rows]
    assert [line[:2] for line in laws[2:]] == [["quick", "nominal"], ["quick", "mu_e x 1.2"]]
    found = json.loads((tmp_path / "summary.json").read_text())["errors"]
    for k, each in enumerate(found):
        assert each == {law: [pytest.approx(0.01 * (1 + n) * (1 + k))] * 3 for n, law in enumerate(RIVALS)}
    assert len(STEPS) * len(CELLS) == 24


def test_a_law_flies_on_the_other_simulator_from_its_first_minute_on_with_the_samples_of_each_day(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    given: list[Any] = []
    run = second_vials.run
    monkeypatch.setattr(second_vials, "run", lambda *a, **k: (given.append(k["samples"]), run(*a, **k))[1])
    trace = flown(nominal(2), "dqn_preview", "quick", 0.5, 1)
    assert trace.share.shape == (30, 2)
    assert np.isfinite(trace.estimate).all()
    monkeypatch.setattr(second_vials, "run", lambda *a, **k: given.append(k["samples"]))
    flown(nominal(2), "pi", "hold", 48.0, 1, samples=2)
    assert given == [[], [6.0, 18.0, 30.0, 42.0]]


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
