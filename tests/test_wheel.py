"""What a user installs: every file the program reads is in the wheel, and the commands run from another folder."""

import os
import shutil
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

pytestmark = [pytest.mark.slow, pytest.mark.xdist_group("wheel")]  # one worker makes what its tests look at
ROOT = Path(__file__).parents[1]
READ = {
    "conf/deploy.yaml", "conf/scenario/hold.yaml", "conf/hydra/launcher/slurm.yaml", "dqn/shipped/policy.npz",
    "dqn/shipped/certificate.json", "experiments/data/open_loop.csv", "experiments/reporting/report.html.j2",
    "experiments/reporting/style.css", "hardware/board/board_agent.py", "hardware/board/board_agent.service",
}  # fmt: skip


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder, source = tmp_path_factory.mktemp("wheel"), tmp_path_factory.mktemp("source") / "tree"
    others = shutil.ignore_patterns(
        ".*", "runs", "multirun", "build", "dist", "*.egg-info", "__pycache__", "tests", "docs"
    )
    shutil.copytree(ROOT, source, ignore=others)  # a build leaves its own things in the tree
    words = ["-m", "pip", "wheel", "--quiet", "--disable-pip-version-check", "--no-deps", "--wheel-dir", str(folder)]
    done = subprocess.run([sys.executable, *words, str(source)], capture_output=True, text=True)
    if done.returncode and "setuptools" in done.stderr:
        pytest.skip("setuptools, which builds the wheel, cannot be fetched here")
    assert done.returncode == 0, done.stderr
    [built] = folder.glob("*.whl")
    return built


@pytest.fixture(scope="module")
def installed(wheel: Path) -> Path:
    folder = wheel.parent / "site"
    with zipfile.ZipFile(wheel) as archive:
        archive.extractall(folder)
    return folder


def run(site: Path, cwd: Path, *words: str) -> subprocess.CompletedProcess[str]:
    environment = {**os.environ, "PYTHONPATH": str(site), "HOME": str(cwd)}
    return subprocess.run([sys.executable, *words], cwd=cwd, env=environment, capture_output=True, text=True)


def test_every_file_that_is_not_code_is_in_the_wheel(wheel: Path) -> None:
    names = set(zipfile.ZipFile(wheel).namelist())
    read = {
        p.relative_to(ROOT).as_posix()
        for f in ("conf", "dqn", "experiments", "hardware")
        for p in (ROOT / f).rglob("*")
    }
    kept = {name for name in read if name.endswith((".yaml", ".npz", ".json", ".csv", ".j2", ".css", ".service"))}
    assert names >= READ
    assert names >= kept
    assert not [name for name in names if name.startswith(("tests", "docs"))]


def test_the_console_script_is_declared(wheel: Path) -> None:
    with zipfile.ZipFile(wheel) as archive:
        [name] = [n for n in archive.namelist() if n.endswith("entry_points.txt")]
        assert "turbidostat = experiments.__main__:main" in archive.read(name).decode()


def test_the_way_from_a_recording_to_a_page_from_another_folder(installed: Path, tmp_path: Path) -> None:
    for line in (
        "calibrate",
        "train env_file=latest agent.total_steps=400 agent.learn_start=100",
        "deploy policy=latest scenario=hold scenario.minutes=[10]",
        "certify policy=shipped quick=true trajectories=0",
        "report",
    ):
        done = run(installed, tmp_path, "-m", "experiments", *line.split())
        assert done.returncode == 0, f"{line}: {done.stderr}"
        assert str(ROOT) not in done.stdout + done.stderr
    assert list(tmp_path.glob("runs/*/*/report.html"))
    service = installed / "hardware" / "board" / "board_agent.service"
    assert "board_agent.py" in service.read_text(encoding="utf-8")
