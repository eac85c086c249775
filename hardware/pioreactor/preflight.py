"""Checks before a run: one line each, passed or with a remedy. They switch a unit's stirring, and nothing else."""

import math
from collections.abc import Iterator

from hardware.clock import RealClock
from hardware.errors import ReactorError
from hardware.family import Check
from hardware.pioreactor.mailbox import CHANNELS, DOSING_JOBS, NAMES
from hardware.pioreactor.messages import NotHeard, PinsUntold
from hardware.pioreactor.pumps import STEP_S
from hardware.pioreactor.reactors import PioreactorReactors
from hardware.pioreactor.station import PioreactorStation
from hardware.pioreactor.versions import TESTED, facts, flow
from hardware.pioreactor.web import Barrier, Web

QUEUE_S = 20.0


def preflight(reactors: PioreactorReactors) -> list[Check]:
    """Check the broker, then everything that a run needs of each unit. Raises: nothing about a unit."""
    try:
        reactors.connect()
        checks = [Check("broker", True, f"{reactors.config.broker} lets {reactors.config.username} in")]
    except ReactorError as error:
        detail, _, remedy = str(error).partition("; ")
        checks = [Check("broker", False, detail, remedy)]
    for station in reactors.stations:
        try:
            checks += list(_unit(station, reactors))
        except ReactorError as error:
            checks.append(Check(f"{station.name} link", False, str(error), "check power, network and backend.units"))
    return checks


def _unit(station: PioreactorStation, reactors: PioreactorReactors) -> Iterator[Check]:
    unit, name, web, config = station.unit, station.name, station.unit.web, station.unit.config
    health = web.get("/health")
    who = str(health.get("pioreactor_unit"))
    yield Check(f"{name} identity", who == name, f"the unit at {web.url} is {who}", f"correct backend.units.{name}")
    version = str(web.get("/versions/app").get("version"))
    asked = "" if version in TESTED else "; the checks of jobs, calibrations, settings and task queue still count"
    yield Check(f"{name} version", version in TESTED, version, f"tested: {', '.join(TESTED)}{asked}", required=False)
    yield (experiment := _experiment(name, config.experiment, unit.leader))
    calibrations = web.get("/active_calibrations")
    names = [NAMES[job] for job in station.doses.pumps.jobs]
    for pump in (f"{name}_pump" for name in names):
        try:
            yield Check(f"{name} {pump}", True, f"{flow(calibrations, pump):.3f} mL/s at its calibrated duty")
        except ReactorError as error:
            yield Check(f"{name} {pump}", False, error.sentence, error.remedy)
    try:
        settings = web.get("/config/merged")
    except NotHeard:  # an older version, whose settings the leader has
        settings = unit.leader.get(f"/workers/{name}/configuration", below="/api").get(name)
    settings = settings if isinstance(settings, dict) else {}
    norm = str(settings.get("od_reading.config", {}).get("ref_normalization", "classic"))
    scaled = norm == "classic" or config.od_scale != 1.0 or any(device.startswith("od") for device in calibrations)
    remedy = "calibrate OD, set backend.od_scale, or set ref_normalization to classic in the vendor's page"
    yield Check(f"{name} scale", scaled, f"ref_normalization = {norm}", remedy)
    eyes = {k: v for k, v in settings.get("od_config.photodiode_channel", {}).items() if v not in ("", "REF")}
    sees = ", ".join(f"{k} at {v} degrees" for k, v in eyes.items()) or "none"
    remedy = f"set backend.channel or backend.units.{name}.channel to one of these, or correct the vendor's page"
    yield Check(f"{name} photodiode", config.channel in eyes, f"{config.channel} of {sees}", remedy)
    wired = {pump: CHANNELS.get(channel) for channel, pump in settings.get("PWM", {}).items()}
    pins = dict(zip(NAMES.values(), config.pump_pins, strict=True))
    seen = ", ".join(f"{pump} at {wired.get(pump)} (backend.pump_pins: {pins[pump]})" for pump in names)
    same = all(wired.get(pump) == pins[pump] for pump in names)
    yield Check(f"{name} wiring", same, seen, "set backend.pump_pins, or correct the section PWM in the vendor's page")
    tube = str(settings.get("bioreactor", {}).get(facts(version).tube, "not set"))
    remedy = "set both to the culture's volume at its efflux tube: the unit refuses doses by its own setting"
    same = tube == "not set" or abs(float(tube) - unit.volume_ml) <= 0.5
    yield Check(f"{name} volume", same, f"{tube} mL in its settings, {unit.volume_ml:g} here", remedy, required=False)
    other = reactors.mqtt.holder(name)
    seen = other.sentence if other else "no other client"
    yield Check(f"{name} client", not other, seen, other.remedy if other else "")
    dosing = sorted({str(job["job_name"]) for job in web.running()} & set(DOSING_JOBS))
    forget = facts(version).forget
    word = f"on the unit {forget} --job-name {dosing[0]}" if forget and dosing else "the unit is rebooted"
    remedy = f"stop it in the vendor's page; a killed job stays in the list until {word}"
    yield Check(f"{name} dosing", not dosing, ", ".join(dosing) or "no dosing job runs", remedy)
    clock = RealClock()
    barrier = Barrier(web, clock)  # a request that only prints help
    while not (passed := barrier.passed()) and clock.now() < QUEUE_S:
        clock.sleep(STEP_S)
    seen = "responds" if passed else f"no response in {QUEUE_S:.0f} s"
    yield Check(f"{name} task queue", passed, seen, "on the unit: sudo systemctl restart huey")
    if experiment.ok:  # in another experiment the unit does not report its pins
        for _ in station.hear_pins():
            unit.real.sleep(STEP_S)
        heard, remedy = unit.box.dc_s > -math.inf, f"tested: {', '.join(TESTED)}; check that stirring runs"
        yield Check(f"{name} pins", heard, "reported when switched" if heard else PinsUntold.says, remedy)


def _experiment(name: str, wanted: str, leader: Web) -> Check:
    """Check that the unit is in the run's experiment, because it reports nothing of another experiment."""
    remedy = "set backend.experiment=NAME, or assign the unit, active, in the vendor's page"
    try:
        why = leader.astray(name)
    except NotHeard as error:
        return Check(f"{name} experiment", False, str(error), "set backend.leader=http://HOST", required=False)
    return Check(f"{name} experiment", not why, f"{why or 'active'}, backend.experiment = {wanted}", remedy)
