"""Who may import whom, and that the bench path stays free of torch."""

import ast
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
OURS = {"dqn", "envs", "hardware", "experiments"}
SIMULATED = ("hardware/simulated.py", "hardware/emulator/")  # what of hardware knows envs


def sources(package: str) -> list[Path]:
    return sorted((ROOT / package).rglob("*.py"))


def imported(path: Path) -> set[str]:
    """Top-level names of every absolute import in a file, inside functions too."""
    names = set()
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            names |= {alias.name.split(".")[0] for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module and node.level == 0:
            names.add(node.module.split(".")[0])
    return names


def allowed(path: Path) -> set[str]:
    name = path.relative_to(ROOT).as_posix()
    package = name.split("/")[0]
    if package == "hardware":
        knows_envs = name.startswith(SIMULATED)
        return {"hardware", "envs"} if knows_envs else {"hardware"}
    return {"envs": {"envs"}, "dqn": {"dqn"}, "experiments": OURS}[package]


@pytest.mark.parametrize("package", sorted(OURS))
def test_imports_go_one_way(package):
    files = sources(package)
    assert files
    for path in files:
        wrong = (imported(path) & OURS) - allowed(path)
        assert not wrong, f"{path.relative_to(ROOT)} imports {sorted(wrong)}"


@pytest.mark.parametrize(
    ("package", "forbidden"),
    [
        ("envs", {"torch", "hydra", "omegaconf", "tensorboard", "matplotlib"}),
        ("hardware", {"torch", "hydra", "omegaconf", "tensorboard", "matplotlib", "gymnasium"}),
        ("dqn", {"hydra", "omegaconf", "gymnasium", "tensorboard", "matplotlib", "stable_baselines3"}),
        ("experiments", {"stable_baselines3"}),
    ],
)
def test_third_parties_stay_where_they_belong(package, forbidden):
    rival = {ROOT / "experiments" / "timing" / "rivals.py"}  # what speed is compared with, an extra
    for path in sources(package):
        wrong = imported(path) & forbidden
        assert not wrong or path in rival, f"{path.relative_to(ROOT)} imports {sorted(wrong)}"


def test_no_module_level_random_numbers():
    for package in sorted(OURS):
        for path in sources(package):
            for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
                if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Attribute):
                    name = f"{ast.unparse(node.value)}.{node.attr}"
                    good = ("Generator", "SeedSequence", "default_rng", "Philox", "PCG64")
                    assert not name.startswith("np.random.") or node.attr in good, f"{path}: {name}"


def test_the_bench_path_loads_no_torch():
    """Deploying needs NumPy policy, loop, recorder and TensorBoard's writer; none of them may pull torch."""
    code = (
        "import sys, dqn.policy, experiments.deploy, experiments.control.loop, experiments.reporting.tensorboard, "
        "experiments.reporting.charts, "
        "experiments.controllers.learned, hardware.simulated; print('torch' in sys.modules)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=ROOT, check=True)
    assert done.stdout.strip() == "False"
