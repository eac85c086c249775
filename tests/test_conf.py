"""Every YAML composes and passes its schema; every wrong word on a command line ends in one clear line."""

import importlib
import re
import sys
from pathlib import Path
from typing import Any

import pytest
import yaml

from conf import presets
from conf.messages import NameTaken
from conf.schema import build, entries
from dqn.config import DQNConfig
from envs.plant.plant import PlantConfig
from envs.scenario import Scenario
from envs.task import EnvConfig
from experiments import __main__ as program
from experiments import demo
from experiments.cli import frame, reference
from experiments.cli.calibrated import read_env_file
from experiments.control.config import DeployConfig
from experiments.deploy import main as deploy
from experiments.train import main
from experiments.training.config import ENVS, TrainConfig
from hardware.chibio.config import ChiBioConfig, EmulatorConfig
from hardware.link.transport import TransportConfig
from hardware.safety.config import SafetyConfig
from hardware.simulated import SimulatedConfig
from tests.studies.ablate import variant

CONF = Path(__file__).parents[1] / "conf"


def options(group: str) -> list[str]:
    return sorted(p.stem for p in (CONF / group).glob("*.yaml"))


def load_train(*overrides: str) -> TrainConfig:
    return main.config(overrides)


def load_deploy(*overrides: str):
    cfg = frame.compose("deploy", overrides)
    return frame.load(cfg, DeployConfig())


def plain(value: Any) -> Any:
    """Tuples as YAML has them."""
    return [plain(one) for one in value] if isinstance(value, tuple | list) else value


def held(config: Any, values: dict[str, Any], prefix: str = "") -> dict[str, tuple[Any, Any]]:
    """Every value of a preset that a config has otherwise: the two of them by name."""
    wrong = {}
    for key, value in values.items():
        found = getattr(config, key)
        if isinstance(value, dict) and not isinstance(found, dict):
            wrong |= held(found, value, f"{prefix}{key}.")
        elif plain(found) != value:
            wrong[f"{prefix}{key}"] = found, value
    return wrong


COMPOSED = {"env": load_train, "agent": load_train, "scenario": load_deploy, "plant": load_deploy}


@pytest.mark.parametrize(("group", "option"), [(group, option) for group in COMPOSED for option in options(group)])
def test_every_preset_composes_to_what_its_file_says(group, option):
    """The minutes of a scenario are those of its steps together; a task is of its own kind."""
    config, values = COMPOSED[group](f"{group}={option}"), presets.load(f"{group}/{option}")
    found = getattr(config, group)
    assert held(found, values) == {}
    if group == "scenario":
        minutes = values.get("minutes", [60] if option == "hold" else list(found.minutes))
        assert found.total_min == sum(minutes)
        assert len(found.setpoints) == len(found.temperatures) == len(minutes)
    if group == "env":
        assert type(found) is ENVS[values.get("kind", "density")]


def test_what_the_paper_says():
    agent, scenario = load_train("agent=paper").agent, load_deploy("scenario=setpoint_steps").scenario
    assert (tuple(agent.hidden), agent.gamma, agent.learning_rate, agent.total_steps) == ((64, 64), 0.99, 1e-3, 10_000)
    assert agent.hindsight_share == agent.action_gap == agent.huber == len(agent.input_matrix) == 0
    assert agent.reward_scale == 1.0
    assert (list(scenario.setpoints), list(scenario.minutes)) == ([0.8, 0.65, 0.5], [30, 30, 30])


STATED = {
    "env/sim": EnvConfig(),
    "agent/paper": DQNConfig(),
}  # say what the paper leaves open, though it is the default
ROOTS = {
    "agent": DQNConfig,
    "env": EnvConfig,
    "plant": PlantConfig,
    "safety": SafetyConfig,
    "scenario": Scenario,
    "backend/transport": TransportConfig,
}
BACKENDS = {"sim": SimulatedConfig(), "chibio": ChiBioConfig(), "emulator": EmulatorConfig()}


def repeated(values: dict[str, Any], default: Any, prefix: str = "") -> list[str]:
    """Keys whose value is the default."""
    found = []
    for key, value in values.items():
        own = getattr(default, key)
        if isinstance(value, dict):
            found += repeated(value, own, f"{prefix}{key}.")
        elif key != "kind" and value == plain(own):
            found.append(f"{prefix}{key}")
    return found


