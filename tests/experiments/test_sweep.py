"""A sweep on one machine: one folder, the results of single runs, and going on after whatever ended it."""

import json
import os
import re
import shlex
import signal
import subprocess
import sys
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from dqn import checkpoint
from experiments import deploy
from experiments.cli import frame, sweep
from experiments.cli.frame import UserError
from experiments.control import run as control
from experiments.control.config import DeployConfig
from experiments.train import main
from experiments.training.config import TrainConfig
from experiments.training.session import Session
from tests.patience import PATIENCE_S
from tests.programs import OURS, Program, run

TRAIN = "experiments.train"
PARALLEL = "joblib", "submitit_local"
BLANK = {"WITHOUT_FIGURES": "1"}
SMOKE = ["+experiment=smoke", "agent.total_steps=300", "env.episode_steps=40", "env.setpoints=[0.3,0.7]"]
LONG = ["n_agents=1", "agent.total_steps=1000", "agent.learn_start=100", "eval_every=200", "checkpoint_every=100"]
pytestmark = pytest.mark.xdist_group("sweep")  # its tests share what a single run gives


def started(*words: str, cwd: Path) -> subprocess.CompletedProcess[str]:
    """By an interpreter of its own, whose workers are not forked from a worker."""
    command, environment = [sys.executable, "-m", TRAIN, *words], {**os.environ, **OURS}
    return subprocess.run(command, cwd=cwd, env=environment, capture_output=True, text=True, timeout=PATIENCE_S)


def summary(folder: Path) -> dict[str, Any]:
    """What does not depend on where and how fast it ran."""
    found = json.loads((folder / "summary.json").read_text())
    return {key: value for key, value in found.items() if key not in ("train_seconds", "policy")}


@pytest.fixture(scope="module")
def alone(tmp_path_factory) -> list[dict[str, Any]]:
    """Summaries of seeds 0 and 1 as single runs."""
    folders = [tmp_path_factory.mktemp(f"alone{seed}") for seed in range(2)]
    for seed, folder in enumerate(folders):
        done = run(TRAIN, *SMOKE, f"seed={seed}", "hydra.run.dir=.", cwd=folder, **BLANK)
        assert done.returncode == 0, done.stderr
    return [summary(folder) for folder in folders]


@pytest.mark.parametrize("launcher", ["basic", *(pytest.param(n, marks=pytest.mark.slow) for n in PARALLEL)])
def test_every_launcher_gives_the_summaries_of_single_runs_in_one_folder(launcher, alone, tmp_path):
    words = "-m", "seed=range(0,2)", *SMOKE, f"hydra/launcher={launcher}"
    done = started(*words, cwd=tmp_path) if launcher in PARALLEL else run(TRAIN, *words, cwd=tmp_path, **BLANK)
    assert done.returncode == 0, done.stderr
    (folder,) = (tmp_path / "runs" / "train").iterdir()
    assert sorted(p.name for p in folder.iterdir() if p.is_dir() and p.name.isdigit()) == ["0", "1"]
    assert [summary(folder / str(k)) for k in range(2)] == alone
    assert f"2 of 2 jobs finished in runs/train/{folder.name}" in done.stdout


@pytest.mark.slow
def test_a_stopped_sweep_does_only_what_is_missing(tmp_path):
    """Ctrl-C in the second of three jobs; then the command that is named, and once more where nothing is missing."""
    words = "experiments.train", "-m", "seed=range(0,3)", *LONG, "hydra.sweep.dir=a sweep"
    process = Program(*words, cwd=tmp_path, out=tmp_path / "out", err=tmp_path / "err", **BLANK)
    folder = tmp_path / "a sweep"
    process.until((folder / "1/checkpoint.pt").is_file)
    process.send_signal(signal.SIGINT)
    assert process.wait() == 130
    (line,) = (tmp_path / "err").read_text().splitlines()
    told = re.fullmatch(
        r"stopped; 1 of 3 jobs finished in a sweep; run the missing jobs: python -m experiments.train (.+)", line
    )
    assert told, line
    before = (folder / "0/summary.json").stat().st_mtime_ns
    assert 1 <= len(_returns(folder / "1")) < 10
    again = run(TRAIN, *shlex.split(told[1]), cwd=tmp_path, **BLANK)
    assert again.returncode == 0, again.stderr
    assert "3 of 3 jobs finished" in again.stdout
    assert not list(folder.glob("*/stopped_*"))  # job 1 went on from its checkpoint
    assert (folder / "0/summary.json").stat().st_mtime_ns == before
    whole = Session(main.config([*LONG, "seed=1"]), tmp_path)
    whole.run()
    whole.writer.close()
    ours = checkpoint.load(folder / "1/checkpoint.pt")
    assert ours["best"]["weights"].equal(whole.best.weights)
    assert ours["returns"] == whole.returns
    times = [(folder / f"{k}/summary.json").stat().st_mtime_ns for k in range(3)]
    assert "3 of 3 jobs finished" in run(TRAIN, "resume=a sweep", cwd=tmp_path).stdout
    assert [(folder / f"{k}/summary.json").stat().st_mtime_ns for k in range(3)] == times


