"""Guests: modules that come with the program outside its core. The core neither imports nor names them."""

import importlib

GUESTS = {
    "envs": ("envs.coculture.guest",),
    "experiments": ("experiments.coculture.guest",),
    "experiments.record": ("experiments.coculture.aftermath",),
    "experiments.comparison": ("experiments.coculture.comparison",),
}
"""Package of the core -> modules that register the guests' parts in this package (docs/extending.md)."""


def load(room: str) -> None:
    """Import the guest modules of the package `room`; each module registers its parts once."""
    for name in GUESTS[room]:
        importlib.import_module(name)