@pytest.mark.parametrize(
    "name",
    [*(f"{group}/{option}" for group in ROOTS for option in options(group)), *(f"backend/{name}" for name in BACKENDS)],
)
def test_a_preset_holds_only_what_differs_from_the_dataclass(name):
    group = name.rpartition("/")[0]
    own = yaml.safe_load((CONF / f"{name}.yaml").read_text()) or {}
    own.pop("defaults", None)
    if name.startswith("env/") and "kind" in own:
        kind = ENVS[own.pop("kind")]
        assert name != "env/relative" or not own
        assert all(getattr(kind(), key) != value for key, value in own.items())
    elif name in STATED:
        assert build(STATED[name], own) == STATED[name]
    elif group == "backend":
        config = BACKENDS[name.rpartition("/")[2]]
        assert (repeated(own, config), own["kind"]) == ([], config.kind)
    else:
        assert repeated(own, ROOTS[group]()) == []


COMMANDS = sorted(p.stem for p in CONF.glob("*.yaml") if p.stem != "base")
LONG = "benchmark", "deploy"
EACH = [pytest.param(name, marks=[pytest.mark.slow] if name in LONG else []) for name in COMMANDS]


@pytest.mark.parametrize("name", COMMANDS)
def test_a_command_s_file_holds_only_what_differs_from_the_dataclass(name):
    command = importlib.import_module(f"experiments.{name}").main
    root = yaml.safe_load((CONF / f"{name}.yaml").read_text())
    root.pop("defaults")
    assert repeated({k: v for k, v in root.items() if not isinstance(v, dict)}, command.schema) == []


@pytest.mark.parametrize("name", EACH)
def test_help_shows_usage_every_value_and_options_that_compose(name, capsys, monkeypatch):
    command = importlib.import_module(f"experiments.{name}").main
    pages = {}
    for word in ("--help", "--help=all"):
        monkeypatch.setattr(sys, "argv", [name, word])
        command()
        pages[word] = page = capsys.readouterr().out
        assert f"python -m experiments.{name}" in page
        for entry in entries(command.schema):
            assert re.search(rf"^(  )?{entry.name}\b", page, re.MULTILINE), entry.name
        assert max(len(line) for line in page.splitlines()) <= 122
    assert len(pages["--help"].splitlines()) <= 100
    whole = set(pages["--help=all"].splitlines())
    words = pages["--help"].partition("the same for one of ")[2].replace("\n", " ")
    for word in words.split(", ") if words else ():
        monkeypatch.setattr(sys, "argv", [name, f"--help={word.strip()}"])
        command()
        part = capsys.readouterr().out.splitlines()
        assert part
        assert set(part) <= whole
    listed = {}
    for line in pages["--help=all"].partition("Values (key=value)")[0].splitlines():
        if group := re.match(r"  ([\w/]+)=(?: |$)", line):
            listed[group[1]] = []
        elif option := re.match(r"    (\w+)  ", line):
            listed[[*listed][-1]].append(option[1])
    assert all(listed.values())
    for group in listed.keys() - {"backend/transport"}:  # stands under a backend that has one
        for option in listed[group]:
            command.config([f"{group}={option}"])


def test_help_of_a_part_that_there_is_not_names_those_that_there_are():
    with pytest.raises(frame.UserError, match=r"^--help = plnat: allowed all, backend, plant, .*share_warnings"):
        deploy._answer(["--help=plnat"])


def test_help_shows_the_values_that_the_rest_of_the_line_gives(capsys, monkeypatch):
    monkeypatch.setattr(sys, "argv", ["deploy", "backend=chibio", "--help=backend", "backend.stir=0.7"])
    deploy()
    page = capsys.readouterr().out
    assert re.search(r"^  backend\.stir = 0\.7 +.+ \(allowed: 0 to 1; default: 0\.5\)$", page, re.MULTILINE)
    assert "backend.control_min" not in page


