"""From a deploy config to a closed loop: everything that the config names is read here, once, and put together.

A rehearsal is assembled here too, with a clock and a transport of its own.
"""

import logging
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import yaml  # type: ignore[import-untyped]

from conf import presets
from conf.presets import load
from conf.schema import build
from dqn.policy import Policy
from envs.bench import Bench
from envs.coculture.pair import FILE, PairConfig
from envs.plant.plant import PlantConfig, of_pair
from envs.scenario import Scenario
from envs.task import EnvConfig
from experiments.certification import certificate
from experiments.certification.bounds import EstimateBounds
from experiments.cli import files, frame
from experiments.cli.calibrated import read_env_file, read_pair, read_plant_file
from experiments.cli.files import choices
from experiments.control import messages
from experiments.control.config import DeployConfig
from experiments.control.policies import WantedPolicy, admit, composition_policy, policy_check, run_policy
from experiments.laws import registry
from experiments.laws.density.learned import settings
from experiments.laws.share.estimator import CompositionEstimator
from experiments.laws.share.program import Program
from experiments.laws.share.recall import Recall
from experiments.loop import signals
from experiments.loop.loop import ClosedLoop
from experiments.loop.progress import Progress
from experiments.loop.share import LightSignal, Share, program_of
from experiments.loop.signals import AIM, Signal
from experiments.record.record import Record
from experiments.record.recovery import COLUMNS, continue_loop, is_over
from hardware.errors import ReactorError, UnfitError
from hardware.family import Family, Opening, family_of, report
from hardware.reactor import Reactor
from hardware.safety.config import SafetyConfig
from hardware.safety.interlock import Interlock
from hardware.storage import atomic

__all__ = ["Setup", "close_loop", "completed", "opened", "run_preflight", "unpack", "with_pair"]

log = logging.getLogger(__name__)

COMPOSITION, VIALS, USUAL_VIALS = "midpoint", "coculture", "nominal_noise"  # presets


@dataclass(frozen=True, eq=False)
class Setup:
    """What a deploy config comes to, part by part; nobody below holds the config itself.

    family, backend, bench: of the reactors. scenarios, ends, roles: one per reactor.
    plant: of the simulated vials, that of a `plant_file` where there is one; with an `env_file` it grows and is fed as
      calibrated.
    model: growth model that model-based controllers are given: the calibrated one, else the nominal one.
    law: config of what decides the pump rate. wanted: the policy that controller=dqn asks for, None for another.
    policy: as read, None for a preflight. bounds: of its certificate.
    further: signals that are held beside the density, which have seen nothing yet.
    species: of two the second one, whose share may be held.
    fsync: of the record. title: who controls what. row: of the run in TensorBoard's table, but its results.
    resumed: an earlier life of the run is continued.
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
    species: str
    fsync: bool
    title: str
    row: dict[str, float | str]
    resumed: bool

    @property
    def columns(self) -> tuple[str, ...]:
        """Of the recordings."""
        aim = (AIM,) if Progress(self.scenarios).announced else ()
        return (*COLUMNS, *aim, *(column for signal in self.further for column in signal.columns))


def with_pair(config: DeployConfig, folder: Path) -> DeployConfig:
    """Keep a copy of two species from a file, `pair.yaml`, by which the run goes, also when it is resumed."""
    kept, given = folder / FILE, read_pair(config.pair) if config.resume is None else None
    if given is not None and config.pair not in presets.groups()["strains"]:
        text = yaml.safe_dump(files.plain(asdict(given)), sort_keys=False, allow_unicode=True)
        atomic.write(kept, f"# The two species of this run, from {config.pair}.\n{text}")
    return replace(config, pair=str(kept)) if kept.is_file() else config


def completed(config: DeployConfig) -> DeployConfig:
    """Fill in the composition controller and the vials where a scenario asks for a composition.

    All simulated vials get the two species of the run. Raises: UserError for a schedule that is not allowed.
    """
    with frame.refusing(ValueError):
        composed = any(s.composed for s in config.schedules())
    pair = read_pair(config.pair)
    if composed:
        config = _composed(config, pair)
    if family_of(config.backend).simulated and config.plant.pair == PairConfig():  # another one differs on purpose
        config = replace(config, plant=of_pair(config.plant, pair))
    return config


def _composed(config: DeployConfig, pair: PairConfig) -> DeployConfig:
    config, backend, chosen = _rested(config, pair), config.backend, []
    if config.composition is None:
        law = build(registry.config(COMPOSITION, registry.SHARE), load(f"composition/{COMPOSITION}"), "composition")
        config = replace(config, composition=law)
        chosen.append(f"composition={COMPOSITION}")
    if (two := family_of(backend).coculture(backend, config.pair)) != backend:
        config = replace(config, backend=two)
        chosen.append(f"backend.plant={two.plant} backend.pair={two.pair}")
    usual = build(PlantConfig(), load(f"plant/{USUAL_VIALS}"), "plant")
    if family_of(backend).simulated and config.plant == usual and not (config.plant_file or config.env_file):
        config = replace(config, plant=build(PlantConfig(), load(f"plant/{VIALS}"), "plant"))
        chosen.append(f"plant={VIALS}")
    config = replace(config, safety=_within(config.safety, pair))
    if chosen:
        log.info("the scenario asks for a share: %s", " ".join(chosen))
    species, (low, high) = f"{pair.first.name} and {pair.second.name}", pair.temperatures
    log.info("%s, %g to %g degC; both grow alike at %.2f degC", species, low, high, pair.even_c)
    return config


def _rested(config: DeployConfig, pair: PairConfig) -> DeployConfig:
    """Every phase without a temperature gets that at which both grow alike."""
    each = {
        name: own | {"temperatures": [pair.resting_c if t is None else t for t in own["temperatures"]]}
        if isinstance(own, dict) and isinstance(own.get("temperatures"), list)
        else own
        for name, own in config.each.items()
    }
    return replace(config, scenario=config.scenario.resting(pair.resting_c), each=each)


def _within(safety: SafetyConfig, pair: PairConfig) -> SafetyConfig:
    """Limits of the thermostat's target: those of the pair where nothing else is asked for. Raises: UserError."""
    usual, given = SafetyConfig(), (safety.composition_low, safety.composition_high)
    low, high = (
        end if asked == left else asked
        for asked, left, end in zip(
            given, (usual.composition_low, usual.composition_high), pair.temperatures, strict=True
        )
    )
    if not low < pair.even_c < high:
        allowed = (
            f"a range that holds {pair.even_c:.2f} degC, where {pair.first.name} and {pair.second.name} grow alike"
        )
        raise frame.UserError(
            f"safety.composition_low to composition_high = {low:g} to {high:g} degC: allowed {allowed}"
        )
    return replace(safety, composition_low=low, composition_high=high)


