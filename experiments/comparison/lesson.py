"""A policy trained on the curves that a run has found, and whether it is better there.

A deployment starts `python -m experiments.comparison.lesson RUN/policies/001.json` as a process of its own
(`experiments/control/relearn.py`). Beside that question it leaves a training run in RUN/policies/001, and in there
verdict.json, which is written last.
"""

import argparse
import json
import logging
import os
import resource
import sys
import threading
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from conf.presets import load
from conf.schema import build
from dqn import policy as policies
from dqn.policy import Policy
from envs.coculture.task import share
from envs.growth import REFERENCE_TEMPERATURE
from envs.plant.plant import Plant, PlantConfig, of_pair
from envs.task import EnvConfig
from experiments.cli import frame
from experiments.comparison.trials import run_share
from experiments.control.question import Question, Verdict
from experiments.laws import registry
from experiments.laws.share import estimator as states
from experiments.laws.share.base import Array, Estimate, Law, Mask, Wanted
from experiments.laws.share.estimator import CompositionEstimator
from experiments.laws.share.learned import ONE_LINE
from experiments.loop.share import program_of
from experiments.training.config import TrainConfig
from experiments.training.run import train
from hardware.storage import atomic

__all__ = ["judged", "learned", "main", "vials"]

log = logging.getLogger(__name__)