def _returns(folder: Path) -> list[Any]:
    found: list[Any] = checkpoint.load(folder / "checkpoint.pt")["returns"]
    return found


def test_a_resumed_sweep_takes_no_other_values_but_another_launcher(tmp_path, monkeypatch):
    """Which is not told what the one before was."""
    monkeypatch.chdir(tmp_path)
    words = ["seed=0,1", "hydra/launcher=joblib", "hydra.launcher.n_jobs=2"]
    begun = sweep.asked(["-m", *words, "hydra.sweep.dir=old"], "train")
    assert begun == sweep.Sweep(Path("old"), "train", words)
    begun.save()
    assert sweep.asked(["resume=old", "hydra/launcher=slurm"], "train").line() == [
        "-m", "seed=0,1", "hydra/launcher=slurm", "hydra.sweep.dir=old",
    ]  # fmt: skip
    for wrong, said in (
        (["resume=old", "seed=3"], r"^seed=3: .* python -m experiments\.train -m resume=old"),
        (["seed=0,2", "hydra.sweep.dir=old"], r"^hydra\.sweep\.dir=old: holds another sweep .*seed=0,1.*folder$"),
    ):
        with pytest.raises(UserError, match=said):
            sweep.asked(["-m", *wrong], "train").save()
    sweep.asked(["-m", "seed=0,1", "hydra.sweep.dir=old"], "train").save()  # the same, by another launcher
    assert sweep.asked(["seed=0"], "train") is None
    assert sweep.asked(["+hparams_search=tuned"], "train") is not None


def test_jobs_are_those_that_hydra_makes_of_the_command_line():
    """A sweep goes over lists as over numbers, and leaves a list alone."""
    given = ["-m", "+agent=paper,tuned", "seed=range(0,2)", "env.mu=0.02", "hydra.sweep.dir=x"]
    assert sweep.jobs(frame.normalise(given, "train")) == [
        [f"agent={agent}", f"++seed={seed}", "++env.mu=0.02"] for agent in ("paper", "tuned") for seed in (0, 1)
    ]
    words = ["++each.M0.minutes=[90],[60,30]", "++backend.reactors=[M0,M1]", "hydra.verbose=true"]
    assert sweep.jobs(["-m", *words, "hydra/launcher=joblib"]) == [
        [f"++each.M0.minutes={minutes}", "++backend.reactors=[M0,M1]"] for minutes in ("[90]", "[60,30]")
    ]
    assert sweep.jobs(["hparams_search=tuned"]) is None
    with pytest.raises(UserError, match=r"^hydra/launcher=ray: no such option; allowed: basic, joblib"):
        frame.normalise(["-m", "hydra/launcher=ray"], "train")


def test_a_folder_goes_on_with_the_same_config_only_and_one_process_at_a_time(tmp_path):
    job = sweep.Job.at(tmp_path)
    job.begin(TrainConfig())
    sweep.Job.at(tmp_path).begin(TrainConfig())
    with pytest.raises(UserError, match=r"has a run with another config; give another hydra\.sweep\.dir="):
        sweep.Job.at(tmp_path).begin(TrainConfig(seed=1))
    (tmp_path / "progress.csv").touch()
    job.put_aside()
    assert (tmp_path / "stopped_1/progress.csv").is_file()
    busy = "import time; from pathlib import Path; from experiments.cli import sweep\n"
    busy += f"with sweep.working(Path({str(tmp_path)!r})): print('in', flush=True); time.sleep(600)"
    with Program("-c", busy, cwd=tmp_path, out=tmp_path / "out") as other:
        other.until(lambda: other.said() == "in\n")
        with pytest.raises(sweep.Busy), sweep.working(tmp_path):
            pass
    with sweep.working(tmp_path):
        pass


def test_what_a_finished_job_found_stands_when_it_is_asked_for_something_else(tmp_path):
    ran = []
    calm = frame.EntryPoint("train", TrainConfig(), lambda config, folder: ran.append(config.seed) or 0.0)
    for seed in (1, 2):
        calm._once(frame.compose("train", [f"seed={seed}"]), tmp_path, sweep.Job.at(tmp_path))
    assert calm._once(frame.compose("train", ["seed=1"]), tmp_path, sweep.Job.at(tmp_path)) == 0.0
    job = sweep.Job.at(tmp_path)
    assert (job.state, job.objective, ran) == ("finished", 0.0, [1])


