"""Saved state of a run: each class declares it once; it is saved as numbers and lists, and checked when restored."""

from collections.abc import Mapping
from contextlib import suppress
from types import NoneType
from typing import Any, Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

KINDS: dict[str, tuple[set[type], str]] = {
    "b": ({bool}, "true or false"),
    "i": ({int}, "numbers"),
    "f": ({int, float, NoneType}, "numbers"),
}


@runtime_checkable
class Remembers(Protocol):
    """An object whose state a resumed run restores.

    Each key names an attribute, with or without a leading underscore: an array, a flag, a list of random streams, or
    another such object. The attribute's value before its first use defines type and shape of a saved value; a saved
    None is allowed only where that value is nan or infinite.

    A class may have a method `resumed()`, which is called after the restore: it resets what begins anew, or raises
    ValueError for an impossible state.
    """

    @property
    def remembers(self) -> tuple[str, ...]: ...


def save(owner: Remembers) -> dict[str, Any]:
    """Return the state of `owner` as plain numbers and lists, with None for values that are not finite."""
    return {key: _plain(getattr(owner, _name(owner, key))) for key in owner.remembers}


def restore(owner: Remembers, state: Any, path: str) -> None:
    """Restore `state` into an unused `owner`. Raises: ValueError, beginning with `path`, naming what does not fit."""
    if not isinstance(state, Mapping):
        raise ValueError(f"{path}: {str(state)[:40]}, expected keys and values")
    for key in owner.remembers:
        name = _name(owner, key)
        now, value = getattr(owner, name), state.get(key, "missing")
        if isinstance(now, Remembers):
            restore(now, value if isinstance(value, Mapping) else {}, f"{path}.{key}")
        elif isinstance(now, list):
            _restore_streams(now, f"{path}.{key}", value)
        else:
            new = _fitted(np.asarray(now), f"{path}.{key}", value)
            setattr(owner, name, new if isinstance(now, np.ndarray) else new.item())
    _resume(owner)


def row(owner: Remembers, n: int) -> dict[str, Any]:
    """Return the state of reactor n, as `save`; an array is saved without its padding of inf."""
    return {key: _plain(_unpadded(getattr(owner, _name(owner, key))[n])) for key in owner.remembers}


def rows(owner: Remembers) -> list[dict[str, Any]]:
    """Return the `row` of every reactor; an empty list if `owner` has no state."""
    return [row(owner, n) for n in range(_reactors(owner))]


def restore_rows(owner: Remembers, state: Any, path: str) -> None:
    """Restore the output of `rows`. Raises: as `restore`."""
    n = _reactors(owner)
    if n and not (isinstance(state, list) and len(state) == n):
        raise ValueError(f"{path}: {str(state)[:40]}, expected one entry for each of {n} reactors")
    for i in range(n):
        mine = state[i] if isinstance(state[i], Mapping) else {}
        for key in owner.remembers:
            values = getattr(owner, _name(owner, key))
            new = _fitted(_unpadded(values[i]), f"{path}.{key}", mine.get(key, "missing"))
            values[(i, slice(new.size)) if new.ndim else i] = new
    _resume(owner)


def _reactors(owner: Remembers) -> int:
    return max((len(getattr(owner, _name(owner, key))) for key in owner.remembers), default=0)


def _name(owner: object, key: str) -> str:
    return f"_{key}" if hasattr(owner, f"_{key}") else key


def _unpadded(values: Any) -> NDArray[Any]:
    return values[~np.isposinf(values)] if np.ndim(values) else np.asarray(values)


def _resume(owner: object) -> None:
    if hasattr(owner, "resumed"):
        owner.resumed()


def _plain(value: Any) -> Any:
    if isinstance(value, np.ndarray):
        finite = np.isfinite(value)
        return (value if finite.all() else np.where(finite, value, np.array(None))).tolist()
    if isinstance(value, Remembers):
        return save(value)
    return [rng.bit_generator.state for rng in value] if isinstance(value, list) else value


def _fitted(now: NDArray[Any], key: str, value: Any) -> NDArray[Any]:
    types, what = KINDS[now.dtype.kind]
    try:
        given = np.array(value, dtype=object)
        new = given.astype(now.dtype) if {type(each) for each in given.flat} <= types else None
    except (TypeError, ValueError, OverflowError):
        new = None
    if new is None:
        raise ValueError(f"{key}: {str(value)[:40]}, expected {what}")
    if new.shape != now.shape:
        raise ValueError(f"{key} has shape {new.shape}, this run needs {now.shape}: was it of as many reactors?")
    if np.isinf(new).any() or np.isfinite(now[np.isnan(new)]).any():  # nan would pass every limit
        raise ValueError(f"{key}: {str(value)[:40]}, expected finite {what}")
    return np.where(np.isnan(new), now, new)


def _restore_streams(streams: list[np.random.Generator], key: str, state: Any) -> None:
    if not (isinstance(state, list) and len(state) == len(streams)):
        raise ValueError(f"{key}: {str(state)[:40]}, expected {len(streams)} random streams")
    for rng, stored in zip(streams, state, strict=True):
        with suppress(TypeError, ValueError, KeyError, OverflowError):
            rng.bit_generator.state = stored
        if rng.bit_generator.state != stored:
            raise ValueError(f"{key}: {str(stored)[:40]}, expected the state of a random stream")
