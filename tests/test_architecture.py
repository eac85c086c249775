"""Layers and who may import whom, no circles, commands that nobody imports, a bench without torch."""

import ast
import re
import subprocess
import sys
from collections.abc import Iterator
from functools import cache
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PACKAGES = ("conf", "dqn", "envs", "hardware", "experiments")

FORBIDDEN = {
    "conf": {"torch", "numpy", "hydra", "omegaconf"},
    "envs": {"torch", "hydra", "omegaconf", "tensorboard", "matplotlib"},
    "hardware": {"torch", "hydra", "omegaconf", "tensorboard", "matplotlib", "gymnasium"},
    "dqn": {"hydra", "omegaconf", "gymnasium", "tensorboard", "matplotlib", "stable_baselines3"},
    "experiments": {"stable_baselines3"},
}


def architecture() -> str:
    return (ROOT / "docs" / "architecture.md").read_text(encoding="utf-8")


def plan() -> dict[str, tuple[int, set[str]]]:
    """Room -> its layer, and the rooms that it may not import although they are not above it."""
    text = architecture().partition("## Layers")[2]
    rows = re.findall(r"^\| (\d) \| `([\w/]+)` \|.*\| ([^|]*)\|$", text, re.MULTILINE)
    return {
        room.replace("/", "."): (int(layer), {other.replace("/", ".") for other in re.findall(r"`([\w/]+)`", cell)})
        for layer, room, cell in rows
    }


PLAN = plan()


@cache
def modules() -> dict[str, Path]:
    """Dotted name -> file of every module of ours; a package stands for its `__init__.py`."""
    found = {}
    for package in PACKAGES:
        for path in sorted((ROOT / package).rglob("*.py")):
            name = ".".join(path.relative_to(ROOT).with_suffix("").parts)
            found[name.removesuffix(".__init__")] = path
    return found


@cache
def tree(module: str) -> ast.Module:
    return ast.parse(modules()[module].read_text(encoding="utf-8"))


def imported(module: str) -> Iterator[str]:
    """Every name a module imports, inside functions and under TYPE_CHECKING too."""
    for node in ast.walk(tree(module)):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module and node.level == 0:
            for alias in node.names:
                full = f"{node.module}.{alias.name}"
                yield full if full in modules() else node.module


@cache
def ours(module: str) -> frozenset[str]:
    return frozenset(name for name in imported(module) if name in modules() and name != module)


def is_command(module: str) -> bool:
    return module.count(".") == 1 and module.startswith("experiments.") and modules()[module].name != "__init__.py"


def room(module: str) -> str:
    """The package a module is in."""
    return module if modules()[module].name == "__init__.py" else module.rpartition(".")[0]


def test_every_room_has_its_layer():
    assert {room(m) for m in modules()} - {"experiments"} == set(PLAN)
    assert {layer for layer, _ in PLAN.values()} == {1, 2, 3, 4, 5}


@pytest.mark.parametrize("name", sorted(PLAN))
def test_a_room_imports_its_own_layer_and_what_is_below(name):
    layer, barred = PLAN[name]
    assert not {other for other in barred if PLAN[other][0] > layer}, "said twice: it is above"
    inside = [m for m in modules() if room(m) == name]
    assert inside
    used = {f"{m} imports {other}": room(other) for m in inside for other in ours(m) if room(other) != name}
    up = [line for line, other in used.items() if other == "experiments" or PLAN[other][0] > layer]
    kept_out = [line for line, other in used.items() if any(f"{other}.".startswith(f"{one}.") for one in barred)]
    assert not up + kept_out


def test_no_circle_of_imports():
    graph = {m: ours(m) - {"envs"} for m in modules()}  # importing any file of envs runs its registration
    try:
        list(TopologicalSorter(graph).static_order())
    except CycleError as circle:
        pytest.fail(" -> ".join(circle.args[1]))


GUEST_ROOMS = ("envs.coculture", "experiments.coculture", "experiments.calibrate_pair")
GUEST_WORDS = re.compile(r"coculture|species|composition|pairconfig|of_pair", re.IGNORECASE)
NAMED_ALL_THE_SAME = {
    "conf.guests": "the one place where guests are registered",
    "hardware.safety.config": "the thermostat's limits are the keys composition_low and composition_high",
    "hardware.storage.marks": "a share that was counted is a column of marks.csv",
}


