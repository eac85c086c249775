"""YAML of a file that a person may have written: of limited size and depth, and without aliases."""

from pathlib import Path

import yaml  # type: ignore[import-untyped]

LARGEST, DEEPEST = 200_000, 30  # bytes and levels; this project's YAML files have a tenth and a third of these


def problem(error: Exception) -> str:
    """Return one line that says what is wrong with a text and where."""
    mark = getattr(error, "problem_mark", None)
    if mark is not None and isinstance(error, yaml.MarkedYAMLError):
        return f"{error.problem} in line {mark.line + 1}"
    return (str(error).splitlines() or [type(error).__name__])[0]


def read_text(path: Path | str) -> str:
    """Read a YAML file; aliases, which may stand for gigabytes, are refused. Raises: OSError; one-line ValueError."""
    with open(path, "rb") as f:
        data = f.read(LARGEST + 1)
    if len(data) > LARGEST:
        raise ValueError(f"longer than {LARGEST} bytes")
    try:
        depth, text = 0, data.decode("utf-8")
        for event in yaml.parse(text, yaml.SafeLoader):
            where = f"in line {event.start_mark.line + 1}"
            if isinstance(event, yaml.AliasEvent) or "${" in getattr(event, "value", ""):
                raise ValueError(f"an alias or interpolation {where}: write the value out")
            depth += isinstance(event, yaml.CollectionStartEvent) - isinstance(event, yaml.CollectionEndEvent)
            if depth > DEEPEST:
                raise ValueError(f"deeper than {DEEPEST} levels {where}")
    except UnicodeDecodeError:
        raise ValueError("no UTF-8 text") from None
    except ValueError:
        raise
    except Exception as error:  # whatever PyYAML meets
        raise ValueError(f"not YAML ({problem(error)})") from None
    return text
