"""A run that learns from itself: the question, the judge, who flies, and what becomes of it when things go wrong."""

import json
import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from conf.schema import build
from dqn import policy as policies
from dqn.policy import Policy
from envs.coculture.pair import PairConfig
from envs.coculture.task import CocultureConfig
from envs.scenario import Scenario
from envs.task import EnvConfig
from experiments.cli import frame
from experiments.cli.calibrated import read_curves
from experiments.comparison import lesson
from experiments.control import assemble
from experiments.control.policies import FIRST, SHIPPED_COMPOSITION, composition_policy, flown, named
from experiments.control.question import Question, Relearn, Verdict
from experiments.control.relearn import Relearning
from experiments.deploy import main
from experiments.laws import registry
from experiments.laws.share.base import Estimate, Wanted
from experiments.laws.share.estimator import CompositionEstimator, CompositionEstimatorConfig
from experiments.laws.share.learned import one_line
from experiments.loop.loop import ClosedLoop, Step
from experiments.loop.share import program_of
from experiments.record.record import Record
from experiments.record.summary import composition_figure_of
from hardware import memory
from hardware.storage.journal import Journal, read_journal
from tests.patience import PATIENCE_S

pytestmark = pytest.mark.numeric

SHIPPED = SHIPPED_COMPOSITION["dqn_preview"]
BIAS_E, BIAS_P, GAIN, FACTOR, THERMOMETER = 4, 5, 6, 7, 9
WORDS = ("plant=coculture", "scenario=ratio_steps", "composition=dqn_preview", "fsync=false")
QUICK = Relearn(every_h=1.0, sd=0.5, moved=0.0, steps=1000, vials=32, hours=2.0, nice=0)


def estimator(errors: tuple[float, float] = (0.0, 0.0), sds: float = 0.004) -> CompositionEstimator:
    """One culture that has been watched for a while, and that is then believed to be of these curves."""
    one = CompositionEstimator(CompositionEstimatorConfig(factor_sd=0.02, offset_sd=5.0), 16.0)
    one.reset(1)
    warm, pair = np.array(33.2), PairConfig()
    pigment = float(pair.production(warm) / pair.rates(warm)[1]) * 0.25  # of as many cells of each
    for k in range(30):
        light = np.array([0.99 * (pigment + 75.0) + 214.0])
        one.watch(np.array([0.5]), light, np.array([33.2]), np.array([float(k)]), np.array([True]))
    one.mean[..., BIAS_E], one.mean[..., BIAS_P] = errors
    for k in (BIAS_E, BIAS_P):
        one.cov[..., k, :] = one.cov[..., :, k] = 0.0
        one.cov[..., k, k] = sds**2
    return one


def question(errors: tuple[float, float] = (0.0, 0.0), law: str = "dqn_preview", **plan: Any) -> Question:
    ratios, minutes = [0.5, 0.3, 0.7, 0.3], [60.0, 360.0, 600.0, 600.0]
    given = {"setpoints": [0.5] * 4, "minutes": minutes, "temperatures": [33.2] * 4, "ratios": ratios}
    schedule = asdict(build(Scenario(), given, "scenario"))
    one, relearn = estimator(errors), asdict(replace(QUICK, **plan))
    return Question(
        1, "M0", (0.0, 29.0), 29.0, errors, (0.004, 0.004), memory.save(one), asdict(one.config), asdict(PairConfig()),
        schedule, relearn, 16.0, (29.0, 36.0), law, FIRST,
    )  # fmt: skip


def claiming(scale_e: float) -> Policy:
    """The shipped policy, which says of itself that it was trained with another growth of the first species."""
    policy = policies.load(SHIPPED)
    model = {**policy.metadata["model"], "scale_e": scale_e}
    return replace(policy, metadata={**policy.metadata, "model": model})


# -- the question ------------------------------------------------------------------------------------------------------


def test_a_question_comes_back_from_its_file_as_the_culture_that_was_asked_about(tmp_path: Path) -> None:
    asked = question((-0.2, 0.05))
    (tmp_path / "001.json").write_text(asked.text())
    again = Question.read(tmp_path / "001.json")
    many, one = again.estimators(5), estimator((-0.2, 0.05))
    assert many.mean.shape[0] == 5
    for key in ("share", "ratio_low", "bias_e", "bias_p_sd", "pigment"):
        if key in one.explain():
            np.testing.assert_allclose(many.explain()[key], np.repeat(one.explain()[key], 5))
    np.testing.assert_allclose(many.volumes_ml, 16.0)
    assert again.hours == pytest.approx((29.0 / 60.0, 29.0 / 60.0 + 2.0))
    env, agent = again.task(policies.load(SHIPPED))
    assert (env.scale_e, env.scale_p, agent.total_steps) == (pytest.approx(0.8), pytest.approx(1.05), 1000)


def test_a_question_that_is_none_is_refused_with_its_file(tmp_path: Path) -> None:
    for content in ("", "{}", "[1]", '{"number": 1}', "\x00"):
        (tmp_path / "001.json").write_text(content)
        with pytest.raises(ValueError, match=r"001\.json.*RUN/policies"):
            Question.read(tmp_path / "001.json")
    done = lesson_of(tmp_path / "001.json")
    assert done.returncode == 1
    assert done.stderr.startswith("error: question")
    assert "Traceback" not in done.stderr


def lesson_of(file: Path, **more: Any) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "experiments.comparison.lesson", str(file)]
    return subprocess.run(command, check=False, capture_output=True, text=True, stdin=subprocess.DEVNULL, **more)