@pytest.mark.slow
def test_the_configuration_page_is_that_of_the_code():
    """Written anew by `python -m experiments.cli.reference > docs/configuration.md`."""
    assert (CONF.parent / "docs" / "configuration.md").read_text(encoding="utf-8") == reference.page()


def test_an_unknown_key_in_a_file_is_named(tmp_path):
    path = tmp_path / "model.yaml"
    path.write_text("growth_rate: 0.02\n")
    with pytest.raises(frame.UserError, match=r"env\.growth_rate: no such key; allowed under env: .*mu"):
        read_env_file(str(path))
    stored = tmp_path / "config.yaml"
    stored.write_text("agent: {noisy: true}\n")
    with pytest.raises(frame.UserError, match=r"agent\.noisy: no such key; allowed under agent: .*epsilon_end"):
        frame._stored(stored, "RUN", TrainConfig())
    with pytest.raises(frame.UserError, match=r"^controller\.estimator: no such key; .* controller=NAME"):
        load_deploy("controller=adaptive_inverse", "controller.kind=pi")
    with pytest.raises(ValueError, match=r"ablations\.mine\.noisy: no such key"):
        variant(DQNConfig(), "mine", {"noisy": True})


LAUGHS = "a0: &a0 [x]\n" + "".join(f"a{k + 1}: &a{k + 1} [{', '.join([f'*a{k}'] * 9)}]\n" for k in range(9))


@pytest.mark.parametrize(
    ("content", "why"),
    [
        (LAUGHS, "an alias or interpolation in line 2: write the value out"),
        ("mu: &x 0.03\ntau: *x\n", "an alias or interpolation in line 2"),
        ("base: &b {mu: 1}\nenv:\n  <<: *b\n", "an alias or interpolation in line 3"),
        ("a: 'xxxxxxxx'\nmu: ${a}${a}\n", "an alias or interpolation in line 2"),
        ("mu: " + 50_000 * "[", "deeper than 30 levels in line 1"),
        ("".join(f"{k * ' '}a:\n" for k in range(200)), "deeper than 30 levels in line 31"),
        ("mu: 0.03 #" + 300_000 * "x", "longer than 200000 bytes"),
        ("mu: [", "not YAML"),
        ("mu: !!python/name:os.system\n", "not YAML"),
        ("mu: " + 5000 * "9", "not YAML|Exceeds the limit"),
        ("- 1", "the file has no key: value pairs"),
    ],
)
def test_a_model_file_that_would_take_for_ever_is_refused_in_one_line(content, why, tmp_path):
    path = tmp_path / "model.yaml"
    path.write_text(content)
    with pytest.raises(frame.UserError, match=rf"^env_file={path}: ({why}).*; give the calibrated.yaml") as caught:
        read_env_file(str(path))
    assert "\n" not in str(caught.value)
    path.write_bytes(b"mu: \xff")
    with pytest.raises(frame.UserError, match=r"no UTF-8 text; give"):
        read_env_file(str(path))


@pytest.mark.parametrize(
    ("given", "understood"),
    [
        ("env.mu=0.02", "++env.mu=0.02"),
        ("+env=sim", "env=sim"),
        ("env=sim", "env=sim"),
        ("backend/transport=serial", "backend/transport=serial"),
        ("backend.reactors=[M0,M1]", "++backend.reactors=[M0,M1]"),
        ("each.M0.minutes=[90]", "++each.M0.minutes=[90]"),
        ("+each.M0.role=control", "++each.M0.role=control"),
        ("++seed=1", "++seed=1"),
        ("seed=range(0,4)", "++seed=range(0,4)"),
        ("+ablations.mine={double: false}", "++ablations.mine={double: false}"),
        ("hydra.run.dir=x", "hydra.run.dir=x"),
        ("plant@plants.own=bench", "plant@plants.own=bench"),
        ("+plant@plants.own=bench", "+plant@plants.own=bench"),
        ("~experiment", "~experiment"),
        ("-m", "-m"),
    ],
)
def test_every_argument_has_the_form_that_hydra_takes(given, understood):
    assert frame.normalise([given], "deploy" if "transport" in given else "train") == [understood]


