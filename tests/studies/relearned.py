"""What learning during a run brings, in vials of another simulator: `python -m tests.studies.relearned`.

Each vial flies the shipped policy for a day. Then, by the code that a deployment runs, a policy is trained on what was
found of its growth, and judged; the second day is flown with the shipped policy, with the new one, and with the laws
that have none, on the same luck. `with learning` is the new one where the judge lets it fly, else the shipped one.
"""

import copy
import json
import logging
import os
import time
from concurrent.futures import as_completed
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from conf.schema import build, check, setting
from dqn import policy as policies
from dqn.policy import Policy
from envs.coculture.pair import PairConfig
from envs.scenario import Scenario
from experiments.cli import files
from experiments.cli.stop import Workers
from experiments.comparison import lesson
from experiments.control.policies import FIRST, SHIPPED_COMPOSITION
from experiments.control.question import Question, Relearn, Verdict
from experiments.laws import registry
from experiments.laws.share.base import Array, Estimate, Mask, Wanted
from experiments.laws.share.estimator import CompositionEstimator, CompositionEstimatorConfig
from experiments.laws.share.learned import ONE_LINE
from experiments.laws.share.recall import Recall
from hardware import memory
from tests.entry import command
from tests.studies import second_vials
from tests.studies.results import leave
from tests.studies.second_vials import PROGRAMS, Conditions, draw, nominal

__all__ = ["RelearnedConfig", "main", "relearned"]

log = logging.getLogger(__name__)

LAW, DAY_MIN = "dqn_preview", 1440
BESIDE = ("midpoint", "receding")
THAN = ("shipped", *BESIDE)
SPECIAL: dict[str, dict[str, Any]] = {
    "nominal": {},
    "mu_e x 0.8": {"scale_e": 0.8},
    "mu_e x 1.2": {"scale_e": 1.2},
    "mu_e x 0.9, mu_p x 1.1": {"scale_e": 0.9, "scale_p": 1.1},
    "another bottle after 30 h": {"bottle_swap": 30.0},
}


@dataclass(frozen=True)
class RelearnedConfig:
    """How many vials, and what a training is."""

    vials: int = setting(64, "whose growth and whose rig are drawn", within=(0, 1000))
    special: int = setting(2, "more in each row in which one thing is not as the pair says", within=(0, 64))
    steps: int = setting(Relearn.steps, "of each training", within=(1000, 1_000_000))
    hours: float = setting(24.0, "of the judge, and of the second day", "h", within=(2, 48))
    judgements: int = setting(
        200,
        "on vials of their own, of both policies of the first nominal vial: how often does the worse one fly?",
        within=(0, 10_000),
    )
    limit_min: float = setting(
        0.0, "no training begins later, rows are of what is trained by then; 0: none", "min", at_least=0
    )
    workers: int = setting(0, "processes; 0 for one per core", within=(0, 256))
    seed: int = setting(2, "of vials and noise", at_least=0)

    def __post_init__(self) -> None:
        check(self)


class Second:
    """One law for a day; then it is changed, or another one flies."""

    remembers: tuple[str, ...] = ()

    def __init__(self, first: Any, then: Any = None, learned: dict[int, Policy] | None = None) -> None:
        self.first, self.then, self.learned = first, then, dict(learned or {})

    def reset(self, n: int) -> None:
        """See `Law.reset`."""
        self.first.reset(n)
        if self.then is not None:
            self.then.reset(n)

    def act(self, estimate: Estimate, wanted: Wanted, minute: Array, rows: Mask) -> Array:
        """See `Law.act`."""
        if float(minute.max()) < DAY_MIN or self.then is None:
            while float(minute.max()) == DAY_MIN and self.learned:
                n, policy = self.learned.popitem()
                self.first.follow(n, n + 1, policy)
            return np.asarray(self.first.act(estimate, wanted, minute, rows))
        return np.asarray(self.then.act(estimate, wanted, minute, rows))