@pytest.mark.parametrize(
    ("entry", "saved", "goes_on"),
    [(main, "checkpoint.pt", True), (deploy.main, "state.json", False)],
    ids=["a training", "a deployment"],
)
def test_of_a_job_that_was_stopped_twice_each_life_is_kept_or_gone_on_with(entry, saved, goes_on, tmp_path):
    """A training goes on from what it saved, to the same result. A deployment begins anew, on vials that are new: what
    its earlier lives left lies aside, in a folder each."""
    asked: list[str | None] = []

    def stopped(config: Any, folder: Path) -> float:
        asked.append(config.resume)
        (folder / saved).write_text(f"life {len(asked)}")
        if len(asked) < 3:
            raise KeyboardInterrupt
        return 0.5

    swept = replace(entry, body=stopped)
    for _ in range(2):
        with pytest.raises(KeyboardInterrupt):
            swept._once(frame.compose(entry.name, []), tmp_path, sweep.Job.at(tmp_path))
    assert swept._once(frame.compose(entry.name, []), tmp_path, sweep.Job.at(tmp_path)) == 0.5
    assert asked == [None, *([str(tmp_path)] * 2 if goes_on else [None] * 2)]
    kept = {p.parent.name: p.read_text() for p in tmp_path.glob(f"*/{saved}")}
    assert kept == ({} if goes_on else {"stopped_1": "life 1", "stopped_2": "life 2"})
    assert (tmp_path / saved).read_text() == "life 3"


def test_two_runs_that_begin_in_the_same_second_have_a_folder_each(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sweep.time, "strftime", lambda form: "2026-01-02_03-04-05")
    folders = []
    for number in (17, 18):
        monkeypatch.setattr(sweep.os, "getpid", lambda number=number: number)
        folders += [sweep.fresh("train"), sweep.asked(["-m", "seed=0,1"], "train").folder]
    assert len(set(folders)) == 4


def test_jobs_are_told_of_in_the_order_of_their_numbers(tmp_path: Path) -> None:
    """Twelve, of which the third and the eleventh failed."""
    for k in range(12):
        (tmp_path / str(k) / ".hydra").mkdir(parents=True)
        (tmp_path / str(k) / ".hydra" / "overrides.yaml").write_text(f"- ++seed={k}\n")
        sweep.Job(tmp_path / str(k)).save(
            "failed" if k in (2, 10) else "finished", 0.1 * k, "full" if k in (2, 10) else ""
        )
    for found in (sweep.survey(tmp_path), sweep.survey(tmp_path, [[f"++seed={k}"] for k in range(12)])):
        assert [(job.folder.name, job.overrides) for job in found] == [(str(k), [f"seed={k}"]) for k in range(12)]
    assert sweep.errors(tmp_path, None) == "error: full (job 2: seed=2; job 10: seed=10); "
    swept, done = sweep.Sweep(tmp_path, "train", []), f"10 of 12 jobs finished in {tmp_path}"
    assert sweep.progress(swept, None).startswith(f"{done}; compare them: ")  # a search: who failed has been tried
    every = [[f"++seed={k}"] for k in range(12)]
    assert sweep.progress(swept, every) == f"{done}; run the missing jobs: {swept.again()}"


def saved(folder: Path, number: int, state: str, error: str = "") -> None:
    (folder / str(number)).mkdir(parents=True)
    sweep.Job(folder / str(number), config="x").save(state, 0.5 if state == "finished" else None, error)


def test_of_many_errors_three_are_told_each_with_three_of_its_jobs(tmp_path: Path) -> None:
    """Five failed with one error, three more each with its own; job 4 did not."""
    failed = {0: "full", 1: "full", 2: "lost", 3: "full", 5: "full", 6: "mad", 7: "sad", 8: "full"}
    for k in range(9):
        saved(tmp_path, k, "failed" if k in failed else "finished", failed.get(k, ""))
    told = sweep.errors(tmp_path, [[f"++seed={k}", "env.mu=1"] for k in range(9)])
    full = "; ".join(f"job {k}: seed={k} env.mu=1" for k in (0, 1, 3))
    one = "lost (job 2: seed=2 env.mu=1); mad (job 6: seed=6 env.mu=1)"
    assert told == f"error: full ({full}; ...); {one}; and 1 other errors; "
    assert "other" not in sweep.errors(tmp_path, [[f"seed={k}"] for k in range(7)])