@pytest.mark.parametrize(
    ("name", "override", "parts"),
    [
        ("train", "env.mu=abc", ["env.mu", "abc", "a number, 0 < mu"]),
        ("train", "foo=1", ["foo", "no such key", "n_agents"]),
        ("train", "lr=1", ["lr", "agent.learning_rate", "env, agent"]),
        ("train", "env=simm", ["env=simm", "no such option", "sim"]),
        ("train", "+experiment=nope", ["experiment=nope", "no such option", "smoke"]),
        ("train", "env=null", ["group"]),
        ("train", "agent.hidden=[", ["["]),
        ("train", "seed=range(0,4)", ["seed=range(0,4)", "-m 'seed=range(0,4)'"]),
        ("train", "seed=1,2", ["seed=1,2", "-m 'seed=1,2'"]),
        ("train", "+agent.relabelled=0.5", ["agent.relabelled: no such key; allowed under agent: ", "hindsight_share"]),
        ("deploy", "controller=turbidostat", ["controller=turbidostat: no such option; allowed: ", "threshold"]),
        ("train", "+experiment=paper", ["experiment=paper: a recipe of benchmark"]),
        ("benchmark", "experiment=smoke", ["experiment=smoke: a recipe of train"]),
        ("deploy", "+experiment=smoke", ["experiment=smoke: a recipe of train"]),
        ("train", "plant=bench", ["plant=bench: train accepts env, agent, experiment,", "plant= is for deploy"]),
        ("benchmark", "plant=bench", ["plant=bench: benchmark accepts env, experiment; plant= is for deploy"]),
        ("report", "agent=tuned", ["agent=tuned: report accepts no group; agent= is for train"]),
        ("mark", "+safety=default", ["safety=default: mark accepts no group; safety= is for deploy"]),
    ],
)
def test_a_wrong_word_is_one_line_with_key_value_and_what_is_allowed(name, override, parts):
    with pytest.raises(frame.UserError) as caught:
        importlib.import_module(f"experiments.{name}").main.config([override])
    message = str(caught.value)
    assert "\n" not in message
    for part in parts:
        assert part in message


@pytest.mark.parametrize(("word", "remedy"), [("--foo", "foo=VALUE"), ("--seed=3", "seed=3")])
def test_a_wrong_option_is_one_line(word, remedy, capsys, monkeypatch):
    monkeypatch.setattr(sys, "argv", ["train", "-m", "seed=1,2", word])
    with pytest.raises(SystemExit) as ended:
        main()
    told = capsys.readouterr().err
    assert (ended.value.code, told.count("\n"), remedy in told) == (1, 1, True)


@pytest.mark.parametrize("word", ["foo", "--foo", "env.mu=0.02"])
def test_the_demo_takes_no_words(word, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "argv", ["demo", word])
    with pytest.raises(SystemExit, match="^1$"):
        demo.main()
    assert capsys.readouterr().err.startswith(f"error: {word}: ")
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("backend", "key", "value"),
    [
        ("chibio", "url", "notaurl"), ("chibio", "url", "http://x/y"), ("pioreactor", "broker", "mqtt://x"),
        ("pioreactor", "leader", "x.local"), ("pioreactor", "units.pio01.address", "10.4.4.4"),
    ],
)  # fmt: skip
def test_an_address_that_cannot_be_one_is_refused_with_the_config(backend, key, value):
    with pytest.raises(frame.UserError, match=rf"{key.rpartition('.')[2]} = '?{re.escape(value)}'?: allowed "):
        load_deploy(f"backend={backend}", f"backend.{key}={value}")


@pytest.mark.parametrize(
    ("name", "override", "line"),
    [
        ("train", "agent=tuned,papr,paper", "agent=papr: no such option; allowed: "),
        ("deploy", "controller=pi,mpc,pid", "controller=pid: no such option; allowed: "),
        ("train", "+experiment=smoke,paper", "experiment=paper: a recipe of benchmark; use python -m"),
    ],
)
def test_each_preset_that_a_sweep_goes_over_is_judged_before_a_job_begins(name, override, line):
    with pytest.raises(frame.UserError, match=f"^{re.escape(line)}"):
        frame.normalise([override], name)


