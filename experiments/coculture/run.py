"""Guest of two species in a run: it adds the pair, the vials, the composition controller and its signal."""

import logging
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any, cast

import yaml  # type: ignore[import-untyped]

from conf import presets
from conf.presets import load
from conf.schema import build
from envs.coculture.pair import FILE, PairConfig
from envs.coculture.second import of_pair, of_plant
from envs.plant.plant import PlantConfig
from envs.scenario import Scenario
from experiments.cli import files, frame
from experiments.coculture.base import SHARE
from experiments.coculture.config import of_deploy, read_pair
from experiments.coculture.estimator import CompositionEstimator
from experiments.coculture.program import composed, program_of, ratios_of, resting
from experiments.coculture.recall import Recall
from experiments.coculture.signal import LightSignal, Share
from experiments.control.config import DeployConfig
from experiments.control.guests import Guest
from experiments.laws import registry
from experiments.loop.signals import Signal
from hardware.family import family_of
from hardware.safety.config import SafetyConfig
from hardware.storage import atomic

log = logging.getLogger(__name__)

COMPOSITION, VIALS, USUAL_VIALS = "midpoint", "coculture", "nominal_noise"  # presets


class TwoSpecies(Guest):
    """Guest that adds composition control by the thermostat if a scenario has setpoints of the share."""

    def completed(self, config: DeployConfig, folder: Path | None) -> DeployConfig:
        """Fill in composition controller and vials if a scenario has a composition, and the pair of simulated vials."""
        config = config if folder is None else _with_pair(config, folder)
        pair = read_pair(of_deploy(config).pair)
        if any(map(composed, config.schedules())):
            config = _composed(config, pair)
        usual = of_plant(config.plant).pair == PairConfig()  # the user may have chosen another pair for the plant
        if family_of(config.backend).simulated and usual:
            config = replace(config, plant=of_pair(config.plant, pair))
        return config

    def signals(
        self, config: DeployConfig, plant: PlantConfig, folder: Path, scenarios: list[Scenario]
    ) -> list[Signal]:
        """Build the signal of the share, or, without a composition controller, a signal that only records light."""
        family, backend = family_of(config.backend), config.backend
        if any(map(composed, scenarios)) and not family.can.fluorescence:
            why = "measures no fluorescence, which the share's estimate needs; remove the ratios or use a Chi.Bio"
            raise frame.UserError(f"scenario.ratios: backend={backend.kind} {why}")
        if of_deploy(config).composition is not None:
            return [_share(config, plant, folder, scenarios)]
        vials = family.vials(backend, plant)
        lit = family.sees_fluorescence(backend) or (vials is not None and of_plant(vials[1]).second.present)
        return [LightSignal()] if lit and not config.signals else []

    def vials(self, config: DeployConfig) -> str:
        return "" if of_deploy(config).composition is None else VIALS

    def deciders(self, config: DeployConfig) -> list[tuple[str, str]]:
        composition = of_deploy(config).composition
        return [] if composition is None else [("share", str(composition.kind))]

    def asked(self, scenario: Scenario, phase: int) -> str:
        ratios = ratios_of(scenario).ratios
        share = ratios[phase] if ratios else None
        return "" if share is None else f"share {share:g}, whose controller decides the temperature"


def _changed(config: DeployConfig, **values: Any) -> DeployConfig:
    return cast(DeployConfig, replace(cast(Any, config), **values))


def _with_pair(config: DeployConfig, folder: Path) -> DeployConfig:
    """Copy a pair that is read from a file into the run folder, and let the config name this copy, also on resume."""
    asked = of_deploy(config).pair
    kept, given = folder / FILE, read_pair(asked) if config.resume is None else None
    if given is not None and asked not in presets.groups()["strains"]:
        text = yaml.safe_dump(files.plain(asdict(given)), sort_keys=False, allow_unicode=True)
        atomic.write(kept, f"# The two species of this run, from {asked}.\n{text}")
    return _changed(config, pair=str(kept)) if kept.is_file() else config


