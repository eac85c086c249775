"""Every command of README and docs does what the page says, or needs hardware.

All of them are checked against what the commands take. Those of the README run, each behind the ones whose files it
reads, with less work for the long ones; `-m campaign` runs all the others.
"""

import importlib
import json
import os
import re
import shlex
import shutil
import subprocess
from collections.abc import Callable
from functools import cache
from pathlib import Path

import pytest

from tests import programs
from tests.documented import OPEN, PAGES, ROOT, commands, needs_hardware
from tests.patience import PATIENCE_S

OTHERS = (
    "experiments", "experiments.demo", "experiments.cli.reference", "hardware.emulator", "hardware.rig",
    "turbidostat",
)  # fmt: skip
SHOWN = {
    " ".join(words): words
    for page in PAGES
    if page.name != "extending.md"  # whose commands a test of its own runs
    for words in commands(page)
    if words[0] not in OTHERS
}
RECORDINGS = "RECORDING.csv", "FILE.csv", "chibio_ecoli_dither.csv"
LESS = {
    "tests.campaigns.rig_study": ['overrides=[scenario.recovery_od=0.7,"scenario.minutes=[3,3,3]"]'],
    "experiments.train": ["agent.total_steps=300", "agent.learn_start=100", "n_agents=2"],
    "tests.studies.ablate": ["agent.total_steps=300", "n_agents=2"],
    "experiments.benchmark": ["replicates=1", "train_seeds=1"],
    "tests.campaigns.faults": ["controls=0", "moments=[dose]", "faults=[feed weak]"],
    "tests.campaigns.kills": ["kills=2", "runs=1"],
    "tests.campaigns.soak": ["days=0.05"],
}
"""Command -> what makes it shorter here without leaving out a part of it."""


def ready(folder: Path) -> None:
    """Files that the pages take for granted: runs of earlier commands, recordings of the reader's own."""
    for name in ("RUN", "SWEEP"):
        (folder / name).mkdir()
        (folder / name / "config.yaml").write_text("seed: 0\n", encoding="utf-8")
    run = folder / "RUN"
    shutil.copy(ROOT / "dqn" / "shipped" / "policy.npz", run)
    for name in RECORDINGS:
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


@pytest.mark.parametrize("shell", ["bash", "zsh"])
def test_a_shell_passes_the_words_of_every_line_on_as_they_stand(shell: str, tmp_path: Path) -> None:
    """Pages and the comments of the presets, which `--help` prints; zsh refuses a bracket that is not quoted."""
    if shutil.which(shell) is None:
        pytest.skip(f"{shell} is not installed")
    presets = [path for room in ("conf", "tests") for path in (ROOT / room).rglob("*.yaml")]
    text = re.sub(r"\\\n\s*", "", "\n".join(path.read_text(encoding="utf-8") for path in (*PAGES, *presets)))
    shown = re.findall(r"(?:^ {4}|^# {3}|`)(python -m .*?)(?= {2}|`|$| \| | > | #)", text, re.MULTILINE)
    lines = [line for line in shown if not OPEN.search(line)]
    script = "\n".join(["python() { printf '%s\\n' \"$*\"; }", *lines])
    plain = {"PATH": os.environ["PATH"], "HOME": "$HOME"}
    done = subprocess.run(
        [shell, "-c", script], cwd=tmp_path, env=plain, capture_output=True, text=True, timeout=PATIENCE_S
    )
    assert done.stderr == ""
    assert done.stdout.splitlines() == [" ".join(shlex.split(line)[1:]) for line in lines]


def test_the_pages_have_commands_at_all() -> None:
    assert len(SHOWN) > 70
    assert sum(needs_hardware(words) for words in SHOWN.values()) >= 6


def run(words: list[str], folder: Path, seconds: float = PATIENCE_S, **environment: str) -> None:
    done = programs.run(*words, cwd=folder, seconds=seconds, HOME=str(folder), **environment)
    assert done.returncode == 0, f"{' '.join(words)}: {done.stderr[-2000:]}"


def shorter(words: list[str]) -> list[str]:
    """The same command with less to do; an emulated device runs as fast as this machine can follow."""
    less = LESS.get(words[0], [])
    if any(word.startswith("resume=") for word in words):
        return words
    if words == ["experiments.deploy", "scenario=ratio_steps"]:
        less = ["scenario.minutes=[20,20,20,20]"]
    if "backend=emulator" in words:
        less = ["scenario.minutes=[2,2,2]", "scenario.recovery_od=0.3", "backend.reactors=[M0]"]
        if any("ratio" in word or "plant=coculture" in word for word in words):
            one = ["setpoints=[0.5]", "minutes=[5]", "temperatures=[33.2]", "ratios=[0.3]"]
            less = [*(f"scenario.{values}" for values in one), "backend.reactors=[M0]"]
    return [*words, *less]


