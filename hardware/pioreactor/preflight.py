"""Before a run: one line per check, passed or with the remedy. Changes nothing on a unit."""

from collections.abc import Iterator

from hardware.check import Check
from hardware.errors import ReactorError
from hardware.pioreactor.jobs import flow
from hardware.pioreactor.mailbox import DOSING_JOBS
from hardware.pioreactor.pump_jobs import MEDIA
from hardware.pioreactor.reactors import PioreactorReactors
from hardware.pioreactor.station import Station

__all__ = ["KNOWN", "preflight"]

KNOWN = ("25.11.19",)  # versions of the vendor's software that the tests ran against
CLOCK_S = 30.0


def preflight(reactors: PioreactorReactors) -> list[Check]:
    """Per unit: reached, version, clock, calibrations, nothing else that doses. Raises: nothing about a unit."""
    checks: list[Check] = []
    for station in reactors.stations:
        try:
            checks += list(_unit(station, reactors))
        except ReactorError as error:
            checks.append(Check(f"{station.name} link", False, str(error), "check power, network, backend.addresses"))
    return checks


def _unit(station: Station, reactors: PioreactorReactors) -> Iterator[Check]:
    """Checks of one unit. Raises: ReactorError where it does not answer."""
    name = station.name
    who = str(station.web.get("/health").get("pioreactor_unit"))
    yield Check(f"{name} identity", who == name, f"the unit at {station.web.url} is {who}", "correct backend.addresses")
    version = str(station.web.get("/versions/app").get("version"))
    yield Check(f"{name} version", version in KNOWN, version, f"tried with {', '.join(KNOWN)}", required=False)
    off = f"{(error_s := station.web.clock_error_s()):+.1f} s against this computer"
    yield Check(f"{name} clock", abs(error_s) < CLOCK_S, off, "only its logs suffer", required=False)
    calibrations = station.web.get("/active_calibrations")
    for pump in ("media_pump", "waste_pump"):
        try:
            yield Check(f"{name} {pump}", True, f"{flow(calibrations, pump, name):.3f} mL/s at its calibrated duty")
        except ReactorError as error:
            detail, _, remedy = str(error).partition("; ")
            yield Check(f"{name} {pump}", False, detail, remedy)
    other, _, remedy = reactors.holder(name).partition("; ")
    yield Check(f"{name} client", not other, other or "no other client of ours", remedy)
    jobs = {str(job["job_name"]) for job in station.web.running()}
    dosing = sorted(jobs & set(DOSING_JOBS))
    killed = f"POST /unit_api/jobs/stop?job_name={dosing[0] if dosing else MEDIA}"
    remedy = f"stop it in the vendor's page; one that was killed stays in its list until {killed}"
    yield Check(f"{name} dosing", not dosing, ", ".join(dosing) or "nothing else doses", remedy)
    largest = f"the vendor has no limit of one dose; ours is {reactors.config.max_dose_ml:g} mL"
    yield Check(f"{name} dead man", True, f"{largest}, and every pump job times itself")