def _composed(config: DeployConfig, pair: PairConfig) -> DeployConfig:
    config, backend, chosen = _rested(config, pair), config.backend, []
    if of_deploy(config).composition is None:
        law = build(registry.config(COMPOSITION, SHARE), load(f"composition/{COMPOSITION}"), "composition")
        config = _changed(config, composition=law)
        chosen.append(f"composition={COMPOSITION}")
    if (two := family_of(backend).holding(backend, VIALS, pair=of_deploy(config).pair)) != backend:
        config = replace(config, backend=two)
        chosen.append(f"backend.plant={two.plant} backend.pair={two.pair}")
    usual = build(PlantConfig(), load(f"plant/{USUAL_VIALS}"), "plant")
    if family_of(backend).simulated and config.plant == usual and not (config.plant_file or config.env_file):
        config = replace(config, plant=build(PlantConfig(), load(f"plant/{VIALS}"), "plant"))
        chosen.append(f"plant={VIALS}")
    config = replace(config, safety=_within(config.safety, pair))
    if chosen:
        log.info("set because the scenario has a composition: %s", " ".join(chosen))
    species, (low, high) = f"{pair.first.name} and {pair.second.name}", pair.temperatures
    log.info("%s, %g to %g degC; both grow alike at %.2f degC", species, low, high, pair.even_c)
    return config


def _rested(config: DeployConfig, pair: PairConfig) -> DeployConfig:
    """Give every phase without a temperature the temperature of equal growth."""
    each = {
        name: own | {"temperatures": [pair.resting_c if t is None else t for t in own["temperatures"]]}
        if isinstance(own, dict) and isinstance(own.get("temperatures"), list)
        else own
        for name, own in config.each.items()
    }
    return replace(config, scenario=resting(config.scenario, pair.resting_c), each=each)


def _within(safety: SafetyConfig, pair: PairConfig) -> SafetyConfig:
    """Set the limits of the thermostat's target to those of the pair, unless they are configured. Raises: UserError."""
    usual, given = SafetyConfig(), (safety.composition_low, safety.composition_high)
    low, high = (
        end if asked == left else asked
        for asked, left, end in zip(
            given, (usual.composition_low, usual.composition_high), pair.temperatures, strict=True
        )
    )
    if not low < pair.even_c < high:
        allowed = (
            f"a range that includes {pair.even_c:.2f} degC, where {pair.first.name} and {pair.second.name} grow alike"
        )
        raise frame.UserError(
            f"safety.composition_low to composition_high = {low:g} to {high:g} degC: allowed {allowed}"
        )
    return replace(safety, composition_low=low, composition_high=high)


def _share(config: DeployConfig, plant: PlantConfig, folder: Path, scenarios: list[Scenario]) -> Signal:
    """Build the signal of the share. Raises: UserError, ValueError if scenario, backend and controller do not fit."""
    from experiments.coculture.policies import check_shares, composition_policy  # slow: also imports certificates

    asked = [name for name, s in zip(config.backend.reactors, scenarios, strict=True) if composed(s)]
    family, two = family_of(config.backend), of_deploy(config)
    kind = two.composition.kind
    if not asked:
        remedy = "add scenario=ratio_steps or scenario.ratios, or remove composition"
        raise frame.UserError(f"composition={kind}: no scenario has setpoints of the share; {remedy}")
    vials = family.vials(config.backend, plant)
    if vials is not None and not of_plant(vials[1]).second.present:
        key = f"{vials[0]}={VIALS}"
        raise frame.UserError(f"composition={kind}: the vials contain only one species; use {key}")
    one = next(s for s in scenarios if composed(s))
    if kind == "optimum" and any(program_of(s) != program_of(one) for s in scenarios):
        raise frame.UserError("composition=optimum: the programs differ; give all reactors the same shares and minutes")
    policy = composition_policy(kind, two.composition_policy, folder, config.resume is not None)
    program, volumes_ml = program_of(one), config.bench.volumes(config.backend.reactors)
    pair = read_pair(two.pair)
    law = registry.build(two.composition, SHARE, policy=policy, program=program, pair=pair)
    if policy is not None:
        check_shares(policy, kind, [program_of(s) for s in scenarios if composed(s)], config.force_policy)
    estimator = Recall(CompositionEstimator(two.composition.estimator, volumes_ml, pair))
    return Share(estimator, law, scenarios, two.share_warnings, family.simulated, pair.second.name)
