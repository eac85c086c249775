"""How many of the bugs written by hand were noticed, by room and list: `python -m tests.mutants.by_hand FOLDER`.

`by_hand.jsonl` beside this file has a bug a line: list, room, file, what stands there and what the bug puts in its
place, what a user would have seen, and whether the test files that were asked noticed it when its list was planted.
"""

import json
import sys
from collections import Counter
from pathlib import Path

from tests.studies.results import leave

__all__ = ["main", "noticed"]

LIST = Path(__file__).with_suffix(".jsonl")
FIRST = "first list, before tests were written for it"
NAMES = (FIRST, "second, after that", "third, after more", "fourth, after more")


def noticed(bugs: list[dict[str, object]]) -> list[list[str]]:
    """A row for each room, and one for all: "noticed of written" for each list."""
    lists = sorted({int(str(b["list"])) for b in bugs})
    written = Counter((b["room"], b["list"]) for b in bugs)
    seen = Counter((b["room"], b["list"]) for b in bugs if b["noticed"])
    rooms = list(dict.fromkeys(str(b["room"]) for b in bugs))
    rows = [[room, *(f"{seen[room, k]} of {written[room, k]}" for k in lists)] for room in rooms]
    whole = [f"{sum(seen[room, k] for room in rooms)} of {sum(written[room, k] for room in rooms)}" for k in lists]
    return [*rows, ["all", *whole]]


def main(folder: Path) -> None:
    """Write the table into a folder, for `tests.studies.results by_hand=FOLDER`."""
    rows = noticed([json.loads(line) for line in LIST.read_text("utf-8").splitlines()])
    folder.mkdir(parents=True, exist_ok=True)
    leave(folder, __file__, ("room", *NAMES[: len(rows[0]) - 1]), rows)


if __name__ == "__main__":
    main(Path(sys.argv[1]))
