"""A change of the setpoint that is known ahead: when the aim moves, who sees it, and what it is worth."""

import csv
import json
import math
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from envs.scenario import Scenario
from envs.task import EnvConfig
from experiments.comparison.trials import Cell, run_trial, windows
from experiments.control import run
from experiments.deploy import main
from experiments.laws import registry
from experiments.laws.density.baselines import Hold, HoldConfig
from experiments.laws.density.estimators import WithEstimator
from experiments.laws.density.inverse import Inverse, InverseConfig
from experiments.loop.progress import Progress
from experiments.loop.signals import AIM, Density
from hardware.emulator.device import plant_preset
from hardware.safety.interlock import Interlock

STEPS = Scenario((0.5, 0.8, 0.8, 0.3), (37.0, 41.0, 20.0, 30.0), (37.0,) * 4, announce_min=25.0)
SHORT = Scenario((0.7, 0.4), (50.0, 10.0), (37.0, 30.0), announce_min=9.0)
AUTO = replace(STEPS, announce_min="auto")


def aim(law: Any, steps: list[tuple[float, float, float]], period_min: float) -> list[float]:
    """What a law is given for setpoint, the next one and the minutes until then, of each reactor."""
    setpoint, following, left = (np.array(column) for column in zip(*steps, strict=True))
    yes, zeros = np.ones(len(steps), dtype=bool), np.zeros(len(steps))
    sample = SimpleNamespace(
        measured=SimpleNamespace(od=zeros + 0.5, temperature=zeros), rows=yes, believed=yes, minute=zeros,
        phase=np.zeros(len(steps), dtype=int), setpoint=setpoint, following=following, left_min=left,
    )  # fmt: skip
    density = Density(law, 1.0, 0.02, period_min)
    density.decide(sample)  # type: ignore[arg-type]
    assert law.given.tolist() == density.aim.tolist()
    return density.aim.tolist()


class Law:
    """Full pump takes .14 off ln OD in 2 min; the culture rests at a share of it, .4: mu is .028 1/min."""

    def __init__(self, share: float = 0.4, error: Any = 0.0) -> None:
        self.estimator = SimpleNamespace(
            full_pump=0.14, relative=lambda r: (np.broadcast_to(error, r.size), np.full(r.size, share))
        )

    def act(self, od: Any, setpoint: Any, minute: Any, rows: Any) -> Any:
        self.given = setpoint
        return np.zeros(len(od))


def test_the_aim_is_on_the_way_to_half_the_change_or_beyond_it_where_the_culture_lags() -> None:
    """From .5 to .65 at .028 1/min: 9.37 min; from .8 to .55 at .07 - .028: 8.92 min. A period is 2 min."""
    law = Law()
    early = [(0.5, 0.8, 11.5), (0.8, 0.3, 11.0), (0.6, 0.6, math.inf)]
    assert aim(law, early, 2.0) == [0.5, 0.8, 0.6]
    on_the_way = [0.65 * math.exp(-0.028 * 4.0), 0.55 * math.exp(0.042 * 1.0), 0.6]
    assert aim(law, [(0.5, 0.8, 6.0), (0.8, 0.3, 3.0), (0.6, 0.6, 1.0)], 2.0)[2] == 0.6
    ods = np.log([0.7 / 0.5, 0.4 / 0.8, 1.0]) / 0.14  # further than the way
    assert aim(Law(error=ods), [(0.5, 0.8, 6.0), (0.8, 0.3, 3.0), (0.6, 0.6, 1.0)], 2.0) == pytest.approx(on_the_way)
    assert aim(law, [(0.5, 0.8, 6.0), (0.8, 0.3, 3.0), (0.6, 0.6, 1.0)], 2.0) == [0.8, 0.3, 0.6], "lags"
    steps = [(0.8, 0.3, 600.0), (0.5, 0.8, 600.0), (0.8, 0.3, math.inf)]
    assert aim(Law(1.0), steps[:2] * 2, 2.0)[:2] == [0.3, 0.5], "full pump holds it at best"


def test_the_estimator_beside_a_law_without_one_believes_what_that_of_a_law_with_one_does() -> None:
    """Both are told the same readings and doses, which are not what either decided: a pump of 0.7."""
    model = EnvConfig(mu=0.02, tau=0.4, control_min=2.0)
    laws = WithEstimator(Hold(HoldConfig(), model), model), Inverse(InverseConfig(), model)
    for law in laws:
        law.reset(1)
        for k in range(40):
            at = np.array([0.5 + 0.02 * (k % 3)]), np.array([37.0]), np.array([2.0 * k]), np.ones(1, dtype=bool)
            law.watch(*at)
            law.act(at[0], np.array([0.5]), at[2], at[3])
            law.dosed(np.array([0.7 * 20.0 * 0.04]))
    assert {key: laws[0].explain()[key] for key in laws[1].explain()} == laws[1].explain()


