"""Config of `deploy`: reactors, controller, scenario and safety."""

from dataclasses import dataclass, fields, replace
from typing import Any

from conf.messages import NotAllowed
from conf.schema import check, part, require, setting
from envs.bench import Bench
from envs.plant.plant import PlantConfig
from envs.scenario import Scenario
from experiments.laws import registry
from experiments.laws.density.learned import LearnedConfig
from hardware.family import family, family_of
from hardware.safety.config import SafetyConfig
from hardware.simulated import SimulatedConfig

AT_END = ("hold", "stop", "regulate")
OF_RUN = ("role", "at_end")  # keys of `each` that do not belong to the scenario


@dataclass(frozen=True)
class DeployConfig:
    """Config of `python -m experiments.deploy`."""

    backend: Any = part(SimulatedConfig, "device or simulation", lambda kind, _: family(kind).config())
    plant: PlantConfig = part(PlantConfig, "simulated vials, for backend=sim")
    bench: Bench = part(Bench, "volume, control period and pump")
    safety: SafetyConfig = part(SafetyConfig, "limits of the interlock")
    scenario: Scenario = part(Scenario, "setpoints and their times")
    at_end: str = setting(
        "hold",
        "action of a reactor whose schedule ends before the others: hold the last setpoint, stop dosing, or regulate "
        "(the device's own regulation takes over and continues after the run)",
        choices=AT_END,
    )
    each: dict[str, Any] = setting(
        {},
        "settings of single reactors, for example each.M1.setpoints=[0.5] each.M1.minutes=[60] each.M1.role=control "
        "each.M1.at_end=stop",
    )
    controller: Any = part(LearnedConfig, "controller of the pump rate", registry.config_at)
    policy: str = setting(
        "shipped",
        "policy of controller=dqn: `shipped` (needs no calibration), a policy.npz, a run folder, or `latest` (newest "
        "policy of train or demo)",
    )
    force_policy: bool = setting(False, "run a policy on a device even if no certificate proves it safe for this run")
    signals: dict[str, Any] = setting(
        {},
        "controllers of further signals, defined in extend=FILE.py: signals.NAME.kind=KIND signals.NAME.KEY=VALUE",
        kinds=registry.config_at,
    )
    env_file: str | None = setting(None, "calibrated.yaml or `latest`: growth model of controllers and simulated plant")
    plant_file: str | None = setting(None, "twin.yaml of calibrate or `latest`: replaces `plant`; backend=sim only")
    notify: str = setting(
        "",
        "receiver of messages about start, alarms, hand-overs, end: a command that reads lines of JSON, or env:NAME, "
        "an environment variable with a command or an address; empty: none",
    )
    fsync: bool = setting(True, "write every row to the disk before the next command")
    dry_run: bool = setting(False, "print the timetable and the parts of the run; contact no device, write no file")
    preflight_only: bool = setting(False, "check the device, then stop")
    watch: bool = setting(
        False,
        "read, estimate, decide and warn, but send no command, while something else regulates the culture; "
        "backend=chibio or pioreactor",
    )
    resume: str | None = setting(None, "run folder to continue, or `latest`")

    def __post_init__(self) -> None:
        check(self)
        self.safety.ages_s(self.bench)
        require(not (self.watch and self.resume), "resume", self.resume, "null with watch=true, which cannot resume")
        if family_of(self.backend).simulated:
            self.plant.vessel.of(self.bench.volumes(self.backend.reactors))
        unknown = [name for name in self.bench.volumes_ml if name not in self.backend.reactors]
        require(not unknown, "bench.volumes_ml", tuple(unknown), f"names of {', '.join(self.backend.reactors)}")
        if "://" in self.notify.split(" ")[0]:
            raise ValueError(
                "notify: an address is a secret, not for a file; use env:NAME, a variable with the address"
            )
        if self.plant_file is not None:
            require(self.env_file is None, "env_file", self.env_file, "null with plant_file, which contains a model")
            require(family_of(self.backend).simulated, "backend.kind", self.backend.kind, "sim with plant_file")

    def schedules(self) -> list[Scenario]:
        """Build the scenario of each reactor. Raises: ValueError with reactor, key and allowed values."""
        unknown = [name for name in self.each if name not in self.backend.reactors]
        if unknown:
            raise ValueError(f"each.{unknown[0]}: no such reactor; allowed {', '.join(self.backend.reactors)}")
        schedules = []
        for name in self.backend.reactors:
            given = self.each.get(name, {})
            if not isinstance(given, dict):
                allowed = f"keys and values, for example each.{name}.minutes=[90]"
                raise NotAllowed(key=f"each.{name}", given=given, allowed=allowed)
            own = {k: v for k, v in given.items() if k not in OF_RUN}
            wrong = set(own) - {f.name for f in fields(Scenario)}
            if wrong:
                allowed = ", ".join([f.name for f in fields(Scenario)] + [*OF_RUN])
                raise ValueError(f"each.{name}.{sorted(wrong)[0]}: no such key; allowed {allowed}")
            try:
                schedules.append(replace(self.scenario, **own) if own else self.scenario)
            except (TypeError, ValueError) as error:
                raise ValueError(f"each.{name}: {error}") from None
        return schedules

    def ends(self) -> list[str]:
        """List each reactor's `at_end`. Raises: ValueError with reactor and allowed values."""
        ends = [str(self.each.get(name, {}).get("at_end", self.at_end)) for name in self.backend.reactors]
        for name, end in zip(self.backend.reactors, ends, strict=True):
            require(end in AT_END, f"each.{name}.at_end", end, ", ".join(AT_END))
        return ends

    def roles(self) -> list[str]:
        """List each reactor's role, a text of the user."""
        return [str(self.each.get(name, {}).get("role", "replicate")) for name in self.backend.reactors]
