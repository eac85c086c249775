"""A command that cannot begin, or that a disk, a folder or a reader refuses, ends with one line or none."""

import errno
import json
import os
import signal
import subprocess
import sys
import time
from multiprocessing.connection import Connection
from pathlib import Path

import pytest

from experiments.__main__ import KINDS
from experiments.cli import start
from tests import programs
from tests.programs import OURS

ROOT = Path(__file__).parents[2]
EDITABLE = f"""
import sys
from importlib.machinery import PathFinder
class Finder:  # stands behind the path, as that of `pip install -e` does
    find_spec = staticmethod(lambda name, path=None, target=None: PathFinder.find_spec(name, path or [{str(ROOT)!r}]))
sys.meta_path.append(Finder)
"""


def started(cwd: Path, path: str, *program: str) -> subprocess.CompletedProcess[str]:
    environment = {**os.environ, "OMP_NUM_THREADS": "1", "PYTHONPATH": path}
    return subprocess.run([sys.executable, *program], cwd=cwd, env=environment, capture_output=True, text=True)


def clash(name: str, place: Path) -> str:
    remedy = "rename the first one, or start the command from another folder"
    return f"package {name} is taken from {place}, not from {ROOT / name}; {remedy}"


def test_on_windows_one_line_says_wsl(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "platform", "win32")
    for program, kind in (("-m", SystemExit), ("notebook", ImportError)):
        monkeypatch.setattr(sys, "argv", [program])
        with pytest.raises(kind, match="WSL"):
            start.begin()


@pytest.mark.parametrize("name", ["conf", "dqn", "envs", "hardware"])
def test_a_package_of_that_name_where_a_command_is_started(name: str, tmp_path: Path) -> None:
    (tmp_path / name).mkdir()
    (tmp_path / name / "__init__.py").touch()
    done = started(tmp_path, str(ROOT), "-m", "experiments.calibrate", "--help")
    assert (done.returncode, done.stdout, done.stderr) == (1, "", f"error: {clash(name, tmp_path / name)}\n")


def test_a_module_of_that_name_in_another_package(tmp_path: Path) -> None:
    (tmp_path / "installed").mkdir()
    (tmp_path / "installed" / "dqn.py").touch()
    path = os.pathsep.join([str(tmp_path / "installed"), str(ROOT)])
    done = started(tmp_path, path, "-m", "experiments.calibrate", "--help")
    assert (done.returncode, done.stderr) == (1, f"error: {clash('dqn', tmp_path / 'installed' / 'dqn.py')}\n")
    done = started(tmp_path, path, "-c", "import experiments")
    assert done.stderr.splitlines()[-1] == f"ImportError: {clash('dqn', tmp_path / 'installed' / 'dqn.py')}"


def test_a_mere_folder_of_that_name_beside_an_editable_install(tmp_path: Path) -> None:
    """It has no `__init__.py`, and yet comes before what stands behind the path."""
    (tmp_path / "site").mkdir()
    (tmp_path / "site" / "sitecustomize.py").write_text(EDITABLE)
    (tmp_path / "work" / "conf").mkdir(parents=True)
    packages = [p for p in sys.path if p.endswith("site-packages")]
    path = os.pathsep.join([str(tmp_path / "site"), *packages])
    # -S keeps a path file of this machine's own from putting the project on the path as well
    program = ("-S", "-c", "import sitecustomize, runpy, sys; sys.argv[:] = ['-m']; sys.path.insert(0, ''); "
               "runpy.run_module('experiments.calibrate', run_name='__main__', alter_sys=True)")  # fmt: skip
    done = started(tmp_path / "work", path, *program)
    assert (done.returncode, done.stderr) == (1, f"error: {clash('conf', tmp_path / 'work' / 'conf')}\n")
    assert not list((tmp_path / "work").glob("runs"))


@pytest.mark.parametrize(
    ("name", "more", "also"),
    [
        ("deploy", ["resume=runs/deploy/x"], "; pumps not verified off: resume the run"),
        ("train", ["resume=runs/train/x"], ""),
    ],
)
def test_ctrl_c_while_a_command_is_imported(tmp_path: Path, name: str, more: list[str], also: str) -> None:
    environment = {**os.environ, "OMP_NUM_THREADS": "1", "PYTHONPATH": str(ROOT)}
    command = [sys.executable, "-m", f"experiments.{name}", *more]
    process = subprocess.Popen(command, cwd=tmp_path, env=environment, stderr=subprocess.PIPE, text=True)
    while "_multiarray_umath" not in Path(f"/proc/{process.pid}/maps").read_text():
        assert process.poll() is None
        time.sleep(0.001)
    process.send_signal(signal.SIGINT)
    said = process.communicate()[1]
    assert said == f"stopped before the command started{also}\n"
    assert process.returncode in (130, -signal.SIGINT)
    assert not list(tmp_path.iterdir())


COMMANDS = (*KINDS["From a recording to a reactor"], *KINDS["At the device"], "benchmark")
SLOW = ("matplotlib", "pandas", "scipy", "tensorboard", "torch")
REFUSED = {  # out of range; a command that has no number refuses its words in another way
    "train": "seed=-1", "deploy": "control_min=0", "benchmark": "replicates=0", "certify": "trajectories=-1",
    "calibrate": "gain=2", "blank": "samples=0", "calibrate_pump": "doses=0",
}  # fmt: skip
ASKED = """
import contextlib, importlib, io, json, sys
commands, slow = json.loads(sys.argv[1])
for name, *words in commands:
    sys.argv = [f"turbidostat {name}", *words]
    with contextlib.redirect_stdout(io.StringIO()), contextlib.suppress(SystemExit):
        importlib.import_module(f"experiments.{name}").main()
    if loaded := [each for each in slow if each in sys.modules]:
        sys.exit(f"{name} {' '.join(words)} loads {', '.join(loaded)}")
"""


@pytest.mark.slow
def test_help_and_a_refusal_load_nothing_that_is_slow(tmp_path: Path) -> None:
    """What computes, draws and trains is loaded where it is used: a slip of the pen costs no second."""
    commands = [[name, word] for name in COMMANDS for word in ("--help", "bogus=1", REFUSED.get(name)) if word]
    done = started(tmp_path, str(ROOT), "-c", ASKED, json.dumps([commands, SLOW]))
    assert done.returncode == 0, done.stderr.splitlines()[-1]
    refusals = [line for line in done.stderr.splitlines() if "error: " in line]
    assert len(refusals) == sum(word != "--help" for _, word in commands), done.stderr
    assert not list(tmp_path.iterdir())


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


@pytest.mark.parametrize("words", [["agent="], ["env.mu=["], ["agent=nope"], ["seed=0,1", "agent.learning_rat=1"]])
def test_a_sweep_that_cannot_be_composed_is_one_line_and_leaves_no_folder(words: list[str], tmp_path: Path) -> None:
    refused(run("experiments.train", "-m", *words, "hydra.sweep.dir=all", cwd=tmp_path), "error: ")
    assert not (tmp_path / "all").exists()


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
