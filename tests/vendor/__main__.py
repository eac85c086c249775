"""`python -m tests.vendor [bench=app|emulator] [faults=[NAME,...]] [workers=2] [out=FOLDER]`: run faults, judge them.

A name stands for every fault that contains it; `planted` are those that the judge must find. Writes outcomes.json.
`python -m tests.vendor table=[FOLDER,...]` writes the newest outcome of each fault below these folders, app beside
emulator, to docs/results/vendor_app.json.
"""

import json
import os
import sys
import time
from concurrent.futures import ProcessPoolExecutor, as_completed
from pathlib import Path
from typing import Any

from tests.studies.results import write
from tests.vendor.bench import BENCHES, ROOT, missing
from tests.vendor.faults import FAULTS, PLANTED, Fault, play

RESULT = ROOT / "docs" / "results" / "vendor_app.json"
COLUMNS = ("fault", "reported after, s", "by", "booked of true volume, mL, app", "emulator", "app", "emulator")


def listed(words: str) -> list[str]:
    return [word.strip() for word in words.strip("[]").split(",") if word.strip()]


def chosen(names: str) -> list[Fault]:
    wanted = listed(names)
    return [f for f in FAULTS + PLANTED if any(name in f.name for name in wanted)] if wanted else FAULTS


def one(arguments: tuple[str, str, str]) -> dict[str, Any]:
    """One fault, in a folder of this worker: its boards have identities of their own."""
    kind, name, base = arguments
    fault = next(f for f in FAULTS + PLANTED if f.name == name)
    return play(kind, fault, Path(base) / f"{kind}_{os.getpid()}", unit=os.getpid() % 900)


def verdict(outcome: dict[str, Any] | None) -> str:
    return "not run" if outcome is None else "; ".join(outcome["failures"]).replace("|", "/")[:300] or "holds"


def told(outcome: dict[str, Any] | None) -> str:
    return "–" if outcome is None or outcome["told_s"] is None else f"{outcome['told_s']:.0f}"


def volumes(outcome: dict[str, Any] | None) -> str:
    each = (outcome or {}).get("reactors", {}).values()
    return ", ".join(f"{m['booked']:.1f} of {m['true']:.1f}" for m in each) or "–"


def row(name: str, app: dict[str, Any] | None, emulator: dict[str, Any] | None) -> list[str]:
    """Return one line of the table. An alarm is named by its reason, a message of the driver is a note."""
    said = next((o["words"] for o in (app, emulator) if o and o["words"]), "").partition(": ")[2]
    by = (said.split(":")[0] if ":" in said.split(" ")[0] else "note") if said else "–"
    after = told(app) if told(app) == told(emulator) else f"{told(app)}, {told(emulator)}"
    return [name, after, by, volumes(app), volumes(emulator), verdict(app), verdict(emulator)]


def table(folders: list[str]) -> list[list[str]]:
    """Return every fault's newest outcome on each bench."""
    newest: dict[tuple[str, str], dict[str, Any]] = {}
    paths = [path for folder in folders for path in Path(folder).rglob("outcome.json")]
    for path in sorted(paths, key=lambda path: path.stat().st_mtime):
        outcome = json.loads(path.read_text())
        newest[outcome["name"], outcome["bench"]] = outcome
    return [row(f.name, *(newest.get((f.name, kind)) for kind in BENCHES)) for f in FAULTS + PLANTED]


def main(arguments: list[str]) -> int:
    given = dict(argument.partition("=")[::2] for argument in arguments)
    out = Path(given.get("out", f"runs/vendor/{time.strftime('%Y-%m-%d_%H-%M-%S')}")).resolve()
    kind = given.get("bench", "app")
    if "table" in given:
        origin = {"command": f"python -m tests.vendor table={given['table']}", "date": time.strftime("%Y-%m-%d")}
        write(RESULT, {**origin, "columns": COLUMNS, "rows": table(listed(given["table"]))})
        return 0
    if kind == "app" and (reason := missing()):
        print(reason)
        return 2
    out.mkdir(parents=True, exist_ok=True)
    outcomes = []
    with ProcessPoolExecutor(int(given.get("workers", "2"))) as pool:
        wanted = reversed(chosen(given.get("faults", "")))  # the longest stand last
        for done in as_completed([pool.submit(one, (kind, fault.name, str(out))) for fault in wanted]):
            outcomes.append(outcome := done.result())
            print(f"{outcome['name']}: told {told(outcome)} s; {volumes(outcome)}; {verdict(outcome)}", flush=True)
            (out / "outcomes.json").write_text(json.dumps(outcomes, indent=1))
    held = sum(not outcome["failures"] for outcome in outcomes)
    print(f"{held} of {len(outcomes)} hold; {out}")
    return int(held < len(outcomes))


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
