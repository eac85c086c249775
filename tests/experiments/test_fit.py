"""What a backend cannot do is refused in one line, before anything is asked of a device or written."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from envs.scenario import Scenario
from experiments.cli import frame
from experiments.control import assemble
from experiments.control.config import DeployConfig
from experiments.deploy import main
from experiments.laws import registry
from hardware.pioreactor.config import PioreactorConfig, RigBackendConfig

CALM = Scenario((0.5, 0.6), (10.0, 10.0), (37.0, 37.0))
WARMER = replace(CALM, temperatures=(30.0, 37.0))


def refused(tmp_path: Path, words: str, **values: Any) -> None:
    config = DeployConfig(**{"backend": PioreactorConfig(), "scenario": CALM, "force_policy": True, **values})
    with pytest.raises(frame.UserError, match=words) as told:
        assemble.unpack(config, tmp_path)
    assert "\n" not in str(told.value)
    assert not list(tmp_path.iterdir())


def test_what_fits_is_taken(tmp_path: Path) -> None:
    for backend, scenario in ((PioreactorConfig(), WARMER), (RigBackendConfig(), CALM)):
        assemble.unpack(DeployConfig(backend=backend, scenario=scenario, force_policy=True), tmp_path)


def test_a_share_needs_fluorescence(tmp_path: Path) -> None:
    shares = Scenario((0.5,), (60.0,), (33.0,), ratios=(0.5,))
    refused(tmp_path, "scenario.ratios: backend=pioreactor measures no fluorescence", scenario=shares)
    refused(tmp_path, "backend=pioreactor_rig measures", scenario=shares, backend=RigBackendConfig())


def test_a_spare_pump_needs_pumps(tmp_path: Path) -> None:
    supplied = replace(CALM, outputs=("pump3 2 mL/h", None))
    refused(tmp_path, "scenario.outputs: backend=pioreactor has no spare pumps; drop them", scenario=supplied)


def test_temperatures_need_a_thermostat(tmp_path: Path) -> None:
    off = PioreactorConfig(thermostat=False)
    refused(tmp_path, "30 to 37 degC: .* backend.thermostat=true", scenario=WARMER, backend=off)


def test_a_controller_that_knows_the_plant_needs_a_simulated_one(tmp_path: Path) -> None:
    refused(tmp_path, "oracle: .* not backend=pioreactor$", controller=registry.config("oracle"))


@pytest.mark.parametrize(
    ("values", "words"),
    [
        ({"max_dose_ml": 0.9}, "interlock allows 1.2 mL in a period of 60 s; give bench.max_rate=0.015 or a larger"),
    ],
)
def test_the_interlock_counts_with_the_units_own_period_volume_and_dose(
    tmp_path: Path, values: dict[str, float], words: str
) -> None:
    refused(tmp_path, words, backend=PioreactorConfig(**values))


@pytest.mark.parametrize("key", ["safety.volume_ml", "backend.volume_ml", "controller.volume_ml", "backend.period_s"])
def test_a_volume_and_a_period_are_said_once_and_by_the_bench(key: str) -> None:
    for backend in ("sim", "chibio", "pioreactor"):
        with pytest.raises(frame.UserError, match=f"(?i){key.rpartition('.')[2]}"):
            main.config([f"backend={backend}", "controller=pi", f"+{key}=28"])


@pytest.mark.parametrize("ml", [26.0, 30.0, 34.5])
def test_a_large_pioreactor_runs_up_to_the_limit_of_its_vial(ml: float, tmp_path: Path) -> None:
    words = ["backend=pioreactor", f"bench.volume_ml={ml}", "controller=pi"]
    setup = assemble.unpack(main.config(words), tmp_path)
    tubes_ml = setup.bench.volumes(setup.backend.reactors)
    assert tubes_ml.tolist() == [ml]
    assert setup.family.rim_ml(tubes_ml).tolist() == [36.0]


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["backend=pioreactor", "bench.volume_ml=36"], "allowed less than the vendor's limit of its vial, 36"),
        (["backend=chibio", "bench.volume_ml=7"], "bench.volume_ml = 7 mL of M0: allowed 10"),
        (["backend=chibio", "bench.volume_ml=30"], "bench.volume_ml = 30 mL of M0: allowed 10"),
        (["backend=chibio", "bench.volume_ml=29.5"], "comes to 1.2 mL at once: allowed 0.5 mL"),
        (
            ["backend=chibio", "backend.reactors=[M0,M1]", "bench.volumes_ml.M1=29.5"],
            "comes to 1.2 mL at once: allowed 0.5 mL",
        ),
        (["backend=sim", "bench.period_s=600"], "comes to 12 mL at once: allowed 5 mL .* give bench.max_rate=0.00833"),
        (["backend=sim", "safety.ml_per_minute=1"], "comes to 1.2 mL at once: allowed 1 mL"),
    ],
)
def test_what_no_vial_or_budget_can_take_is_one_line(words: list[str], said: str, tmp_path: Path) -> None:
    with pytest.raises(frame.UserError, match=said) as told:
        assemble.unpack(main.config([*words, "controller=pi"]), tmp_path)
    assert "\n" not in str(told.value)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("words", [["signals.x=1"], ["signals=slope"], ["signals=[pace]"], ["signals.x.kind=slope"]])
def test_a_signal_that_is_none_is_one_line(words: list[str]) -> None:
    with pytest.raises((frame.UserError, ValueError), match="signals.* allowed .|signals"):
        main.config(words)
