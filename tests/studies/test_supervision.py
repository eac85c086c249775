"""The study of the supervisor, small: what it finds is of the right kind, and stands in its summary."""

import json
from pathlib import Path

import pytest

from tests.studies.supervision import SupervisionConfig, supervision

pytestmark = pytest.mark.numeric


@pytest.mark.slow
def test_a_blinded_filter_rests_elsewhere_unless_it_is_watched(tmp_path: Path) -> None:
    supervision(SupervisionConfig(vials=4, hours=1.5, plants=("nominal_noise",)), tmp_path)
    found = json.loads((tmp_path / "summary.json").read_text())
    sound, watched, unwatched, law = (float(row[1]) for row in found["blinded"])
    assert watched < 1.2 * sound < 0.005
    assert min(unwatched, law) > 0.03
    assert float(found["blinded"][1][2]) > 95.0
    assert 0.0 <= found["false_alarms_a_day"]["alarms"] <= found["false_alarms_a_day"]["decisions"] < 40.0
    assert [row[0] for row in found["costs"]] == ["nominal_noise, steps", "nominal_noise, switch"]
