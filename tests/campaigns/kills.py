"""`kill -9` of a real run at random moments, resumed each time: `python -m tests.campaigns.kills`.

A real client process (`experiments.deploy`) controls a real emulator process. After every kill the client is resumed
with `resume=RUN`; at the end, what the emulator knows it did is compared with what the run recorded.
"""

import logging
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict
from pathlib import Path
from typing import Any

from experiments.cli import files, frame
from hardware.chibio.calibrations import save_calibration
from tests.campaigns.killed_run import Findings, KillConfig, killed_run
from tests.campaigns.rehearsal import SOUND
from tests.entry import command
from tests.studies.results import leave

__all__ = ["kill_campaign"]

log = logging.getLogger(__name__)


def one_run(config: KillConfig, folder: Path, run: int, stop: threading.Event) -> Findings:
    """One recording with its share of the kills. Raises: Stopped."""
    kills = config.kills // config.runs + (run < config.kills % config.runs)
    began = time.monotonic()
    findings = killed_run(config, kills, folder / f"run{run}", run, stop)
    log.info("run %d: %d kills in %.0f s, %s", run, kills, time.monotonic() - began, "ok" if findings.ok else "NOT ok")
    return findings


def kill_campaign(config: KillConfig, folder: Path) -> None:
    """All runs; summary.json. Raises: UserError if anything was lost or doubled, or a culture was not held."""
    began = time.monotonic()
    for name in config.reactors:
        for part, pump in (("feed", SOUND.feed), ("waste", SOUND.waste)):
            save_calibration(folder / "calibration", name, part, asdict(pump))
    found, stop = [], threading.Event()
    with ThreadPoolExecutor(config.workers) as executor:
        futures = [executor.submit(one_run, config, folder, run, stop) for run in range(config.runs)]
        try:
            found = [future.result() for future in futures]
        except BaseException:  # clients and emulators have sessions of their own: nobody else ends them
            stop.set()
            executor.shutdown(cancel_futures=True)
            raise
    keys = [k for k, v in asdict(found[0]).items() if isinstance(v, (int, float)) and not isinstance(v, bool)]
    total: dict[str, Any] = {k: sum(getattr(f, k) for f in found) for k in keys}
    total |= {key: max(getattr(f, key) for f in found) for key in ("schedule_error_s", "mean_error", "out_min")}
    total |= {"pumps_off": all(f.pumps_off for f in found), "overflowed": any(f.overflowed for f in found)}
    total["wall_s"] = round(time.monotonic() - began, 1)
    files.write_json(folder / "summary.json", {**total, "runs": [asdict(f) for f in found]})
    rows = [(k.replace("_", " "), f"{v:.4g}" if isinstance(v, float) else v) for k, v in total.items()]
    leave(folder, __file__, ("of all runs", ""), rows)
    for f in found:
        for line in f.trouble:
            log.warning("%s", line)
    log.info("%s", ", ".join(f"{k.replace('_', ' ')} {round(v, 2)}" for k, v in total.items()))
    if not all(f.ok for f in found):
        first = next((line for f in found for line in f.trouble), "see the counts in summary.json")
        raise frame.UserError(
            f"something was lost or doubled, or not held: {first}; summary.json and the logs have all"
        )


main = command(__file__, KillConfig(), kill_campaign)


if __name__ == "__main__":
    main()
