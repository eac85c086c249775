"""Scores of the modules of TABLE: killed / (all - equivalent), printed and written to runs/mutants.json.

Equivalent mutants are those that equivalent.txt lists, each with its reason.
"""

from __future__ import annotations

import datetime
import json
import os
import random
import re
import sys
import time
from collections import Counter, defaultdict
from pathlib import Path

from tests.mutants.operators import ROOT, Module, Mutant
from tests.mutants.server import run_group

LISTED = Path(__file__).with_name("equivalent.txt")

SAFETY, STORAGE, CHIBIO = "hardware/safety", "hardware/storage", "hardware/chibio"
TABLE = {
    "dqn": (
        [f"dqn/{name}.py" for name in (
            "agent", "targets", "replay", "trainer", "optimiser", "hindsight", "network", "checkpoint", "policy",
            "config",
        )],
        ["dqn", "test_settings.py"],
    ),
    "safety": (
        [f"{SAFETY}/{name}.py" for name in ("budget", "config", "interlock", "readings", "unexplained_change")],
        ["hardware/test_interlock.py", "hardware/test_safety_limits.py", "test_settings.py"],
    ),
    "storage": (
        [f"{STORAGE}/{name}.py" for name in ("journal", "atomic", "recorder")],
        ["hardware/test_disk.py", "hardware/test_atomic.py", "hardware/test_journal.py", "hardware/test_recording.py"],
    ),
    "dosing": (
        [f"{CHIBIO}/{name}.py" for name in (
            "dosing", "dose_sequence", "sampling", "resume", "agenda", "overflow_pump", "diagnosis",
        )] + [f"{STORAGE}/doses.py"],
        [f"hardware/test_{name}.py" for name in (
            "dosing", "dose_sequence", "ending", "history", "sampling", "agenda", "diagnosis", "overflow_pump",
            "reactors",
        )] + ["experiments/test_open_dose.py", "test_settings.py"],
    ),
    "figures": (
        ["experiments/loop/metrics.py", "experiments/comparison/statistics.py"],
        ["experiments/test_metrics.py", "experiments/test_statistics.py"],
    ),
}  # fmt: skip
"""Which tests are asked about which modules; paths of tests are below tests/."""


def listed() -> dict[tuple[str, str, str, str], str]:
    """The equivalent mutants, each with its reason."""
    row = re.compile(r"^`([^`]+)` `([^`]+)` `([^`]+)` → `([^`]+)`: (.+)$", re.MULTILINE)
    found = row.findall(LISTED.read_text())
    return {(path, where, was, now): reason for path, where, was, now, reason in found}


def main(arguments: list[str]) -> int:
    """Run, print, store. Returns 1 if a score is below 90 %."""
    os.environ["OMP_NUM_THREADS"] = "1"
    os.chdir(ROOT)
    given = dict(a.partition("=")[::2] for a in arguments)
    if set(given) - {"module", "sample", "seed", "again"}:
        raise SystemExit("usage: python -m tests.mutants [module=PREFIX,...] [sample=N] [seed=N] [again=SCORES.json]")
    wanted = tuple(given.get("module", "").split(","))
    groups = [([Module(p) for p in paths if p.startswith(wanted)], tests) for paths, tests in TABLE.values()]
    everything = [m for modules, _ in groups for module in modules for m in module.mutants]
    if "again" in given:
        survivors = json.loads(Path(given["again"]).read_text())["survivors"]
        everything = [m for m in everything if [*m.key] in survivors and m.key not in listed()]
    if "sample" in given:
        rng = random.Random(int(given.get("seed", "0")))
        everything = rng.sample(everything, min(int(given["sample"]), len(everything)))
    equivalent, results, began = listed(), [], time.monotonic()

    def tell(mutant: Mutant, result: str) -> None:
        if result in ("survived", "not run") and mutant.key in equivalent:
            result = "equivalent"
        results.append((mutant, result))
        if result in ("survived", "not run"):
            print(f"{result}: {mutant}", flush=True)

    for modules, tests in groups:
        chosen = [m for m in everything if m.path in {module.path for module in modules}]
        files = [str(ROOT / "tests" / t) for t in tests if (ROOT / "tests" / t.split("::")[0]).exists()]
        if chosen:
            run_group(modules, files, chosen, tell)
    return report(results, time.monotonic() - began)


def report(results: list[tuple[Mutant, str]], seconds: float) -> int:
    """The score of each module, printed and stored."""
    counts: dict[str, Counter[str]] = defaultdict(Counter)
    for mutant, result in results:
        counts[mutant.path][result] += 1
        counts["all"][result] += 1
    rows = {}
    print(f"\n{'module':42} mutants killed time-out survived not-run equivalent  score")
    for path in [*(p for p in counts if p != "all"), "all"]:
        c = counts[path]
        dead, n = c["killed"] + c["time-out"], sum(c.values()) - c["equivalent"]
        rows[path] = {"score": round(100.0 * dead / max(n, 1), 1), **c}
        print(
            f"{path:42} {sum(c.values()):7} {c['killed']:6} {c['time-out']:8} {c['survived']:8} {c['not run']:7} "
            f"{c['equivalent']:10} {rows[path]['score']:5.1f}%"
        )
    print(f"{len(results)} mutants in {seconds:.0f} s")
    survivors = [mutant.key for mutant, result in results if result in ("survived", "not run")]
    stored = {"date": datetime.date.today().isoformat(), "seconds": round(seconds), "modules": rows}
    (ROOT / "runs").mkdir(exist_ok=True)
    (ROOT / "runs" / "mutants.json").write_text(json.dumps({**stored, "survivors": survivors}, indent=1) + "\n")
    return int(any(row["score"] < 90.0 for row in rows.values()))


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
