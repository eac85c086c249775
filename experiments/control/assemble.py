"""From a deploy config to a closed loop: read the files that the config names, and build all objects of the run.

Rehearsals in tests use this module, too, with their own clock and transport.
"""

import logging
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from conf.presets import load
from conf.schema import build
from dqn.policy import Policy
from envs.bench import Bench
from envs.plant.plant import PlantConfig
from envs.scenario import Scenario
from envs.task import EnvConfig
from experiments.certification.bounds import EstimateBounds
from experiments.cli import frame
from experiments.cli.calibrated import read_env_file, read_plant_file
from experiments.cli.files import choices
from experiments.control import messages
from experiments.control.config import DeployConfig
from experiments.control.guests import GUESTS
from experiments.control.policies import WantedPolicy, policy_check, run_policy
from experiments.laws import registry
from experiments.loop import signals
from experiments.loop.loop import ClosedLoop
from experiments.loop.progress import Progress
from experiments.loop.signals import AIM, Signal
from experiments.record.record import Record
from experiments.record.recovery import COLUMNS, continue_loop, is_over
from hardware.errors import ReactorError
from hardware.family import Family, Opening, family_of, report
from hardware.reactor import Array, Reactor
from hardware.safety.config import SafetyConfig
from hardware.safety.interlock import Interlock
from hardware.watch.opened import WatchedFamily
from hardware.watched import WatchedInterlock

log = logging.getLogger(__name__)

USUAL_VIALS = "nominal_noise"  # preset


@dataclass(frozen=True, eq=False)
class Setup:
    """Objects built from a deploy config; lower layers receive these, not the config.

    family, backend, bench: of the reactors. scenarios, ends, roles: one entry per reactor.
    plant: simulated vials: from `plant_file` if given, with growth and pump of `env_file` if given.
    model: growth model for model-based controllers: calibrated if a file is given, else nominal.
    law: config of the pump rate's controller. wanted: policy that controller=dqn asks for; None for other controllers.
    policy: the loaded policy; None for a preflight. bounds: from its certificate.
    further: the signals other than the density, without readings yet.
    fsync: whether each row is forced to disk. title: controller and plant of the run. row: the run's parameters in
      TensorBoard's HPARAMS table. resumed: whether this run continues an earlier one.
    """

    family: Family
    backend: Any
    bench: Bench
    safety: SafetyConfig
    scenarios: list[Scenario]
    ends: list[str]
    roles: list[str]
    plant: PlantConfig
    model: EnvConfig
    law: Any
    wanted: WantedPolicy | None
    policy: Policy | None
    bounds: EstimateBounds | None
    further: list[Signal]
    fsync: bool
    title: str
    row: dict[str, float | str]
    resumed: bool

    @property
    def columns(self) -> tuple[str, ...]:
        """Columns of the recordings."""
        aim = (AIM,) if Progress(self.scenarios).announced else ()
        return (*COLUMNS, *aim, *(column for signal in self.further for column in signal.columns))


def completed(config: DeployConfig, folder: Path | None = None) -> DeployConfig:
    """Let every guest complete a config. Args as in `Guest.completed`. Raises: UserError."""
    with frame.refusing(ValueError, ReactorError):
        for guest in GUESTS:
            config = guest.completed(config, folder)
    return config


