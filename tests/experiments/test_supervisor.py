"""The policy that ships under its supervisor: which law acts, what the journal and the console say of it."""

import logging
from pathlib import Path

import numpy as np
import pytest

from envs.scenario import Scenario
from envs.task import EnvConfig
from experiments.certification import certificate
from experiments.control.policies import find_policy, load_policy
from experiments.laws.density.estimator import LOG_OD, EstimatorConfig
from experiments.laws.density.learned import RelativeController
from experiments.record.summary import ChangeLog
from hardware.emulator.device import DeviceOptions, plant_preset
from hardware.storage.journal import read_journal
from tests.campaigns.rehearsal import Rehearsal, rehearsed

MODEL = EnvConfig(mu=0.025, tau=1 / 3)
SHIPPED = find_policy("shipped")
POLICY = load_policy("shipped", 1.0, 0.02)
BOUNDS = certificate.bounds(POLICY, SHIPPED)


def supervised(n: int = 3) -> RelativeController:
    made = RelativeController(POLICY, EstimatorConfig(), MODEL, BOUNDS)
    made.reset(n)
    return made


def in_doubt(law: RelativeController, row: int, sd_od: float) -> None:
    """The OD of a row is known only within sd_od."""
    law.estimator.cov[row, LOG_OD, :] = law.estimator.cov[row, :, LOG_OD] = 0.0
    law.estimator.cov[row, LOG_OD, LOG_OD] = sd_od**2


def test_inside_the_bounds_the_policy_acts_outside_the_law_on_the_nominal_model() -> None:
    """Row 1 is in doubt. The law by hand: u = tau (mu + ln(x/r)/h), h = 1 min, between 0 and 0.02 mL/s."""
    assert BOUNDS is not None
    law, n = supervised(), 3
    rows, setpoint = np.ones(n, dtype=bool), np.full(n, 0.5)
    for minute in range(30):
        law.act(np.full(n, 0.5), setpoint, np.full(n, float(minute)), rows)
        law.dosed(np.full(n, 0.5))
    assert not law.explain()["supervised"].any()
    for k, od in enumerate((0.51, 0.5, 0.49, 0.47, 0.6)):
        in_doubt(law, 1, 1e3)
        law.estimator.config = EstimatorConfig(noise_floor=0.1, noise_relative=0.1)  # nothing is learned of a reading
        law.estimator._noise[1] = 1e6
        rate = law.act(np.full(n, od), setpoint, np.full(n, 30.0 + k), rows)
        law.dosed(np.full(n, 0.5))
        said = law.explain()
        np.testing.assert_array_equal(said["supervised"], [0.0, 1.0, 0.0])
        by_hand = np.clip((0.025 + np.log(od / 0.5)) / 3.0, 0.0, 0.02)
        assert rate[1] == pytest.approx(by_hand, rel=1e-9)
        observation = np.stack([said["error"], said["growth_share"]], axis=1)
        of_policy = 0.02 * POLICY.actions[POLICY.q_values(observation).argmax(axis=1)]
        np.testing.assert_allclose(rate[[0, 2]], of_policy[[0, 2]])


@pytest.mark.parametrize(("od", "allowed"), [(0.5, 0.04 / 0.5), (0.25, 0.04 / 0.25), (0.9, 0.04 / 0.9)])
def test_the_bound_is_that_of_the_certificate(od: float, allowed: float) -> None:
    """0.04 OD, as ln(1 + 0.04 / OD): twice the filter's own sd may reach it and not pass it."""
    assert BOUNDS is not None
    assert BOUNDS.od == 0.04
    law = supervised(1)
    for minute in range(30):
        law.act(np.array([od]), np.array([od]), np.array([float(minute)]), np.ones(1, dtype=bool))
        law.dosed(np.array([0.5]))
    observation = np.stack(law.estimator.relative(np.array([od])), axis=1)
    for share, outside in ((0.98, False), (1.02, True)):
        in_doubt(law, 0, 0.5 * share * np.log1p(allowed) * float(law.estimator.full_pump[0]) / BOUNDS.full_pump)
        assert law._outside(np.array([od]), observation).tolist() == [outside]


def test_without_a_certificate_nobody_supervises() -> None:
    law = RelativeController(POLICY, EstimatorConfig(), MODEL, None)
    law.reset(1)
    law.act(np.array([0.5]), np.array([0.5]), np.zeros(1), np.ones(1, dtype=bool))
    in_doubt(law, 0, 1e3)
    law.act(np.array([np.nan]), np.array([0.5]), np.ones(1), np.ones(1, dtype=bool))
    assert law.explain()["supervised"].tolist() == [0.0]


def test_the_console_says_once_when_the_supervisor_begins_and_ends_and_the_journal_every_time(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """M0's estimate is spoilt for five samples; M1's never is."""
    run = Rehearsal(tmp_path, rehearsed(("M0", "M1"), Scenario((0.5,), (600.0,), (37.0,))), od=0.5)
    run.begin()
    law, log_changes, spoilt = run.loop.density.law, ChangeLog(run.loop), 0
    assert isinstance(law, RelativeController)
    with caplog.at_level(logging.INFO):
        for step in run.run(1860.0):
            log_changes(step)
            if step.minute[0] > 20.0 and spoilt < 5:
                spoilt += int(step.rows[0])
                law.estimator._noise[0] = 1e9
                in_doubt(law, 0, 1e3)
            elif spoilt == 5:
                law.estimator._noise[0] = 1.0
                spoilt += 1
    run.close()
    said = [r.getMessage() for r in caplog.records if "policy acts" in r.getMessage() or "law acts" in r.getMessage()]
    rows = [row for row in read_journal(tmp_path / "journal.jsonl")[0] if row["kind"] == "decision"]
    acted = [r["row"]["time_min"] for r in rows if r["reactor"] == "M0" and r["why"]["supervised"] == 1.0]
    after = [r["row"]["time_min"] for r in rows if r["reactor"] == "M0" and r["row"]["time_min"] > acted[-1]]
    assert said == [
        f"M0: the supervisor's law acts, the estimate is in doubt, from minute {acted[0]:.0f}",
        f"M0: the policy acts again from minute {after[0]:.0f}",
    ]
    assert 4 <= len(acted) <= 6
    assert not any(r["why"]["supervised"] for r in rows if r["reactor"] == "M1")


def test_three_strains_on_three_pumps_are_held_without_a_calibration(tmp_path: Path) -> None:
    """True OD, from the emulator, against the setpoint in the last ten minutes of each phase."""
    schedule = Scenario((0.5, 0.4), (25.0, 25.0), (37.0, 37.0), recovery_od=0.45)
    run = Rehearsal(
        tmp_path, rehearsed(("M0", "M1", "M2"), schedule), DeviceOptions(plant=plant_preset("mixed")), od=0.45
    )
    vials = [vial.plant for vial in run.device.vials.values()]
    growth = [float(v.culture.draws["mu"][0]) for v in vials]
    flow = [float(v.feed.draws["pump_gain_ml_s"][0]) for v in vials]
    assert max(growth) / min(growth) > 1.15
    assert max(flow) / min(flow) > 1.3
    run.begin()
    errors: list[list[float]] = [[], [], []]
    for step in run.run():
        for n in np.flatnonzero(step.rows & (step.phase >= 0) & (step.elapsed % 25.0 > 15.0)):
            errors[n].append(abs(float(vials[n].culture.od[0] - step.setpoint[n])))
    run.close()
    assert all(len(mine) > 15 for mine in errors)
    assert max(float(np.mean(mine)) for mine in errors) < 0.01
