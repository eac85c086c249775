"""An array job on a real SLURM of one node: jobs that are killed or told to end are queued again and lose nothing."""

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path

import pytest

from dqn import checkpoint
from experiments.cli import sweep
from experiments.train import main
from experiments.training.session import Session
from tests.experiments import slurm_lab
from tests.patience import PATIENCE_S

ROOT = Path(__file__).parents[2]
WORDS = ["agent.total_steps=1000", "agent.learn_start=100", "eval_every=500", "checkpoint_every=100"]
pytestmark = [pytest.mark.slow, pytest.mark.skipif(bool(slurm_lab.missing()), reason=slurm_lab.missing())]


@pytest.fixture
def cluster(tmp_path: Path) -> Iterator[dict[str, str]]:
    with slurm_lab.cluster(tmp_path / "slurm") as environment:
        yield {**environment, "PYTHONPATH": str(ROOT)}


def until(there: Callable[[], bool], process: subprocess.Popen[str], seconds: float = PATIENCE_S) -> None:
    deadline = time.monotonic() + seconds
    while not there():
        assert time.monotonic() < deadline
        assert process.poll() is None
        time.sleep(0.01)


def kill(job: str) -> None:
    """kill -9 to the work of an array job's task, as by a power cut."""
    array, _, task = job.partition("_")
    marks = {f"SLURM_ARRAY_JOB_ID={array}".encode(), f"SLURM_ARRAY_TASK_ID={task}".encode(), b"SLURM_PROCID=0"}
    for path in Path("/proc").glob("[0-9]*"):
        with suppress(OSError):
            ours = marks <= set((path / "environ").read_bytes().split(b"\0"))
            if ours and b"submitit.core._submit" in (path / "cmdline").read_bytes():
                os.kill(int(path.name), signal.SIGKILL)


def log(folder: Path, array: str, number: int) -> str:
    """What a job of the sweep and what watched over it said, in all its lives."""
    path = folder / f".submitit/{array}_{number}/{array}_{number}_0_log.out"
    return path.read_text() if path.is_file() else ""


def test_jobs_killed_or_told_to_end_are_queued_again_and_end_with_the_weights_of_an_uninterrupted_run(
    cluster: dict[str, str], tmp_path: Path
) -> None:
    """Job 0 is killed by the cluster, job 1 gets the signal of a time limit, in the middle of their training."""
    folder = tmp_path / "sweep"
    words = ["-m", "seed=range(0,4)", *WORDS, "hydra/launcher=slurm", "hydra.launcher.mem_gb=1"]
    with open(tmp_path / "out", "w") as out:
        process = subprocess.Popen(
            [sys.executable, "-m", "experiments.train", *words, "hydra.sweep.dir=sweep"],
            cwd=tmp_path, env=cluster, stdout=out, stderr=out, text=True,
        )  # fmt: skip
    try:
        until((folder / "0/checkpoint.pt").is_file, process)
        array = next(path.name for path in (folder / ".submitit").glob("[0-9]*_*")).partition("_")[0]
        subprocess.run(["scontrol", "requeue", f"{array}_0"], env=cluster, check=True)
        kill(f"{array}_0")
        until((folder / "1/checkpoint.pt").is_file, process)
        ask = subprocess.Popen(["scancel", "--signal=USR2", f"{array}_1"], env=cluster, stderr=subprocess.DEVNULL)
        until(lambda: "Requeued job" in log(folder, array, 1), process)
        ask.kill()  # it would ask again and again, also the job's next life
        ask.wait()
        status = process.wait(PATIENCE_S)
    finally:
        process.kill()
        process.wait()
    assert status == 0, (tmp_path / "out").read_text()
    lives = [log(folder, array, k).count("Starting with") for k in range(4)]
    assert lives == [2, 2, 1, 1]
    assert not list(folder.glob("*/stopped_*"))  # the second life went on, it did not begin anew
    assert [job.state for job in sweep.survey(folder)] == ["finished"] * 4
    assert [json.loads((folder / f"{k}/summary.json").read_text())["seeds"] for k in range(4)] == [
        [k] for k in range(4)
    ]
    for k in range(2):
        (tmp_path / f"whole{k}").mkdir()
        whole = Session(main.config([*WORDS, f"seed={k}"]), tmp_path / f"whole{k}")
        whole.run()
        whole.writer.close()
        ours, theirs = (checkpoint.load(at / "checkpoint.pt") for at in (folder / str(k), whole.folder))
        assert ours["best"]["weights"].equal(theirs["best"]["weights"])
        assert ours["returns"] == theirs["returns"]