def unpack(config: DeployConfig, folder: Path) -> Setup:
    """Build the objects of a run from its config; copy the policy into the run folder.

    Raises: UserError for a file that cannot be read and for parts that do not fit together.
    """
    family, backend, safety = family_of(config.backend), config.backend, config.safety
    if config.watch:
        family = WatchedFamily(family)
    resumed = config.resume is not None
    with frame.refusing(ValueError):
        scenarios, ends, roles = config.schedules(), config.ends(), config.roles()
    if resumed and not family.can.resume:
        why = (
            "repeat a simulated run instead" if family.simulated else "its reactors cannot be resumed; start a new run"
        )
        raise messages.CannotResume(run=config.resume, why=why)
    bench, (plant, model) = config.bench, _models(config)
    volumes_ml = bench.volumes(backend.reactors)
    if family.simulated and (other_ml := plant.vessel.volume_ml) is not None and (volumes_ml != other_ml).any():
        log.info(messages.VolumesDiffer(other_ml=other_ml, volume_ml=bench.volume_ml))
    usual = PlantConfig(), build(PlantConfig(), load(f"plant/{USUAL_VIALS}"), "plant")
    if not family.simulated and config.plant not in usual:
        log.warning(messages.PlantIgnored(backend=config.backend.kind))
    _check_fit(config, family, scenarios, ends)
    _check_room(bench, safety, family.rim_ml(volumes_ml) - volumes_ml)
    further = _further(config, plant, folder, scenarios)
    if any(signal.sees_light for signal in further):  # the device has to measure it
        backend = family.seeing_fluorescence(backend)
    fastest = min(model.max_pump_rate, bench.max_rate)
    model = replace(model, control_min=bench.control_min, max_pump_rate=fastest)
    wanted = policy = bounds = None
    if config.controller.kind == "dqn":
        asked = tuple(setpoint for scenario in scenarios for setpoint in scenario.setpoints)
        changes, stake = config.controller.estimator, (family.at_stake, config.force_policy)
        wanted = WantedPolicy(config.policy, bench, model, changes, asked, *stake)
    if wanted is not None and not config.preflight_only:
        policy, bounds = run_policy(wanted, folder, resumed)
    return Setup(
        family, backend, bench, safety, scenarios, ends, roles, plant, model, config.controller, wanted,
        policy, bounds, further, config.fsync, *_named(config, family, folder),
        resumed,
    )  # fmt: skip


def _models(config: DeployConfig) -> tuple[PlantConfig, EnvConfig]:
    """Return the simulated vials, and the growth model for model-based controllers. Raises: UserError."""
    plant, bench = config.plant, config.bench
    model = EnvConfig(tau=bench.tau)
    if config.plant_file is not None:
        plant = read_plant_file(config.plant_file)
    if config.env_file is not None:
        model = read_env_file(config.env_file)
        gain = (plant.vessel.volume_ml or bench.volume_ml) / (60.0 * model.tau)  # tau = V / (60 g)
        growth, pump = replace(plant.growth, mu=model.mu), replace(plant.pump, gain_ml_s=gain)
        plant = replace(plant, growth=growth, pump=pump)
    return plant, model


def _check_fit(config: DeployConfig, family: Family, scenarios: list[Scenario], ends: list[str]) -> None:
    """Check, without the device, that family, scenario and controller fit together. Raises: UserError."""
    law, kind = config.controller.kind, config.backend.kind
    if not family.simulated:
        try:
            registry.on_device(law)
        except ValueError:
            raise messages.KnowsThePlant(controller=law, backend=kind) from None
    with frame.refusing(ReactorError):
        family.fits(config.backend, config.bench, scenarios, ends)


def _check_room(bench: Bench, safety: SafetyConfig, above_ml: Array) -> None:
    """Check that the vial and the budget per minute allow the largest dose. Raises: UserError.

    Args: above_ml: free volume of each vial above its waste tube, mL, (N,).
    """
    room_ml = float(np.min(np.minimum(safety.overflow_ml, above_ml)))
    largest_ml, allowed_ml = bench.max_rate * bench.period_s, min(room_ml, safety.ml_a_minute(bench))
    if largest_ml > allowed_ml + 1e-9:
        given = f"bench.max_rate = {bench.max_rate:g} over {bench.period_s:g} s makes one dose of {largest_ml:.3g} mL"
        allowed = (
            f"{max(allowed_ml, 0.0):.3g} mL (limit: free volume of a vial above its tube, or safety.ml_per_minute)"
        )
        least = max(np.floor(1e5 * allowed_ml / bench.period_s) / 1e5, 0.0)
        raise frame.UserError(f"{given}: allowed {allowed}; use bench.max_rate={least:g} or less")


def _named(config: DeployConfig, family: Family, folder: Path) -> tuple[str, dict[str, float | str]]:
    """Return the run's title (controller and plant), and its parameters for TensorBoard's HPARAMS table."""
    chosen, decides, controlled = choices(folder), str(config.controller.kind), str(config.backend.kind)
    if family.simulated:
        controlled = "plant_file" if config.plant_file else chosen.get("plant", "given")
        if controlled == USUAL_VIALS:  # a guest may have replaced them
            controlled = next(filter(None, (guest.vials(config) for guest in GUESTS)), controlled)
    law = "".join(f" and {kind}" for guest in GUESTS for _, kind in guest.deciders(config))
    row: dict[str, float | str] = {"command": "deploy", "decides": decides, "on": controlled}
    row["scenario"] = chosen.get("scenario", "given")
    if family.simulated and not (config.plant_file or config.env_file):
        volume_ml = config.plant.vessel.volume_ml or config.bench.volume_ml
        tau = volume_ml / (60.0 * config.plant.pump.gain_ml_s)
        row |= {"seed": config.backend.seed, "mu": config.plant.growth.mu, "tau": tau}
    return f"{decides}{law} {'beside' if config.watch else 'on'} {controlled}", row


