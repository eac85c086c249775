"""The list of commands, the console script's words, and what a real shell completes."""

import subprocess
import tomllib
from pathlib import Path

import pytest

from conf.presets import commands
from tests import programs
from tests.programs import ROOT

FILES = sorted(p.stem for p in (ROOT / "experiments").glob("*.py") if not p.stem.startswith("__"))


def run(*words: str, cwd: Path = ROOT) -> subprocess.CompletedProcess[str]:
    return programs.run("experiments", *words, cwd=cwd)


def listed(page: str) -> list[list[str]]:
    """Words of every line that names a command."""
    lines = [line for line in page.splitlines() if line[:2] == "  " and line[2] != " "]
    return [line.split() for line in lines if line.split()[0] in {*FILES, *commands()}]


@pytest.mark.parametrize("words", [[], ["--help"], ["help"]])
def test_every_command_is_listed_with_a_sentence(words: list[str]) -> None:
    done = run(*words)
    assert done.returncode == 0
    said = {name: what for name, *what in listed(done.stdout)}
    assert set(FILES) <= set(said)
    assert all(len(" ".join(said[name])) > 20 for name in FILES)


@pytest.mark.parametrize("words", [["--version"], ["train", "--version"], ["deploy", "controller=pi", "--version"]])
def test_the_version_is_the_program_s(words: list[str], tmp_path: Path) -> None:
    said = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    done = run(*words, cwd=tmp_path)
    assert (done.returncode, done.stdout, done.stderr) == (0, f"{said['name']} {said['version']}\n", "")
    assert not list(tmp_path.iterdir())


def test_a_command_runs_as_by_its_own_module(tmp_path: Path) -> None:
    ours, own = run("train", "--cfg", "job"), programs.run("experiments.train", "--cfg", "job", cwd=ROOT)
    assert ours.stdout == own.stdout != ""
    refused = run("train", "seed=-1", cwd=tmp_path)
    assert (refused.returncode, refused.stderr.startswith("error: seed = -1: ")) == (1, True)
