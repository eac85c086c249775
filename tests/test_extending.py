"""Every file and command of docs/extending.md, as a user would type them, in an empty folder."""

import csv
import json
import re
import shlex
import subprocess
from pathlib import Path

import numpy as np
import pytest

from tests import programs
from tests.programs import ROOT

PAGE = (ROOT / "docs" / "extending.md").read_text(encoding="utf-8")
NAMED = re.compile(r"`(\w+\.(?:py|yaml))`(?:(?!`\w+\.(?:py|yaml)`)[\s\S])*?```(?:python|yaml)\n([\s\S]*?)```")
FILES = {name: text for name, text in NAMED.findall(PAGE)}
WHOLE = {  # named by the page
    name: (ROOT / "tests" / "extensions" / name).read_text(encoding="utf-8")
    for name in ("light.py", "drug.py", "ekf.py", "ppo.py")
}
COMMANDS = [line.removeprefix("    ") for line in PAGE.splitlines() if line.startswith("    python ")]
SHORT = {
    "experiments.benchmark": ["replicates=1"],
    "experiments.train": ["agent.total_steps=500", "agent.learn_start=100"],
}


def run(words: list[str], folder: Path) -> subprocess.CompletedProcess[str]:
    """A command whose figures are blank."""
    return programs.run(*words, cwd=folder, WITHOUT_FIGURES="1")


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    for name, text in (FILES | WHOLE).items():
        (tmp_path / name).write_text(text, encoding="utf-8")
    return tmp_path


def summary(folder: Path) -> dict[str, object]:
    [path] = folder.glob("runs/*/*/summary.json")
    found: dict[str, object] = json.loads(path.read_text(encoding="utf-8"))
    return found


def test_the_page_names_every_file_it_shows() -> None:
    names = "steps.yaml", "gentle.py", "patient.py", "heat_shock.py", "logged.py", "log_error.py", "sb3.py", "mine.py"
    assert set(FILES) == set(names)
    assert len(COMMANDS) == 18


@pytest.mark.slow
@pytest.mark.parametrize("command", [c for c in COMMANDS if not re.search("sb3|ppo|policy", c)])
def test_a_command_of_the_page_works(command: str, folder: Path) -> None:
    words = shlex.split(command)[2:]
    done = run([*words, *SHORT.get(words[0], [])], folder)
    assert done.returncode == 0, done.stderr
    assert summary(folder)


@pytest.mark.slow
def test_another_library_trains_and_its_policy_chooses_as_its_network_does_and_pumps(folder: Path) -> None:
    pytest.importorskip("stable_baselines3", reason="Stable-Baselines3 is in the extra [bench]")
    assert [c for c in COMMANDS if "sb3" in c] == ["python sb3.py"]
    check = """
import runpy
from pathlib import Path
from dqn import policy as policies
made = runpy.run_path("sb3.py")
seen = made["np"].random.default_rng(0).uniform(0.05, 1.2, (500, 2)).astype("float32")
theirs, _ = made["model"].predict(seen, deterministic=True)
assert (policies.load(Path("policy.npz")).act(seen) == theirs).mean() > 0.995
"""
    [deploys] = [shlex.split(c)[2:] for c in COMMANDS if "policy.npz" in c]
    for words in (["-c", check], deploys):
        done = run(words, folder)
        assert done.returncode == 0, done.stderr
    assert summary(folder)["reactors"]


@pytest.mark.slow
def test_an_agent_of_ones_own_trains_and_its_policy_pumps(folder: Path) -> None:
    train, deploy = (shlex.split(c)[2:] for c in COMMANDS if re.search("ppo|deploy policy=latest", c))
    done = run([*train, "agent.total_steps=430", "agent.horizon=70", "hydra.run.dir=runs/train/here"], folder)
    assert done.returncode == 0, done.stderr
    found = summary(folder)
    assert (found["env_steps"], found["updates"]) == (430, 6 * 10)
    assert "train/critic_loss" in (folder / "runs/train/here/progress.csv").read_text(encoding="utf-8")
    again = run([*deploy, "scenario=./steps.yaml", "hydra.run.dir=there"], folder)
    assert again.returncode == 0, again.stderr
    assert json.loads((folder / "there" / "summary.json").read_text(encoding="utf-8"))["reactors"]


