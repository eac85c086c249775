"""What a backend cannot do is refused in one line, before anything is asked of a device or written."""

from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from conf import presets
from conf.schema import build
from envs.bench import Bench
from envs.plant.culture import GrowthConfig
from envs.plant.plant import PlantConfig
from envs.plant.pump import PumpConfig
from envs.plant.vessel import VesselConfig
from envs.scenario import Scenario
from experiments.cli import frame
from experiments.coculture.base import SHARE
from experiments.coculture.signal import Share, ShareWarnings
from experiments.control import assemble
from experiments.control.config import DeployConfig
from experiments.control.messages import CannotResume, PlantIgnored
from experiments.deploy import main
from experiments.laws import registry
from experiments.laws.density.learned import LearnedConfig
from experiments.record.record import Record
from hardware.chibio.config import ChiBioConfig, EmulatorConfig
from hardware.pioreactor.config import PioreactorConfig, RigBackendConfig
from hardware.safety.config import SafetyConfig
from hardware.simulated import SimulatedConfig
from tests.hardware.driver_lab import DriverLab
from tests.hardware.script import logged

pytestmark = pytest.mark.numeric

CALM = Scenario((0.5, 0.6), (10.0, 10.0), (37.0, 37.0))
WARMER = replace(CALM, temperatures=(30.0, 37.0))
OF_TWO = Scenario((0.5,), (60.0,), (33.0,), ratios=(0.5,))


def test_what_fits_is_taken(tmp_path: Path) -> None:
    for backend, scenario in ((PioreactorConfig(), WARMER), (RigBackendConfig(), CALM)):
        assemble.unpack(DeployConfig(backend=backend, scenario=scenario, force_policy=True), tmp_path)
    undosed = PioreactorConfig(max_dose_ml=0.9)  # too little for a controller's doses, no reason not to watch
    assemble.unpack(DeployConfig(backend=undosed, scenario=CALM, force_policy=True, watch=True), tmp_path)


@pytest.mark.parametrize(
    ("values", "words"),
    [
        ({"scenario": OF_TWO}, "scenario.ratios: backend=pioreactor "),
        ({"scenario": OF_TWO, "backend": RigBackendConfig()}, "backend=pioreactor_rig "),
        ({"scenario": replace(CALM, outputs=("pump3 2 mL/h", None))}, "scenario.outputs of pio01: pump 3"),
        ({"scenario": WARMER, "backend": PioreactorConfig(thermostat=False)}, "30 to 37 degC: .* backend.thermostat"),
        ({"controller": registry.config("oracle")}, "oracle .* backend=pioreactor$"),
        ({"backend": PioreactorConfig(max_dose_ml=0.9)}, "1.2 mL in a period of 60 s; set bench.max_rate=0.015 "),
    ],
)
def test_what_a_backend_cannot_do_is_one_line(tmp_path: Path, values: dict[str, Any], words: str) -> None:
    """Light, spare pumps, temperatures, a plant that is known, and doses of the bench's own period and volume."""
    config = DeployConfig(**{"backend": PioreactorConfig(), "scenario": CALM, "force_policy": True, **values})
    with pytest.raises(frame.UserError, match=words) as told:
        assemble.unpack(config, tmp_path)
    assert "\n" not in str(told.value)
    assert not list(tmp_path.iterdir())


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
        ("pioreactor bench.volume_ml=36", "allowed less than the vendor's limit of this vial, 36"),
        ("chibio bench.volume_ml=7", "bench.volume_ml = 7 mL of M0: allowed 10"),
        ("chibio bench.volume_ml=30", "bench.volume_ml = 30 mL of M0: allowed 10"),
        ("chibio backend.reactors=[M0,M1] bench.volumes_ml.M1=29.5", "one dose of 1.2 mL: allowed 0.5 mL"),
        ("sim bench.period_s=600", "one dose of 12 mL: allowed 5 mL .* use bench.max_rate=0.00833"),
        ("sim safety.ml_per_minute=1", "one dose of 1.2 mL: allowed 1 mL"),
    ],
)
def test_what_no_vial_or_budget_can_take_is_one_line(words: str, said: str, tmp_path: Path) -> None:
    with pytest.raises(frame.UserError, match=said) as told:
        assemble.unpack(main.config([*f"backend={words}".split(), "controller=pi"]), tmp_path)
    assert "\n" not in str(told.value)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("words", [["signals.x=1"], ["signals=slope"], ["signals=[pace]"], ["signals.x.kind=slope"]])
def test_a_signal_that_is_none_is_one_line(words: list[str]) -> None:
    with pytest.raises((frame.UserError, ValueError), match="signals.* allowed .|signals"):
        main.config(words)


