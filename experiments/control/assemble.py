"""From a deploy config to a closed loop: everything that the config names is read here, once, and put together.

A rehearsal is assembled here too, with a clock and a transport of its own.
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
    """Objects built from a deploy config, part by part; lower layers do not hold the config itself.

    family, backend, bench: of the reactors. scenarios, ends, roles: one per reactor.
    plant: of the simulated vials, that of a `plant_file` where there is one; with an `env_file` it grows and is fed as
      calibrated.
    model: growth model that model-based controllers are given: the calibrated one, else the nominal one.
    law: config of what decides the pump rate. wanted: the policy that controller=dqn asks for, None for another.
    policy: as read, None for a preflight. bounds: of its certificate.
    further: signals that are held beside the density, which have seen nothing yet.
    fsync: of the record. title: who controls what. row: of the run in TensorBoard's table, but its results.
    resumed: whether this run continues an earlier one.
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
        """Of the recordings."""
        aim = (AIM,) if Progress(self.scenarios).announced else ()
        return (*COLUMNS, *aim, *(column for signal in self.further for column in signal.columns))


def completed(config: DeployConfig, folder: Path | None = None) -> DeployConfig:
    """Fill in what guests complete. Args: as of `Guest.completed`. Raises: UserError."""
    with frame.refusing(ValueError, ReactorError):
        for guest in GUESTS:
            config = guest.completed(config, folder)
    return config


def unpack(config: DeployConfig, folder: Path) -> Setup:
    """Everything that a config names, read and checked; the run folder gets a copy of the policy.

    Raises: UserError naming what cannot be read or does not fit.
    """
    family, backend, safety = family_of(config.backend), config.backend, config.safety
    if config.watch:
        family = WatchedFamily(family)
    resumed = config.resume is not None
    with frame.refusing(ValueError):
        scenarios, ends, roles = config.schedules(), config.ends(), config.roles()
    if resumed and not family.can.resume:
        why = "a simulated run takes a second; run it again" if family.simulated else "its reactors cannot; start anew"
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
    """Of the simulated vials, and the growth model that model-based controllers are given. Raises: UserError."""
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
    """Whether family, scenario, controller and interlock fit, before a device is asked. Raises: UserError."""
    law, kind = config.controller.kind, config.backend.kind
    if not family.simulated:
        try:
            registry.on_device(law)
        except ValueError:
            raise messages.KnowsThePlant(controller=law, backend=kind) from None
    with frame.refusing(ReactorError):
        family.fits(config.backend, config.bench, scenarios, ends)


def _check_room(bench: Bench, safety: SafetyConfig, above_ml: Array) -> None:
    """Check that the largest dose may be given at all, by the vial and by the budget of a minute. Raises: UserError.

    Args: above_ml: room of each vial above its tube, mL, (N,).
    """
    room_ml = float(np.min(np.minimum(safety.overflow_ml, above_ml)))
    largest_ml, allowed_ml = bench.max_rate * bench.period_s, min(room_ml, safety.ml_a_minute(bench))
    if largest_ml > allowed_ml + 1e-9:
        given = f"bench.max_rate = {bench.max_rate:g} over {bench.period_s:g} s makes one dose of {largest_ml:.3g} mL"
        allowed = f"{max(allowed_ml, 0.0):.3g} mL (what a vial has room for above its tube, and safety.ml_per_minute)"
        least = max(np.floor(1e5 * allowed_ml / bench.period_s) / 1e5, 0.0)
        raise frame.UserError(f"{given}: allowed {allowed}; give bench.max_rate={least:g} or less")


def _named(config: DeployConfig, family: Family, folder: Path) -> tuple[str, dict[str, float | str]]:
    """Who controls what, in a title and as a row of TensorBoard's table; growth and pump of a simulated vial."""
    chosen, decides, controlled = choices(folder), str(config.controller.kind), str(config.backend.kind)
    if family.simulated:
        controlled = "plant_file" if config.plant_file else chosen.get("plant", "given")
        if controlled == USUAL_VIALS:  # which may have been replaced
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
    """Build the signals held beside the density. Raises: UserError where scenario, backend and they do not fit."""
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
    """Laws, interlock and scenarios around reactors that are ready; a resumed loop stands where it was.

    Raises: UserError naming what the controller needs and does not have here; RecordingError for a state that is
      damaged or does not fit.
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
    scale = volumes_ml / setup.bench.volume_ml if counts else np.ones(len(volumes_ml))  # its model is of one volume
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
    """Open the loop around the configured reactors, which are released afterwards. Raises: ReactorError, UserError."""
    if setup.resumed and is_over(record.journal, record.state_path):
        remedy = "nothing was done to the device; start a new run"
        raise frame.UserError(f"resume={record.folder}: the run is over, its pumps were verified off; {remedy}")
    opening = Opening(setup.backend, setup.bench, setup.plant, record.journal, record.folder, setup.resumed)
    with setup.family.open(opening) as reactors:
        try:
            yield close_loop(setup, reactors, record)
        except BaseException:  # before the loop, which ends with the same by itself: an overflow pump runs already
            reactors.stop()
            raise


def run_preflight(setup: Setup, folder: Path) -> None:
    """`preflight_only=true`: every check a line with pass or the remedy. Raises: UserError if one failed."""
    if setup.family.simulated:
        raise frame.UserError("preflight_only=true: a simulated reactor needs no preflight; use backend=chibio")
    policy = [] if setup.wanted is None else [policy_check(setup.wanted)]
    with frame.refusing(ReactorError):
        report([*setup.family.preflight(setup.backend, setup.bench, folder), *policy])
