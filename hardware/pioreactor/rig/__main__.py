"""`python -m hardware.pioreactor.rig`: the vendor's software around our vials, until Ctrl-C."""

import argparse
import signal
import sys
import time
from pathlib import Path

from hardware.errors import ReactorError
from hardware.pioreactor.rig.build import CACHE, environment
from hardware.pioreactor.rig.processes import Rig, RigConfig


def main() -> int:
    """Start it, say where it is, wait."""
    parser = argparse.ArgumentParser(prog="python -m hardware.pioreactor.rig", description=__doc__)
    parser.add_argument("--units", default="pio01,pio02", help="names, separated by commas")
    parser.add_argument("--growth-x", type=float, default=10.0, help="growth faster than real time, 1 to 60")
    parser.add_argument("--od", type=float, default=0.7, help="of the cultures at the start")
    parser.add_argument("--folder", default="", help="of the environment; default: in the user's cache")
    parser.add_argument("--build-only", action="store_true", help="build the environment and start nothing")
    given = parser.parse_args()
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    try:
        if given.build_only:
            folder = Path(given.folder).expanduser() if given.folder else CACHE
            print(f"the vendor's software is in {environment(folder)}")
            return 0
        config = RigConfig(folder=given.folder, growth_x=given.growth_x, od=given.od)
        with Rig(given.units.split(","), config) as rig:
            where = " ".join(f"{unit}={url}" for unit, url in rig.web.items())
            print(f"rig ready: {where} broker=127.0.0.1:{rig.broker} truth={rig.folder}/truth.jsonl", flush=True)
            while True:
                time.sleep(3600.0)
    except KeyboardInterrupt:
        return 0
    except (ReactorError, ValueError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 1


if __name__ == "__main__":
    sys.exit(main())
