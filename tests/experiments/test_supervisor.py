"""The policy that ships under its supervisor: which law acts, what the journal and the console say of it."""

import logging
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
import pytest

from conf import presets
from conf.schema import build
from envs.plant.plant import Plant, PlantConfig
from envs.scenario import Scenario
from envs.task import EnvConfig
from experiments.certification import certificate
from experiments.certification.bounds import EstimateBounds
from experiments.control.policies import find_policy, load_policy
from experiments.laws import registry
from experiments.laws.density.estimator import LOG_OD, MU, Estimator, EstimatorConfig
from experiments.laws.density.inverse import Inverse, InverseConfig
from experiments.laws.density.learned import LearnedConfig, RelativeController, settings
from experiments.loop.loop import ClosedLoop
from experiments.loop.messages import FilterAlarm
from experiments.record.messages import SupervisorActs
from experiments.record.summary import ChangeLog
from hardware.emulator.device import DeviceOptions, plant_preset
from hardware.safety.interlock import Interlock, kinds_of
from hardware.simulated import SimulatedConfig, SimulatedReactors
from hardware.storage.journal import read_journal
from tests.campaigns.rehearsal import Rehearsal, rehearsed
from tests.hardware.script import logged

MODEL = EnvConfig(mu=0.025, tau=1 / 3)
SHIPPED = find_policy("shipped")
POLICY = load_policy("shipped", 1.0, 0.02)
BOUNDS = certificate.bounds(POLICY, settings(POLICY), SHIPPED, MODEL)
BLIND = EstimatorConfig(
    noise_floor=1e-4, noise_relative=0.0, noise_memory=0.0, gate_max=20, gate_od=0.0, pulse_cv=0.0, growth_cv=0.0
)
"""It takes its model for exact and every reading for exact, so that it leaves most readings out."""


def supervised(n: int = 3) -> RelativeController:
    made = RelativeController(POLICY, EstimatorConfig(), MODEL, BOUNDS)
    made.reset(n)
    return made


def in_doubt(law: RelativeController, row: int, sd_od: float) -> None:
    """The OD of a row is known only within sd_od."""
    law.estimator.cov[row, LOG_OD, :] = law.estimator.cov[row, :, LOG_OD] = 0.0
    law.estimator.cov[row, LOG_OD, LOG_OD] = sd_od**2


def test_inside_the_bounds_the_policy_acts_outside_the_law_on_a_second_filter() -> None:
    """Row 1 is in doubt. There acts what `inverse` with its default settings decides of the same readings and doses."""
    assert BOUNDS is not None
    law, other, n = supervised(), Inverse(InverseConfig(), MODEL), 3
    other.reset(n)
    rows, setpoint = np.ones(n, dtype=bool), np.full(n, 0.5)

    def shown(od: float, minute: float) -> tuple[np.ndarray, np.ndarray]:
        given = np.full(n, od), setpoint, np.full(n, minute), rows
        decided = law.act(*given), other.act(*given)
        for each in (law, other):
            each.dosed(np.full(n, 0.5))
        return decided

    for minute in range(30):
        shown(0.5, float(minute))
    assert not law.explain()["supervised"].any()
    for k, od in enumerate((0.51, 0.5, 0.49, 0.47, 0.6)):
        in_doubt(law, 1, 1e3)
        law.estimator.config = EstimatorConfig(noise_floor=0.1, noise_relative=0.1)  # nothing is learned of a reading
        law.estimator._noise[1] = 1e6
        rate, by_inverse = shown(od, 30.0 + k)
        said = law.explain()
        np.testing.assert_array_equal(said["supervised"], [0.0, 1.0, 0.0])
        np.testing.assert_array_equal(said["alarm"], np.zeros(n))
        assert rate[1] == pytest.approx(by_inverse[1], rel=1e-9)
        observation = np.stack([said["error"], said["growth_share"]], axis=1)
        of_policy = 0.02 * POLICY.actions[POLICY.q_values(observation).argmax(axis=1)]
        np.testing.assert_allclose(rate[[0, 2]], of_policy[[0, 2]])


@pytest.mark.parametrize("od", [0.5, 0.25, 0.9])
@pytest.mark.parametrize("over", [1.0, 2.0, 0.8])
def test_the_bound_is_that_of_the_certificate_at_the_od_that_is_estimated(od: float, over: float) -> None:
    """0.04 OD, as ln(1 + 0.04 / OD): twice the filter's own sd may reach it and not pass it, whatever the setpoint."""
    assert BOUNDS is not None
    assert BOUNDS.od == 0.04
    law, setpoint = supervised(1), np.array([od / over])
    for minute in range(30):
        law.act(np.array([od]), setpoint, np.array([float(minute)]), np.ones(1, dtype=bool))
        law.dosed(np.array([0.5]))
    assert law.explain()["od_estimate"][0] == pytest.approx(od, rel=2e-3)
    allowed = np.log1p(0.04 / od)
    observation = np.stack(law.estimator.relative(setpoint), axis=1)
    for share, outside in ((0.96, False), (1.04, True)):
        in_doubt(law, 0, 0.5 * share * allowed * float(law.estimator.full_pump[0]) / BOUNDS.full_pump)
        assert law._outside(setpoint, observation).tolist() == [outside]


