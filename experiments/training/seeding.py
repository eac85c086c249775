"""One integer to named, independent random streams."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

__all__ = ["streams"]


def streams(seeds: Sequence[int], names: Sequence[str]) -> dict[str, list[np.random.SeedSequence]]:
    """For each name one SeedSequence per seed, independent of the other names and seeds.

    The stream of a name depends on its seed and its place in `names` only, so agent i of a population has the streams
    of the same seed alone. New names go at the end.
    """
    spawned = [np.random.SeedSequence(seed).spawn(len(names)) for seed in seeds]
    return {name: [children[k] for children in spawned] for k, name in enumerate(names)}
