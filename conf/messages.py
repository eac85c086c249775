"""How errors, alarms and notices are declared: each one a class with a sentence, what helps, and its values by name.

    class PumpStaysOn(DeviceStateError, says="{pump} is still on after {tries} tries", remedy="pull its plug"): ...

    raise PumpStaysOn(pump="Pump1", tries=4)

The docstring says what it means, where the sentence does not. docs/three_am.md has a row for every such class.
"""

from copy import copy
from functools import partial
from string import Formatter
from typing import Any, ClassVar, Self


def names(kind: "type[Message]") -> set[str]:
    """Names of the values in a message's sentence and remedy."""
    return {name for _, name, _, _ in Formatter().parse(kind.says + kind.remedy) if name}


class Message:
    """Something to tell; where it declares no sentence, a text alone.

    Attributes: fields, its values; sentence, what happened; remedy, what to do; their names are `names`.
    Raises: TypeError for a value that the sentence does not have, or one that is missing.
    """

    says: ClassVar[str] = ""
    remedy: str = ""

    def __init_subclass__(cls, says: str = "", remedy: str = "") -> None:
        cls.says, cls.remedy = says or cls.says, remedy or cls.remedy

    def __init__(self, *text: object, **fields: Any) -> None:
        if fields.keys() != names(type(self)) or (text and self.says):
            raise TypeError(f"{type(self).__name__}: {sorted(fields)}, expected {sorted(names(type(self)))}")
        self.fields, self.sentence = fields, self.says.format(**fields) if self.says else " ".join(map(str, text))
        self.remedy = self.remedy.format(**fields)

    def __str__(self) -> str:
        return "; ".join(filter(None, (self.sentence, self.remedy)))

    def about(self, what: str) -> Self:
        """Return the message with what it is about before its sentence."""
        named = copy(self)
        named.sentence = f"{what}: {self.sentence}"
        return named

    def __reduce__(self) -> Any:
        return partial(type(self), *getattr(self, "args", ()), **self.fields), ()

    @property
    def row(self) -> dict[str, Any]:
        """Its name and values, for a row of a journal."""
        return {"name": type(self).__name__, "fields": {key: _plain(value) for key, value in self.fields.items()}}


def _plain(value: Any) -> Any:
    if isinstance(value, Message):
        return value.row
    return value if isinstance(value, bool | int | float | str | None) else str(value)


# fmt: off

class NotAllowed(Message, ValueError, says="{key} = {given}: allowed {allowed}"):
    """A value of a config or of a command line."""
class NoSuchKey(Message, ValueError, says="{key}: no such key{hint}", remedy="allowed {where}: {known}"): ...
class NameTaken(Message, ValueError, says="{what} {name}: there is one of this name already", remedy="choose another"):
    """Told where something is added to those that come with the program."""