def unpack(config: DeployConfig, folder: Path) -> Setup:
    """Everything that a config names, read and checked; the run folder gets a copy of the policy.

    Raises: UserError naming what cannot be read or does not fit.
    """
    family, backend, safety = family_of(config.backend), config.backend, config.safety
    resumed = config.resume is not None
    with frame.refusing(ValueError):
        scenarios, ends = config.schedules(), config.ends()
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
    further = _further(config, plant, folder, scenarios)
    if any(signal.sees_light for signal in further):  # the device has to measure it
        backend = family.seeing_fluorescence(backend)
    fastest = min(model.max_pump_rate, bench.max_rate)
    model = replace(model, control_min=bench.control_min, max_pump_rate=fastest)
    wanted = policy = bounds = None
    if config.controller.kind == "dqn":
        asked = tuple(setpoint for scenario in scenarios for setpoint in scenario.setpoints)
        changes = config.controller.estimator
        stake = config.poor_regret_pct, family.at_stake, config.force_policy
        wanted = WantedPolicy(config.policy, bench, model, changes, asked, *stake)
    if wanted is not None and not config.preflight_only:
        policy = run_policy(wanted, folder, resumed)
        admit(policy, folder / "policy.npz", wanted, resumed)
        with frame.refusing(ValueError):
            own = settings(policy, changes)
        bounds = certificate.bounds(policy, own, folder / "policy.npz", model)
    return Setup(
        family, backend, bench, safety, scenarios, ends, config.roles(), plant, model, config.controller, wanted,
        policy, bounds, further, read_pair(config.pair).second.name, config.fsync, *_named(config, family, folder),
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
        _check_room(config, family)


def _check_room(config: DeployConfig, family: Family) -> None:
    """Whether the largest dose may be given at all: by the vial and by the budget of a minute. Raises: UnfitError."""
    bench, tubes_ml = config.bench, config.bench.volumes(config.backend.reactors)
    room_ml = float(np.min(np.minimum(config.safety.overflow_ml, family.rim_ml(tubes_ml) - tubes_ml)))
    largest_ml, allowed_ml = bench.max_rate * bench.period_s, min(room_ml, config.safety.ml_a_minute(bench))
    if largest_ml > allowed_ml + 1e-9:
        given = (
            f"bench.max_rate = {bench.max_rate:g} mL/s over {bench.period_s:g} s comes to {largest_ml:.3g} mL at once"
        )
        why = "what a vial has room for above its tube, and safety.ml_per_minute"
        least = max(np.floor(1e5 * allowed_ml / bench.period_s) / 1e5, 0.0)
        raise UnfitError(
            f"{given}: allowed {max(allowed_ml, 0.0):.3g} mL ({why}); give bench.max_rate={least:g} or less"
        )


def _named(config: DeployConfig, family: Family, folder: Path) -> tuple[str, dict[str, float | str]]:
    """Who controls what, in a title and as a row of TensorBoard's table; growth and pump of a simulated vial."""
    chosen, decides, controlled = choices(folder), str(config.controller.kind), str(config.backend.kind)
    if family.simulated:
        controlled = "plant_file" if config.plant_file else chosen.get("plant", "given")
        if config.composition is not None and controlled == USUAL_VIALS:  # replaced by `completed`
            controlled = VIALS
    law = "" if config.composition is None else f" and {config.composition.kind}"
    row: dict[str, float | str] = {"command": "deploy", "decides": decides, "on": controlled}
    row["scenario"] = chosen.get("scenario", "given")
    if family.simulated and not (config.plant_file or config.env_file):
        volume_ml = config.plant.vessel.volume_ml or config.bench.volume_ml
        tau = volume_ml / (60.0 * config.plant.pump.gain_ml_s)
        row |= {"seed": config.backend.seed, "mu": config.plant.growth.mu, "tau": tau}
    return f"{decides}{law} on {controlled}", row


def _further(config: DeployConfig, plant: PlantConfig, folder: Path, scenarios: list[Scenario]) -> list[Signal]:
    """Build the signals held beside the density. Raises: UserError where scenario, backend and they do not fit."""
    with frame.refusing(ValueError, ReactorError):
        share = [] if config.composition is None else [_share(config, plant, folder, scenarios)]
        own = [signals.made(name, law, scenarios) for name, law in config.signals.items()]
        vials = family_of(config.backend).vials(config.backend, plant)
        lit = family_of(config.backend).sees_fluorescence(config.backend) or (vials and vials[1].second.present)
        light = [LightSignal()] if lit and not share and not own else []
        family, made = family_of(config.backend), [*share, *light, *own]
        actuators = {actuator.name: actuator for actuator in family.actuators(config.backend)}
        signals.fitting(made, list(actuators.values()))
        for signal in made:
            pump, key = actuators[signal.actuator].pump if signal.actuator else 0, f"signals.{signal.name}"
            if pump and any(pump in s.supplied for s in scenarios):
                raise messages.PumpTwice(key=key, pump=pump)
            family.gives(config.backend, config.bench, [{pump} - {0}] * len(scenarios), key)
        return made


def _share(config: DeployConfig, plant: PlantConfig, folder: Path, scenarios: list[Scenario]) -> Signal:
    """Build the signal of the share. Raises: UserError where scenario, backend and its law do not fit; ValueError."""
    asked = [name for name, s in zip(config.backend.reactors, scenarios, strict=True) if s.composed]
    kind = config.composition.kind
    if not asked:
        remedy = "give scenario=ratio_steps or scenario.ratios, or drop it"
        raise frame.UserError(f"composition={kind}: no scenario asks for a share; {remedy}")
    vials = family_of(config.backend).vials(config.backend, plant)
    if vials is not None and not vials[1].second.present:
        key = f"{vials[0]}={VIALS}"
        raise frame.UserError(f"composition={kind}: the vials hold one species that does not fluoresce; give {key}")
    one = next(s for s in scenarios if s.composed)
    if kind == "optimum" and any(program_of(s) != program_of(one) for s in scenarios):
        raise frame.UserError("composition=optimum plans one program: give all reactors the same shares and minutes")
    policy = composition_policy(kind, config.composition_policy, folder, config.resume is not None)
    program, volumes_ml = program_of(one), config.bench.volumes(config.backend.reactors)
    pair = read_pair(config.pair)
    law = registry.build(config.composition, registry.SHARE, policy=policy, program=program, pair=pair)
    if policy is not None:
        _check_shares(policy, kind, [program_of(s) for s in scenarios if s.composed], config.force_policy)
    estimator = Recall(CompositionEstimator(config.composition.estimator, volumes_ml, pair))
    simulated = family_of(config.backend).simulated
    return Share(estimator, law, scenarios, config.share_warnings, simulated=simulated)


def _check_shares(policy: Policy, kind: str, programs: list[Program], forced: bool) -> None:
    """Whether a policy was trained for what is asked for; a share beyond that it holds at the end of its range.

    Raises: UserError; forced: it is only said.
    """
    low, high = policy.metadata["model"]["setpoints"]
    outside = sorted({s for p in programs for s in p.extremes if not low - 1e-9 <= s <= high + 1e-9})
    if not outside:
        return
    what = f"composition={kind}: its policy was trained for shares of {low:g} to {high:g}, the scenario asks for "
    what += ", ".join(f"{s:g}" for s in outside)
    if not forced:
        remedy = "give composition=midpoint, a policy trained with env.setpoints that reach there, or force_policy=true"
        raise frame.UserError(f"{what}; {remedy}")
    log.warning("%s; it runs all the same: force_policy=true", what)


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
    interlock = Interlock(len(volumes_ml), setup.safety, setup.bench, volumes_ml, rim_ml)
    for signal in setup.further:
        if isinstance(signal, Share) and plant is not None:
            signal.truth = partial(getattr, plant.culture, "share")
    counts = registry.takes(setup.law.kind, "model") and not registry.takes(setup.law.kind, "plant")
    scale = volumes_ml / setup.bench.volume_ml if counts else np.ones(len(volumes_ml))  # its model is of one volume
    loop = ClosedLoop(
        reactors, law, interlock, setup.scenarios, record.decided, setup.ends, setup.further, scale,
        setup.family.actuators(setup.backend), setup.model,
    )  # fmt: skip
    if plant is not None:
        loop.density.known(plant, flow, setup.bench)
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