README = {
    " ".join(words): words
    for words in commands(ROOT / "README.md")
    if words[0] not in ("turbidostat", "experiments.demo", "experiments.certify", "hardware.emulator")
    and not needs_hardware(words)
}
QUICK = (
    "experiments", "experiments.calibrate", "experiments.train env_file=latest",
    "experiments.deploy policy=latest env_file=latest",
)  # fmt: skip
"""Lines of every run of the suite; their figures are blank."""


def before(shown: str) -> str | None:
    """The line of the README whose files this one reads."""
    lines = [*README][: [*README].index(shown)]
    if "policy=latest" in shown:
        writer = "train env_file=latest"
    elif "_file=latest" in shown or "report" in shown:
        writer = "-m " if "runs=" in shown else "calibrate"
    else:
        writer = "stop_within" if "resume=latest" in shown else None
    return None if writer is None else next(line for line in lines if writer in line)


@pytest.fixture(scope="module")
def lived(tmp_path_factory: pytest.TempPathFactory) -> Callable[[str], Path]:
    """The folder of somebody who typed a line of the README, and before it those that it needs."""

    @cache
    def typed(shown: str) -> Path:
        folder = tmp_path_factory.mktemp("reader")
        shutil.copy(ROOT / "experiments" / "data" / "open_loop.csv", folder / "YOURS.csv")
        if earlier := before(shown):
            shutil.copytree(typed(earlier), folder, dirs_exist_ok=True)
        plain = {"WITHOUT_FIGURES": "1"} if shown in QUICK else {}
        run(shorter(README[shown]), folder, **plain)
        return folder

    return typed


@pytest.mark.numeric
@pytest.mark.xdist_group("readme")
@pytest.mark.parametrize(
    "shown", [pytest.param(line, marks=[] if line in QUICK else pytest.mark.slow) for line in README]
)
def test_a_line_of_the_readme_works(shown: str, lived: Callable[[str], Path]) -> None:
    lived(shown)


@pytest.mark.numeric
@pytest.mark.slow
def test_the_way_of_the_readme_from_a_recording_to_the_device_is_completed(tmp_path: Path) -> None:
    """Calibrate, train, certify, preflight, run: by the Chi.Bio driver over sockets, and nothing is forced."""
    lines = list(commands(ROOT / "README.md"))
    [server] = [words for words in lines if words[0] == "hardware.emulator"]
    [check, deploy] = [words for words in lines if any(word.startswith("backend.url=") for word in words)]
    run(["experiments.calibrate"], tmp_path)
    run(["experiments.train", "env_file=latest", "stop_within=2"], tmp_path)
    refused = programs.run(*deploy, cwd=tmp_path)
    assert (refused.returncode, "force_policy" in refused.stderr) == (1, True)
    run(["experiments.certify", "policy=latest"], tmp_path)
    with programs.Program(*server, "--port", "0", cwd=tmp_path, out=tmp_path / "said") as device:
        device.until(lambda: "emulator ready" in device.said())
        [url] = re.findall(r"ready: (http://\S+)", device.said())
        here = [f"backend.url={url}" if word.startswith("backend.url=") else word for word in deploy]
        run([*here, "preflight_only=true"], tmp_path)
        run([*here, "scenario.minutes=[3,2,2]", "scenario.recovery_od=0.3"], tmp_path)
    assert set(check) - set(deploy) == {"preflight_only=true"}
    [summary] = tmp_path.glob("runs/deploy/*/summary.json")
    assert json.loads(summary.read_text())["outcome"] == "completed"


def test_the_readme_has_lines_that_need_no_hardware() -> None:
    assert len(README) > 12
    assert set(QUICK) <= set(README)


@pytest.mark.campaign
@pytest.mark.timeout(3600)
@pytest.mark.parametrize("shown", [name for name in SHOWN if name not in README and not needs_hardware(SHOWN[name])])
def test_a_command_of_the_pages_runs(shown: str, tmp_path: Path) -> None:
    run(["experiments.calibrate", "hydra.run.dir=RUN"], tmp_path)
    if "resume=RUN" in shown or "run=RUN" in shown:
        run(["experiments.deploy", "hydra.run.dir=RUN"], tmp_path)
    shutil.copy(ROOT / "dqn" / "shipped" / "policy.npz", tmp_path / "RUN")
    for name in RECORDINGS:
        shutil.copy(ROOT / "experiments" / "data" / "open_loop.csv", tmp_path / name)
    run(shorter(SHOWN[shown]), tmp_path, 3000.0)
