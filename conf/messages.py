"""Declaration of errors, alarms and notices: each is a class with a sentence, a remedy and named values.

    class PumpStaysOn(DeviceStateError, says="{pump} is still on after {tries} tries", remedy="pull its plug"): ...

    raise PumpStaysOn(pump="Pump1", tries=4)

The docstring explains the message where the sentence does not. docs/three_am.md has a row for every such class.
"""

from copy import copy
from functools import partial
from string import Formatter
from typing import Any, ClassVar, Self


def names(kind: "type[Message]") -> set[str]:
    """Return the names of the values in a message's sentence and remedy."""
    return {name for _, name, _, _ in Formatter().parse(kind.says + kind.remedy) if name}


class Message:
    """Base class of errors, alarms and notices. A class without a declared sentence takes its text as argument.

    Attributes: fields: the values by name, exactly those of `names`. sentence: what happened. remedy: what to do.
    Raises: TypeError if a value is missing, or if neither sentence nor remedy contains it.
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
        """Return a copy of the message whose sentence starts with `what` and a colon."""
        named = copy(self)
        named.sentence = f"{what}: {self.sentence}"
        return named

    def __reduce__(self) -> Any:
        return partial(type(self), *getattr(self, "args", ()), **self.fields), ()

    @property
    def row(self) -> dict[str, Any]:
        """Class name and values of the message, for a row of the journal."""
        return {"name": type(self).__name__, "fields": {key: _plain(value) for key, value in self.fields.items()}}


def _plain(value: Any) -> Any:
    if isinstance(value, Message):
        return value.row
    return value if isinstance(value, bool | int | float | str | None) else str(value)


# fmt: off

class NotAllowed(Message, ValueError, says="{key} = {given}: allowed {allowed}"):
    """A value of a config or command line is invalid."""
class NoSuchKey(Message, ValueError, says="{key}: no such key{hint}", remedy="allowed {where}: {known}"): ...
class NameTaken(Message, ValueError, says="{what} {name}: this name is in use", remedy="choose another name"):
    """An extension adds something under a name that the program already uses."""
