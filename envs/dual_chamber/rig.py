"""Mixing chamber and reservoir: two strains, three pumps, pulses once a minute (docs/dual_chamber.md, Plant).

A fast strain x1 and a slow strain x2 share the mixing chamber; the reservoir holds the slow strain alone, xR:

  x1' = (mu1 - D1 - D2) x1,    x2' = (mu2 - D1 - D2) x2 + D2 xR,    xR' = (mu2 - D3) xR

with D1 fresh medium and D2 reservoir culture into the mixing chamber, D3 fresh medium into the reservoir, each in
volumes of the receiving vial per minute. The architecture is that of Brancato, Salzano, De Lellis, Fiore, Russo and
di Bernardo, arXiv 2511.08554 (2025). Their equations and constants were not available: the balances are ours and the
constants are assumed.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from conf.schema import check, require, setting
from envs.plant.noise import Streams, Tape, spread

__all__ = [
    "FAST",
    "LEVEL",
    "RESERVOIR",
    "SLOW",
    "Readings",
    "Rig",
    "RigCase",
    "RigConfig",
    "advance",
    "carried",
    "taken",
]

Array = NDArray[np.float64]

FAST, SLOW, RESERVOIR, LEVEL = range(4)
"""Columns of a state: x1, x2, xR in OD and the reservoir's volume in mL."""

TINY = 1e-9  # mL, what rounding may take from the smallest dose


@dataclass(frozen=True)
class RigConfig:
    """What the laws believe of the rig. Raises: ValueError naming key, value and allowed range."""

    mu_fast: float = setting(0.03, "growth rate of the fast strain", "1/min", above=0.0, at_most=0.1)
    mu_slow: float = setting(0.02, "growth rate of the slow strain", "1/min", above=0.0, at_most=0.1)
    volume_ml: float = setting(20.0, "mixing chamber, kept at its outlet", "mL", within=(5, 50))
    reservoir_ml: float = setting(20.0, "reservoir up to its outlet", "mL", within=(5, 50))
    heel_ml: float = setting(1.0, "of the reservoir, below the tube that empties it", "mL", within=(0.1, 4))
    largest_ml: float = setting(1.2, "largest dose of a minute, any pump", "mL", within=(0.05, 10))
    reservoir_od: float = setting(0.5, "density the reservoir is held at", "OD", within=(0.05, 2))

    def __post_init__(self) -> None:
        check(self, "rig")
        allowed = f"greater than rig.mu_slow = {self.mu_slow:g}: without a difference nothing lowers the slow share"
        require(self.mu_fast > self.mu_slow, "rig.mu_fast", self.mu_fast, allowed)

    @property
    def growth(self) -> Array:
        """Growth rates of x1, x2, 1/min, (2,)."""
        return np.array([self.mu_fast, self.mu_slow])


@dataclass(frozen=True)
class RigCase:
    """A plant: what differs from that, and what its sensors and pumps do. Raises: as RigConfig."""

    fast_scale: float = setting(1.0, "of the fast strain's growth rate", within=(0.5, 1.5))
    slow_scale: float = setting(1.0, "of the slow strain's growth rate", within=(0.5, 1.5))
    growth_cv: float = setting(0.02, "relative spread of each growth rate between rigs", within=(0, 0.3))
    reservoir_gain: float = setting(1.0, "of the pump from the reservoir", within=(0, 2))
    gain_cv: float = setting(0.03, "relative spread of each pump between rigs", within=(0, 0.3))
    dose_cv: float = setting(0.03, "relative spread of a dose", within=(0, 0.3))
    smallest_ml: float = setting(0.2, "smallest useful dose, below it nothing flows", "mL", within=(0, 2))
    carry_over: bool = setting(True, "whether the controller carries the rest of a small dose to the next")
    od_sd: float = setting(0.005, "noise of a reading of OD", "OD", within=(0, 0.2))
    fluorescence_sd: float = setting(0.01, "noise of the fluorescence of the fast strain, in OD of it", "OD",
                                     within=(0, 0.2))  # fmt: skip
    fluorescence_cv: float = setting(0.03, "error of its calibration, between rigs", within=(0, 0.3))

    def __post_init__(self) -> None:
        check(self, "plant")


def taken(config: RigConfig, level: Array, dose: Array) -> Array:
    """Volume that leaves the reservoir, mL: the dose, as far as there is culture above the heel. Any one shape."""
    return np.asarray(np.minimum(dose, np.maximum(level - config.heel_ml, 0.0)))