def _further(config: DeployConfig, plant: PlantConfig, folder: Path, scenarios: list[Scenario]) -> list[Signal]:
    """Build the signals other than the density. Raises: UserError if scenario or backend does not fit them."""
    with frame.refusing(ValueError, ReactorError):
        family, made = family_of(config.backend), []
        for guest in GUESTS:
            made += guest.signals(config, plant, folder, scenarios)
        made += [signals.made(name, law, scenarios) for name, law in config.signals.items()]
        actuators = {actuator.name: actuator for actuator in family.actuators(config.backend)}
        signals.fitting(made, list(actuators.values()))
        for signal in made:
            pump, key = actuators[signal.actuator].pump if signal.actuator else 0, f"signals.{signal.name}"
            if pump and any(pump in s.supplied for s in scenarios):
                raise messages.PumpTwice(key=key, pump=pump)
            family.gives(config.backend, config.bench, [{pump} - {0}] * len(scenarios), key)
        return made


def close_loop(setup: Setup, reactors: Reactor, record: Record) -> ClosedLoop:
    """Build the closed loop of opened reactors; a resumed loop continues in its saved state.

    Raises: UserError if the controller needs something that this run does not have; RecordingError if the saved state
      is damaged or does not fit.
    """
    (plant, flow), volumes_ml = setup.family.truth(reactors), setup.bench.volumes(reactors.names)
    with frame.refusing(ValueError):
        law = registry.build(
            setup.law, model=setup.model, policy=setup.policy, plant=plant, flow_ml_s=flow, bounds=setup.bounds,
            volume_ml=volumes_ml,
        )  # fmt: skip
    rim_ml = setup.family.rim_ml(volumes_ml)
    kind = WatchedInterlock if isinstance(setup.family, WatchedFamily) else Interlock
    interlock = kind(len(volumes_ml), setup.safety, setup.bench, volumes_ml, rim_ml)
    counts = registry.takes(setup.law.kind, "model") and not registry.takes(setup.law.kind, "plant")
    scale = volumes_ml / setup.bench.volume_ml if counts else np.ones(len(volumes_ml))  # the model has one volume
    loop = ClosedLoop(
        reactors, law, interlock, setup.scenarios, record.decided, setup.ends, setup.further, scale,
        setup.family.actuators(setup.backend), setup.model,
    )  # fmt: skip
    if plant is not None:
        loop.known(plant, flow)
    if setup.resumed:
        continue_loop(loop, record.journal, record.state_path, record.rows)
    return loop


@contextmanager
def opened(setup: Setup, record: Record) -> Iterator[ClosedLoop]:
    """Open the reactors, yield their closed loop, and release them afterwards. Raises: ReactorError, UserError."""
    if setup.resumed and is_over(record.journal, record.state_path):
        remedy = "no command was sent to a device; start a new run"
        raise frame.UserError(f"resume={record.folder}: the run has ended with all pumps verified off; {remedy}")
    opening = Opening(setup.backend, setup.bench, setup.plant, record.journal, record.folder, setup.resumed)
    with setup.family.open(opening) as reactors:
        try:
            yield close_loop(setup, reactors, record)
        except BaseException:  # an error before the loop starts: an overflow pump may already run
            reactors.stop()
            raise


def run_preflight(setup: Setup, folder: Path) -> None:
    """Run the checks of `preflight_only=true`; print each with pass or remedy. Raises: UserError if one fails."""
    if setup.family.simulated:
        raise frame.UserError("preflight_only=true: a simulated reactor needs no preflight; use backend=chibio")
    policy = [] if setup.wanted is None else [policy_check(setup.wanted)]
    with frame.refusing(ReactorError):
        report([*setup.family.preflight(setup.backend, setup.bench, folder), *policy])