@pytest.mark.parametrize(
    ("share", "doubt", "outside"),
    [
        (0.5, 0.09, False), (0.5, 0.11, True), (0.25, 0.09, False),
        (0.15, 0.0, False),  # the policy is shown 0.2, which is off by 0.05
        (0.05, 0.0, True),  # and here by 0.15
        (0.15, 0.06, True),  # it may be 0.09
        (0.95, 0.0, False),  # nothing above 0.9 can be: the pump would not hold it
        (0.95, 0.12, False),  # so it is 0.83 to 0.9
        (0.95, 0.2, True), (0.88, 0.15, True),  # 0.75 to 0.9, shown as 0.9
    ],
)  # fmt: skip
def test_the_share_that_is_shown_may_be_off_by_as_much_as_was_proven(share: float, doubt: float, outside: bool) -> None:
    """By 0.1 here, between 0.2 and 0.9; a share is 0 at least and 0.9 at most."""
    assert BOUNDS is not None
    for proven, last, beyond in (((0.2, 0.9), share, outside), ((0.05, 0.9), 0.0, doubt > 0.15)):
        bounds = replace(BOUNDS, proven=proven, growth_share=0.1)
        law = RelativeController(POLICY, EstimatorConfig(), MODEL, bounds)
        law.reset(2)
        law.estimator.cov[:] = 0.0
        law.estimator.cov[1, MU, MU] = (0.5 * doubt * float(law.estimator.full_pump[1]) / MODEL.control_min) ** 2
        observation = np.array([[0.0, 0.5], [0.0, last]])
        assert law._outside(np.full(2, 0.5), observation).tolist() == [False, beyond]


def test_the_journal_is_told_of_each_vial_what_its_policy_saw_and_how_sure_that_was() -> None:
    """After one reading e = ln(x / r) / 0.06 and s = 0.025 / 0.06 by the model; one that has none keeps its last."""
    law = supervised(3)
    od, setpoint = np.array([0.52, 0.3, np.nan]), np.array([0.5, 0.4, 0.5])
    in_doubt(law, 1, 0.3)
    law.act(od, setpoint, np.zeros(3), np.ones(3, dtype=bool))
    told = law.explain()
    np.testing.assert_allclose(told["error"], [np.log(1.04) / 0.06, np.log(0.75) / 0.06, np.nan], rtol=1e-6)
    np.testing.assert_allclose(told["growth_share"], [0.025 / 0.06, 0.025 / 0.06, np.nan], rtol=1e-6)
    error_sd, share_sd = law.estimator.sd(setpoint)
    np.testing.assert_allclose(told["error_sd"][:2], error_sd[:2])
    np.testing.assert_allclose(told["growth_share_sd"][:2], share_sd[:2])
    assert not np.isclose(error_sd[:2], share_sd[:2]).any()
    assert np.isnan([told["error_sd"][2], told["q_best"][2], told["q_lead"][2]]).all()


def test_a_filter_is_set_by_the_policy_s_file_then_by_the_command_and_the_second_one_by_nobody() -> None:
    """Bounds, model and policy are the run's own."""
    given = replace(POLICY, metadata={**POLICY.metadata, "estimator": {"gate_max": 9, "noise_memory": 7.0}})
    config = LearnedConfig(estimator={"gate_max": 3})
    made = registry.build(config, model=replace(MODEL, max_pump_rate=0.03), policy=given, bounds=BOUNDS)
    assert made.estimator.config == EstimatorConfig(gate_max=3, noise_memory=7.0)
    assert made.second.config == EstimatorConfig()
    assert made.estimator.model.max_pump_rate == made.second.model.max_pump_rate == 0.03
    assert (made.policy, made.bounds) == (given, BOUNDS)