def learned(question: Question, in_force: Policy, folder: Path) -> Policy:
    """The policy of a training on the curves of the question; one that was cut goes on where it was."""
    env, agent = question.task(in_force)
    resume = str(folder) if (folder / "checkpoint.pt").is_file() else None
    seed, every = question.plan.seed + question.number, max(agent.total_steps // 40, 1)
    train(TrainConfig(env, agent, seed=seed, eval_every=every, checkpoint_every=every, resume=resume), folder)
    return policies.load(folder / "policy.npz")


def drawn(believed: CompositionEstimator, rng: np.random.Generator) -> Array:
    """One state of each culture from what is believed of it, (N, 10)."""
    n, starts, size = believed.mean.shape
    weight = np.exp(believed.log_weight - believed.log_weight.max(axis=1, keepdims=True))
    which = (rng.random((n, 1)) > np.cumsum(weight / weight.sum(axis=1, keepdims=True), axis=1)).sum(axis=1)
    rows = np.arange(n), np.minimum(which, starts - 1)
    value, vector = np.linalg.eigh(believed.cov[rows])
    spread = vector * np.sqrt(np.maximum(value, 0.0))[:, None, :]
    return np.asarray(believed.mean[rows] + np.einsum("nij,nj->ni", spread, rng.standard_normal((n, size))))


def vials(question: Question, believed: CompositionEstimator, seed: int, times: int = 1) -> Plant:
    """Vials that are what is believed of one: growth and what lags, flow, sensors, doses, share, density and light.

    Args: believed: of as many cultures. times: so often each, with the same luck, one behind all others.
    """
    n = len(believed.mean)
    z = np.tile(drawn(believed, np.random.default_rng([seed, 2])), (times, 1))
    luck = [np.random.default_rng([seed, 3, k]) for _ in range(times) for k in range(n)]
    usual, c = of_pair(build(PlantConfig(), load("plant/coculture"), "plant"), question.curves), believed.config
    pump = replace(usual.pump, dosing="pulse", pulse_cv=float(believed.explain()["dose_spread"][0]))
    seen = replace(usual.fluorescence, od_term=c.od_term, noise_sd=c.fluorescence_sd)
    real = replace(usual, pump=pump, fluorescence=seen, sensor=replace(usual.sensor, noise_floor=c.od_sd))
    plant = Plant(real, len(z), luck, question.volume_ml)
    plant.culture.species_factor[:] = np.maximum(1.0 + z[:, states.BIAS_E : states.GAIN], 0.1)
    plant.feed.gain_factor[:] = np.maximum(z[:, states.GAIN], 0.1)
    light = plant.fluorescence
    assert light is not None
    light.draws["fluorescence_factor"][:] = np.maximum(z[:, states.FACTOR], 0.05)
    light.draws["fluorescence_offset"][:] = z[:, states.OFFSET]
    plant.thermal.offset[:] = -z[:, states.THERMOMETER]
    plant.reset(np.exp(z[:, states.LOG_OD]), np.tile(believed.measured, times), share(z[:, states.LOGIT]))
    many = believed.of(np.tile(np.arange(n), times))
    rates, made, past = many.lagging(z[:, states.THERMOMETER])
    plant.culture.adapted_to(rates / question.curves.rates(REFERENCE_TEMPERATURE))
    light.stand(np.exp(z[:, states.LOG_F]), made * np.exp(z[:, states.LOG_Q]), past.T)
    return plant


class SideBySide:
    """Several laws of the share, each for as many cultures, one behind the other."""

    def __init__(self, laws: Sequence[Law], n: int) -> None:
        self.laws, self._own = laws, [np.arange(k * n, (k + 1) * n) for k in range(len(laws))]
        for law in laws:
            law.reset(n)

    def act(self, estimate: Estimate, wanted: Wanted, minute: Array, rows: Mask) -> Array:
        """See `Law.act`."""
        asked = [Wanted(wanted.setpoint[i], wanted.following[i], wanted.minutes[i]) for i in self._own]
        each = zip(self.laws, self._own, asked, strict=True)
        return np.concatenate([law.act(estimate.of(i), own, minute[i], rows[i]) for law, i, own in each])


def judged(question: Question, old: Policy, new: Policy) -> dict[str, list[float]]:
    """Mean |true share - setpoint| on every vial: of both policies, and of the best law without one."""
    plan, scenario, curves = question.plan, question.scenario, question.curves
    limits = (question.limits[0], question.limits[1])
    program, model = program_of(scenario), EnvConfig(tau=question.volume_ml / 60.0)
    followed: Mapping[str, tuple[str, Policy | None]] = {
        "old": (question.law, old), "new": (question.law, new), ONE_LINE: (ONE_LINE, None)
    }  # fmt: skip
    laws = SideBySide(
        [
            registry.build(registry.config(kind, registry.SHARE), registry.SHARE, policy=policy, pair=curves)
            for kind, policy in followed.values()
        ],
        plan.vials,
    )
    n = plan.vials * len(followed)
    plant = vials(question, question.estimators(plan.vials), plan.seed + question.number, len(followed))
    density = registry.build(registry.config("inverse"), model=model)
    phases = np.asarray(scenario.setpoints), np.asarray(scenario.temperatures, dtype=np.float64)
    announced = scenario.announce_min
    run = run_share(plant, question.estimators(n), laws, density, program, *phases, announced, question.hours, limits)
    asked = program.setpoint(round(60.0 * question.hours[0]) + np.arange(run["share"].shape[1], dtype=np.float64))
    error = np.nanmean(np.abs(run["share"].astype(np.float64) - asked), axis=1).reshape(len(followed), plan.vials)
    return {name: each.tolist() for name, each in zip(followed, error, strict=True)}


def answer(path: Path) -> Verdict:
    """Train, judge, and write down what came out. Raises: ValueError, UserError."""
    question, folder = Question.read(path), path.with_suffix("")
    folder.mkdir(exist_ok=True)
    old = policies.load(path.parents[1] / question.in_force)
    new = learned(question, old, folder)
    found = Verdict(judged(question, old, new), float(new.metadata["regret_pct"]))
    content = {"errors": found.errors, "regret_pct": found.regret_pct}
    atomic.write(folder / "verdict.json", json.dumps(content, indent=1, allow_nan=False))
    log.info("%s", found.why)
    return found


def _orphaned() -> None:
    while os.read(0, 4096):  # nothing, once the run is gone, however it went
        pass
    os._exit(1)


def main() -> int:
    """Entry point; ends with the process that holds its standard input."""
    parser = argparse.ArgumentParser(prog="python -m experiments.comparison.lesson", description=__doc__)
    parser.add_argument("question", type=Path, help="RUN/policies/001.json, as a deployment wrote it")
    parser.add_argument("--until-eof", action="store_true", help="end when standard input ends")
    given = parser.parse_args()
    logging.basicConfig(level=logging.INFO, format="%(asctime)s %(message)s")
    try:
        plan = Question.read(given.question).plan
        most = int(plan.memory_gib * 2**30)
        resource.setrlimit(resource.RLIMIT_DATA, (most, most))
        if given.until_eof:
            threading.Thread(target=_orphaned, daemon=True).start()
        answer(given.question)
    except (ValueError, OSError, MemoryError, frame.UserError, policies.PolicyError) as error:
        print(f"error: {str(error) or type(error).__name__}", file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        print("stopped", file=sys.stderr)
        return 130
    return 0


if __name__ == "__main__":
    sys.exit(main())
