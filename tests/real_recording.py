"""The real Chi.Bio recording that lies beside the project; tests that need it skip where it is absent."""

from pathlib import Path

import pytest

DITHER = Path(__file__).parents[2] / "shared" / "data" / "chibio_ecoli_dither.csv"

needs_dither = pytest.mark.skipif(
    not DITHER.is_file(), reason=f"{DITHER} is absent: the real recording is not part of the project"
)