PI = registry.config("pi")
TWO = DeployConfig(backend=SimulatedConfig(reactors=("M0", "M1")), controller=PI)
DEVICE = replace(TWO, backend=ChiBioConfig(reactors=("M0", "M1")))
STEPS = Scenario((0.5,) * 4, (60.0, 360.0, 600.0, 600.0), (None,) * 4, ratios=(None, 0.3, 0.7, 0.3))
SHARES: dict[str, Any] = {"scenario": STEPS, "composition": registry.config("pi", SHARE)}


def test_what_differs_for_one_reactor_differs_for_no_other() -> None:
    own = {"setpoints": [0.3, 0.9], "minutes": [5.0, 90.0], "temperatures": [31.0, 32.0], "role": "control"}
    three = SimulatedConfig(reactors=("M0", "M1", "M4"))
    each = {"M1": own, "M4": {"at_end": "regulate"}}
    config = DeployConfig(backend=three, scenario=Scenario((0.6,), (60.0,), (37.0,)), at_end="stop", each=each)
    assert [tuple(s.setpoints) for s in config.schedules()] == [(0.6,), (0.3, 0.9), (0.6,)]
    assert [s.total_min for s in config.schedules()] == [60.0, 95.0, 60.0]
    assert [list(s.temperatures) for s in config.schedules()] == [[37.0], [31.0, 32.0], [37.0]]
    assert config.ends() == ["stop", "stop", "regulate"]
    assert config.roles() == ["replicate", "control", "replicate"]


@pytest.mark.parametrize(
    ("each", "said"),
    [
        ({"M2": {"minutes": [9.0]}}, r"^each\.M2: no such reactor; allowed M0, M1$"),
        ({"M1": {"minuts": [9.0]}}, r"^each\.M1\.minuts: no such key; allowed setpoints, minutes, .*, role, at_end$"),
        ({"M1": {"minutes": [9.0] * 4}}, r"^each\.M1: .* lists of 1, 4 and 1: allowed one"),
        ({"M1": 5}, "^each.M1 = .*: allowed keys and values"), ({"M1": [1]}, "^each.M1 = .*: allowed keys and values"),
        ({"M1": {"at_end": "sleep"}}, r"^each\.M1\.at_end = sleep: allowed hold, stop, regulate"),
    ],
)  # fmt: skip
def test_what_no_reactor_takes_is_named_with_the_reactor(each: dict[str, Any], said: str) -> None:
    with pytest.raises(ValueError, match=said):
        (bad := replace(TWO, each=each)).schedules(), bad.ends()
    with pytest.raises(ValueError, match=r"^bench\.volumes_ml = \['M7'\]: allowed names of M0, M1$"):
        replace(TWO, bench=Bench(volumes_ml={"M1": 14.0, "M7": 14.0}))


@pytest.mark.parametrize(("pair", "degc"), [("ecoli_pputida", 33.2), ("ecoli_psyringae", 28.6)])
def test_every_phase_without_a_temperature_gets_that_at_which_both_species_grow_alike(pair: str, degc: float) -> None:
    """M1 says some of its own."""
    own = {"M1": {"temperatures": [None, 30.0, 31.5, None], "ratios": [0.4, 0.4, 0.6, 0.4]}}
    whole = assemble.completed(replace(TWO, **SHARES, each=own, pair=pair))
    assert [tuple(s.temperatures) for s in whole.schedules()] == [(degc,) * 4, (degc, 30.0, 31.5, degc)]
    assert whole.plant.pair.even_c == pytest.approx(degc, abs=0.06)
    assert not whole.plant.second.present  # vials that somebody gave stay as they are


@pytest.mark.parametrize(
    ("given", "limits"),
    [
        ({}, (26.0, 33.0)), ({"composition_high": 31.5}, (26.0, 31.5)), ({"composition_low": 27.0}, (27.0, 33.0)),
        ({"composition_low": 25.0, "composition_high": 34.0}, (25.0, 34.0)),
    ],
)  # fmt: skip
def test_the_thermostat_s_limits_are_those_of_the_pair_at_each_end_that_nobody_sets(given, limits, caplog):
    """29 and 36 degC are what is left as it is."""
    config = replace(TWO, **SHARES, pair="ecoli_psyringae", safety=SafetyConfig(**given))
    with caplog.at_level("INFO"):
        safety = assemble.completed(config).safety
    assert (safety.composition_low, safety.composition_high) == limits
    assert "E. coli and P. syringae, 26 to 33 degC; both grow alike at 28.65 degC" in caplog.text
    alone = replace(TWO, safety=SafetyConfig(**given))
    assert assemble.completed(alone).safety == alone.safety  # of one species none are set
    narrow = replace(config, safety=SafetyConfig(composition_low=26.0, composition_high=28.6))
    with pytest.raises(
        frame.UserError, match=r"= 26 to 28\.6 degC: allowed a range that includes 28\.65 degC, where E"
    ):
        assemble.completed(narrow)