def test_an_agent_of_ones_own_continues_to_the_bit_from_amid_a_horizon(folder: Path) -> None:
    """Of two groups; the first record of the second life is that of the first one, and so is every weight."""
    check = """
import runpy
from pathlib import Path
import numpy as np, torch
from dqn import checkpoint
from envs.task import EnvConfig
from experiments.training import agents, tasks
agents.GROUP, task = 2, tasks.of(EnvConfig(episode_steps=30))
agent = runpy.run_path("ppo.py")["PpoConfig"](total_steps=130, horizon=41)
whole, again = (agents.population(task, agent, (3, 4, 9)) for _ in range(2))
start, records = whole.weights(), []
for record in whole.run():
    records.append(record)
    if record.step == 90:
        checkpoint.save(Path("at.pt"), whole.state_dict())
again.load_state_dict(checkpoint.load(Path("at.pt")))
for one, other in zip(records[3:], again.run(), strict=True):
    assert one.step == other.step
    np.testing.assert_array_equal(one.episode_return, other.episode_return)
    np.testing.assert_array_equal(one.curves["train/critic_loss"], other.curves["train/critic_loss"])
assert torch.equal(whole.weights(), again.weights()) and not (start == whole.weights()).all(1).any()
"""
    done = run(["-c", check], folder)
    assert done.returncode == 0, done.stderr


def test_a_controller_of_ones_own_decides(folder: Path) -> None:
    """With gain 0 it pumps what balances growth, mu tau = 0.01 mL/s, whatever it measures."""
    words = "extend=gentle.py controller=gentle controller.gain=0 scenario=./steps.yaml"
    done = run(["experiments.deploy", *words.split()], folder)
    assert done.returncode == 0, done.stderr
    [recording] = folder.glob("runs/deploy/*/recordings/M0.csv")
    with open(recording, encoding="utf-8") as f:
        proposed = [float(row["proposed_ml_s"]) for row in csv.DictReader(f) if row["proposed_ml_s"]]
    assert len(proposed) >= 30
    np.testing.assert_allclose(proposed, 0.03 / 3.0, rtol=1e-6)


def test_the_run_folder_keeps_the_file_and_resumes_without_it(folder: Path) -> None:
    first = ["experiments.train", "extend=log_error.py", "env=log_error", "agent.total_steps=300"]
    first.append("agent.learn_start=100")
    done = run([*first, "checkpoint_every=100", "hydra.run.dir=here"], folder)
    assert done.returncode == 0, done.stderr
    (folder / "log_error.py").unlink()
    again = run(["experiments.train", "resume=here"], folder)
    assert again.returncode == 0, again.stderr


def test_a_task_with_a_config_of_its_own_trains(tmp_path: Path) -> None:
    """A plain dataclass that shares nothing with the configs of the program, and observations of its own."""
    words = ["experiments.train", f"extend={ROOT / 'tests' / 'extensions' / 'level.py'}", "env=level"]
    done = run([*words, "agent.total_steps=200", "agent.learn_start=50", "hydra.run.dir=here"], tmp_path)
    assert done.returncode == 0, done.stderr
    assert "learns env=level agent=tuned: a tank that loses 10 % in a step;" in done.stderr + done.stdout
    assert "experiments.deploy" not in done.stderr + done.stdout  # which cannot run it
    found = json.loads((tmp_path / "here" / "summary.json").read_text(encoding="utf-8"))
    assert found["env_steps"] == 200
    with np.load(tmp_path / "here" / "policy.npz") as stored:
        assert json.loads(str(stored["metadata"]))["observation"] == ["level", "goal"]
        np.testing.assert_array_equal(stored["actions"], np.linspace(0.0, 0.2, 5))
    events = b"".join(path.read_bytes() for path in (tmp_path / "here").rglob("events*"))
    assert b"leak" in events
    for flag, expected in ((["--help=all"], "fraction of the level that leaks"), (["--cfg", "job"], "leak: 0.1")):
        shown = run([*words, *flag], tmp_path)
        assert shown.returncode == 0, shown.stderr
        assert expected in shown.stdout
    wrong = run([*words, "env.leak=2"], tmp_path)
    assert wrong.stderr == "error: env.leak = 2.0: allowed 0 to 1\n"


