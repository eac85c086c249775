"""Every YAML composes and passes its schema; every wrong word on a command line ends in one clear line."""

from pathlib import Path

import pytest
from omegaconf import OmegaConf

from experiments.cli import frame
from experiments.control.config import deploy_schema
from experiments.training.config import TrainConfig

CONF = Path(__file__).parents[1] / "conf"


def options(group: str) -> list[str]:
    return sorted(p.stem for p in (CONF / group).glob("*.yaml"))


def load_train(*overrides: str) -> TrainConfig:
    return frame.load(frame.compose("train", overrides), TrainConfig())


def load_deploy(*overrides: str):
    cfg = frame.compose("deploy", overrides)
    return frame.load(cfg, deploy_schema(cfg.backend.kind))


@pytest.mark.parametrize("form", [[], ["+env=sim"], ["env=sim"]])
def test_both_forms_of_choosing_an_environment(form):
    assert load_train(*form) == load_train()


@pytest.mark.parametrize("option", options("env"))
def test_every_environment_composes(option):
    assert load_train(f"env={option}").env.mu > 0


@pytest.mark.parametrize("option", options("agent"))
def test_every_agent_composes(option):
    agent = load_train(f"agent={option}").agent
    assert tuple(agent.hidden) == (64, 64)
    assert (agent.gamma, agent.learning_rate, agent.total_steps) == (0.99, 1e-3, 10_000)


def test_the_papers_agent_adds_nothing_to_a_plain_dqn():
    agent = load_train("agent=paper").agent
    assert agent.hindsight_share == agent.action_gap == agent.huber == 0.0
    assert agent.reward_scale == 1.0
    assert len(agent.input_matrix) == 0


@pytest.mark.parametrize("option", options("scenario"))
def test_every_scenario_composes(option):
    assert load_deploy(f"scenario={option}").scenario.total_min > 0


@pytest.mark.parametrize("option", options("plant"))
def test_every_plant_composes(option):
    assert load_deploy(f"plant={option}").plant.growth.mu > 0


def test_the_overflow_pump_of_the_device_is_off_and_its_values_are_checked():
    assert load_deploy("backend=chibio").backend.overflow_pump.pump == ""
    assert load_deploy("backend=emulator", "backend.overflow_pump.pump=Pump4").backend.overflow_pump.pump == "Pump4"
    for override in ("pump=Pump2", "duty=1.0", "duty=much", "tube=22"):
        with pytest.raises(frame.UserError, match=rf"overflow_pump\.{override.split('=')[0]}"):
            load_deploy("backend=chibio", f"backend.overflow_pump.{override}")


def test_the_papers_schedule():
    scenario = load_deploy("scenario=setpoint_steps").scenario
    assert list(scenario.setpoints) == [0.8, 0.65, 0.5]
    assert list(scenario.minutes) == [30, 30, 30]


def test_yaml_and_dataclass_defaults_are_the_same():
    """A value stands in YAML with its source; the dataclass must not quietly hold another."""
    shown = OmegaConf.to_container(frame.compose("train", []), resolve=True)
    default = OmegaConf.to_container(OmegaConf.create(OmegaConf.to_container(OmegaConf.structured(TrainConfig()))))
    shown.pop("agent")  # a choice of the defaults list
    default.pop("agent")
    assert shown == default


@pytest.mark.parametrize(
    ("override", "parts"),
    [
        ("env.mu=abc", ["env.mu", "abc", "a number"]),
        ("env.mu=-1", ["env.mu", "-1", "allowed 0 < mu"]),
        ("env.mu=nan", ["env.mu", "nan", "allowed"]),
        ("env.nois=1", ["env.nois", "no such key", "mu, tau"]),
        ("+env.nois=1", ["env.nois", "no such key", "mu, tau"]),
        ("foo=1", ["foo", "no such key", "n_agents"]),
        ("+foo=1", ["foo", "no such key", "n_agents"]),
        ("env=simm", ["env=simm", "no such option", "sim"]),
        ("+experiment=nope", ["experiment=nope", "no such option", "smoke"]),
        ("seed=1.5", ["seed", "1.5", "a whole number"]),
        ("seed=-1", ["seed", "-1", "at least 0"]),
        ("agent.init_zero_output=perhaps", ["agent.init_zero_output", "perhaps", "true or false"]),
        ("agent.gamma=1", ["agent.gamma", "1.0", "0 <= gamma < 1"]),
        ("agent.hidden=[64,x]", ["agent.hidden[1]", "x", "a whole number"]),
        ("device=tpu", ["device", "tpu", "cpu or cuda"]),
        ("env=null", ["group"]),
        ("agent.hidden=[", ["["]),
    ],
)
def test_a_wrong_override_is_one_line_with_key_value_and_what_is_allowed(override, parts):
    with pytest.raises(frame.UserError) as caught:
        load_train(override)
    message = str(caught.value)
    assert "\n" not in message
    for part in parts:
        assert part in message
