"""Every fault that is tried, of both families."""

from collections.abc import Iterable

from tests.campaigns import chibio_faults, pioreactor_faults
from tests.campaigns.fault import Fault

__all__ = ["FAULTS", "by_name"]

FAULTS = (*chibio_faults.FAULTS, *pioreactor_faults.FAULTS)


def by_name(names: Iterable[str]) -> tuple[Fault, ...]:
    """The named faults. Raises: ValueError naming one that does not exist and those that do."""
    known = {fault.name: fault for fault in FAULTS}
    wanted = tuple(names)
    for name in wanted:
        if name not in known:
            raise ValueError(f"faults = {name}: no such fault; allowed {', '.join(known)}")
    return tuple(known[name] for name in wanted)
