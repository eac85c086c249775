"""`python -m hardware.rig`: run the vendor's software with simulated vials until Ctrl-C."""

import argparse
import signal
import sys
import time
from dataclasses import fields

from hardware.errors import ReactorError
from hardware.pioreactor.config import RigConfig
from hardware.rig.build import environment, newer, version
from hardware.rig.processes import Rig


def main() -> int:
    program = "python -m hardware.rig"
    usage = f"{program} [--units NAME=ML,...] ...; {program} --help says all"
    parser = argparse.ArgumentParser(prog=program, usage=usage, description=__doc__)
    parser.add_argument("--units", default="pio01=20,pio02=14", help="NAME=CULTURE_ML of each unit, with commas")
    parser.add_argument("--growth-x", type=float, default=10.0, help="growth rate over that of real time: 10")
    parser.add_argument("--build-only", action="store_true", help="build the environment and start nothing")
    for one in fields(RigConfig):
        name, default = f"--{one.name.replace('_', '-')}", one.default
        parser.add_argument(name, type=type(default), default=default, help=f"as backend.rig.{one.name}: {default}")
    given = vars(parser.parse_args())
    words, build_only, growth_x = given.pop("units").split(","), given.pop("build_only"), given.pop("growth_x")
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    try:
        config = RigConfig(**given)
        if build_only:
            env = environment(config.package, config.folder)
            print("\n".join(filter(None, [f"the vendor's software {version(env)} is in {env}", newer()])))
            return 0
        units = {name: float(ml or 20.0) for name, _, ml in (word.partition("=") for word in words)}
        with Rig(units, config, growth_x) as rig:
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
