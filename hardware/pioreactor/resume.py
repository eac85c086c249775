"""What a run must remember of each unit and its doses, and how the journal gives it back after a crash."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, ClassVar, Self

from hardware.pioreactor.mailbox import PUMPS
from hardware.storage import history

__all__ = ["History", "replay"]


@dataclass(frozen=True)
class History(history.History):
    """One unit's past; boot, when it had been started; of an open dose id, and task, the answer to its request."""

    boot: str = ""
    id: str = ""
    task: str = ""

    KINDS: ClassVar = (*history.History.KINDS, "task")
    KEYS: ClassVar = {**history.History.KEYS, "boot": str}

    def after(self, row: Mapping[str, Any]) -> Self:
        """Return what is known after one more row of this unit. Raises: as a row that is damaged makes it."""
        known = super().after(row)
        if row["kind"] == "intent":
            return replace(known, id=str(row["id"]), task="")
        if row["kind"] == "task" and row["id"] == known.id:
            return replace(known, task=str(row["task"]), wasted=row["job"] != PUMPS[0])
        return known


def replay(rows: Sequence[Mapping[str, Any]]) -> dict[str, History]:
    """Replay the journal of a run for each unit. Args: rows: oldest first. Raises: RecordingError."""
    return history.replayed(rows, History())