class Seen(Recall):
    """An estimator of which a copy is kept as it was after a day.

    known_h: since when both growth curves have been known well enough for a training, h, (N,); nan: not yet.
    """

    after_a_day: CompositionEstimator | None = None
    known_h: Array = np.empty(0)

    def watch(self, od: Array, fluorescence: Array, temperature: Array, minute: Array, rows: Mask) -> None:
        super().watch(od, fluorescence, temperature, minute, rows)
        doubt = self.estimator.growth_errors()[1].max(axis=1)
        before = self.known_h if self.known_h.size else np.full(len(doubt), np.nan)
        self.known_h = np.where(doubt > Relearn.sd, np.nan, np.where(np.isnan(before), minute / 60.0, before))
        if float(minute.max()) == DAY_MIN - 1:
            self.after_a_day = copy.deepcopy(self.estimator)


def vials(config: RelearnedConfig) -> tuple[Conditions, list[str]]:
    """All of them, and the row that each is of."""
    sets = [("drawn", draw(config.vials, config.seed, calibrated=True))] * bool(config.vials)
    n = config.special
    sets += [(row, replace(nominal(n), calibrated=True, **fixed)) for row, fixed in SPECIAL.items()] * bool(n)
    keys = [key for key, value in vars(sets[0][1]).items() if isinstance(value, np.ndarray)]
    all_of: dict[str, Any] = {key: np.concatenate([getattr(c, key) for _, c in sets]) for key in keys}
    rows = [row for row, c in sets for _ in range(c.n)]
    return Conditions(len(rows), calibrated=True, **all_of), rows


def law(kind: str, policy: Policy | None = None) -> Any:
    """A law of the share."""
    return registry.build(registry.config(kind, registry.SHARE), registry.SHARE, policy=policy)


def asked(believed: CompositionEstimator, config: RelearnedConfig, k: int) -> Question:
    """What a deployment of this program would ask after a day."""
    steps = [step for _ in range(4) for step in PROGRAMS["ratio_steps"].steps]
    minutes, shares = [minutes for minutes, _ in steps], [share for _, share in steps]
    given = {"minutes": minutes, "ratios": shares, "setpoints": [0.5] * len(steps), "temperatures": [33.2] * len(steps)}
    schedule = asdict(build(Scenario(), given, "scenario"))
    errors, sds = believed.growth_errors()
    plan = asdict(Relearn(steps=config.steps, hours=config.hours, seed=1000 * config.seed + k))
    return Question(
        1, "M0", (0.0, DAY_MIN - 1.0), DAY_MIN - 1.0, tuple(errors[0].tolist()), tuple(sds[0].tolist()),
        memory.save(believed), asdict(believed.config), asdict(PairConfig()), schedule, plan, 20.0, (29.0, 36.0), LAW,
        FIRST,
    )  # fmt: skip


def flown(conditions: Conditions, config: RelearnedConfig, law_of: Second) -> tuple[Seen, Array]:
    """The estimator, and the mean error of each vial's second day."""
    estimator = Seen(CompositionEstimator(CompositionEstimatorConfig()))
    hours = 24.0 + config.hours
    trace = second_vials.run(conditions, estimator, law_of, PROGRAMS["ratio_steps"], hours, seed=config.seed)
    return estimator, np.abs(trace.share - trace.setpoint)[DAY_MIN:].mean(axis=0)


def answered(file: Path, until: float) -> bool:
    """Whether there is a training and its verdict, of an earlier life of the study or one that began until then."""
    os.environ["OMP_NUM_THREADS"] = "1"
    if not (there := (file.with_suffix("") / "verdict.json").is_file()) and time.time() < until:
        logging.disable(logging.WARNING)
        lesson.answer(file)
        return True
    return there


def verdict(place: Path) -> Verdict:
    """Of one vial."""
    return Verdict(**json.loads((place / "policies" / "001" / "verdict.json").read_text(encoding="utf-8")))


def misjudged(pool: Workers, question: Question, one: Policy, other: Policy, times: int) -> dict[str, float]:
    """How often the worse of two policies flies, judged for 6 h on other vials each time; all say which one it is."""
    asked = [replace(question, number=k, relearn={**question.relearn, "hours": 6.0}) for k in range(1, times + 1)]
    found = [job.result() for job in [pool.submit(lesson.judged, each, one, other) for each in asked]]
    less = float(np.mean([np.subtract(errors["new"], errors["old"]) for errors in found]))
    worse, better = ("new", "old") if less > 0.0 else ("old", "new")
    flew = sum(Verdict({"new": errors[worse], "old": errors[better]}, np.nan).flies for errors in found)
    return {"judgements": times, "worse_by": abs(less), "worse_flew": flew}