# -- the judge ---------------------------------------------------------------------------------------------------------


def test_the_vials_are_what_is_believed_of_the_culture() -> None:
    asked = question((-0.2, 0.1))
    believed = asked.estimators(3000)
    plant = lesson.vials(asked, believed, 5)
    mean, cov = believed.mean[0], believed.cov[0]
    weight = np.exp(believed.log_weight[0] - believed.log_weight[0].max())
    weight /= weight.sum()

    def expected(k: int) -> tuple[float, float]:
        middle = float(weight @ mean[:, k])
        return middle, float(np.sqrt(weight @ (cov[:, k, k] + (mean[:, k] - middle) ** 2)))

    light = plant.fluorescence
    assert light is not None
    drawn = {
        BIAS_E: plant.culture.species_factor[:, 0] - 1.0, BIAS_P: plant.culture.species_factor[:, 1] - 1.0,
        GAIN: plant.feed.gain_factor, FACTOR: light.draws["fluorescence_factor"], THERMOMETER: -plant.thermal.offset,
        0: np.log(plant.culture.share / (1.0 - plant.culture.share)), 1: np.log(plant.culture.od),
        2: np.log(light.pigment),
    }  # fmt: skip
    for k, found in drawn.items():
        middle, sd = expected(k)
        assert found.mean() == pytest.approx(middle, abs=4.0 * sd / 3000**0.5), k
        assert found.std() == pytest.approx(sd, rel=0.1), k
    np.testing.assert_allclose(plant.thermal.read(), 33.2)
    np.testing.assert_allclose(plant.thermal.target, 33.2)
    np.testing.assert_allclose(plant.vessel.volume_ml, 16.0)


def test_species_grow_by_their_own_factors() -> None:
    asked = question((-0.2, 0.1))
    plant = lesson.vials(asked, asked.estimators(8), 1)
    pair, factor = PairConfig(), plant.culture.species_factor
    true = plant.thermal.temperature
    np.testing.assert_allclose(60.0 * plant.culture.rates(plant.age_min), pair.rates(true) * factor, rtol=1e-6)


def test_a_verdict_by_hand() -> None:
    old, new = [0.05, 0.06, 0.04, 0.05], [0.04, 0.05, 0.03, 0.05]
    verdict = Verdict({"old": old, "new": new, "midpoint": [0.05] * 4}, 3.0)
    assert verdict.less("new", "old") == (pytest.approx(-0.0075), pytest.approx(1.96 * 0.005 / 2.0))
    assert verdict.flies
    assert verdict.row()["errors"] == pytest.approx({"old": 0.05, "new": 0.0425, "midpoint": 0.05})
    unsure = Verdict({"old": old, "new": [0.04, 0.07, 0.03, 0.05]}, 3.0)
    assert not unsure.flies
    assert "not surely better" in unsure.why
    law = Verdict({"old": old, "new": new, "midpoint": [0.039, 0.049, 0.031, 0.04]}, 3.0)
    assert (law.best, law.flies, law.row()["law"]) == ("midpoint", True, "midpoint")
    assert law.row()["difference"] == pytest.approx(-0.01025)
    assert law.why.startswith("midpoint less old -0.01")
    spread = Verdict(
        {"old": old, "new": new, "midpoint": [0.01, 0.09, 0.01, 0.01]}, 3.0
    )  # lower in the mean, not surely
    assert (spread.best, spread.row()["law"]) == ("new", "new")


def test_a_policy_for_other_curves_does_not_fly_and_one_for_these_does() -> None:
    asked = question((-0.2, 0.0), vials=32, hours=12.0)
    right, wrong = policies.load(SHIPPED), claiming(0.6)  # as if E. coli grew by 20 % more, where it grows by 20 % less
    said_no = Verdict(lesson.judged(asked, right, wrong), 0.0)
    assert said_no.best != "new"
    assert said_no.less("new", "old")[0] > 0.005
    errors = lesson.judged(asked, wrong, right)
    assert Verdict({law: errors[law] for law in ("old", "new")}, 0.0).best == "new"
    assert Verdict(lesson.judged(asked, right, right), 0.0).best != "new", "of two that are one, neither"


def test_a_law_in_force_is_what_the_next_policy_is_compared_with() -> None:
    asked = question((-0.2, 0.0), vials=32, hours=5.0)
    policy = policies.load(SHIPPED)
    law = replace(policy, metadata={**policy.metadata, "learned": {"law": "midpoint"}})
    errors = lesson.judged(asked, law, policy)
    assert errors["old"] == errors["midpoint"]
    assert errors["new"] != errors["midpoint"]


def test_the_thermostat_of_the_judge_keeps_the_run_s_limits(monkeypatch: pytest.MonkeyPatch) -> None:
    seen = []
    run_share = lesson.run_share
    monkeypatch.setattr(lesson, "run_share", lambda *given: (seen.append(run_share(*given)), seen[-1])[1])
    asked = replace(question((0.1, 0.0), hours=7.0), limits=(31.5, 34.0))
    lesson.judged(asked, policies.load(SHIPPED), policies.load(SHIPPED))
    (run,) = seen
    settled = run["temperature"][:, 60:]
    assert settled.min() > 31.5 - 1.0
    assert settled.max() < 34.0 + 1.0
    assert run["share"].shape == (3 * 32, 7 * 60 + 1)
    np.testing.assert_array_equal(run["share"][:32], run["share"][32:64], "the same policy, the same luck")


