"""From a deploy config to a closed loop: everything that the config names is read here, once, and put together.

A rehearsal is assembled here too, with a clock and a transport of its own.
"""

import logging
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np

from conf.presets import load
from conf.schema import build
from dqn.policy import Policy
from envs.plant.plant import PlantConfig
from envs.scenario import Scenario
from envs.task import EnvConfig
from experiments.certification import certificate
from experiments.certification.bounds import EstimateBounds
from experiments.cli import frame
from experiments.composition import registry as compositions
from experiments.control import families
from experiments.control.config import DeployConfig
from experiments.control.families import Opening
from experiments.control.fit import check_fit
from experiments.control.plant_file import read_plant_file
from experiments.control.policies import admit, composition_policy, policy_check, run_policy
from experiments.controllers import registry
from experiments.loop.composition import Composition, Keeper, program_of
from experiments.loop.loop import ClosedLoop
from experiments.record.record import Record
from experiments.record.recovery import continue_loop
from experiments.training.config import read_env_file
from hardware.emulator.device import plant_preset
from hardware.pioreactor.config import PioreactorConfig
from hardware.reactor import Array, Reactor
from hardware.safety.interlock import VIAL_ML, Interlock
from hardware.simulated import SimulatedReactors

__all__ = ["Setup", "close_loop", "completed", "opened", "run_preflight", "unpack"]

log = logging.getLogger(__name__)

COMPOSITION, VIALS, USUAL_VIALS = "dqn_preview", "coculture", "nominal_noise"  # presets


@dataclass(frozen=True, eq=False)
class Setup:
    """What a deploy config comes to.

    scenarios: one per reactor. plant: of the simulated vials, that of a `plant_file` where there is one; with an
      `env_file` it grows and is fed as calibrated.
    model: growth model that model-based controllers are given: the calibrated one, else the nominal one.
    policy: of controller=dqn, None for a preflight. bounds: of its certificate. resumed: an earlier life of the run is
      continued. keeper: of the composition, None where none is controlled.
    """

    config: DeployConfig
    scenarios: list[Scenario]
    plant: PlantConfig
    model: EnvConfig
    policy: Policy | None
    bounds: EstimateBounds | None
    resumed: bool
    keeper: Keeper | None = None


def completed(config: DeployConfig) -> DeployConfig:
    """Of a scenario that asks for a share, what was left as it is for one species: who controls it, and the vials.

    Raises: UserError for a schedule that is not allowed.
    """
    try:
        composed = any(s.composed for s in config.schedules())
    except ValueError as error:
        raise frame.UserError(str(error)) from None
    if not composed:
        return config
    backend, chosen = config.backend, []
    if config.composition is None:
        law = build(compositions.config(COMPOSITION), load(f"composition/{COMPOSITION}"), "composition")
        config = replace(config, composition=law)
        chosen.append(f"composition={COMPOSITION}")
    if backend.kind == "emulator" and backend.plant == type(backend)().plant:
        config = replace(config, backend=replace(backend, plant=VIALS))
        chosen.append(f"backend.plant={VIALS}")
    usual = build(PlantConfig(), load(f"plant/{USUAL_VIALS}"), "plant")
    if backend.kind == "sim" and config.plant == usual and not (config.plant_file or config.env_file):
        config = replace(config, plant=build(PlantConfig(), load(f"plant/{VIALS}"), "plant"))
        chosen.append(f"plant={VIALS}")
    if chosen:
        log.info("the scenario asks for a share: %s", " ".join(chosen))
    return config


def unpack(config: DeployConfig, folder: Path) -> Setup:
    """Everything that a config names, read and checked; the run folder gets a copy of the policy.

    Raises: UserError naming what cannot be read or does not fit.
    """
    backend, resumed = config.backend, config.resume is not None
    try:
        scenarios = config.schedules()
        config.ends()
    except ValueError as error:
        raise frame.UserError(str(error)) from None
    if resumed and backend.kind == "sim":
        raise frame.UserError(f"resume={config.resume}: a simulated run takes a second; run it again")
    bench, plant = config.bench, config.plant
    model = EnvConfig(tau=bench.tau)
    if config.plant_file is not None:
        plant = read_plant_file(config.plant_file)
    if config.env_file is not None:
        model = read_env_file(config.env_file)
        gain = (plant.vessel.volume_ml or bench.volume_ml) / (60.0 * model.tau)  # tau = V / (60 g)
        growth, pump = replace(plant.growth, mu=model.mu), replace(plant.pump, gain_ml_s=gain)
        plant = replace(plant, growth=growth, pump=pump)
    if backend.kind == "sim" and (plant.vessel.volume_ml or bench.volume_ml) != bench.volume_ml:
        of_bench = f"bench.volume_ml = {bench.volume_ml:g} mL, which everything else goes by"
        log.warning("plant.vessel.volume_ml = %g mL differs from %s: on purpose?", plant.vessel.volume_ml, of_bench)
    check_fit(config, scenarios)
    keeper = _keeper(config, plant, folder, scenarios)
    if keeper is not None and hasattr(backend, "fluorescence"):  # the device has to measure what the estimate needs
        backend = replace(backend, fluorescence=replace(backend.fluorescence, measure=True))
        config = replace(config, backend=backend)
    fastest = min(model.max_pump_rate, bench.max_rate)
    model = replace(model, control_min=bench.control_min, max_pump_rate=fastest)
    policy = bounds = None
    if config.controller.kind == "dqn" and not config.preflight_only:
        policy = run_policy(config.policy, folder, resumed, bench.control_min, bench.max_rate)
        admit(policy, folder / "policy.npz", config, scenarios)
        bounds = certificate.bounds(policy, folder / "policy.npz")
    return Setup(config, scenarios, plant, model, policy, bounds, resumed, keeper)


