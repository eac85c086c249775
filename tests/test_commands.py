"""Every command of README and docs does what the page says, or needs hardware.

In each run of the suite all of them are checked against what the commands take, and those of the README run one after
the other in one folder, with less work for the long ones. `-m slow` runs all the others.
"""

import importlib
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from tests.documented import PAGES, ROOT, commands, needs_hardware
from tests.patience import PATIENCE_S

OTHERS = (
    "experiments", "experiments.demo", "experiments.cli.reference", "hardware.emulator", "hardware.rig",
    "turbidostat",
)  # fmt: skip
SHOWN = {
    f"{page.name}: {' '.join(words)}": words
    for page in PAGES
    for words in commands(page)
    if words[0] not in OTHERS and page.name != "extending.md"  # whose commands a test of its own runs
}
SHIPPED = "+experiment=shipped"  # a minute; to its end it gives the policy that ships, which is put in its place
LESS = {
    "tests.campaigns.rig_study": ['overrides=[scenario.recovery_od=0.7,"scenario.minutes=[3,3,3]"]'],
    "experiments.train": ["agent.total_steps=300", "agent.learn_start=100", "n_agents=2"],
    "tests.studies.ablate": ["agent.total_steps=300", "n_agents=2"],
    "tests.studies.degradation": ["agent.total_steps=600", "n_agents=2"],
    "experiments.benchmark": ["replicates=1", "train_seeds=1"],
    "tests.campaigns.faults": ["controls=0", "moments=[dose]", "faults=[feed weak]"],
    "tests.campaigns.kills": ["kills=2", "runs=1"],
    "tests.campaigns.soak": ["days=0.05"],
    "tests.studies.speed": ["runs=1", "groups=[start_up]"],
}
"""Command -> what makes it shorter here without leaving out a part of it."""


def ready(folder: Path) -> None:
    """Files that the pages take for granted: runs of earlier commands, recordings of the reader's own."""
    for name in ("RUN", "SWEEP"):
        (folder / name).mkdir()
        (folder / name / "config.yaml").write_text("seed: 0\n", encoding="utf-8")
    run = folder / "RUN"
    shutil.copy(ROOT / "dqn" / "shipped" / "policy.npz", run)
    for name in ("RECORDING.csv", "FILE.csv", "chibio_ecoli_dither.csv"):
        shutil.copy(ROOT / "experiments" / "data" / "open_loop.csv", folder / name)
    calibrated = folder / "runs" / "calibrate" / "1"
    calibrated.mkdir(parents=True)
    for path in (calibrated, run):
        (path / "calibrated.yaml").touch()
        (path / "twin.yaml").touch()
    train = folder / "runs" / "train" / "1"
    train.mkdir(parents=True)
    for name in ("config.yaml", "checkpoint.pt", "sweep.json"):
        (train / name).touch()


@pytest.mark.parametrize("shown", SHOWN)
def test_a_command_of_the_pages_is_one_that_the_program_takes(
    shown: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    ready(tmp_path)
    monkeypatch.chdir(tmp_path)
    program, *words = SHOWN[shown]
    swept = "-m" in words
    given = [w for w in words if w != "-m" and not w.startswith("--help")]
    if swept:  # one of its jobs
        given = [re.sub(r",.*$", "", w.replace("=range(", "=")) for w in given]
    assert (ROOT / f"{program.replace('.', '/')}.py").is_file()
    importlib.import_module(program).main.config(given)


def test_the_pages_have_commands_at_all() -> None:
    assert len(SHOWN) > 70
    assert sum(needs_hardware(words) for words in SHOWN.values()) >= 6


def run(words: list[str], folder: Path, seconds: float = PATIENCE_S) -> None:
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "HOME": str(folder), "OMP_NUM_THREADS": "1"}
    done = subprocess.run(
        [sys.executable, "-m", *words],
        cwd=folder, env=environment, capture_output=True, text=True, timeout=seconds, check=False,
    )  # fmt: skip
    assert done.returncode == 0, f"{' '.join(words)}: {done.stderr[-2000:]}"


def shorter(words: list[str]) -> list[str]:
    """The same command with less to do; an emulated device runs as fast as this machine can follow."""
    less = LESS.get(words[0], [])
    if any(word.startswith("resume=") for word in words):
        return words
    if "backend=emulator" in words:
        less = ["scenario.minutes=[2,2,2]", "scenario.recovery_od=0.3", "backend.reactors=[M0]"]
        if any("ratio" in word or "plant=coculture" in word for word in words):
            one = ["setpoints=[0.5]", "minutes=[5]", "temperatures=[33.2]", "ratios=[0.3]"]
            less = [*(f"scenario.{values}" for values in one), "backend.reactors=[M0]"]
    return [*words, *less]


README = [
    words
    for words in commands(ROOT / "README.md")
    if words[0] not in ("turbidostat", "experiments.demo") and not needs_hardware(words)
]


@pytest.fixture(scope="module")
def reader(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of somebody who types the lines of the README one after the other."""
    return tmp_path_factory.mktemp("reader")


@pytest.mark.numeric
@pytest.mark.xdist_group("readme")
@pytest.mark.parametrize("words", README, ids=[" ".join(words) for words in README])
def test_the_readme_works_line_by_line(words: list[str], reader: Path) -> None:
    run(shorter(words), reader)
    if SHIPPED in words:
        newest = max(reader.glob("runs/train/*/policy.npz"), key=lambda path: path.stat().st_mtime)
        shutil.copy(ROOT / "dqn" / "shipped" / "policy.npz", newest)


def test_the_readme_has_lines_that_need_no_hardware() -> None:
    assert len(README) > 12


@pytest.mark.slow
@pytest.mark.timeout(3600)
@pytest.mark.parametrize("shown", [name for name in SHOWN if "README" not in name and not needs_hardware(SHOWN[name])])
def test_a_command_of_the_pages_runs(shown: str, tmp_path: Path) -> None:
    run(["experiments.calibrate", "hydra.run.dir=RUN"], tmp_path)
    if "resume=RUN" in shown or "run=RUN" in shown:
        run(["experiments.deploy", "hydra.run.dir=RUN"], tmp_path)
    shutil.copy(ROOT / "dqn" / "shipped" / "policy.npz", tmp_path / "RUN")
    for name in ("RECORDING.csv", "FILE.csv", "chibio_ecoli_dither.csv"):
        shutil.copy(ROOT / "experiments" / "data" / "open_loop.csv", tmp_path / name)
    run(shorter(SHOWN[shown]), tmp_path, 3000.0)