def test_vials_go_on_where_a_culture_is_that_has_just_changed_its_temperature() -> None:
    """An estimate from minutes after 36 degC: its band holds the shares of vials that are drawn from it."""
    asked = question((-0.1, 0.05), vials=200, hours=4.0)
    one = estimator((-0.1, 0.05))
    for k in range(30, 100):
        light = np.array([np.nan])
        temperature = np.array([36.0 if k < 85 else 29.5])
        one.watch(np.array([0.5]), light, temperature, np.array([float(k)]), np.array([True]))
    asked = replace(asked, believed=memory.save(one), elapsed_min=99.0)
    believed = asked.estimators(200)
    plant = lesson.vials(asked, believed, 3)
    pair, law = PairConfig(), registry.build(registry.config("midpoint", "share"), "share")
    law.reset(200)
    density = registry.build(registry.config("inverse"), model=EnvConfig(tau=16.0 / 60.0))
    program = program_of(asked.scenario)
    m_p = 60.0 * plant.culture.rates(plant.age_min)[:, 1]
    assert m_p.mean() == pytest.approx(one.estimate().rate[0], rel=0.01)
    assert m_p.mean() < 0.92 * pair.rates(29.5)[1], "it lags"
    phases = np.full(4, 0.5), np.full(4, 33.2)
    run = lesson.run_share(plant, believed, law, density, program, *phases, 360.0, asked.hours)
    for k in (1, 60, 120, 239):
        held = (run["low"][:, k] <= run["share"][:, k]) & (run["share"][:, k] <= run["high"][:, k])
        assert held.mean() > 0.85, k
        assert abs((run["estimate"][:, k] - run["share"][:, k]).mean()) < 0.01, k


def test_what_is_compared_is_the_program_that_is_still_to_come(monkeypatch: pytest.MonkeyPatch) -> None:
    seen = []
    run_share = lesson.run_share
    monkeypatch.setattr(lesson, "run_share", lambda *given: (seen.append(run_share(*given)), seen[-1])[1])
    shipped, asked = policies.load(SHIPPED), question()
    schedule = {**asked.schedule, "setpoints": [0.3, 0.4, 0.5, 0.6]}
    asked = replace(asked, elapsed_min=1000.0, schedule=schedule)  # twenty minutes before the last change
    assert asked.hours == pytest.approx((1000.0 / 60.0, 1000.0 / 60.0 + 2.0))
    found = lesson.judged(asked, shipped, shipped)
    (run,) = seen
    wanted = np.where(np.arange(1000, 1121) < 1020, 0.7, 0.3)
    np.testing.assert_allclose(
        np.abs(run["share"] - wanted).mean(axis=1), np.concatenate(list(found.values())), rtol=1e-6
    )
    assert run["od"][:, 100:].mean() == pytest.approx(0.6, abs=0.02)
    assert replace(asked, elapsed_min=1590.0).hours == pytest.approx((26.5, 27.0))


def test_the_policy_in_force_is_the_one_that_is_named(tmp_path: Path) -> None:
    (tmp_path / "policies").mkdir()
    policies.save(tmp_path / FIRST, policies.load(SHIPPED))
    (tmp_path / "policies" / "009.json").write_text(replace(question(), in_force=named(7)).text())
    done = lesson_of(tmp_path / "policies" / "009.json")
    assert done.returncode == 1
    assert "007.npz: no such file" in done.stderr


