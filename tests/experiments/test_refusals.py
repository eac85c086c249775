"""A disk, a folder or a reader that refuses ends a command with one line or none, whatever was going on."""

import errno
import os
import subprocess
import sys
from multiprocessing.connection import Connection
from pathlib import Path

import pytest

from tests import programs
from tests.programs import OURS

ENVIRONMENT = {**os.environ, **OURS}
SHORT = ["agent=paper", "agent.total_steps=200", "agent.learn_start=100", "checkpoint_every=100"]


def run(*words: str, cwd: Path, limit: int | None = None) -> subprocess.CompletedProcess[str]:
    """A command that draws only where its figures are what is refused."""
    drawn = "experiments.calibrate" in words
    return programs.run(*words, cwd=cwd, limit=limit, WITHOUT_FIGURES="" if drawn else "1")


def refused(done: subprocess.CompletedProcess[str], words: str) -> None:
    assert done.returncode == 1
    assert words in done.stderr
    assert len(done.stderr.splitlines()) == 1, done.stderr
    assert "Traceback" not in (done.stdout or "")


def test_a_bad_value_in_a_sweep_costs_its_job_one_line(tmp_path: Path) -> None:
    done = run("experiments.train", "-m", "seed=-1,0", *SHORT, "hydra.sweep.dir=all", cwd=tmp_path)
    refused(done, "error: seed = -1: ")
    assert (tmp_path / "all/1/policy.npz").is_file()


@pytest.mark.parametrize("words", [["agent="], ["env.mu=["], ["agent=nope"]])
def test_a_sweep_that_cannot_be_composed_is_one_line(words: list[str], tmp_path: Path) -> None:
    refused(run("experiments.train", "-m", *words, cwd=tmp_path), "error: ")


@pytest.mark.parametrize(
    ("limit", "words"),
    [
        (100, ["experiments.train", *SHORT]),  # what is refused first: the config
        (12_000, ["experiments.train", *SHORT]),  # the checkpoint, which torch writes
        pytest.param(12_000, ["experiments.calibrate"], marks=pytest.mark.slow),  # a figure
        (3_000, ["tests.studies.ablate", "only=[tuned]", "n_agents=1", "agent.total_steps=200"]),  # the events
    ],
)
def test_a_full_disk_is_one_line(limit: int, words: list[str], tmp_path: Path) -> None:
    done = run(*words, "hydra.run.dir=run", cwd=tmp_path, limit=limit)
    refused(done, os.strerror(errno.EFBIG))


def test_a_folder_that_cannot_be_made_is_one_line(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    for place, why in (("file/run", os.strerror(errno.ENOTDIR)), ("/proc/run", os.strerror(errno.ENOENT))):
        done = run("experiments.calibrate", f"hydra.run.dir={place}", cwd=tmp_path)
        refused(done, f"error: {place}: {why}; ")
        assert "hydra.run.dir=" in done.stderr


def test_a_standard_output_that_is_full_is_one_line(tmp_path: Path) -> None:
    with open("/dev/full", "w") as full:
        done = subprocess.run(
            [sys.executable, "-m", "experiments.train", "--help"],  # an interpreter's end writes what is left
            cwd=tmp_path, env=ENVIRONMENT, stdout=full, stderr=subprocess.PIPE, text=True,
        )  # fmt: skip
    refused(done, f"error: writing: {os.strerror(errno.ENOSPC)}; ")


def unread() -> int:
    """The end of a pipe whose reader is gone from the beginning."""
    read, write = os.pipe()
    os.close(read)
    return write


@pytest.mark.parametrize("name", ["train", "deploy", "demo"])
def test_help_that_nobody_reads_says_nothing_about_it(name: str, tmp_path: Path) -> None:
    command, end = [sys.executable, "-m", f"experiments.{name}", "--help"], unread()
    done = subprocess.run(command, cwd=tmp_path, env=ENVIRONMENT, stdout=end, stderr=subprocess.PIPE, text=True)
    os.close(end)
    assert (done.returncode, done.stderr) == (0, "")


def test_a_run_whose_log_nobody_reads_comes_to_its_end(tmp_path: Path) -> None:
    words, err = ["experiments.train", *SHORT, "hydra.run.dir=run"], tmp_path / "err"
    with Connection(unread(), readable=False) as end:
        program = programs.Program(*words, cwd=tmp_path, out=end, err=err, WITHOUT_FIGURES="1")
        assert (program.wait(), err.read_text()) == (0, "")
    assert (tmp_path / "run/policy.npz").is_file()
