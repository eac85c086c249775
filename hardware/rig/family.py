"""The Pioreactor rig as a family: the driver of real units, and the vendor's software with simulated vials."""

import logging
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

from envs.bench import Bench
from hardware.pioreactor.config import PioreactorConfig, RigBackendConfig, UnitConfig
from hardware.pioreactor.family import PioreactorFamily
from hardware.rig.processes import Rig

log = logging.getLogger(__name__)


class RigFamily(PioreactorFamily):
    """Simulated units that a run starts, and that end with the run."""

    config = RigBackendConfig
    called = "the Pioreactor rig"
    at_stake = False

    @contextmanager
    def reached(self, backend: PioreactorConfig, bench: Bench, folder: Path) -> Iterator[PioreactorConfig]:
        assert isinstance(backend, RigBackendConfig)
        cultures = dict(zip(backend.reactors, bench.volumes(backend.reactors).tolist(), strict=True))
        login = backend.username, backend.password()
        with Rig(cultures, backend.rig, backend.speed, folder, backend.experiment, login) as rig:
            units = {u: replace(backend.units.get(u, UnitConfig()), address=url) for u, url in rig.web.items()}
            log.info("the vendor's software %s at %s, cultures %g times real time", rig.version, rig.web, backend.speed)
            yield replace(
                backend, broker="127.0.0.1", broker_port=rig.broker, tls=False, units=units,
                leader=rig.web[backend.reactors[0]],
            )  # fmt: skip

    def address(self, backend: PioreactorConfig) -> str:
        return "in this computer"


FAMILY = RigFamily()
