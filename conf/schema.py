"""Declaration of config values: each dataclass field states default, meaning, unit and range.

    mu: float = setting(0.03, "specific growth rate", "1/min", above=0.0, at_most=0.1)

`check` refuses a value out of range, `build` makes a config from plain values. The help of the command line and
docs/configuration.md are generated from the same fields.
"""

import copy
import math
import types
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import MISSING, dataclass, field, fields, is_dataclass, make_dataclass, replace
from difflib import get_close_matches
from typing import Any, TypeVar, Union, cast, get_args, get_origin, get_type_hints

from conf.messages import NoSuchKey, NotAllowed

T = TypeVar("T")

ON_BENCH = ("volume_ml", "period_s", "control_min", "max_rate", "bottle_ml")  # keys of `bench` (envs/bench.py)
TRUE, FALSE = ("true", "yes", "on", "1", "y", "t"), ("false", "no", "off", "0", "n", "f")


Kinds = Callable[[str, str], Any]


@dataclass(frozen=True)
class Meaning:
    """Meaning of a config field and its allowed values. Bounds apply to each entry of a tuple.

    interval: the value is a pair [low, high], low <= high. some: a tuple needs at least one entry. words: texts allowed
    instead of a number. note: text after the range in messages. kinds: function that returns the default config of a
    part, or of each part of a dict, for its kind ("": none given) and key; it raises ValueError with the known kinds.
    """

    what: str
    unit: str = ""
    above: float | None = None
    at_least: float | None = None
    below: float | None = None
    at_most: float | None = None
    choices: tuple[str, ...] = ()
    interval: bool = False
    some: bool = False
    note: str = ""
    words: tuple[str, ...] = ()
    kinds: Kinds | None = None

    def holds(self, given: Any) -> bool:
        """Return whether a value is allowed. A nan violates every bound."""
        if given is None or given in self.words:
            return True
        if isinstance(given, Sequence) and not isinstance(given, str):
            if self.interval and not (len(given) == 2 and given[0] <= given[1]):
                return False
            return (len(given) > 0 or not self.some) and all(self.holds(entry) for entry in given)
        if self.choices:
            return given in self.choices
        return (
            (self.above is None or given > self.above)
            and (self.at_least is None or given >= self.at_least)
            and (self.below is None or given < self.below)
            and (self.at_most is None or given <= self.at_most)
        )

    def allowed(self, key: str, many: bool = False, optional: bool = False) -> str:
        """Return the allowed range in words, "" if every value of the type is allowed.

        Args: key: name of the field; many: whether the value is a tuple; optional: whether it may be null.
        """
        words = self._range((self.unit or "value") if many else key)
        if words and many and not self.interval:
            words = f"each {'one of ' if self.choices else ''}{words}"
        if self.some:
            words = f"one or more, {words}" if words else "one or more"
        if words:
            words = ", or ".join([words, *self.words, *["null"] * optional])
        return words + (f" ({self.note})" if words and self.note else "")

    def _range(self, name: str) -> str:
        if self.choices:
            return ", ".join(filter(None, self.choices)) + (", or '' for none" if "" in self.choices else "")
        low = self.above if self.at_least is None else self.at_least
        high = self.below if self.at_most is None else self.at_most
        left = "" if low is None else f"{low:g} {'<' if self.at_least is None else '<='} "
        right = "" if high is None else f" {'<' if self.at_most is None else '<='} {high:g}"
        if self.interval:
            return f"[low, high] with {left}low <= high{right}"
        if high is None:
            return f"{'greater than' if self.at_least is None else 'at least'} {low:g}" if left else ""
        if low is None:
            return f"{'less than' if self.at_most is None else 'at most'} {high:g}"
        if math.isinf(high) and self.at_most is None:
            return f"a finite number {'greater than' if self.at_least is None else 'of at least'} {low:g}"
        return f"{low:g} to {high:g}" if self.above is None and self.below is None else f"{left}{name}{right}"


@dataclass(frozen=True)
class Entry:
    """One field of a config. said: its declaration, empty without `setting` or `part`; optional: it may be null."""

    name: str
    said: Meaning
    value: Any
    optional: bool

    @property
    def allowed(self) -> str:
        """Allowed range in words."""
        return self.said.allowed(self.name, isinstance(self.value, list | tuple), self.optional)


