"""Work on the bench in virtual time: what becomes of the counts that are averaged to a blank."""

import numpy as np
import pytest

from hardware.chibio.procedures import measure_blanks, warm_up
from hardware.errors import DeviceStateError
from tests.hardware.driver_lab import DriverLab


def test_a_blank_is_the_mean_of_the_counts_of_its_own_reactor() -> None:
    lab = DriverLab(("M0", "M1"), od=0.001, blanked=False)
    lab.reactors.begin()
    mean, sd = measure_blanks(lab.reactors, 5)
    for i, name in enumerate(lab.names):
        counts = [row["raw"] for row in lab.of("sample") if row["reactor"] == name][:5]
        assert len(set(counts)) == 5
        assert mean[i] == pytest.approx(sum(counts) / 5.0)
        assert sd[i] == pytest.approx(np.sqrt(sum((c - mean[i]) ** 2 for c in counts) / 4.0))
        assert lab.device.apps[name].data["OD0"]["target"] == pytest.approx(mean[i], abs=1e-6)


@pytest.mark.parametrize("cold", ["M0", "M1"])
def test_a_blank_waits_for_the_coldest_vial(cold: str) -> None:
    """One at 37 degC from the start, and one at 27 that its heater warms by 2 degC/min."""
    lab = DriverLab(("M0", "M1"), od=0.001, blanked=False)
    lab.reactors.begin()
    lab.device.vials[cold].plant.thermal.reset(27.0)
    lab.device.vials[cold].plant.thermal.set_target(37.0)
    farthest = [degc for _, degc in warm_up(lab.reactors, 0.7, 20.0, every_min=1.0)]
    assert min(farthest) < 32.0
    true = [float(lab.device.vials[name].plant.thermal.temperature[0]) for name in lab.names]
    assert true == pytest.approx([37.0, 37.0], abs=0.7)


def test_no_blank_is_taken_while_something_is_wrong() -> None:
    lab = DriverLab(od=0.001, blanked=False)
    lab.reactors.begin()
    before = lab.device.apps["M0"].data["OD0"]["target"]
    lab.clock.sleep(5.0)
    lab.device.handle("POST", "/SetOutputTarget/Pump1/M0/0.01")
    lab.device.handle("POST", "/SetOutputOn/Pump1/1/M0")
    with pytest.raises(DeviceStateError, match="M0: pump"):
        measure_blanks(lab.reactors, 5)
    assert lab.device.apps["M0"].data["OD0"]["target"] == before