def test_each_training_of_a_run_has_a_seed_of_its_own_and_its_answer_says_which_policy_erred_how(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The third one of a plan with seed 20, of which 1000 steps were asked; one that was cut is resumed."""
    asked, shipped = replace(question((-0.2, 0.05), seed=20), number=3), policies.load(SHIPPED)
    trained, resumed = [], []

    def train(setup: Any, folder: Path) -> None:
        trained.append((setup.seed, setup.env, setup.agent.total_steps, setup.eval_every, folder.name))
        resumed.append(setup.resume)
        policies.save(folder / "policy.npz", replace(shipped, metadata={**shipped.metadata, "regret_pct": 4.5}))

    errors = {"old": [0.05, 0.06], "new": [0.03, 0.02], "midpoint": [0.04, 0.04]}
    compared = []
    monkeypatch.setattr(lesson, "train", train)
    monkeypatch.setattr(lesson, "judged", lambda *given: (compared.append(given[1:]), errors)[1])
    (tmp_path / "policies").mkdir()
    policies.save(tmp_path / FIRST, shipped)
    path = tmp_path / "policies" / "003.json"
    path.write_text(asked.text())
    lesson.answer(path)
    env, _ = asked.task(shipped)
    assert (trained, resumed) == ([(23, env, 1000, 25, "003")], [None])
    written = json.loads((tmp_path / "policies" / "003" / "verdict.json").read_text())
    assert written == {"errors": errors, "regret_pct": 4.5}
    [(old, new)] = compared
    assert (old.metadata.get("regret_pct"), new.metadata["regret_pct"]) == (shipped.metadata.get("regret_pct"), 4.5)
    (path.with_suffix("") / "checkpoint.pt").touch()
    lesson.answer(path)
    assert resumed[1] == str(path.with_suffix(""))


def test_vials_of_another_seed_are_others_and_those_of_several_laws_are_the_same_for_each() -> None:
    asked = question((-0.2, 0.1))
    one, again, other = (lesson.vials(asked, asked.estimators(4), seed, 2) for seed in (5, 5, 6))
    for read in (
        lambda plant: plant.culture.od,
        lambda plant: plant.feed.gain_factor,
        lambda plant: plant.culture.share,
    ):
        np.testing.assert_array_equal(read(one), read(again))
        np.testing.assert_array_equal(read(one)[:4], read(one)[4:])
        assert (read(one) != read(other)).all()
        assert len(set(read(one)[:4])) == 4


def test_curves_on_which_the_starts_disagree_are_not_known() -> None:
    one = estimator(sds=0.001)
    one.mean[0, :, BIAS_E] = np.linspace(-0.1, 0.1, one.mean.shape[1])
    one.log_weight[:] = 0.0
    errors, sds = one.growth_errors()
    assert errors[0] == pytest.approx([0.0, 0.0])
    assert sds[0] == pytest.approx([np.linspace(-0.1, 0.1, 5).std(), 0.001], rel=1e-3)


# -- the law -----------------------------------------------------------------------------------------------------------


def test_each_culture_follows_its_own_policy_and_is_shown_what_that_does_not_know() -> None:
    law = registry.build(registry.config("dqn_preview", "share"), "share", policy=policies.load(SHIPPED))
    law.reset(3)
    own = claiming(0.8)
    law.follow(2, 4, own)
    assert law.number.tolist() == [0, 0, 4]
    x = np.zeros(3)
    errors = np.array([-0.2, 0.0, -0.2])
    estimate = Estimate(x, x + 0.1, x + 33.2, x + 0.9, errors, x, x)
    wanted = Wanted(x + 0.55, x + 0.7, x + 300.0)
    chosen = law.act(estimate, wanted, x, np.ones(3, dtype=bool))
    growth = PairConfig().rates(law._even_c)[0]

    def by_hand(policy: Policy, beyond: float) -> float:
        logit = [np.log(s / (1.0 - s)) for s in (0.55, 0.7)]
        return float(policy.chosen(np.array([[0.0, 33.2, 0.9 - beyond * growth, *logit, 300.0]]))[0])

    assert chosen == pytest.approx([by_hand(law.policy, -0.2), by_hand(law.policy, 0.0), by_hand(own, 0.0)])
    wanted = Wanted(x + 0.55, x + 0.7, x + 295.0)
    later = law.act(estimate, wanted, x + 5.0, np.array([False, False, True]))
    logit = [np.log(s / (1.0 - s)) for s in (0.55, 0.7)]
    assert later[:2] == pytest.approx(chosen[:2])
    assert later[2] == pytest.approx(own.chosen(np.array([[0.0, 33.2, 0.9, *logit, 295.0]]))[0])
    slower = replace(own, metadata={**own.metadata, "model": {**own.metadata["model"], "control_min": 20.0}})
    with pytest.raises(ValueError, match=r"control_min = 20.*30"):
        law.follow(1, 5, slower)


def test_where_midpoint_was_better_it_decides_for_that_culture_also_after_a_resume() -> None:
    """A change from .3 to .7 in 6 h, by hand: midpoint begins with full authority at half the way, and goes on."""
    policy = policies.load(SHIPPED)
    beaten = replace(claiming(0.8), metadata={**claiming(0.8).metadata, "learned": {"law": "midpoint"}})
    law = registry.build(registry.config("dqn_preview", "share"), "share", policy=policy)
    alone = registry.build(registry.config("midpoint", "share"), "share")
    law.reset(3)
    alone.reset(3)
    law.follow(1, 2, beaten)
    for minute in np.arange(0.0, 361.0, 5.0):
        x, rows = np.zeros(3), np.ones(3, dtype=bool)
        reached = np.log(0.3 / 0.7) + 0.02 * max(minute - 260.0, 0.0)  # faster than thought, once it has begun
        estimate = Estimate(x + reached, x + 0.1, x + 33.2, x + 0.9, x - 0.1, x, x + 0.2)
        wanted = Wanted(x + 0.3, x + 0.7, x + 360.0 - minute)
        chosen = law.act(estimate, wanted, x + minute, rows)
        expected = alone.act(estimate, wanted, x + minute, rows)
        assert chosen[1] == expected[1]
        assert chosen[0] == chosen[2]
        if minute == 300.0:  # begun, and told anew by a resumed run
            kept, law = (
                memory.save(law),
                registry.build(registry.config("dqn_preview", "share"), "share", policy=policy),
            )
            law.reset(3)
            memory.restore(law, kept, memory.words("law"))
            law.follow(1, 2, beaten)
    assert kept["one_line"]["towards"][1] == 0.7
    assert kept["one_line"]["towards"][0] is None


def test_of_each_culture_the_growth_is_corrected_by_what_its_own_policy_does_not_know(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """E. coli grows by 20 % less than its curve: for policies that know of 0, 20 and 30 % the rest is -0.2, 0, 0.1."""
    shown = {}

    def chosen(policy: Policy, observation: np.ndarray) -> np.ndarray:
        shown[policy.metadata["model"].get("scale_e", 1.0)] = observation[:, 2].copy()
        return np.full(len(observation), 33.0)

    monkeypatch.setattr(Policy, "chosen", chosen)
    law = registry.build(registry.config("dqn_preview", "share"), "share", policy=policies.load(SHIPPED))
    law.reset(5)
    law.follow(1, 4, claiming(0.8))
    law.follow(4, 9, claiming(0.7))
    x, rate = np.zeros(5), np.array([0.9, 0.8, 0.7, 0.6, 0.5])
    estimate = Estimate(x, x + 33.2, x + 33.2, rate, x - 0.2, x, x)
    law.act(estimate, Wanted(x + 0.5, x + 0.5, x), x, np.array([True, True, True, False, True]))
    growth = 0.07727 * law._even_c - 1.66954  # of E. coli, 1/h
    assert shown == {
        1.0: pytest.approx([0.9 + 0.2 * growth, 0.7 + 0.2 * growth], rel=1e-3),
        0.8: pytest.approx([0.8], rel=1e-3),
        0.7: pytest.approx([0.5 - 0.1 * growth], rel=1e-3),
    }


# -- the run -----------------------------------------------------------------------------------------------------------


class Flight:
    """A simulated run that may learn: real loop, real record, real process of a training."""

    def __init__(self, folder: Path, plan: Relearn, *words: str) -> None:
        self.folder, self.plan = folder, plan
        folder.mkdir(exist_ok=True)
        config = main.config([*WORDS, *words])
        frame.save_config(config, folder)
        self.setup = assemble.unpack(assemble.completed(config), folder)
        self.told: list[tuple[str, str, str]] = []
        self.now = 0.0

    @contextmanager
    def life(self) -> Iterator[tuple[ClosedLoop, Relearning, Record]]:
        record = Record(self.folder, self.setup.backend.reactors, False, self.setup.columns)
        with assemble.opened(self.setup, record) as loop:
            learning = Relearning(
                self.plan, loop, record, (29.0, 36.0), lambda *said: self.told.append(said), lambda: self.now
            )
            try:
                yield loop, learning, record
            finally:
                learning.close()
                loop.reactors.stop()
                record.close()

    def rows(self, *kinds: str) -> list[dict[str, Any]]:
        return [row for row in read_journal(self.folder / "journal.jsonl")[0] if row["kind"] in kinds]


def go(loop: ClosedLoop, learning: Relearning, record: Record, minutes: float) -> Step:
    """The run goes on for some minutes of its own time."""
    until = loop.reactors.elapsed() / 60.0 + minutes
    while True:
        step = loop.step()
        record.done(step, loop.state())
        learning.take(step)
        if float(np.nanmax(step.minute)) >= until - 1e-6:
            return step


def finish(learning: Relearning, step: Step, at_most_s: float = PATIENCE_S) -> None:
    """The training under way, to its end."""
    until = time.monotonic() + at_most_s
    while learning._child is not None and time.monotonic() < until:
        time.sleep(0.05)
        learning._look()
    assert learning._child is None


@pytest.fixture(scope="module")
def learned(tmp_path_factory: pytest.TempPathFactory) -> Flight:
    """A run of two reactors, of which one has E. coli grow by 20 % less, and what both have learned once."""
    flight = Flight(tmp_path_factory.mktemp("learned") / "run", QUICK, "backend.reactors=[M0,M1]")
    with flight.life() as (loop, learning, record):
        loop.reactors.plant.culture.species_factor[0, 0] = 0.8  # type: ignore[attr-defined]
        step = go(loop, learning, record, 59.0)
        assert flight.rows("learn") == []
        step = go(loop, learning, record, 60.0)
        assert [row["reactor"] for row in flight.rows("learn")] == ["M0"], "one at a time"
        finish(learning, step)
        go(loop, learning, record, 2.0)
        flight.last = go(loop, learning, record, 1.0)  # type: ignore[attr-defined]
        flight.table, flight.rows_of_summary = record.table(), learning.learned  # type: ignore[attr-defined]
    return flight


def test_a_training_is_asked_for_and_judged_in_the_journal(learned: Flight) -> None:
    first, second = learned.rows("learn")
    assert (first["number"], second["number"], second["reactor"]) == (1, 2, "M1"), "who has waited longer"
    (row,) = learned.rows("judged")
    assert (row["number"], row["reactor"], row["vials"]) == (1, "M0", 32)
    assert set(row["errors"]) == {"old", "new", "midpoint"}
    verdict = json.loads((learned.folder / "policies" / "001" / "verdict.json").read_text())
    assert row["flies"] == Verdict(**verdict).flies
    asked = Question.read(learned.folder / "policies" / "001.json")
    assert list(asked.errors) == first["curves"]
    assert asked.in_force == FIRST
    assert list(asked.rests_on_min) == [0.0, first["minute"]]
    trained = policies.load(learned.folder / "policies" / "001" / "policy.npz")
    assert trained.metadata["model"]["scale_e"] == pytest.approx(1.0 + asked.errors[0])
    assert list((learned.folder / "policies" / "001").glob("events.*")), "TensorBoard shows the training"
    decisions = [row for row in learned.rows("decision") if row["reactor"] == "M0"]
    assert decisions[-1]["why"]["policy"] == (1 if row["flies"] else 0)
    assert decisions[0]["why"]["policy"] == 0


def judge(flight: Flight, number: int, flies: bool, law: float | None = None) -> None:
    """Put a verdict of one's own in place of what a training has left. Args: law: error of `midpoint`."""
    folder = flight.folder / "policies" / f"{number:03d}"
    folder.mkdir(exist_ok=True)
    new = [0.03 if flies else 0.06] * 7 + [0.031]
    errors = {"old": [0.05] * 8, "new": new} | ({} if law is None else {"midpoint": [law] * 7 + [law + 0.001]})
    (folder / "verdict.json").write_text(json.dumps({"errors": errors, "regret_pct": 3.0}))
    policies.save(folder / "policy.npz", claiming(0.9))


def begun(folder: Path, plan: Relearn = QUICK, *words: str) -> Flight:
    """A run whose first training has just been cut."""
    flight = Flight(folder, plan, *words)
    with flight.life() as (loop, learning, record):
        go(loop, learning, record, 62.0 + 60.0 * plan.every_h)
        assert learning._child is not None
        child = learning._child
        assert os.getsid(child.pid) == os.getsid(0), "Linux weighs sessions against each other, and nice within one"
        assert os.getpgid(child.pid) == child.pid, "Ctrl-C is not for it"
    assert child.poll() is not None, "no training outlives the run"
    assert flight.rows("judged") == []
    return flight


def test_a_better_policy_flies_with_its_origin_and_is_named_before_it_does(tmp_path: Path) -> None:
    flight = begun(tmp_path / "run")
    judge(flight, 1, flies=True)
    with flight.life() as (loop, learning, record):  # what had been found before the kill stands
        finish(learning, None)  # type: ignore[arg-type]
        assert flown(flight.rows("judged")) == {"M0": 1}
        assert learning._law.number.tolist() == [1]
        kept = policies.load(flight.folder / named(1))
        origin = kept.metadata["learned"]
        assert origin["errors"]["old"] == pytest.approx(0.05)
        assert set(origin) >= {"run", "reactor", "minute", "curves", "sds", "rests_on_min", "in_force", "why"}
        assert flight.told[0][0] == "policy"
        assert "flies from now on" in flight.told[0][1]
        (row,) = learning.learned
        other = {**row, "number": 2, "flies": False}
        figure = composition_figure_of(record.table(), flight.setup.scenarios, "P. putida", "", [row, other])
        assert [text.get_text().strip() for text in figure.axes[0].texts] == ["policy 001"]
        go(loop, learning, record, 1.0)
    with flight.life() as (_, learning, _):
        assert learning._law.number.tolist() == [1], "a later life goes on with it"
        assert [row["number"] for row in learning.learned] == [1]
    assert composition_policy("dqn_preview", str(flight.folder), tmp_path, False).metadata["learned"] == origin  # type: ignore[union-attr]
    (flight.folder / named(1)).unlink()
    with pytest.raises(frame.UserError, match=r"001\.npz.*in force by the journal"), flight.life():
        pass


def test_where_midpoint_is_better_than_both_it_flies_and_stays_over_a_resume(tmp_path: Path) -> None:
    flight = begun(tmp_path / "run")
    judge(flight, 1, flies=True, law=0.02)
    for _ in range(2):
        with flight.life() as (loop, learning, record):
            finish(learning, None)  # type: ignore[arg-type]
            assert learning._law.number.tolist() == [1]
            assert one_line(learning._law._policies[1])
            assert learning.learned[0]["law"] == "midpoint"
            go(loop, learning, record, 1.0)
    assert "flies as midpoint from now on: midpoint less old -0.0299" in flight.told[0][1]
    assert policies.load(flight.folder / named(1)).metadata["learned"]["law"] == "midpoint"


def test_two_reactors_that_differ_learn_each_its_own(tmp_path: Path) -> None:
    words = ("backend.reactors=[M0,M1]", "+bench.volumes_ml.M1=14", "scenario.recovery_od=0.6")
    flight = Flight(tmp_path / "run", QUICK, *words)
    with flight.life() as (loop, learning, record):
        learning._rests = np.inf
        step = go(loop, learning, record, 130.0)
        assert (step.elapsed < step.minute - 3.0).all(), "the schedule begins behind the recovery"
        learning._last_min[:], learning._rests = (60.0, 0.0), 0.0
        step = go(loop, learning, record, 1.0)
    asked = Question.read(flight.folder / "policies" / "001.json")
    assert (asked.reactor, asked.volume_ml, asked.in_force) == ("M1", 14.0, FIRST)
    assert asked.elapsed_min == pytest.approx(step.elapsed[1])
    assert asked.rests_on_min[1] == pytest.approx(step.minute[1])
    judge(flight, 1, flies=True)
    with flight.life() as (loop, learning, record):
        assert learning._law.number.tolist() == [0, 1]
        assert flight.rows("judged")[0]["minute"] == pytest.approx(0.0, abs=0.1)
        learning._rests = np.inf
        go(loop, learning, record, 130.0)
        learning._last_min[:], learning._rests = (60.0, 0.0), 0.0
        go(loop, learning, record, 1.0)
        assert [row["number"] for row in flight.rows("learn")] == [1, 2]
        assert Question.read(flight.folder / "policies" / "002.json").in_force == named(1)
        learning.close()
        minute = loop.reactors.elapsed() / 60.0
        learning._judged(2, "M1", None, "by hand")
        assert flight.rows("judged")[-1]["minute"] == pytest.approx(minute)
        learning._last_min[:] = (minute, 0.0)
        go(loop, learning, record, 1.0)
        third = Question.read(flight.folder / "policies" / "003.json")
        assert (third.reactor, third.in_force) == ("M1", named(1)), "the second one did not fly"
    with pytest.raises(frame.UserError, match=r"composition_policy\.npz of M0, .*001\.npz of M1"):
        composition_policy("dqn_preview", str(flight.folder), tmp_path, False)


def test_the_policy_in_force_is_the_newest_that_flew_also_behind_a_long_journal(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    journal = Journal(tmp_path / "journal.jsonl", fsync=False)
    for number, name, flies in ((1, "M0", True), (2, "M1", True), (3, "M0", True), (4, "M0", False)):
        journal.append("learn", {"number": number, "reactor": name})
        journal.append("judged", {"number": number, "reactor": name, "flies": flies})
    for _ in range(20):
        journal.append("sample", {"pad": "x" * 100})
    journal.close()
    monkeypatch.setattr("hardware.storage.journal.TAIL", 500)
    again = Journal(tmp_path / "journal.jsonl", fsync=False)
    again.close()
    assert flown(again.rows) == {"M0": 3, "M1": 2}
    assert [row["number"] for row in again.rows if row["kind"] == "learn"] == [1, 2, 3, 4]


def test_a_resumed_run_goes_on_with_the_policy_it_began_with(tmp_path: Path) -> None:
    policies.save(tmp_path / "own.npz", claiming(0.8))
    (tmp_path / "run").mkdir()
    first = composition_policy("dqn_preview", str(tmp_path / "own.npz"), tmp_path / "run", False)
    (tmp_path / "own.npz").unlink()
    again = composition_policy("dqn_preview", str(tmp_path / "own.npz"), tmp_path / "run", True)
    assert first is not None
    assert again is not None
    assert again.metadata["model"] == first.metadata["model"] == claiming(0.8).metadata["model"]


def test_a_worse_policy_does_not_fly_and_the_run_does_not_ask_again_at_once(tmp_path: Path) -> None:
    flight = begun(tmp_path / "run", replace(QUICK, moved=0.02))
    judge(flight, 1, flies=False)
    with flight.life() as (loop, learning, record):
        finish(learning, None)  # type: ignore[arg-type]
        assert flown(flight.rows("judged")) == {}
        assert not (flight.folder / named(1)).exists()
        assert "not surely better" in flight.rows("judged")[0]["why"]
        assert flight.told == []
        go(loop, learning, record, 90.0)
        assert len(flight.rows("learn")) == 1


def test_a_training_that_fails_costs_the_run_nothing_and_says_why(tmp_path: Path) -> None:
    flight = begun(tmp_path / "run")
    (flight.folder / FIRST).write_bytes(b"nothing")
    with flight.life() as (loop, learning, record):
        finish(learning, None)  # type: ignore[arg-type]
        (row,) = flight.rows("judged")
        assert not row["flies"]
        assert re.search(r"failed, exit status 1: error: .*composition_policy\.npz", row["why"])
        assert [event for event, *_ in flight.told] == ["policy"], "somebody is told"
        assert not learning._trained.any(), "it is tried again"
        step = go(loop, learning, record, 62.0)
        learning._last_min -= 180.0
        assert learning._not_yet(0, step) == ""
    with flight.life() as (_, learning, _):
        assert not learning._trained.any()


def test_a_question_that_is_gone_after_a_kill_is_said_and_the_run_goes_on(tmp_path: Path) -> None:
    flight = begun(tmp_path / "run")
    (flight.folder / "policies" / "001.json").unlink()
    with flight.life() as (loop, learning, record):
        assert "could not begin" in flight.rows("judged")[0]["why"]
        go(loop, learning, record, 5.0)


def test_a_training_without_an_end_is_given_up(tmp_path: Path) -> None:
    flight = begun(tmp_path / "run", replace(QUICK, steps=5_000_000, limit_min=30.0))
    with flight.life() as (_, learning, _):
        child = learning._child
        assert child is not None
        flight.now += 29.0 * 60.0
        learning._look()
        assert learning._child is child
        os.kill(child.pid, signal.SIGSTOP)  # one that ends nothing by itself
        flight.now += 2.0 * 60.0
        for _ in range(3):
            learning._look()  # nobody waits for it
        flight.now += 11.0
        finish(learning, None)  # type: ignore[arg-type]
        assert child.returncode in (-signal.SIGTERM, -signal.SIGKILL)
        assert "given up after 30 min" in flight.rows("judged")[0]["why"]


def test_a_mistake_in_learning_does_not_end_the_run(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    flight = Flight(tmp_path / "run", QUICK)
    with flight.life() as (loop, learning, record):
        learning._trained = np.zeros((1, 3))  # a mistake
        go(loop, learning, record, 125.0)
        assert flight.rows("learn") == []
    assert [line for line in caplog.messages if "no training now (ValueError" in line]


def test_a_disk_that_refuses_the_question_is_asked_again_later(tmp_path: Path) -> None:
    flight = Flight(tmp_path / "run", QUICK)
    (flight.folder / "policies").write_text("in the way")
    with flight.life() as (loop, learning, record):
        go(loop, learning, record, 130.0)
        assert flight.rows("learn") == []
        (flight.folder / "policies").unlink()
        go(loop, learning, record, 3.0)
        assert flight.rows("learn") == [], "it rests"
        flight.now += 601.0
        go(loop, learning, record, 3.0)
        assert len(flight.rows("learn")) == 1


@pytest.mark.parametrize(
    ("plan", "said"),
    [
        ({"sd": 0.001}, "are known to"),
        ({"moved": 0.5}, "within 0.5 of"),
        ({"every_h": 5.0}, "less than 5 h ago"),
        ({}, ""),
    ],
)
def test_why_a_run_does_not_learn_yet(tmp_path: Path, plan: dict[str, float], said: str) -> None:
    flight = Flight(tmp_path / "run", replace(QUICK, **plan))
    with flight.life() as (loop, learning, record):
        learning._rests = np.inf  # it begins none
        step = go(loop, learning, record, 150.0)
        learning.config = flight.plan
        assert said in learning._not_yet(0, step)
        assert bool(said) == bool(learning._not_yet(0, step))


def test_none_is_asked_of_an_estimate_of_some_time_ago_nor_for_hours_without_a_share(tmp_path: Path) -> None:
    flight = Flight(tmp_path / "run", QUICK, "scenario.ratios=[.5,.3,null,.3]")
    with flight.life() as (loop, learning, record):
        learning._rests = np.inf
        step = go(loop, learning, record, 100.0)
        assert learning._not_yet(0, step) == ""
        assert "not of now" in learning._not_yet(0, replace(step, minute=step.minute + 1.0))
        later = replace(step, elapsed=step.elapsed + 330.0)  # in the phase without a share
        assert "in less than 2 h" in learning._not_yet(0, later)


def test_who_has_waited_longest_is_asked_first_whoever_is_sampled(tmp_path: Path) -> None:
    flight = Flight(tmp_path / "run", QUICK, "backend.reactors=[M0,M1,M2]")
    with flight.life() as (loop, learning, record):
        learning._rests = np.inf
        step = go(loop, learning, record, 130.0)
        learning._last_min[:] = [60.0, 20.0, 40.0]
        for k, n in enumerate((0, 1, 2, 0, 2, 1)):  # sampled one after another
            learning._rests = np.inf if k < 3 else 0.0
            learning.take(replace(step, rows=np.arange(3) == n))
        assert [row["reactor"] for row in flight.rows("learn")] == ["M1"]


def test_a_run_that_learns_no_more_keeps_what_it_has_learned(tmp_path: Path) -> None:
    flight = begun(tmp_path / "run")
    judge(flight, 1, flies=True)
    with flight.life():
        pass
    flight.plan = Relearn()
    with flight.life() as (loop, learning, record):
        assert learning._law.number.tolist() == [1]
        go(loop, learning, record, 5.0)
        assert len(flight.rows("learn")) == 1


def test_a_run_begins_from_the_curves_of_its_first_policy(tmp_path: Path) -> None:
    policies.save(tmp_path / "own.npz", claiming(0.8))
    flight = Flight(tmp_path / "run", QUICK, f"composition_policy={tmp_path / 'own.npz'}")
    with flight.life() as (_, learning, _):
        np.testing.assert_allclose(learning._trained, [[-0.2, 0.0]])


def test_none_is_worth_it_shortly_before_the_end(tmp_path: Path) -> None:
    flight = Flight(tmp_path / "run", QUICK, "scenario.minutes=[60,30,60,60]")
    with flight.life() as (loop, learning, record):
        learning._rests = np.inf
        assert "in less than 2 h to come" in learning._not_yet(0, go(loop, learning, record, 100.0))


def test_a_training_ends_with_the_process_that_started_it(tmp_path: Path) -> None:
    folder = tmp_path / "policies"
    folder.mkdir()
    (folder / "001.json").write_text(question(steps=5_000_000).text())
    policies.save(tmp_path / FIRST, policies.load(SHIPPED))
    command = [sys.executable, "-m", "experiments.comparison.lesson", str(folder / "001.json"), "--until-eof"]
    child = subprocess.Popen(command, stdin=subprocess.PIPE, stderr=subprocess.DEVNULL)
    until = time.monotonic() + PATIENCE_S
    while not (folder / "001").is_dir() and time.monotonic() < until:
        time.sleep(0.05)
    assert child.poll() is None
    assert child.stdin is not None
    child.stdin.close()
    assert child.wait(PATIENCE_S) != 0


# -- the doors ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (("composition=midpoint",), "composition=midpoint, which follows no policy"),
        ((), "over in seconds"),
    ],
)
def test_a_run_that_cannot_learn_says_so(tmp_path: Path, words: tuple[str, ...], said: str) -> None:
    config = main.config([*WORDS, *words, "relearn.every_h=12"])
    with pytest.raises(frame.UserError, match=said):
        assemble.unpack(assemble.completed(config), tmp_path)


@pytest.mark.parametrize(
    ("words", "hours"),
    [
        ((), 12.0),  # 27 h
        (("relearn.every_h=0",), 0.0),
        (("relearn.every_h=5",), 5.0),
        (("composition=midpoint",), 0.0),
        (("composition=dqn",), 0.0),
        (("scenario.minutes=[60,360,600,420]",), 0.0),  # a day and no more
        (("scenario.minutes=[60,360,600,421]",), 12.0),
        (("backend.reactors=[M0,M1]", "scenario.minutes=[60,60,60,60]", "each.M1.minutes=[60,360,600,600]"), 12.0),
    ],
)
def test_a_run_of_more_than_a_day_that_foresees_its_program_learns_unless_told_otherwise(words, hours) -> None:
    words = (*WORDS[1:], "backend=emulator", *words)
    assert assemble.completed(main.config(list(words))).relearn.every_h == hours


def test_a_simulation_does_not_learn_by_itself() -> None:
    assert assemble.completed(main.config([*WORDS])).relearn.every_h == 0.0


def test_a_task_takes_the_curves_that_a_run_has_found(learned: Flight) -> None:
    with pytest.raises(frame.UserError, match=r"several reactors.*M0\.csv"):
        read_curves(str(learned.folder), CocultureConfig())
    newest = [row["why"] for row in learned.rows("decision") if row["reactor"] == "M0"][-1]
    env = read_curves(
        str(learned.folder / "recordings" / "M0.csv"), CocultureConfig(preview_min=360.0, control_min=30.0)
    )
    assert env.scale_e == pytest.approx(1.0 + newest["bias_e"])
    assert env.scale_p == pytest.approx(1.0 + newest["bias_p"])
    assert env.preview_min == 360.0
    with pytest.raises(frame.UserError, match="env_file"):
        read_curves(str(learned.folder / "recordings" / "M7.csv"), CocultureConfig())
    with pytest.raises(frame.UserError, match="env_file"):
        read_curves(str(learned.folder / "policies"), CocultureConfig())