def compared(less: Array) -> str:
    """Mean of a difference, vial by vial, and half its 95 % interval."""
    half = "" if len(less) < 2 else f" ± {1.96 * less.std(ddof=1) / len(less) ** 0.5:.4f}"
    return f"{less.mean():+.4f}{half}"


def relearned(config: RelearnedConfig, folder: Path) -> None:
    """A row for the drawn vials and one for each other kind: mean errors, and how many flew."""
    conditions, rows = vials(config)
    shipped, places = policies.load(SHIPPED_COMPOSITION[LAW]), [folder / f"vial{k:03d}" for k in range(len(rows))]
    estimator, errors = flown(conditions, config, Second(law(LAW, shipped)))
    after = estimator.after_a_day
    assert after is not None
    found: dict[str, Array] = {"shipped": errors}
    known_h = [float(np.nanquantile(estimator.known_h, q)) for q in (0.05, 0.5, 0.95)]
    log.info("growth is known to %g after %.1f h (5 %%: %.1f, 95 %%: %.1f)", Relearn.sd, *np.take(known_h, [1, 0, 2]))
    until, new = time.time() + 60.0 * config.limit_min if config.limit_min else np.inf, {}
    with Workers(config.workers) as pool:
        jobs = {}
        for k, place in reversed(list(enumerate(places))):  # every kind is there soon
            (place / "policies").mkdir(parents=True, exist_ok=True)
            policies.save(place / FIRST, shipped)
            file = place / "policies" / "001.json"
            file.write_text(asked(after.of(np.array([k])), config, k).text(), encoding="utf-8")
            jobs[pool.submit(answered, file, until)] = k
        for job in as_completed(jobs):
            if job.result():
                place = places[k := jobs[job]]
                new[k] = policies.load(place / "policies" / "001" / "policy.npz")
                log.info("%d of %d, %s: %s", len(new), len(jobs), rows[k], verdict(place).why)
        judge = {}
        if config.judgements:
            k = next((k for k in sorted(new) if rows[k] == "nominal"), max(new))
            question = Question.read(places[k] / "policies" / "001.json")
            judge = misjudged(pool, question, shipped, new[k], config.judgements)
            log.info("the worse policy, by %(worse_by).4f, flies %(worse_flew)d times of %(judgements)d", judge)
    laws = {kind: flown(conditions, config, Second(law(LAW, shipped), law(kind)))[1] for kind in BESIDE}
    best = np.array([verdict(place).best if k in new else "old" for k, place in enumerate(places)])
    found["trained"] = flown(conditions, config, Second(law(LAW, shipped), learned=new))[1]
    beside = np.where(best == ONE_LINE, laws[ONE_LINE], found["shipped"])
    found["with learning"] = np.where(best == "new", found["trained"], beside)
    found |= laws
    table = []
    for row in dict.fromkeys(rows[k] for k in sorted(new)):
        own = np.array([k in new and one == row for k, one in enumerate(rows)])
        flew = [f"{(best[own] == law).sum()}" for law in ("new", ONE_LINE, "old")]
        cells = [row, ", ".join(flew), *(f"{error[own].mean():.4f}" for error in found.values())]
        table.append([*cells, *(compared(found["with learning"][own] - found[than][own]) for than in THAN)])
    head = ["vials", f"flew: new, {ONE_LINE}, old", *found, *(f"less {than}" for than in THAN)]
    leave(folder, __file__, head, table)
    verdicts = [verdict(place).row() if k in new else None for k, place in enumerate(places)]
    content = {"rows": rows, "errors": found, "verdicts": verdicts, "table": table}
    files.write_json(folder / "summary.json", {**content, "judge": judge, "known_h": known_h})


main = command(__file__, RelearnedConfig(), relearned)


if __name__ == "__main__":
    main()