@pytest.mark.parametrize("order", [("{}", "tuned"), ("tuned", "{}"), ("paper", "{}", "tuned")])
def test_a_file_of_one_s_own_stands_anywhere_among_the_presets_of_a_sweep(order, tmp_path, monkeypatch):
    monkeypatch.setattr(presets, "_added", {})
    (tmp_path / "mine.yaml").write_text("hidden: [8]\n", encoding="utf-8")
    said = ",".join(order)
    assert frame.normalise([f"agent={said.format(tmp_path / 'mine.yaml')}"], "train") == [
        f"agent={said.format('mine')}"
    ]
    assert presets.load("agent/mine") == {"hidden": [8]}


@pytest.mark.parametrize("command", [main, deploy])
def test_a_folder_that_holds_a_run_takes_no_other_one(command, tmp_path, monkeypatch):
    """Else a second run would be appended to the recordings of the first."""
    monkeypatch.setattr(frame.EntryPoint, "_hydra", lambda command: pytest.fail("it began"))
    (tmp_path / command.resumes).write_text("{}")
    with pytest.raises(frame.UserError, match="resume="):
        command._answer([f"hydra.run.dir={tmp_path}"])
    assert [path.name for path in tmp_path.iterdir()] == [command.resumes]


@pytest.mark.parametrize("where", [0, 1, 2])
def test_a_value_beside_resume_is_refused_wherever_it_is_typed(where, tmp_path, monkeypatch):
    """What Hydra is told, and nothing else, stands beside it."""
    goes_on = []
    monkeypatch.setattr(sys, "argv", ["train"])
    monkeypatch.setattr(frame.EntryPoint, "_hydra", lambda command: goes_on.append(command.name))
    (tmp_path / "config.yaml").write_text("seed: 3\n", encoding="utf-8")
    given = [f"resume={tmp_path}", "hydra.verbose=true"]
    main._answer(given)
    assert goes_on == ["train"]
    line = f"seed=7: a resumed run has all values in {tmp_path}/config.yaml; drop this one"
    with pytest.raises(frame.UserError, match=f"^{re.escape(line)}$"):
        main._answer([*given[:where], "seed=7", *given[where:]])
    assert goes_on == ["train"]


def test_a_recipe_says_which_command_it_is_for():
    assert {presets.owners(f"experiment/{option}") for option in options("experiment")} == {("benchmark",), ("train",)}


def test_each_part_of_a_benchmark_is_the_preset_of_its_name():
    """But the agent of `dqn`, which is the tuned one, and the controller that flies the paper's policy."""
    said = [entry for entry in yaml.safe_load((CONF / "benchmark.yaml").read_text())["defaults"] if entry != "base"]
    named = {part: option for entry in said if isinstance(entry, dict) for part, option in entry.items() if "@" in part}
    assert len(named) > 40
    other = {part: option for part, option in named.items() if part.rpartition(".")[2] != option}
    assert other == {
        "agent@agents.dqn": "tuned", "agent@agents.dqn_paper": "paper", "controller@controllers.dqn_paper": "dqn",
    }  # fmt: skip
    for part in named:
        group, _, place = part.partition("@")
        assert place.startswith(f"{reference.SINGULAR.get(group, group)}s.")


def test_what_a_command_begins_with_when_nothing_is_chosen():
    assert {name: {k: v for k, v in presets.chosen(name).items() if v} for name in COMMANDS} == {
        "benchmark": {"env": "sim"}, "blank": {"backend": "chibio"}, "calibrate": {}, "calibrate_pair": {},
        "calibrate_pump": {"backend": "chibio"}, "certify": {}, "mark": {}, "report": {},
        "score": {"env": "sim"}, "train": {"env": "sim", "agent": "tuned"},
        "replay": {"safety": "default", "controller": "dqn"},
        "deploy": {
            "backend": "sim", "plant": "nominal_noise", "safety": "default", "controller": "dqn",
            "scenario": "setpoint_steps",
        },
    }  # fmt: skip