def test_a_change_is_known_as_long_ahead_as_the_scenario_says() -> None:
    progress = Progress([STEPS, SHORT, AUTO])
    for minute in np.arange(0.0, 130.0, 0.5):
        following, left = progress.following(np.full(3, minute))
        for n, scenario in enumerate((STEPS, SHORT, AUTO)):
            ahead = [(e, r) for e, r in zip(scenario.edges[1:-1], scenario.setpoints[1:], strict=True) if e > minute]
            known = ahead and ahead[0][0] - minute <= scenario.announced_min
            assert left[n] == (ahead[0][0] - minute if known else math.inf)
            assert following[n] == (ahead[0][1] if known else progress.asked(np.full(3, minute))[1][n])
    assert progress.following(np.full(3, np.nan))[1].tolist() == [math.inf] * 3, "in recovery"
    progress = Progress([replace(STEPS, until=("od >= 0.9", None, None, None))])  # nobody knows when it ends
    assert progress.following(np.array([30.0]))[1].tolist() == [math.inf]
    assert progress.following(np.array([60.0]))[1].tolist() == [18.0]


@pytest.mark.parametrize(
    ("scenario", "told"),
    [
        (STEPS, True),
        (AUTO, True),
        (replace(STEPS, announce_min=0.0), False),
        (replace(STEPS, announce_min=None), False),
        (replace(STEPS, setpoints=(0.5,) * 4), False),
        (replace(STEPS, announce_min=None, ratios=(0.3, 0.4, 0.5, None)), True),
        (replace(AUTO, ratios=(0.3, 0.4, 0.5, None)), True),
    ],
)
def test_where_a_share_is_asked_for_changes_are_known_ahead_by_default(scenario: Scenario, told: bool) -> None:
    assert Progress([SHORT and scenario, scenario]).announced is told


@pytest.mark.parametrize("kind", ["inverse", "pi_tuned"])
@pytest.mark.parametrize("growth", [0.03, 0.021])
def test_aiming_half_way_costs_less_than_half_of_the_squared_error(kind: str, growth: float) -> None:
    """By physics a quarter, of a culture that grows as the model says and a sensor without noise."""
    preset = plant_preset("nominal")
    plant = replace(preset, growth=replace(preset.growth, mu=growth), start_od=0.5)
    model = EnvConfig(mu=growth)
    law = registry.config_at(kind, "controller")

    def ise(announce_min: float) -> float:
        scenario = replace(STEPS, announce_min=announce_min)
        trial = run_trial(
            Cell(kind, "nominal", "steps"), plant, scenario, lambda _: registry.build(law, model=model), model, 2, 1
        )
        assert trial.held.max() <= 1
        return float(sum(trial.score(window, "clean").ise[0] for window in windows(scenario)))

    assert ise(25.0) < 0.5 * ise(0.0)


def test_recording_and_windows_keep_the_setpoint_that_was_asked_for(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    judged, check = list[float](), Interlock.check
    monkeypatch.setattr(Interlock, "check", lambda *given: judged.append(float(given[3][0])) or check(*given))
    words = ["plant=nominal", "plant.start_od=0.5", "controller=inverse", "backend.reactors=[M0,M1]"]
    words += ["scenario.setpoints=[0.5,0.7]", "scenario.minutes=[20,9]", "scenario.temperatures=[37,37]"]
    words += ["scenario.announce_min=auto", "+each.M1.announce_min=0"]
    (tmp_path / "run").mkdir()
    run.deploy(main.config([*words, "fsync=false"]), tmp_path / "run")
    summary = json.loads((tmp_path / "run" / "summary.json").read_text())
    texts = {name: (tmp_path / "run" / "recordings" / f"{name}.csv").read_text() for name in ("M0", "M1")}
    rows = {name: list(csv.DictReader(text.splitlines())) for name, text in texts.items()}
    ahead = {name: [r for r in each if r[AIM] != r["setpoint"]] for name, each in rows.items()}
    assert ahead["M1"] == []
    assert {float(r["setpoint"]) for r in ahead["M0"]} == {0.5}
    assert all(0.5 < float(r[AIM]) <= 0.7 for r in ahead["M0"])
    assert [w["setpoint"] for w in summary["windows"]] == [0.5, 0.7] * 2
    assert judged == [float(row[AIM]) for row in rows["M0"]]
    first = float(ahead["M0"][0]["elapsed_min"])
    assert 20.0 - first == pytest.approx(math.log(0.6 / 0.5) / 0.03, abs=1.0)