def test_what_an_earlier_life_left_goes_aside_but_its_record_and_its_log(tmp_path: Path) -> None:
    for name in (".hydra", "recordings", "stopped_1"):
        (tmp_path / name).mkdir()
    for name in ("job.json", ".lock", "deploy.log", "config.yaml", "journal.jsonl"):
        (tmp_path / name).touch()
    sweep.Job(tmp_path).put_aside()
    assert sorted(p.name for p in tmp_path.iterdir()) == [
        ".hydra", ".lock", "deploy.log", "job.json", "stopped_1", "stopped_2",
    ]  # fmt: skip
    assert sorted(p.name for p in (tmp_path / "stopped_2").iterdir()) == ["config.yaml", "journal.jsonl", "recordings"]
    sweep.Job(tmp_path).put_aside()
    assert not (tmp_path / "stopped_3").exists()


def test_a_job_at_work_elsewhere_is_waited_for_and_one_whose_process_is_gone_is_missing(tmp_path, monkeypatch):
    folder = tmp_path / "my sweep"
    for k, state in enumerate(("finished", "running", "running", "finished")):
        saved(folder, k, state)
    gone: set[str] = set()
    monkeypatch.setattr(sweep, "_free", lambda at: at.name in gone)
    swept, every = sweep.Sweep(folder, "train", ["seed=range(0,4)"]), [[f"seed={k}"] for k in range(4)]
    line = f"2 of 4 jobs finished in {folder}"
    compare = f"compare them: python -m experiments.report runs='{folder}'"
    assert sweep.progress(swept, every) == f"{line}; 2 still running in other processes; {compare}"
    gone.add("2")
    assert [job.state for job in sweep.survey(folder, every)] == [
        "finished", "running", "stopped", "finished",
    ]  # fmt: skip
    again = f"python -m experiments.train -m resume='{folder}'"
    assert sweep.progress(swept, every) == f"{line}; 1 still running in other processes; run the missing jobs: {again}"
    assert sweep.progress(swept, [*every, ["seed=4"]]).startswith("2 of 5 jobs finished")


def test_of_two_folders_the_last_is_taken_and_a_search_that_is_none_sweeps_nothing(tmp_path: Path) -> None:
    first, second = ({"command": "train", "arguments": [f"seed={k}"]} for k in (1, 2))
    for name, content in (("a", first), ("b", second)):
        (tmp_path / name).mkdir()
        (tmp_path / name / "sweep.json").write_text(json.dumps(content))
    found = sweep.asked(["-m", f"resume={tmp_path}/a", f"resume={tmp_path}/b"], "train")
    assert (found.folder, found.arguments) == (tmp_path / "b", ["seed=2"])
    with pytest.raises(UserError, match=r"^experiments\.deploy: .* python -m experiments\.train -m"):
        sweep.asked(["-m", f"resume={tmp_path}/a"], "deploy")
    named = sweep.asked(["-m", "hydra.sweep.dir=x", "seed=1,2", "hydra.sweep.dir=y z"], "train")
    assert (str(named.folder), named.arguments) == ("y z", ["seed=1,2"])
    assert named.again() == "python -m experiments.train -m resume='y z'"
    assert sweep.asked(["+hparams_search=null", "seed=1"], "train") is None
    (tmp_path / "a" / "sweep.json").write_text("{")
    assert sweep.read(tmp_path / "a") is None
    with pytest.raises(UserError, match="not a sweep; to continue a single run, drop -m"):
        sweep.asked(["-m", f"resume={tmp_path}"], "train")


def test_a_cluster_without_accounting_is_said_once_by_the_log_alone(caplog, monkeypatch, tmp_path):
    slurm = pytest.importorskip("submitit.slurm.slurm")
    monkeypatch.setenv("PATH", str(tmp_path))  # no sacct, which fails as one without accounting does
    watcher = slurm.SlurmInfoWatcher()
    for number in ("12", "13", "14"):
        watcher.register_job(number)
        watcher.update()
    (said,) = caplog.records
    assert said.name == frame.log.name
    assert "sacct" in said.getMessage()


@pytest.mark.parametrize("swept", [True, False])
def test_a_deployment_that_was_stopped_is_a_job_to_be_done_again(swept, tmp_path, monkeypatch):
    monkeypatch.setattr(control, "_recorded", lambda *_: "stopped by the operator")
    monkeypatch.setattr(control, "swept", lambda: swept)
    with pytest.raises(KeyboardInterrupt) if swept else nullcontext():
        control.deploy(DeployConfig(), tmp_path)
