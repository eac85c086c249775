"""Random numbers of a plant: one stream per vial, independent of the controller."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Streams = Sequence[np.random.Generator]


def streams(rng: np.random.Generator | Streams, n: int) -> list[np.random.Generator]:
    """Return n generators, one per vial. From a single generator, stream i is the same for every n.

    Raises: ValueError if `rng` is a sequence whose length is not n.
    """
    if isinstance(rng, np.random.Generator):
        return rng.spawn(n)
    if len(rng) != n:
        raise ValueError(f"number of random streams = {len(rng)}: allowed {n}, one per vial; pass one generator each")
    return list(rng)


def spread(rngs: Streams, mean: Array | float, cv: Array | float) -> Array:
    """Draw mean (1 + cv z), one per stream, shape (N,); z is standard normal, clipped at +-3."""
    z = np.clip([rng.standard_normal() for rng in rngs], -3.0, 3.0)
    return np.asarray(mean * (1.0 + cv * z), dtype=np.float64)


def uniform(rngs: Streams, low: float, high: float) -> Array:
    """Draw uniformly on [low, high), one number per stream, shape (N,)."""
    return np.asarray([low + (high - low) * rng.random() for rng in rngs], dtype=np.float64)


class Tape:
    """Rows of random numbers for N vials; each event, e.g. a minute or a reading, takes one row.

    Every row has the same number of draws, used or not, so a controller cannot change later draws. Two controllers with
    equal seeds meet equal noise (paired comparison), and the noise of vial i depends only on stream i.

    Args:
      rngs: one stream per vial.
      normals, uniforms: draws per row and vial.
    """

    BLOCK = 128  # rows drawn at once: one call per stream and block instead of one per row

    def __init__(self, rngs: Streams, normals: int, uniforms: int) -> None:
        self._rngs, self._sizes = rngs, (normals, uniforms)
        self._row = self.BLOCK
        self._normal = np.empty((len(rngs), self.BLOCK, normals))
        self._uniform = np.empty((len(rngs), self.BLOCK, uniforms))

    def next(self) -> tuple[Array, Array]:
        """Draw the next row: (standard normals, uniforms on [0, 1)), shapes (normals, N) and (uniforms, N)."""
        if self._row == self.BLOCK:
            for i, rng in enumerate(self._rngs):
                self._normal[i] = rng.standard_normal((self.BLOCK, self._sizes[0]))
                self._uniform[i] = rng.random((self.BLOCK, self._sizes[1]))
            self._row = 0
        row, self._row = self._row, self._row + 1
        return self._normal[:, row].T, self._uniform[:, row].T