@pytest.mark.parametrize(
    ("name", "text", "said"),
    [
        ("mine.py", None, "extend="),
        ("mine.py", "import numpy\nnumpy.nothing\n", "mine.py:2: AttributeError"),
        ("mine.py", "def (:\n", "mine.py:1: SyntaxError"),
        (
            "mine.py",
            "from experiments.laws import registry\nregistry.add('pi', int, int, 'x')\n",
            "mine.py:2: NameTaken: ",
        ),
        ("mine.py", "from envs.plant import disturbance\ndisturbance.add('', print)\n", "mine.py:2: NotAllowed: "),
        ("mine.yaml", "setpoint: [0.5]\n", "scenario.setpoint"),
        ("mine.yaml", "[1, 2]\n", "scenario="),
        ("mine.yaml", "a: [\n", "scenario="),
    ],
)
def test_a_file_of_one_s_own_that_does_not_load_is_one_line(
    name: str, text: str | None, said: str, tmp_path: Path
) -> None:
    if text is not None:
        (tmp_path / name).write_text(text, encoding="utf-8")
    done = run(["experiments.deploy", f"{'extend' if name == 'mine.py' else 'scenario'}={name}"], tmp_path)
    assert (done.returncode, done.stderr.count("\n")) == (1, 1)
    assert done.stderr.startswith("error: ")
    assert said in done.stderr
    assert not (tmp_path / "runs").exists()


def test_cleanrl_s_way_to_an_environment() -> None:
    """What its dqn.py builds and reads, with the three changes of the page."""
    import gymnasium

    def copy() -> gymnasium.Env[object, object]:
        return gymnasium.wrappers.RecordEpisodeStatistics(gymnasium.make("envs:Bioreactor-v0"))

    env = gymnasium.vector.SyncVectorEnv([copy, copy], autoreset_mode=gymnasium.vector.AutoresetMode.SAME_STEP)
    env.reset(seed=1)
    for step in range(100):
        after, _, _, truncations, infos = env.step(env.action_space.sample())
        assert list(truncations) == [step == 99] * 2
    for k, first in enumerate(after):
        assert infos["final_info"]["episode"]["l"][k] == 100
        assert infos["final_obs"][k].shape == first.shape
        assert infos["final_obs"][k][0] != first[0]


def test_two_preset_files_of_one_name_are_told_apart(tmp_path: Path) -> None:
    for name in ("a", "b"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "steps.yaml").write_text(FILES["steps.yaml"], encoding="utf-8")
    done = run(["experiments.deploy", "-m", "scenario=a/steps.yaml,b/steps.yaml"], tmp_path)
    assert (done.returncode, done.stderr.count("\n")) == (1, 1)
    assert "b/steps.yaml" in done.stderr


def test_a_recipe_of_ones_own_stands_at_the_root(tmp_path: Path) -> None:
    (tmp_path / "mine.yaml").write_text("seed: 7\nagent: {total_steps: 300}\n", encoding="utf-8")
    done = run(["experiments.train", "experiment=mine.yaml", "--cfg", "job"], tmp_path)
    assert done.returncode == 0, done.stderr
    assert "seed: 7\n" in done.stdout
    assert "total_steps: 300\n" in done.stdout
