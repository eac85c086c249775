"""A signal of one's own from one file outside the program: recorded, warned of, summed up, saved, resumed, refused."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from conf.messages import NameTaken
from envs.scenario import Scenario
from experiments.cli import frame
from experiments.coculture.signal import COLUMNS
from experiments.control import run
from experiments.control.assemble import unpack
from experiments.deploy import main
from experiments.loop import signals
from experiments.record.recovery import COLUMNS as USUAL
from experiments.training import agents, tasks
from hardware.actuator import THERMOSTAT
from hardware.safety.interlock import kinds_of
from tests.experiments.test_composition_deploy import rows
from tests.extensions import light

HOLD = ("plant=coculture", "scenario=hold", "scenario.setpoints=[0.5]", "scenario.temperatures=[33.2]")
WORDS = (*HOLD, "scenario.recovery_od=0", "scenario.minutes=[300]", "fsync=false")
LIGHT = ("signals.light.kind=integral", "signals.light.setpoint=1400")
SCHEDULE = Scenario((0.5,), (80.0,), (33.2,))


@pytest.mark.slow
def test_it_is_recorded_warned_of_summed_up_and_saved(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    with caplog.at_level("WARNING"):
        run.deploy(main.config([*WORDS, *LIGHT]), tmp_path)
    found = rows(tmp_path)
    minute, mean = (np.array([float(row[key]) for row in found]) for key in ("elapsed_min", "light"))
    assert {row["light_setpoint"] for row in found} == {"1400.0"}
    assert np.abs(mean[minute > 150.0] - 1400.0).mean() < 80.0  # it begins at 1786
    assert {kind for row in found for kind in kinds_of(row["interlock"])} == {"light_far"}
    assert any("light_far" in r.getMessage() and "1786" in r.getMessage() for r in caplog.records)
    summary = json.loads((tmp_path / "summary.json").read_text(encoding="utf-8"))
    (window,), told = summary["windows"], summary["reactors"]["M0"]["reasons"]
    inside = minute < 300.0
    assert window["light_setpoint"] == 1400.0
    assert window["light_abs_error_mean"] == pytest.approx(np.abs(mean[inside] - 1400.0).mean())
    assert window["light_abs_error_last2h"] < window["light_abs_error_mean"]
    assert window["od_abs_error_mean"] < 0.02
    assert "ratio_setpoint" not in window
    assert told["light_far"]["first_min"] == 0.0
    state = json.loads((tmp_path / "state.json").read_text(encoding="utf-8"))
    assert state["light"]["mean"] == [mean[-1]]
    assert state["light"]["law"]["integral"] != [0.0]
    decided = [json.loads(line) for line in (tmp_path / "journal.jsonl").read_text().splitlines()]
    assert all("thermostat_degc" in row["why"] for row in decided if row["kind"] == "decision")


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (("signals.light.kind=pid",), "signals.light.kind = pid: allowed integral"),
        (("signals.dark.kind=integral",), "signals.dark.kind = integral: allowed "),
        ((*LIGHT, "scenario.ratios=[0.5]"), "composition and light act by the same thermostat; allowed one"),
    ],
)
def test_what_does_not_fit_is_one_line(words: tuple[str, ...], said: str, tmp_path: Path) -> None:
    with pytest.raises((frame.UserError, ValueError), match=said.replace("[", r"\[")) as caught:
        run.deploy(main.config([*WORDS, *words]), tmp_path)
    assert "\n" not in str(caught.value)


def test_the_columns_of_every_signal_follow_one_another(tmp_path: Path) -> None:
    setup = unpack(main.config([*WORDS, *LIGHT]), tmp_path)
    assert setup.columns == (*USUAL, "light", "light_setpoint")
    shares = main.config(["plant=coculture", "scenario=ratio_steps", "composition=pi"])
    assert unpack(shares, tmp_path).columns == (*USUAL, *COLUMNS, "true_ratio")


def test_names_and_actuators_are_used_once() -> None:
    with pytest.raises(NameTaken):
        signals.add("light", light.Light)
    with pytest.raises(NameTaken):
        signals.add("interlock", light.Light)
    held = [signals.made("light", light.IntegralConfig(), [SCHEDULE]) for _ in range(2)]
    with pytest.raises(ValueError, match="light and light act by the same thermostat"):
        signals.fitting(held, [THERMOSTAT])
    with pytest.raises(NameTaken):
        agents.add("dqn", type("Other", (), {}), Any, (), "Nothing.")  # type: ignore[arg-type]
    with pytest.raises(NameTaken):
        tasks.add("density", type("Other", (), {}), Any, "Nothing.")  # type: ignore[arg-type]
    with pytest.raises(ValueError, match=r"signals\.dark: .*allowed .*light"):
        signals.made("dark", None, [SCHEDULE])