def _keeper(config: DeployConfig, plant: PlantConfig, folder: Path, scenarios: list[Scenario]) -> Keeper | None:
    """What controls the composition, None if nothing does. Raises: UserError where scenario, backend and it differ."""
    asked = [name for name, s in zip(config.backend.reactors, scenarios, strict=True) if s.composed]
    if config.composition is None:
        return None
    kind = config.composition.kind
    if not asked:
        remedy = "give scenario=ratio_steps or scenario.ratios, or drop it"
        raise frame.UserError(f"composition={kind}: no scenario asks for a share; {remedy}")
    emulated = config.backend.kind == "emulator"
    if config.backend.kind == "sim" or emulated:
        vials = plant_preset(config.backend.plant) if emulated else plant
        if not vials.second.present:
            key = f"{'backend.' if emulated else ''}plant=coculture"
            raise frame.UserError(f"composition={kind}: the vials hold one species that does not fluoresce; give {key}")
    one = next(s for s in scenarios if s.composed)
    if kind == "optimum" and any(program_of(s) != program_of(one) for s in scenarios):
        raise frame.UserError("composition=optimum plans one program: give all reactors the same shares and minutes")
    policy = composition_policy(kind, config.composition_policy, folder, config.resume is not None)
    try:
        keeper: Keeper = compositions.build(
            config.composition, policy, program_of(one), config.bench.volumes(config.backend.reactors)
        )
    except ValueError as error:
        raise frame.UserError(str(error)) from None
    return keeper


def close_loop(setup: Setup, reactors: Reactor, record: Record) -> ClosedLoop:
    """Controller, interlock and scenarios around reactors that are ready; a resumed loop stands where it was.

    Raises: UserError naming what the controller needs and does not have here; RecordingError for a state that is
      damaged or does not fit.
    """
    plant, flow, bench = None, 1.0, setup.config.bench
    volumes_ml = bench.volumes(reactors.names)
    if isinstance(reactors, SimulatedReactors):
        plant, flow = reactors.plant, reactors.config.pump_ml_s
    try:
        controller = registry.build(
            setup.config.controller, setup.model, setup.policy, plant, flow, setup.bounds, volumes_ml
        )
    except ValueError as error:
        raise frame.UserError(str(error)) from None
    interlock, composition = (
        Interlock(len(volumes_ml), setup.config.safety, bench, volumes_ml, _rim(setup.config)),
        None,
    )
    if setup.keeper is not None:
        truth = None if plant is None else partial(getattr, plant.culture, "share")
        composition = Composition(setup.keeper, setup.scenarios, setup.config.share_warnings, truth)
    ends = setup.config.ends()
    loop = ClosedLoop(reactors, controller, interlock, setup.scenarios, record.decided, ends, composition)
    if setup.resumed:
        continue_loop(loop, record.journal, record.state_path)
    return loop


def _rim(config: DeployConfig) -> Array | float:
    """What each vial holds, mL."""
    return np.array(config.backend.full_ml) if isinstance(config.backend, PioreactorConfig) else VIAL_ML


@contextmanager
def opened(setup: Setup, record: Record) -> Iterator[ClosedLoop]:
    """The loop around the configured reactors, which are released afterwards. Raises: ReactorError, UserError."""
    opening = Opening(
        setup.config.backend, setup.config.bench, setup.plant, record.journal, record.folder, setup.resumed
    )
    with families.opened(opening) as reactors:
        try:
            yield close_loop(setup, reactors, record)
        except BaseException:  # before the loop, which ends with the same by itself: an overflow pump runs already
            reactors.stop()
            raise


def run_preflight(setup: Setup, folder: Path) -> None:
    """`preflight_only=true`: every check a line with pass or the remedy. Raises: UserError if one failed."""
    config, backend = setup.config, setup.config.backend
    if backend.kind == "sim":
        raise frame.UserError("preflight_only=true: a simulated reactor needs no preflight; use backend=chibio")
    policy = [policy_check(config, setup.scenarios)] if config.controller.kind == "dqn" else []
    families.preflight(backend, folder, policy)
