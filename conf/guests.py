"""The guests: what comes with the program and is no part of its core, which neither imports nor names it."""

import importlib

GUESTS = {
    "envs": ("envs.coculture.guest",),
    "experiments": ("experiments.coculture.guest",),
    "experiments.record": ("experiments.coculture.aftermath",),
    "experiments.comparison": ("experiments.coculture.comparison",),
}
"""Room that is added to -> the modules that add what its guests bring (docs/extending.md)."""


def load(room: str) -> None:
    """Make the guests of a room known, each once."""
    for name in GUESTS[room]:
        importlib.import_module(name)