def test_without_a_certificate_no_bounds_supervise_and_what_surprises_both_filters_is_a_note() -> None:
    law = RelativeController(POLICY, EstimatorConfig(), MODEL, None)
    law.reset(1)
    law.act(np.array([0.5]), np.array([0.5]), np.zeros(1), np.ones(1, dtype=bool))
    in_doubt(law, 0, 1e3)
    law.act(np.array([np.nan]), np.array([0.5]), np.ones(1), np.ones(1, dtype=bool))
    assert law.explain()["supervised"].tolist() == [0.0]
    for minute, od in enumerate((0.5, 0.9) * 5, 2):  # the doubt is gone with the first of them
        law.act(np.array([od]), np.array([0.5]), np.array([float(minute)]), np.ones(1, dtype=bool))
    assert law.estimator.loudness[0] > 36.0
    assert [law.explain()[key].tolist() for key in ("supervised", "alarm", "noted")] == [[0.0], [0.0], [1.0]]


def surprised(filter_: Estimator, squares: list[float]) -> None:
    """A filter of one row whose newest surprises, in units of their sd, had these squares."""
    filter_._squares[0, len(filter_._squares[0]) - len(squares) :] = squares


@pytest.mark.parametrize(
    ("first", "second", "alarm"),
    [
        ([0.8] * 40, [0.8] * 40, False),
        ([0.8] * 37 + [7.5] * 3, [0.8] * 40, True),  # 7 * 0.8 + 3 * 7.5 = 28.1 > 21
        ([7.5] * 3 + [0.8] * 37, [0.8] * 40, False),  # as large, and 37 readings ago
        ([0.8] * 30 + [2.0] * 10, [0.8] * 40, False),  # 20 < 21
        ([0.8] * 30 + [2.2] * 10, [0.8] * 40, True),
        ([0.1] * 40, [0.8] * 40, True),  # mean 0.1 < 6 / 40
        ([0.1] * 40, [0.1] * 40, False),  # the readings are as quiet to the second filter: so is the sensor
        ([0.2] * 40, [0.8] * 40, False),
        ([0.1] * 39, [0.8] * 40, False),  # not yet long
        ([0.8] * 40, [0.1] * 40, False),
        ([0.8] * 40, [9.0] * 40, False),  # what the second one thinks of itself alarms nobody
        ([9.0] * 40, [5.9] * 40, True),  # 90 > 1.5 * 59
        ([9.0] * 40, [6.1] * 40, False),  # readings that surprise both say nothing of the first
    ],
)
def test_surprises_that_do_not_fit_raise_the_alarm(first: list[float], second: list[float], alarm: bool) -> None:
    """And the law of the second filter decides, which knows another OD here; a missing reading changes nothing."""
    law, one = supervised(1), np.ones(1, dtype=bool)
    for minute in range(3):
        law.act(np.full(1, 0.5), np.full(1, 0.5), np.array([float(minute)]), one)
        law.dosed(np.full(1, 0.5))
    law.second.mean[0, LOG_OD] = np.log(0.52)
    for filter_, squares in ((law.estimator, first), (law.second, second)):
        filter_._squares[:] = np.nan
        surprised(filter_, squares)
    rate = law.act(np.full(1, 0.5), np.full(1, 0.5), np.full(1, 2.0), one)  # known already: no surprise in it
    said = law.explain()
    assert (said["alarm"][0], said["supervised"][0]) == (alarm, alarm)
    error, share = law.second.relative(np.full(1, 0.5))
    by_policy = 0.02 * POLICY.chosen(np.stack(law.estimator.relative(np.full(1, 0.5)), axis=1))
    by_law = 0.02 * np.clip(error + share, 0.0, 1.0)
    assert by_law[0] > by_policy[0] + 0.002
    assert rate == pytest.approx(by_law if alarm else by_policy, rel=1e-9)
    law.act(np.full(1, np.nan), np.full(1, 0.5), np.full(1, 3.0), one)
    assert law.explain()["alarm"][0] == alarm


@pytest.mark.parametrize("period", [1.0, 2.0, 5.0])
def test_the_law_of_the_supervisor_puts_the_next_sample_on_the_setpoint_whenever_that_is(period: float) -> None:
    """u = tau (mu + ln(x/r) / h): a dose of a minute every two would let the culture go."""
    law, one = RelativeController(POLICY, EstimatorConfig(), replace(MODEL, control_min=period), None), np.ones(1, bool)
    law.reset(1)
    for k in range(20):
        law.act(np.full(1, 0.5), np.full(1, 0.5), np.full(1, period * k), one)
        law.dosed(np.full(1, 20.0 * 0.025 * period))  # as much as grows
    surprised(law.estimator, [2.2] * 10)
    surprised(law.second, [0.8] * 10)
    law.second.mean[0, LOG_OD] = np.log(0.506)
    rate = law.act(np.full(1, 0.5), np.full(1, 0.5), np.full(1, period * 19), one)
    assert law.explain()["supervised"].tolist() == [1.0]
    assert rate[0] == pytest.approx((0.025 + np.log(0.506 / 0.5) / period) / 3.0, rel=1e-6)