def test_a_share_is_estimated_with_each_vial_s_volume_and_the_settings_of_the_run(tmp_path: Path) -> None:
    law = SHARES["composition"]
    law = replace(law, estimator=replace(law.estimator, od_term=90.0))
    warns = ShareWarnings(0.2, 5.0, 0.6, 1.0)
    later = {"M1": {"announce_min": 45.0, "ratios": [0.6, None, 0.4, None]}}
    given = {"scenario": replace(STEPS, announce_min=90.0), "composition": law, "each": later, "share_warnings": warns}
    vials = build(PlantConfig(), presets.load("plant/coculture"), "plant")
    bench = Bench(volume_ml=16.0, volumes_ml={"M1": 12.0})
    config = replace(TWO, **given, pair="ecoli_psyringae", bench=bench, plant=vials)
    setup = assemble.unpack(assemble.completed(config), tmp_path)
    (share,) = setup.further
    assert isinstance(share, Share)
    filter_ = share.estimator.estimator  # type: ignore[attr-defined]
    assert np.ravel(filter_._volume_ml).tolist() == [16.0, 12.0]
    assert (filter_.pair.second.name, share.species) == ("P. syringae", "P. syringae")
    assert filter_.config.od_term == 90.0
    assert share.warnings == warns
    assert [s.announce_min for s in share.schedules] == [90.0, 45.0]
    assert share.columns[-1] == "true_ratio"


def test_a_device_is_told_to_measure_light_only_where_a_share_is_held(tmp_path: Path) -> None:
    held = assemble.unpack(assemble.completed(replace(DEVICE, **SHARES)), tmp_path)
    assert held.backend.fluorescence.measure
    assert held.columns[-1] == "temperature_target_degc"  # of a device nobody knows the true share
    alone = assemble.unpack(DEVICE, tmp_path)
    assert (alone.backend.fluorescence.measure, alone.further) == (False, [])
    lights = replace(DEVICE.backend, fluorescence=replace(DEVICE.backend.fluorescence, measure=True))
    lit = assemble.unpack(replace(DEVICE, backend=lights), tmp_path)
    assert [signal.name for signal in lit.further] == ["fluorescence"]


def test_an_emulated_device_gets_vials_of_the_run_s_two_species_and_keeps_those_that_were_chosen(caplog):
    plain = replace(TWO, backend=EmulatorConfig(reactors=("M0", "M1")), scenario=STEPS, pair="ecoli_psyringae")
    with caplog.at_level("INFO"):
        whole = assemble.completed(plain)
    assert (whole.backend.plant, whole.backend.pair) == ("coculture", "ecoli_psyringae")
    assert (whole.composition.kind, whole.plant) == ("midpoint", plain.plant)
    said = "composition=midpoint backend.plant=coculture backend.pair=ecoli_psyringae"
    assert f"set because the scenario has a composition: {said}\n" in caplog.text
    mixed = replace(plain, backend=replace(plain.backend, plant="coculture_mixed"))
    assert assemble.completed(mixed).backend.plant == "coculture_mixed"
    usual = build(PlantConfig(), presets.load("plant/nominal_noise"), "plant")
    caplog.clear()
    with caplog.at_level("INFO"):
        simulated = assemble.completed(replace(TWO, **SHARES, plant=usual))
    assert simulated.plant.second.present
    assert "set because the scenario has a composition: plant=coculture\n" in caplog.text


