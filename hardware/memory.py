"""What a run remembers: declared once by each class, saved as plain numbers and lists, put back only where it fits."""

from collections.abc import Mapping
from contextlib import suppress
from types import NoneType
from typing import Any, NamedTuple, Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

__all__ = ["Remembers", "Words", "restore", "restore_rows", "row", "rows", "save", "words"]

KINDS: dict[str, tuple[set[type], str]] = {
    "b": ({bool}, "true or false"),
    "i": ({int}, "numbers"),
    "f": ({int, float, NoneType}, "numbers"),
}


@runtime_checkable
class Remembers(Protocol):
    """Something with a memory, which a resumed run continues.

    Each key is an attribute, of that name or with an underscore before it: an array, a flag, a list of random streams,
    or something that remembers. As it stands before its first use, an attribute says which type and shape a saved value
    has, and where it may be None: in place of the nan or the infinity that stands there then.

    A class may have a method `resumed()`: called after everything was put back; sets what begins anew, or raises
    ValueError for what cannot be.
    """

    @property
    def remembers(self) -> tuple[str, ...]:
        """The keys of its state."""


class Words(NamedTuple):
    """How a refusal is worded: of a state without keys, of a wrong value, another shape, another number of reactors."""

    whole: str
    wrong: str
    shape: str
    reactors: str


def words(path: str) -> Words:
    """Build the refusals of a state stored under `path`."""
    shape = f"{path}.{{key}} has shape {{found}}, this run needs {{shape}}"
    return Words(
        f"{path}: {{value}}, expected keys and values", f"{path}.{{key}}: {{value}}, expected {{what}}", shape, shape
    )


def save(owner: Remembers) -> dict[str, Any]:
    """Everything that `owner` remembers, as plain numbers and lists; None stands for what is not finite."""
    return {key: _plain(getattr(owner, _name(owner, key))) for key in owner.remembers}


def restore(owner: Remembers, state: Any, said: Words) -> None:
    """Continue as saved; `owner` has not been used yet. Raises: ValueError naming what is missing or does not fit."""
    if not isinstance(state, Mapping):
        raise ValueError(said.whole.format(value=str(state)[:40]))
    for key in owner.remembers:
        name = _name(owner, key)
        now, value = getattr(owner, name), state.get(key, "missing")
        if isinstance(now, Remembers):
            restore(now, value if isinstance(value, Mapping) else {}, said)
        elif isinstance(now, list):
            _restore_streams(now, key, value, said)
        else:
            new = _fitted(np.asarray(now), key, value, said)
            setattr(owner, name, new if isinstance(now, np.ndarray) else new.item())
    _resume(owner)


def row(owner: Remembers, n: int) -> dict[str, Any]:
    """Return what `owner` remembers of reactor n, as `save`; an array is saved without its padding of inf."""
    return {key: _plain(_unpadded(getattr(owner, _name(owner, key))[n])) for key in owner.remembers}


def rows(owner: Remembers) -> list[dict[str, Any]]:
    """Every reactor's `row`; none of something that remembers nothing."""
    return [row(owner, n) for n in range(_reactors(owner))]


def restore_rows(owner: Remembers, state: Any, path: str) -> None:
    """Continue as `rows` saved. Raises: ValueError as `restore`, whose text begins with `path`."""
    n = _reactors(owner)
    if n and not (isinstance(state, list) and len(state) == n):
        raise ValueError(f"{path}: {str(state)[:40]}, expected one entry for each of {n} reactors")
    wrong = f"{path}: {{key}} {{value}}, expected {{what}}"
    shape = f"{path}: {{key}} {{value}} has shape {{found}}, this run needs {{shape}}"
    for i in range(n):
        mine = state[i] if isinstance(state[i], Mapping) else {}
        for key in owner.remembers:
            values = getattr(owner, _name(owner, key))
            new = _fitted(_unpadded(values[i]), key, mine.get(key, "missing"), Words("", wrong, shape, shape))
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


def _fitted(now: NDArray[Any], key: str, value: Any, said: Words) -> NDArray[Any]:
    """Convert a saved value to an array like `now`. Raises: ValueError."""

    def refused(form: str, what: str = "", found: tuple[int, ...] = ()) -> ValueError:
        text = {"key": key, "value": str(value)[:40], "what": what, "found": found, "shape": now.shape}
        return ValueError(form.format(**text, k=found[0] if found else 0, n=now.shape[0] if now.ndim else 1))

    types, what = KINDS[now.dtype.kind]
    try:
        given = np.array(value, dtype=object)
        new = given.astype(now.dtype) if {type(each) for each in given.flat} <= types else None
    except (TypeError, ValueError, OverflowError):
        new = None
    if new is None:
        raise refused(said.wrong, what)
    if new.shape != now.shape:
        other = new.ndim and now.ndim and len(new) != len(now)
        raise refused(said.reactors if other else said.shape, what, new.shape)
    if np.isinf(new).any() or np.isfinite(now[np.isnan(new)]).any():  # nan would pass every limit
        raise refused(said.wrong, f"finite {what}")
    return np.where(np.isnan(new), now, new)


def _restore_streams(streams: list[np.random.Generator], key: str, state: Any, said: Words) -> None:
    if not (isinstance(state, list) and len(state) == len(streams)):
        raise ValueError(said.wrong.format(key=key, value=str(state)[:40], what=f"{len(streams)} random streams"))
    for rng, stored in zip(streams, state, strict=True):
        with suppress(TypeError, ValueError, KeyError, OverflowError):
            rng.bit_generator.state = stored
        if rng.bit_generator.state != stored:
            raise ValueError(said.wrong.format(key=key, value=str(stored)[:40], what="the state of a random stream"))