def test_vials_are_judged_alone() -> None:
    """Both first filters are too quiet; the second one of row 1 is as well, so there the sensor is quiet."""
    law, both = supervised(2), np.ones(2, dtype=bool)
    law.act(np.full(2, 0.5), np.full(2, 0.5), np.zeros(2), both)
    law.estimator._squares[:] = 0.1
    law.second._squares[:] = [[0.8], [0.1]]
    law.act(np.full(2, 0.5), np.full(2, 0.5), np.zeros(2), both)
    np.testing.assert_array_equal(law.explain()["alarm"], [1.0, 0.0])


def watched(config: EstimatorConfig, bounds: EstimateBounds | None) -> tuple[np.ndarray, np.ndarray]:
    """Alarms and true |x - r| of 16 vials with a real sensor and pump through four setpoints, (decisions, vials)."""
    plant = Plant(build(PlantConfig(), presets.load("plant/nominal_noise"), "plant"), 16, np.random.default_rng(7))
    vials = SimulatedReactors(plant, SimulatedConfig(reactors=tuple(f"V{k}" for k in range(16))))
    law = RelativeController(POLICY, config, EnvConfig(), bounds)
    loop = ClosedLoop(vials, law, Interlock(16), Scenario((0.5, 0.8, 0.35, 0.6), (60.0,) * 4, (37.0,) * 4))
    alarms, off = [], []
    for _ in range(240):
        step = loop.step()
        assert step.rows.all()
        alarms.append(step.explanation["alarm"])
        off.append(np.abs(plant.culture.od - step.setpoint))
    return np.array(alarms), np.array(off)


@pytest.mark.slow
def test_a_filter_that_is_blind_is_found_out_and_costs_nothing() -> None:
    """It alarms as soon as its ten watched readings are there; its policy has no certificate and so no bounds."""
    assert certificate.bounds(POLICY, settings(POLICY, asdict(BLIND)), SHIPPED, EnvConfig()) is None
    sound, off_sound = watched(EstimatorConfig(), certificate.bounds(POLICY, settings(POLICY), SHIPPED, EnvConfig()))
    blind, off_blind = watched(BLIND, None)
    assert sound.mean() < 0.01
    assert blind[10:].mean() >= 0.99
    assert off_blind.mean() == pytest.approx(off_sound.mean(), rel=0.1)
    at_rest = np.arange(240) % 60 >= 30
    assert off_blind[at_rest].mean() == pytest.approx(off_sound[at_rest].mean(), rel=0.1)
    assert off_sound[at_rest].mean() < 0.005


def begun(folder: Path) -> tuple[Rehearsal, RelativeController, ChangeLog]:
    """Two reactors at 0.5 under the policy that ships, what decides there, and what the screen says."""
    run = Rehearsal(folder, rehearsed(("M0", "M1"), Scenario((0.5,), (600.0,), (37.0,))), od=0.5)
    run.begin()
    law = run.loop.density.law
    assert isinstance(law, RelativeController)
    return run, law, ChangeLog(run.loop)


def test_surprises_stand_in_the_row_and_the_screen_says_who_decides_alone(tmp_path, caplog):
    """Some readings of M0 are made surprising; its rows say so."""
    run, law, log_changes = begun(tmp_path)
    spoilt = 0
    with caplog.at_level(logging.INFO):
        for step in run.run(1500.0):
            log_changes(step)
            law.estimator._squares[0, -4:] = 9.0 if step.minute[0] > 15.0 and spoilt < 2 else 0.5
            spoilt += int(step.rows[0] and step.minute[0] > 15.0)
    run.close()
    rows = [row for row in read_journal(tmp_path / "journal.jsonl")[0] if row["kind"] == "decision"]
    alarmed = [
        (r["reactor"], r["row"]["interlock"]) for r in rows if FilterAlarm.kind in kinds_of(r["row"]["interlock"])
    ]
    assert {name for name, _ in alarmed} == {"M0"}
    assert len(alarmed) == sum(r["why"]["alarm"] for r in rows) >= 1
    assert FilterAlarm.kind not in caplog.text
    assert len(logged(caplog, SupervisorActs)) == 1


@pytest.mark.slow
def test_three_strains_on_three_pumps_are_held_without_a_calibration(tmp_path: Path) -> None:
    """True OD, from the emulator, against the setpoint in the last ten minutes of each phase."""
    schedule = Scenario((0.5, 0.4), (25.0, 25.0), (37.0, 37.0), recovery_od=0.45)
    run = Rehearsal(
        tmp_path, rehearsed(("M0", "M1", "M2"), schedule), DeviceOptions(plant=plant_preset("mixed")), od=0.45
    )
    vials = [vial.plant for vial in run.device.vials.values()]
    growth = [float(v.draws["mu"][0]) for v in vials]
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