def test_a_job_of_a_cluster_is_told_of_its_end_and_queued_again():
    """Two hours of one core, told two minutes before their end; the search takes its trials one by one."""
    slurm = yaml.safe_load((CONF / "hydra" / "launcher" / "slurm.yaml").read_text())
    assert (slurm["timeout_min"], slurm["signal_delay_s"], slurm["max_num_timeout"]) == (120, 120, 100)
    assert (slurm["cpus_per_task"], slurm["mem_gb"], slurm["defaults"]) == (1, 2, ["submitit_slurm"])
    assert [word.partition("=")[2] for word in slurm["setup"][0].split()[1:]] == ["1"] * 3
    search = yaml.safe_load((CONF / "hydra" / "sweeper" / "search.yaml").read_text())
    assert (search["trials"], search["at_once"], search["space"]) == (20, 1, {})


@pytest.mark.parametrize(
    ("words", "understood"),
    [
        (["env=relative"], ["env=relative", "agent=relative"]), (["env=sim", "seed=1"], ["env=sim", "++seed=1"]),
        (["+env=coculture_preview", "seed=3"], ["env=coculture_preview", "++seed=3", "agent=coculture_preview"]),
        (["env=relative", "agent=paper"], ["env=relative", "agent=paper"]),
        (["agent=paper", "env=relative"], ["agent=paper", "env=relative"]),
        (["env=relative,sim"], ["env=relative,sim"]),
        (["resume=null", "seed=2"], ["++resume=null", "++seed=2"]),
    ],
)  # fmt: skip
def test_with_a_task_comes_the_agent_that_belongs_to_it_unless_another_is_chosen(words, understood):
    assert frame.normalise(words, "train") == understood


def test_of_two_folders_to_resume_the_last_is_taken(tmp_path):
    for name in ("a", "b"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "config.yaml").touch()
    words = frame.normalise([f"resume={tmp_path}/a", f"resume={tmp_path}/b"], "train")
    assert words[-2:] == [f"hydra.run.dir={tmp_path}/b", "hydra.output_subdir=null"]
    with pytest.raises(frame.UserError, match=rf"^resume={tmp_path}/c: not a run folder \(no config\.yaml\)"):
        frame.normalise([f"resume={tmp_path}/c"], "train")


def test_a_command_that_no_heading_lists_stands_below_others(monkeypatch):
    monkeypatch.setattr(program, "commands", lambda: ["audit", "blank", "deploy"])
    monkeypatch.setattr(program, "sentence", lambda name: f"What {name} does.")
    page = list(program.page())
    assert program.names()[-1] == "audit"
    assert page[page.index("Others") + 1].split() == ["audit", "What", "audit", "does."]
    assert page.count("  blank           What blank does.") == 1
    assert page.index("At the device") < page.index("  mark            What mark does.") < page.index("Comparisons")


def test_a_preset_file_is_called_by_its_name_and_other_files_are_left_alone(tmp_path, monkeypatch):
    monkeypatch.setattr(presets, "_added", {})
    (tmp_path / "my-vials.2.yaml").write_text("start_od: 0.3\n", encoding="utf-8")
    words = [f"+plant={tmp_path}/my-vials.2.yaml", "env_file=calibrated.yaml", "controller=pi"]
    assert frame.normalise(words, "deploy") == ["plant=my_vials_2", "++env_file=calibrated.yaml", "controller=pi"]
    assert presets.added()["plant/my_vials_2"] == presets.Added(
        {"start_od": 0.3}, f"The file {tmp_path}/my-vials.2.yaml."
    )  # fmt: skip
    assert "my_vials_2" in presets.options("deploy", "plant")
    with pytest.raises(NameTaken):
        presets.add("plant/bench", {}, "")
    with pytest.raises(ValueError, match="^vials = mine: no such group; allowed .*, plant, "):
        presets.add("vials/mine", {}, "")


@pytest.mark.parametrize(
    ("words", "said", "status"),
    [
        (["-h"], "usage: turbidostat COMMAND", None),
        (["calibrat"], "did you mean calibrate?\n", 2), (["xyzzy"], "error: xyzzy: ", 2),
    ],
)  # fmt: skip
def test_the_console_script_answers_by_itself(words, said, status, monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", ["turbidostat", *words])
    if status is None:
        program.main()
    else:
        with pytest.raises(SystemExit) as ended:
            program.main()
        assert ended.value.code == status
    assert said in "".join(capsys.readouterr())
