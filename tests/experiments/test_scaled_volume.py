"""Another volume with pumps and limits in proportion: laws and interlock decide the same, doses in proportion."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from experiments.control import assemble
from experiments.deploy import main
from experiments.laws import registry
from experiments.record.record import Record
from hardware.safety.interlock import kinds_of

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