def advance(config: RigConfig, state: Array, dose: Array, growth: Array | None = None) -> Array:
    """State (..., 4) after a minute that begins with a pulse of each pump; the integral of the balances.

    With V the mixing chamber, w what the reservoir gives, a = V / (V + v1 + w):

      x1 <- a x1 e^mu1,   x2 <- a (x2 + w xR / V) e^mu2,   xR <- xR (VR - w) / (VR - w + v3) e^mu2

    and VR <- min(VR - w + v3, its outlet). Both vials are mixed before their waste runs off.

    Args: dose: v1 fresh to mixing, v2 reservoir to mixing, v3 fresh to reservoir, mL, (..., 3). growth: 1/min of x1
    and x2, (..., 2); None: the config's.
    """
    factor = np.exp(config.growth if growth is None else growth)
    level = state[..., LEVEL]
    given = taken(config, level, dose[..., 1])
    left = level - given
    filled = left + dose[..., 2]
    kept = config.volume_ml / (config.volume_ml + dose[..., 0] + given)
    fast = state[..., FAST] * kept * factor[..., 0]
    slow = (state[..., SLOW] + state[..., RESERVOIR] * given / config.volume_ml) * kept * factor[..., 1]
    reservoir = state[..., RESERVOIR] * left / filled * factor[..., 1]
    return np.stack(np.broadcast_arrays(fast, slow, reservoir, np.minimum(filled, config.reservoir_ml)), axis=-1)


def carried(asked: Array, rest: Array, smallest: float, largest: float) -> tuple[Array, Array]:
    """Dose over, so that small doses are put together until they flow: the dose of now and the rest kept, mL.

    What a pump cannot give in one minute is not kept. Args: asked, rest: mL, any one shape.
    """
    wanted = np.maximum(asked, 0.0) + rest
    flows = wanted >= smallest - TINY
    return np.where(flows, np.minimum(wanted, largest), 0.0), np.where(flows, 0.0, wanted)


class Readings(NamedTuple):
    """OD of the mixing chamber and of the reservoir, fluorescence of the fast strain as OD of it, each (N,)."""

    od: Array
    reservoir_od: Array
    fluorescence: Array


class Rig:
    """N rigs. A row of the noise is one minute, whatever is dosed, so that laws meet the same draws.

    Args: config: constants; case: what is different here; rngs: one stream per rig; state: start, (N, 4).
    State: `state` (N, 4). Ledger, mL since the start, each (N,): `fresh_ml` to both vials, `waste_ml` from both.
    """

    def __init__(self, config: RigConfig, case: RigCase, rngs: Streams, state: Array) -> None:
        self.config, self.case, self.state = config, case, state.copy()
        scales = (case.fast_scale, case.slow_scale)
        self.growth = config.growth * np.stack([spread(rngs, s, case.growth_cv) for s in scales], axis=-1)
        gains = (1.0, case.reservoir_gain, 1.0)
        self.gain = np.stack([spread(rngs, g, case.gain_cv) for g in gains], axis=-1)
        self._calibration = spread(rngs, 1.0, case.fluorescence_cv)
        self._tape = Tape(rngs, 6, 0)
        self.fresh_ml, self.waste_ml = np.zeros(len(rngs)), np.zeros(len(rngs))

    def step(self, dose: Array) -> Readings:
        """A minute after doses (N, 3), mL as asked of the pumps; what is read at its end."""
        case, (noise, _) = self.case, self._tape.next()
        flows = (
            self.gain * np.clip(dose, 0.0, self.config.largest_ml) * (1.0 + case.dose_cv * np.clip(noise[:3].T, -3, 3))
        )
        flows = np.where(dose >= case.smallest_ml - TINY, flows, 0.0)
        before = self.state[:, LEVEL]
        given = taken(self.config, before, flows[:, 1])
        self.state = advance(self.config, self.state, flows, self.growth)
        self.fresh_ml += flows[:, 0] + flows[:, 2]
        self.waste_ml += flows[:, 0] + given + (before - given + flows[:, 2] - self.state[:, LEVEL])
        fast, slow, reservoir = self.state[:, :LEVEL].T
        return Readings(
            fast + slow + case.od_sd * noise[3],
            reservoir + case.od_sd * noise[4],
            fast * self._calibration + case.fluorescence_sd * noise[5],
        )
