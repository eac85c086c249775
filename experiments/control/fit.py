"""Whether backend, scenario, controller and interlock fit one another: refused before a device is asked."""

import math

from envs.outputs import DOSE_ML
from envs.scenario import Scenario
from experiments.cli import frame
from experiments.control.config import DeployConfig
from experiments.controllers import registry
from experiments.loop.supply import MADE_UP_MIN
from hardware.chibio.config import ChiBioConfig
from hardware.pioreactor.config import PioreactorConfig

__all__ = ["check_fit"]


def check_fit(config: DeployConfig, scenarios: list[Scenario]) -> None:
    """Raises: UserError naming the backend, what it lacks or what differs, and the remedy."""
    if isinstance(config.backend, ChiBioConfig | PioreactorConfig):
        _check_controller(config)
    if isinstance(config.backend, ChiBioConfig) and config.bench.period_s != 60.0:
        given = f"bench.period_s = {config.bench.period_s:g} s"
        raise frame.UserError(f"{given}: allowed 60 with backend={config.backend.kind}, which measures so often")
    if isinstance(config.backend, PioreactorConfig):
        _check_units(config, config.backend, scenarios)
    _check_supply(config, scenarios)


def _check_controller(config: DeployConfig) -> None:
    kind = config.controller.kind
    try:
        registry.on_device(kind)
    except ValueError:
        remedy = f"allowed with backend=sim only, not backend={config.backend.kind}"
        raise frame.UserError(f"controller = {kind}: knows a simulated plant; {remedy}") from None


def _check_units(config: DeployConfig, backend: PioreactorConfig, scenarios: list[Scenario]) -> None:
    """What a Pioreactor does not measure or control, and whether its doses are what the interlock counts with."""
    where, bench = f"backend={backend.kind}", config.bench
    if any(s.composed for s in scenarios):
        raise frame.UserError(
            f"scenario.ratios: {where} measures no fluorescence, by which a share is known; drop them or use a Chi.Bio"
        )
    asked = sorted({t for s in scenarios for t in s.temperatures if math.isfinite(t)})
    if len(asked) > 1 and not backend.thermostat:
        raise frame.UserError(
            f"scenario.temperatures ask for {asked[0]:g} to {asked[-1]:g} degC: {where} controls none without "
            "backend.thermostat=true"
        )
    if bench.max_rate * bench.period_s > backend.max_dose_ml + 1e-9:
        least = math.floor(1e5 * backend.max_dose_ml / bench.period_s) / 1e5
        raise frame.UserError(
            f"{where}: backend.max_dose_ml = {backend.max_dose_ml:g} mL, the interlock allows "
            f"{bench.max_rate * bench.period_s:.3g} mL in a period of {bench.period_s:g} s; "
            f"give bench.max_rate={least:g} or a larger backend.max_dose_ml"
        )


def _check_supply(config: DeployConfig, scenarios: list[Scenario]) -> None:
    """Whether pumps that a scenario gives by have a tube, and doses may be large enough. Raises: UserError."""
    if not any(s.supplied for s in scenarios):
        return
    backend, bench = config.backend, config.bench
    most_ml, needed = bench.max_rate * bench.period_s, 2.0 * DOSE_ML
    if most_ml < needed:
        remedy = f"allowed {needed / bench.period_s:.4f} mL/s or more beside scenario.outputs"
        raise frame.UserError(f"bench.max_rate = {bench.max_rate:g} mL/s: {remedy}")
    if bench.control_min > MADE_UP_MIN:
        remedy = f"allowed at most {60.0 * MADE_UP_MIN:g} s beside scenario.outputs"
        raise frame.UserError(f"bench.period_s = {bench.period_s:g} s: {remedy}")
    if backend.kind == "sim":
        return
    if not hasattr(backend, "supply"):
        raise frame.UserError(f"scenario.outputs: backend={backend.kind} has no spare pumps; drop them")
    for name, scenario in zip(backend.reactors, scenarios, strict=True):
        for number in sorted(scenario.supplied):
            key = f"backend.supply.pump{number}_ml_s"
            if f"Pump{number}" not in backend.supply.pumps:
                remedy = f"weigh what it gives in a second at full power (docs/scenarios.md) and give its flow, {key}"
                raise frame.UserError(f"scenario.outputs of {name}: Pump{number} has no tube; {remedy}")
            can = backend.supply.most_ml(f"Pump{number}")
            if can < most_ml - 1e-9:
                remedy = f"allowed {most_ml:.2f} mL a dose; take a wider tube or a smaller bench.max_rate"
                raise frame.UserError(f"{key}: Pump{number} gives at most {can:.2f} mL a dose: {remedy}")