def entries(config: Any) -> list[Entry]:
    """List the fields of a config dataclass, in order."""
    return [
        Entry(f.name, f.metadata.get("meaning", Meaning("")), getattr(config, f.name), "None" in str(f.type))
        for f in fields(config)
    ]


def setting(default: T, what: str, unit: str = "", within: tuple[float, float] | None = None, **bounds: Any) -> T:
    """Declare a field of a config dataclass. Args: as in `Meaning`; within=(low, high) sets at_least and at_most."""
    if within:
        bounds |= {"at_least": within[0], "at_most": within[1]}
    said = {"meaning": Meaning(what, unit, **bounds)}
    if isinstance(default, dict | list):
        return field(default_factory=lambda: copy.copy(default), metadata=said)
    return field(default=default, metadata=said)


def part(factory: Callable[[], T], what: str, kinds: Kinds | None = None) -> T:
    """Declare a field that holds another config dataclass. Args: kinds: as in `Meaning`."""
    return field(default_factory=factory, metadata={"meaning": Meaning(what, kinds=kinds)})


def add(to: type[Any], more: type[Any]) -> None:
    """Append fields to a config class. They are set, compared, checked and shown like the fields it already has.

    Args: more: class that declares the fields like a config, without the decorator. Its `__post_init__` runs on each
      new instance of `to`, before the `__post_init__` of `to`.
    Raises: ValueError if `to` already has a field of this name.
    """
    own, hints = {f.name: f for f in fields(to)}, get_type_hints(more)
    added = {name: vars(more)[name] for name in more.__annotations__}
    for name, declared in added.items():
        require(name not in own, f"new field of {to.__name__}", name, "a name that the class does not have yet")
        to.__annotations__[name] = hints[name]
        made = declared.default_factory() if declared.default is MISSING else declared.default
        setattr(to, name, made)  # for instances made before
    checks = [getattr(of, "__post_init__", None) for of in (more, to)]

    def checked(self: Any) -> None:
        for check_one in filter(None, checks):
            check_one(self)

    hints, again = get_type_hints(to), {name: field(**_said(f)) for name, f in (own | added).items()}
    typed = [(name, hints[name], f) for name, f in again.items()]
    whole = make_dataclass(to.__name__, typed, frozen=True, namespace={"__post_init__": checked})
    for name in ("__init__", "__repr__", "__eq__", "__hash__", "__dataclass_fields__", "__match_args__"):
        setattr(to, name, getattr(whole, name))
    to.__post_init__ = checked


def _said(f: Any) -> dict[str, Any]:
    given = {"default": f.default, "default_factory": f.default_factory}
    return {"metadata": f.metadata, **{key: value for key, value in given.items() if value is not MISSING}}


def require(holds: bool, key: str, given: object, allowed: str) -> None:
    """Check a rule, e.g. a rule about several fields. Raises: NotAllowed if `holds` is false."""
    if not holds:
        raise NotAllowed(key=key, given=list(given) if isinstance(given, tuple) else given, allowed=allowed)


def check(config: Any, prefix: str = "") -> None:
    """Check every field of a config dataclass against its range; called by `__post_init__`.

    Args: prefix: key of the config, "plant.pump"; "" for the config of a command.
    Raises: ValueError `prefix.key = value unit: allowed RANGE`.
    """
    for entry in (e for e in entries(config) if not e.said.holds(e.value)):
        key = f"{prefix}.{entry.name}" if prefix else entry.name
        shown = entry.value if isinstance(entry.value, list | tuple) else f"{entry.value} {entry.said.unit}".rstrip()
        require(False, key, shown, entry.allowed)


def build(default: T, values: Mapping[str, Any], prefix: str = "") -> T:
    """Return a copy of the config `default` in which `values` replace its values.

    Parts are given as nested mappings. Numbers may be text and tuples may be lists, as in YAML and command lines.

    Args: prefix: key of the config, for messages.
    Raises:
      ValueError: for an unknown key, with the most similar key; for an invalid value, with the allowed values.
    """
    try:
        return _built(default, values, prefix)
    except _NoSuchKey as error:
        key, of = error.args
        above, _, name = key.rpartition(".")
        moved = "; set it under bench" if name in ON_BENCH else ""
        meant = "" if moved else _meant(key, default, prefix)
        where = f"under {above}" if above else "here"
        raise NoSuchKey(key=key, hint=f"{moved}{meant}", where=where, known=", ".join(of)) from None


