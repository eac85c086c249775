"""A search of hyper-parameters by two processes on one file, of which one is killed."""

import importlib.metadata
import json
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from hydra.core.utils import JobReturn, JobStatus

from experiments.cli import frame, search, sweep
from tests.programs import Program

WORDS = ["+hparams_search=tuned", "+experiment=smoke", "n_agents=1", "agent.total_steps=300", "checkpoint_every=100"]
TRIALS = 4


def _optuna() -> int:
    try:
        return int(importlib.metadata.version("optuna").partition(".")[0])
    except importlib.metadata.PackageNotFoundError:
        return 0


pytestmark = pytest.mark.skipif(_optuna() < 4, reason="no optuna 4 or newer: pip install -e '.[sweep]'")


def worker(folder: Path, name: str) -> Program:
    """A process that takes part in the search."""
    words = [*WORDS, f"hydra.sweeper.trials={TRIALS}", "hydra.sweep.dir=search"]
    return Program("experiments.train", *words, cwd=folder, out=folder / name, WITHOUT_FIGURES="1")


@pytest.mark.slow
def test_two_processes_share_a_search_and_take_up_the_trial_of_a_killed_one(tmp_path: Path) -> None:
    first = worker(tmp_path, "first")
    folder = tmp_path / "search"
    first.until((folder / "0/config.yaml").is_file)  # the first trial is at work
    first.kill()
    first.wait()
    assert sweep.Job.at(folder / "0").state == "running"
    for each in [worker(tmp_path, "second"), worker(tmp_path, "third")]:
        assert each.wait() == 0, each.said()
    said = "".join((tmp_path / name).read_text() for name in ("second", "third"))
    assert said.count("trial 0 continues: its process has ended") == 1
    jobs = sweep.survey(folder)
    assert [job.folder.name for job in jobs] == [str(k) for k in range(TRIALS)]
    assert [job.state for job in jobs] == ["finished"] * TRIALS
    assert len({job.overrides[-1] for job in jobs}) == TRIALS
    ours = {job.folder.name: job.objective for job in jobs}
    best = json.loads((folder / "best.json").read_text())
    assert best["objective"] == min(v for v in ours.values() if v is not None) == ours[str(best["trial"])]
    study = search.Search(TRIALS, 1, frame.OmegaConf.create({}))
    study.folder = folder
    trials = study._open().get_trials()
    assert [(t.number, t.state.name, t.value) for t in trials] == [(k, "COMPLETE", ours[str(k)]) for k in range(TRIALS)]


def test_an_objective_of_nothing_is_the_best_of_those_above_it(tmp_path: Path) -> None:
    """Twelve trials: one of them reaches 0, one fails, the others return their number."""

    def launch(overrides: list[list[str]], initial_job_idx: int) -> list[JobReturn]:
        (words,) = overrides
        value = 0.0 if initial_job_idx == 10 else float(initial_job_idx + 1)
        status = JobStatus.FAILED if initial_job_idx == 3 else JobStatus.COMPLETED
        done = JobReturn(overrides=words, status=status)
        done.return_value = RuntimeError("full") if initial_job_idx == 3 else value
        return [done]

    study = search.Search(12, 1, frame.OmegaConf.create({"env.mu": {"low": 0.01, "high": 0.03}}))
    study.folder, study.launcher = tmp_path, SimpleNamespace(launch=launch)  # type: ignore[assignment]
    study.sweep([])
    best = json.loads((tmp_path / "best.json").read_text())
    assert (best["trial"], best["objective"]) == (10, 0.0)
    assert [t.value for t in study._open().get_trials()] == [1.0, 2.0, 3.0, None, *map(float, range(5, 11)), 0.0, 12.0]


def test_trials_that_are_given_out_together_keep_their_numbers_folders_and_results(tmp_path: Path) -> None:
    """Five, two at a time: the words of the command line come first, and each result is its own trial's."""
    given: list[tuple[int, list[list[str]]]] = []

    def launch(overrides: list[list[str]], initial_job_idx: int) -> list[JobReturn]:
        given.append((initial_job_idx, overrides))
        done = [JobReturn(overrides=words, status=JobStatus.COMPLETED) for words in overrides]
        for words, job in zip(overrides, done, strict=True):
            job.return_value = 10.0 - float(words[-1].removeprefix("hydra.sweep.subdir="))
        return done

    space = {"agent.gamma": {"low": 0.1, "high": 0.9}, "agent.paper": {"choices": ["yes"]}}
    study = search.Search(5, 2, frame.OmegaConf.create(space))
    study.folder, study.launcher = tmp_path, SimpleNamespace(launch=launch)  # type: ignore[assignment]
    study.sweep(["++seed=3", "env=sim"])
    assert [(first, len(batch)) for first, batch in given] == [(0, 2), (2, 2), (4, 1)]
    words = [job for _, batch in given for job in batch]
    assert [job[:2] + job[-1:] for job in words] == [
        ["++seed=3", "env=sim", f"hydra.sweep.subdir={k}"] for k in range(5)
    ]
    best = json.loads((tmp_path / "best.json").read_text())
    assert (best["trial"], best["objective"]) == (4, 6.0)
    assert best["values"] == [word.removeprefix("++") for word in words[4][2:-1]]
    assert [t.value for t in study._open().get_trials()] == [10.0, 9.0, 8.0, 7.0, 6.0]


def test_a_range_is_of_whole_numbers_where_both_its_ends_are(tmp_path: Path) -> None:
    said = {
        "whole": {"low": 1, "high": 4}, "part": {"low": 0, "high": 0.5}, "down": {"low": -0.5, "high": 1},
        "even": {"low": 2, "high": 8, "step": 2}, "tens": {"low": 0.001, "high": 1.0, "log": True},
        "some": {"choices": ["a", "b"]},
    }  # fmt: skip
    tried: list[dict[str, Any]] = []

    def launch(overrides: list[list[str]], initial_job_idx: int) -> list[JobReturn]:
        done = [JobReturn(overrides=words, status=JobStatus.COMPLETED) for words in overrides]
        for words, job in zip(overrides, done, strict=True):
            values = dict(word.removeprefix("++").split("=") for word in words[:-1])
            tried.append({key: v if key == "some" else json.loads(v) for key, v in values.items()})
            job.return_value = 1.0
        return done

    study = search.Search(40, 40, frame.OmegaConf.create(said))
    study.folder, study.launcher = tmp_path, SimpleNamespace(launch=launch)  # type: ignore[assignment]
    study.sweep([])
    assert len(tried) == 40
    for key, allowed in (("whole", {1, 2, 3, 4}), ("even", {2, 4, 6, 8}), ("some", {"a", "b"})):
        assert {params[key] for params in tried} == allowed
    for key, low, high in (("part", 0.0, 0.5), ("down", -0.5, 1.0), ("tens", 0.001, 1.0)):
        values = [params[key] for params in tried]
        assert all(low <= value <= high for value in values)
        assert len(set(values)) == 40
    assert 5 <= sum(params["tens"] < 0.03 for params in tried) <= 35  # half of three tens


def test_a_space_that_is_none_is_one_line() -> None:
    with pytest.raises(frame.UserError, match=r"^hydra\.sweeper\.space\.env\.mu: .*; write \{low: 1, high: 9\}"):
        search.Search(1, 1, frame.OmegaConf.create({"env.mu": {"low": 2.0, "high": 1.0}}))