def test_the_core_neither_imports_nor_names_a_guest():
    """The rooms of guests are entered through what anybody may add, by the names in conf/guests.py alone."""
    core = [m for m in modules() if not f"{m}.".startswith(tuple(f"{room}." for room in GUEST_ROOMS))]
    named = {m for m in core if GUEST_WORDS.search(modules()[m].read_text(encoding="utf-8"))}
    allowed = {m for m in core if f"{m}.".startswith(tuple(f"{place}." for place in NAMED_ALL_THE_SAME))}
    assert named - allowed == set()
    assert {place for place in NAMED_ALL_THE_SAME if not any(f"{m}.".startswith(f"{place}.") for m in named)} == set()


def test_nobody_imports_a_command():
    for module in modules():
        wrong = {m for m in ours(module) if is_command(m)}
        assert not wrong, f"{module} imports {sorted(wrong)}"


def test_the_program_does_without_its_tests():
    for module in modules():
        assert not {name for name in imported(module) if name.split(".")[0] == "tests"}, module


def test_every_command_can_be_run():
    for module in filter(is_command, modules()):
        text = modules()[module].read_text(encoding="utf-8")
        assert 'if __name__ == "__main__":' in text, module
        assert module.removesuffix(".__main__") in (ast.get_docstring(tree(module)) or ""), module


def test_a_package_says_what_it_is_for_and_does_nothing():
    for module, path in modules().items():
        if path.name == "__init__.py":
            text = ast.get_docstring(tree(module))
            assert text, module
            assert len(text.splitlines()) <= 5, module
            does = module in (
                "envs",
                "experiments",
            )  # one registers its environment, one checks whose packages these are
            assert len(tree(module).body) == 1 or does, f"{module}: code in __init__.py"


@pytest.mark.parametrize("package", PACKAGES)
def test_third_parties_stay_where_they_belong(package):
    for module in modules():
        if module.split(".")[0] == package:
            wrong = {name.split(".")[0] for name in imported(module)} & FORBIDDEN[package]
            assert not wrong, f"{module} imports {sorted(wrong)}"


def test_no_module_level_random_numbers():
    for module in (name for name, path in modules().items() if "np.random" in path.read_text(encoding="utf-8")):
        for node in ast.walk(tree(module)):
            if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Attribute):
                name = f"{ast.unparse(node.value)}.{node.attr}"
                good = ("Generator", "SeedSequence", "default_rng", "Philox", "PCG64")
                assert not name.startswith("np.random.") or node.attr in good, f"{module}: {name}"


@pytest.mark.slow
def test_the_bench_path_loads_no_torch():
    """Deploying needs NumPy policy, loop, recorder and TensorBoard's writer; none of them may pull torch."""
    names = [m for m in modules() if room(m) in ("experiments.control", "experiments.laws.density", "hardware.chibio")]
    code = f"import sys, {', '.join([*names, 'experiments.deploy'])}; print('torch' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=ROOT, check=True)
    assert done.stdout.strip() == "False"


def test_the_page_names_files_that_exist():
    named = set(re.findall(r"\b(?:conf|dqn|envs|hardware|experiments|tests|docs)/[\w/.-]+\.\w+", architecture()))
    assert len(named) > 40
    missing = sorted(name for name in named if not (ROOT / name).is_file())
    assert not missing


def test_the_ways_through_the_code_name_functions_that_exist():
    steps = re.findall(r"^\d+\. `([\w/]+/\w+\.py)`, (`[\w.`, ]+`)", architecture(), re.MULTILINE)
    assert len(steps) > 30
    for file, names in steps:
        text = (ROOT / file).read_text(encoding="utf-8")
        for name in re.findall(r"\w+", names):
            assert re.search(rf"\b(?:def|class) {name}\b|^{name}\b", text, re.MULTILINE), f"{file}: {name}"


def test_a_class_has_a_name_of_its_own():
    """One that occurs twice means two things; `_Private` ones are seen in their file alone."""
    names = [node.name for m in modules() for node in tree(m).body if isinstance(node, ast.ClassDef)]
    assert sorted(name for name in names if names.count(name) > 1 and name[0] != "_") == []


def test_no_random_numbers_are_seeded_from_a_clock() -> None:
    """A failure that nobody can repeat teaches nothing."""
    found = []
    seeded, clock = "default_rng|Random|SeedSeq|seed$", r"time(_ns)?\(|monotonic|now\("
    for path in [*modules().values(), *sorted((ROOT / "tests").rglob("*.py"))]:
        text = path.read_text(encoding="utf-8")
        both = re.search(seeded.rstrip("$"), text) and re.search(clock, text)
        for node in ast.walk(ast.parse(text)) if both else ():
            if isinstance(node, ast.Call) and re.search(seeded, ast.unparse(node.func)):
                given = ast.unparse(node)
                found += [f"{path.relative_to(ROOT)}: {given}"] * bool(re.search(clock, given))
    assert found == []