class _NoSuchKey(Exception):
    """Unknown key. args: the whole key and the list of known names."""


def _keys(config: Any, prefix: str) -> Iterator[str]:
    for f in fields(config):
        key, value = f"{prefix}.{f.name}" if prefix else f.name, getattr(config, f.name)
        yield key
        if is_dataclass(value):
            yield from _keys(value, key)


def _meant(key: str, config: Any, prefix: str) -> str:
    """Return a hint: the most similar key of the whole tree, or how to choose a kind without this key; "" if none."""
    keys: dict[str, str] = {}
    for known in sorted(_keys(config, prefix), key=lambda known: known.count(".")):
        last = known.rpartition(".")[2]
        initials = "".join(word[0] for word in last.split("_")) if "_" in last else last
        for called in (last, initials):
            keys.setdefault(called, known)
    group, _, name = key.rpartition(".")
    near = get_close_matches(name, keys, 1, 0.75)
    if near and keys[near[0]] == key:  # a key of the preset, which a kind given by GROUP.kind lacks
        return f"; choose the kind with {group}=NAME, not with {group}.kind=NAME"
    return f"; did you mean {keys[near[0]]}?" if near else ""


def _built(default: T, values: Mapping[str, Any], prefix: str) -> T:
    """See `build`. Raises: _NoSuchKey."""
    of = {f.name: f for f in fields(cast(Any, default))}
    hints = get_type_hints(type(default))
    given = {}
    for name, entry in values.items():
        key = f"{prefix}.{name}" if prefix else str(name)
        if name not in of:
            raise _NoSuchKey(key, list(of))
        said = of[name].metadata.get("meaning", Meaning(""))
        given[name] = _converted(entry, hints[name], getattr(default, name), key, said)
    return replace(cast(Any, default), **given)  # type: ignore[no-any-return]


def _converted(given: Any, hint: Any, default: Any, key: str, said: Meaning) -> Any:
    """Convert a plain value to the type of its field, declared in `said`. Raises: ValueError that names the key."""
    if get_origin(hint) in (Union, types.UnionType):
        if given is None:
            return None
        hint = next(h for h in get_args(hint) if h is not types.NoneType)
    origin, inner = get_origin(hint) or hint, get_args(hint)
    if said.kinds is not None and origin is not dict and given is not None:
        require(isinstance(given, Mapping), key, given, f"keys and values, as {key}.kind=NAME")
        if default is None or "kind" in given:
            default = said.kinds(str(given.get("kind", "")), key)
    holds_part = is_dataclass(default) or is_dataclass(hint)
    if holds_part or origin is dict:
        require(isinstance(given, Mapping), key, given, f"keys and values, as {key}.NAME=VALUE")
    if holds_part:
        return _built(default if is_dataclass(default) else hint(), given, key)
    if origin is dict:
        of, own = (inner[1] if inner else Any), default or {}
        return own | {str(k): _converted(v, of, own.get(k), f"{key}.{k}", said) for k, v in given.items()}
    if origin in (tuple, list):
        require(isinstance(given, list | tuple), key, given, "a list, as [1,2]")
        of = inner[0] if inner else Any
        return origin(  # a matrix, row by row
            _converted(v, hint if of is float and isinstance(v, list | tuple) else of, None, f"{key}[{i}]", said)
            for i, v in enumerate(given)
        )
    return _scalar(given, hint, key, said)


def _scalar(given: Any, hint: Any, key: str, said: Meaning) -> Any:
    """Convert a number, text or switch to the type of its field."""
    if hint is bool:
        word = str(given).lower()
        require(word in (*TRUE, *FALSE), key, given, "true or false")
        return word in TRUE
    if given in said.words:
        return given
    if hint in (int, float):
        try:
            if isinstance(given, str | int | hint) and not isinstance(given, bool):
                return hint(given)
        except ValueError:
            pass
        name = (said.unit or "value") if key.endswith("]") else key.rpartition(".")[2]
        within = "" if said.interval else replace(said, some=False).allowed(name)
        require(False, key, given, ", ".join(filter(None, ("a whole number" if hint is int else "a number", within))))
    if hint is str:
        require(given is not None and not isinstance(given, Mapping | list | tuple), key, given, "text")
        return str(given)
    return given
