"""A disk, a folder or a reader that refuses ends a command with one line or none, whatever was going on."""

import os
import resource
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
ENVIRONMENT = {**os.environ, "OMP_NUM_THREADS": "1", "PYTHONPATH": str(ROOT)}
COMMANDS = sorted(p.stem for p in (ROOT / "conf").glob("*.yaml") if p.stem != "base")
SHORT = ["agent=paper", "agent.total_steps=200", "agent.learn_start=100", "checkpoint_every=100"]


def run(*words: str, cwd: Path, limit: int | None = None) -> subprocess.CompletedProcess[str]:
    """A command. Args: limit: bytes that a file may have; more is refused as by a full disk."""

    def bound() -> None:
        if limit is not None:
            resource.setrlimit(resource.RLIMIT_FSIZE, (limit, limit))

    command = [sys.executable, "-m", *words]
    return subprocess.run(command, cwd=cwd, env=ENVIRONMENT, capture_output=True, text=True, preexec_fn=bound)


def refused(done: subprocess.CompletedProcess[str], words: str) -> None:
    assert done.returncode == 1
    assert words in done.stderr
    assert len(done.stderr.splitlines()) == 1, done.stderr
    assert "Traceback" not in done.stdout


def test_a_bad_value_in_a_sweep_costs_its_job_one_line(tmp_path: Path) -> None:
    done = run("experiments.train", "-m", "seed=-1,0", *SHORT, "hydra.sweep.dir=all", cwd=tmp_path)
    refused(done, "error: seed = -1: allowed at least 0")
    assert (tmp_path / "all/1/policy.npz").is_file()


@pytest.mark.parametrize("words", [["agent="], ["env.mu=["], ["agent=nope"]])
def test_a_sweep_that_cannot_be_composed_is_one_line(words: list[str], tmp_path: Path) -> None:
    refused(run("experiments.train", "-m", *words, cwd=tmp_path), "error: ")


@pytest.mark.parametrize(
    ("limit", "words"),
    [
        (100, ["experiments.train", *SHORT]),  # what is refused first: the config
        (12_000, ["experiments.train", *SHORT]),  # the checkpoint, which torch writes
        (12_000, ["experiments.calibrate"]),  # a figure
        (3_000, ["tests.studies.ablate", "only=[tuned]", "n_agents=1", "agent.total_steps=200"]),  # the events
    ],
)
def test_a_full_disk_is_one_line(limit: int, words: list[str], tmp_path: Path) -> None:
    done = run(*words, "hydra.run.dir=run", cwd=tmp_path, limit=limit)
    refused(done, "File too large; free disk space")


def test_a_folder_that_cannot_be_made_is_one_line(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    for place, why in (("file/run", "Not a directory"), ("/proc/run", "No such file or directory")):
        done = run("experiments.calibrate", f"hydra.run.dir={place}", cwd=tmp_path)
        refused(done, f"error: {place}: {why}; choose a folder that can be written, with hydra.run.dir=FOLDER")


def test_a_standard_output_that_is_full_is_one_line(tmp_path: Path) -> None:
    with open("/dev/full", "w") as full:
        done = subprocess.run(
            [sys.executable, "-m", "experiments.train", "--help"],
            cwd=tmp_path, env=ENVIRONMENT, stdout=full, stderr=subprocess.PIPE, text=True,
        )  # fmt: skip
    assert (done.returncode, done.stderr) == (1, "error: writing: No space left on device; free disk space\n")


def unread(*words: str, cwd: Path) -> tuple[int, str]:
    """Status and standard error of a command whose reader is gone from the beginning."""
    read, write = os.pipe()
    os.close(read)
    command = [sys.executable, "-m", *words]
    done = subprocess.run(command, cwd=cwd, env=ENVIRONMENT, stdout=write, stderr=subprocess.PIPE, text=True)
    os.close(write)
    return done.returncode, done.stderr


@pytest.mark.parametrize("name", [*COMMANDS, "demo"])
def test_help_that_nobody_reads_says_nothing_about_it(name: str, tmp_path: Path) -> None:
    assert unread(f"experiments.{name}", "--help", cwd=tmp_path) == (0, "")


def test_a_run_whose_log_nobody_reads_comes_to_its_end(tmp_path: Path) -> None:
    assert unread("experiments.train", *SHORT, "hydra.run.dir=run", cwd=tmp_path) == (0, "")
    assert (tmp_path / "run/policy.npz").is_file()
