"""`python -m tests.vendor [bench=app|emulator] [faults=[NAME,...]] [workers=2] [out=FOLDER]`: run faults, judge them.

`python -m tests.vendor side_by_side` compares sysdata. A name stands for every fault that contains it; `planted` are
those that the judge must find. Writes table.md and outcomes.json.
"""

import json
import os
import sys
import time
from concurrent.futures import ProcessPoolExecutor, as_completed
from pathlib import Path
from typing import Any

from tests.vendor import test_side_by_side
from tests.vendor.bench import missing
from tests.vendor.faults import FAULTS, PLANTED, Fault, play

COLUMNS = ("item", "fault", "told after, s", "words", "booked/true, mL", "motor runs/doses/repeats", "worst OD")
HEADER = "| " + " | ".join((*COLUMNS, "lost, doubled", "false", "verdict")) + " |"


def row(outcome: dict[str, Any]) -> str:
    """One line of the table."""
    reactors = outcome.get("reactors", {})

    def each(text: Any) -> str:
        return ", ".join(text(one) for one in reactors.values())

    told = "–" if outcome["told_s"] is None else f"{outcome['told_s']:.0f}"
    cells = [
        str(outcome["item"]), outcome["name"], told, outcome["words"][:120].replace("|", "/"),
        each(lambda one: f"{one['booked']:.1f}/{one['true']:.1f}"),
        each(lambda one: "/".join(str(n) for n in one["motor"].values())),
        each(lambda one: f"{one['worst_od']:.2f}"),
        each(lambda one: f"{one['lost']} {one['doubled']}"),
        each(lambda one: " ".join(f"{kind} {n}" for kind, n in one["false"].items()) or "–"),
        "; ".join(outcome["failures"])[:600].replace("|", "/") or "holds",
    ]  # fmt: skip
    return f"| {' | '.join(cells)} |"


def chosen(names: str) -> list[Fault]:
    wanted = [name.strip() for name in names.strip("[]").split(",") if name.strip()]
    every = FAULTS + PLANTED
    return [f for f in every if any(name in f.name for name in wanted)] if wanted else FAULTS


def work_of(base: Path, kind: str) -> Path:
    """A folder for each worker: its boards have identities of their own."""
    return base / f"{kind}_{os.getpid()}"


def one(arguments: tuple[str, str, str]) -> dict[str, Any]:
    kind, name, base = arguments
    fault = next(f for f in FAULTS + PLANTED if f.name == name)
    return play(kind, fault, work_of(Path(base), kind), unit=os.getpid() % 900)


def main(arguments: list[str]) -> int:
    given = dict(argument.partition("=")[::2] for argument in arguments)
    out = Path(given.get("out", f"runs/vendor/{time.strftime('%Y-%m-%d_%H-%M-%S')}")).resolve()
    if "side_by_side" in given:
        print(test_side_by_side.table(out, list(test_side_by_side.SEQUENCES)))
        return 0
    kind = given.get("bench", "app")
    if kind == "app" and (reason := missing()):
        print(reason)
        return 2
    out.mkdir(parents=True, exist_ok=True)
    outcomes = []
    with ProcessPoolExecutor(int(given.get("workers", "2"))) as pool:
        wanted = reversed(chosen(given.get("faults", "")))  # the longest stand last
        for done in as_completed([pool.submit(one, (kind, fault.name, str(out))) for fault in wanted]):
            outcomes.append(outcome := done.result())
            print(row(outcome), flush=True)
            (out / "outcomes.json").write_text(json.dumps(outcomes, indent=1))
            lines = [HEADER, "|" + "---|" * 10, *map(row, outcomes)]
            (out / "table.md").write_text("\n".join(lines) + "\n")
    held = sum(not outcome["failures"] for outcome in outcomes)
    print(f"{held} of {len(outcomes)} hold; {out / 'table.md'}")
    return int(held < len(outcomes))


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
