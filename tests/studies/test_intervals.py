"""The study of the intervals, small: each kind in its row, and a law that must be refused without figures."""

import json
from pathlib import Path

import pytest

from tests.studies.intervals import IntervalsConfig, intervals, one, row

pytestmark = pytest.mark.numeric


@pytest.mark.slow
def test_a_table_for_each_simulator_with_a_row_for_each_kind(tmp_path: Path) -> None:
    config = IntervalsConfig(2, 2, ("threshold", "proportional"), (2.0, 3.0), (0.05,), workers=1)
    intervals(config, tmp_path)
    summary = json.loads((tmp_path / "summary.json").read_text())
    for name in ("own", "second"):
        cells = [
            [c.strip() for c in line.split("|")[1:-1]] for line in (tmp_path / f"{name}.md").read_text().splitlines()
        ]
        kinds = [["threshold", "2"], ["threshold", "3"], ["proportional", "2"], ["proportional", "3"]]
        assert [line[:2] for line in cells[2:]] == kinds
        assert {line[2] for line in cells[2:]} == {"5 %"}
        assert [line[3].partition(" of ")[2] for line in cells[2:]] == ["2"] * 4
        assert cells[4][3:7] == cells[5][3:7] == ["0 of 2", "–", "–", "–"]
    own, second = summary["found"][:4], summary["found"][4:]
    assert own[1]["median_bias_pct"] != second[1]["median_bias_pct"]  # no draw is shared
    assert own[1] == one("threshold", 3.0, 0.05, 2, 1, "own")
    for each in (own[1], second[1]):
        assert abs(each["median_bias_pct"]["mu"]) < 3 * each["relative_half_width_pct"]["mu"]


def test_a_row_names_mu_before_tau() -> None:
    numbers = {
        "recordings": 8, "refused": 3, "wrong_pct": 12.5, "coverage_pct": {"mu": 80.0, "tau": 100.0},
        "median_bias_pct": {"mu": -1.26, "tau": 0.5}, "relative_half_width_pct": {"mu": 4.0, "tau": 5.04},
    }  # fmt: skip
    said = ("device's PI", "24", "10 %", "5 of 8", "80.0 / 100.0", "-1.3 / +0.5", "4.0 / 5.0", "12.5")
    assert row(("pi", 24.0, 0.1), numbers) == said