def test_what_a_backend_does_not_take_over_is_said(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    usual = build(PlantConfig(), presets.load("plant/nominal_noise"), "plant")
    for plant, said in ((usual, []), (PlantConfig(), []), (PlantConfig(start_od=0.3), [{"backend": "chibio"}])):
        caplog.clear()
        assemble.unpack(replace(DEVICE, plant=plant), tmp_path)
        assert logged(caplog, PlantIgnored) == said
    caplog.clear()
    assemble.unpack(replace(TWO, plant=PlantConfig(start_od=0.3)), tmp_path)
    assert caplog.text == ""
    with pytest.raises(CannotResume):
        assemble.unpack(replace(TWO, resume="RUN"), tmp_path)
    assert assemble.unpack(replace(DEVICE, resume="RUN"), tmp_path).resumed


def test_a_run_is_named_and_listed_by_what_was_chosen_for_it(tmp_path: Path) -> None:
    """tau = V / (60 g): of 16 mL and 0.8 mL/s a third, of 12 mL a quarter."""
    (tmp_path / ".hydra").mkdir()
    chosen = "    choices:\n      plant: bench\n      scenario: day\n      composition: null\n      hydra/output: x\n"
    (tmp_path / ".hydra" / "hydra.yaml").write_text(f"hydra:\n  runtime:\n{chosen}  verbose: false\n")
    vials = PlantConfig(growth=GrowthConfig(mu=0.021), pump=PumpConfig(gain_ml_s=0.8))
    config = replace(TWO, backend=replace(TWO.backend, seed=7), bench=Bench(volume_ml=12.0), plant=vials)
    own = {"command": "deploy", "decides": "pi", "on": "bench", "scenario": "day"}
    for vessel, tau in ((VesselConfig(16.0), 1 / 3), (VesselConfig(), 0.25)):
        setup = assemble.unpack(replace(config, plant=replace(vials, vessel=vessel)), tmp_path)
        assert (setup.title, setup.row) == ("pi on bench", {**own, "seed": 7, "mu": 0.021, "tau": pytest.approx(tau)})
    (tmp_path / "twin.yaml").write_text("start_od: 0.4\n")
    for other, on in ((replace(config, plant_file=str(tmp_path / "twin.yaml")), "plant_file"), (DEVICE, "chibio")):
        setup = assemble.unpack(other, tmp_path)
        assert (setup.title, setup.row) == (f"pi on {on}", {**own, "on": on})
    (tmp_path / ".hydra" / "hydra.yaml").write_text("    choices:\n      plant: nominal_noise\n")
    usual = build(PlantConfig(), presets.load("plant/nominal_noise"), "plant")
    both = assemble.unpack(assemble.completed(replace(TWO, **SHARES, plant=usual)), tmp_path)
    assert (both.title, both.row["on"], both.row["scenario"]) == ("pi and pi on coculture", "coculture", "given")
    (tmp_path / ".hydra" / "hydra.yaml").write_text("    choices:\n      plant: coculture_mixed\n")
    mixed = build(PlantConfig(), presets.load("plant/coculture_mixed"), "plant")
    own_vials = assemble.unpack(assemble.completed(replace(TWO, **SHARES, plant=mixed)), tmp_path)
    assert own_vials.title == "pi and pi on coculture_mixed"


def test_a_loop_s_interlock_knows_each_vial_s_tube_and_rim_and_the_limits_of_the_run(tmp_path: Path) -> None:
    """A vial holds 30 mL to its rim; 5 mL above its tube where there is room for as much."""
    bench = Bench(volume_ml=18.0, volumes_ml={"M1": 28.0}, max_rate=0.015)
    each = {"M0": {"at_end": "stop"}}
    config = replace(DEVICE, bench=bench, each=each, safety=SafetyConfig(ml_per_hour=33.0, overflow_ml=5.0))
    setup = assemble.unpack(config, tmp_path)
    with closing(Record(tmp_path, ("M0", "M1"), False, setup.columns)) as record:
        lab = DriverLab(("M0", "M1"))
        loop = assemble.close_loop(setup, lab.reactors, record)
    assert loop.interlock.budget.volume_ml.tolist() == [18.0, 28.0]
    assert loop.interlock.budget._full_ml.tolist() == [23.0, 30.0]
    assert loop.interlock.config.ml_per_hour == 33.0
    assert loop.supply._most_ml == pytest.approx(0.9)
    assert loop._at_end.tolist() == ["stop", "hold"]


def test_a_policy_is_asked_for_with_the_bench_the_setpoints_and_the_stake_of_the_run(tmp_path: Path) -> None:
    """What the laws are told is the slower of the model's and the bench's pump, at the bench's period."""
    each = {"M1": {"setpoints": [0.3, 0.7], "minutes": [5.0, 5.0], "temperatures": [37.0, 37.0]}}
    bench = Bench(volume_ml=15.0, max_rate=0.015, period_s=90.0)
    law = LearnedConfig(estimator={"noise_floor": 0.01})
    own = {"policy": "mine.npz", "force_policy": True, "preflight_only": True}
    config = replace(TWO, controller=law, bench=bench, scenario=CALM, each=each, **own)
    wanted = assemble.unpack(config, tmp_path).wanted
    assert wanted is not None
    assert (wanted.name, wanted.bench, wanted.estimator) == ("mine.npz", bench, {"noise_floor": 0.01})
    assert (wanted.model.control_min, wanted.model.max_pump_rate, wanted.model.tau) == (1.5, 0.015, 0.25)
    assert tuple(wanted.setpoints) == (0.5, 0.6, 0.3, 0.7)
    assert (wanted.at_stake, wanted.forced, wanted.refuses) == (False, True, False)
    device = replace(DEVICE, controller=LearnedConfig(), preflight_only=True)
    wanted = assemble.unpack(device, tmp_path).wanted
    assert wanted is not None
    assert (wanted.name, wanted.at_stake, wanted.forced, wanted.refuses) == ("shipped", True, False, True)
    assert assemble.unpack(TWO, tmp_path).wanted is None
