"""Packages of the same names elsewhere are told apart from ours before anything runs; an early Ctrl-C is one line."""

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from experiments.__main__ import KINDS

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
    remedy = "rename that one, or start the command from another folder"
    return f"package {name} is taken from {place}, not from {ROOT / name}; {remedy}"


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
    assert said == f"stopped before anything began{also}\n"
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
