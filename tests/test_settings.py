"""Every setting of every config takes what its row of docs/configuration.md allows, and refuses what lies just outside.

The page is read as text: beside the code it is the one place that says defaults, units and ranges. No other test needs
to repeat them. A changed limit, an open end that became a closed one, or a config that skips its check fails here.
"""

import importlib
import math
import re
from collections.abc import Iterator
from dataclasses import dataclass, fields, is_dataclass
from pathlib import Path
from typing import Any, get_type_hints

import numpy as np
import pytest
import yaml

from conf.schema import build, entries

ROOT = Path(__file__).parents[1]
ROOMS = ("conf", "dqn", "envs", "experiments", "hardware")
ELSEWHERE = {  # not on the page: bases, and what the programs beside the commands take
    "CocultureConfig", "ControllerConfig", "DeviceOptions", "LawConfig", "PreviewConfig", "PumpCalibration",
    "RelativeConfig", "Source", "VialConfig",
}  # fmt: skip
NUMBER = r"(-?(?:\d[\d.]*(?:e[-+]?\d+)?|inf))"

LINE = re.compile(r"- \[?`(\w+)(?:=(.*?))?`(?:\]\(\S+\))?(?: ([^:(][^:]*?))?(?: \((.+?)\))?: (.+)")


@dataclass(frozen=True)
class Row:
    """A line of the page: what the page says of one setting."""

    key: str
    default: str
    unit: str
    allowed: str
    meaning: str


@dataclass(frozen=True)
class Range:
    """The ends of a range, each with whether it belongs to the range."""

    low: float = -math.inf
    with_low: bool = False
    high: float = math.inf
    with_high: bool = True

    def edges(self, whole: bool) -> Iterator[tuple[float, bool]]:
        """Values at the ends, with whether they are allowed."""
        for end, held, outwards in ((self.low, self.with_low, -math.inf), (self.high, self.with_high, math.inf)):
            if math.isinf(end):
                if end > 0.0 and not held:
                    yield math.inf, False
                continue
            step = math.copysign(1.0, outwards) if whole else None
            out = end + step if step else float(np.nextafter(end, outwards))
            within = end - step if step else float(np.nextafter(end, -outwards))
            yield (end, True) if held else (within, True)
            yield (out, False) if held else (end, False)


def ranged(text: str) -> Range | None:
    """What the words of a range say; None where they name choices or nothing."""
    text = re.sub(r" \(.*\)$", "", text)
    for form, (with_low, with_high) in {
        rf"{NUMBER} to {NUMBER}": (True, True),
        rf"a finite number greater than {NUMBER}()": (False, False),
        rf"a finite number of at least {NUMBER}()": (True, False),
        rf"at least {NUMBER}()": (True, True),
        rf"greater than {NUMBER}()": (False, True),
        rf"()at most {NUMBER}": (False, True),
        rf"()less than {NUMBER}": (False, False),
    }.items():
        if found := re.search(f"(?:^|each ){form}(?:, or null)?$", text):
            low, high = found.groups()
            return Range(float(low or -math.inf), with_low, float(high or math.inf), with_high)
    if found := re.search(rf"{NUMBER} (<=?) [^\d<]+?(?: <= high)?(?: (<=?) {NUMBER})?(?:, or null)?$", text):
        low, left, right, high = found.groups()
        return Range(float(low), left == "<=", float(high or math.inf), right != "<")
    return None


def tables() -> dict[str, dict[str, Row]]:
    """The lines of the page by heading, without those of the presets; first the lines of what a heading is as."""
    found: dict[str, dict[str, Row]] = {}
    for line in (ROOT / "docs" / "configuration.md").read_text("utf-8").partition("\n## Presets")[0].splitlines():
        if line.startswith("### "):
            heading = line.removeprefix("### ")
        elif base := re.match(r"As \[(.+)\]\(", line):
            found[heading] = dict(found[base[1]])
        elif own := LINE.fullmatch(line):
            key, default, unit, allowed, meaning = (group or "" for group in own.groups())
            found.setdefault(heading, {})[key] = Row(key, default, unit, allowed, meaning)
    return found


def configs() -> list[type[Any]]:
    """Every dataclass of the program that has a setting, each module loaded by its name."""
    found: dict[type[Any], None] = {}
    for path in sorted(path for room in ROOMS for path in (ROOT / room).rglob("*.py")):
        if path.name != "schema.py" and re.search(r"\b(setting|part)\(", path.read_text("utf-8")):
            module = importlib.import_module(".".join(path.relative_to(ROOT).with_suffix("").parts))
            kinds = [kind for kind in vars(module).values() if isinstance(kind, type) and is_dataclass(kind)]
            found |= dict.fromkeys(kind for kind in kinds if any("meaning" in f.metadata for f in fields(kind)))
    return list(found)


TABLES, CONFIGS = tables(), configs()


def table_of(config: type[Any]) -> str:
    """The heading under which a config stands: by its keys, and by its kind where several have the same."""
    default = {f.name: f.default for f in fields(config)}
    alike = [name for name, rows in TABLES.items() if list(rows) == list(default)]
    return next((name for name in alike if len(alike) == 1 or TABLES[name]["kind"].default == default["kind"]), "")


def rows_of(config: type[Any]) -> list[Row]:
    """What the page says of a config, or where it stands elsewhere what the config itself declares."""
    if heading := table_of(config):
        return list(TABLES[heading].values())
    return [Row(e.name, "", e.said.unit, e.allowed, e.said.what) for e in entries(config())]


def test_every_config_has_its_table_and_every_table_its_config() -> None:
    assert {config.__name__ for config in CONFIGS if not table_of(config)} <= ELSEWHERE
    assert {table_of(config) for config in CONFIGS} - {""} == set(TABLES)


def refusal(config: type[Any], key: str, value: Any) -> str:
    """What a config says of a value, "" if it takes it."""
    try:
        build(config(), {key: value})
    except ValueError as error:
        return str(error)
    return ""


@pytest.mark.parametrize("config", CONFIGS, ids=lambda config: config.__name__)
def test_default_unit_range_and_meaning_are_those_of_the_page(config: type[Any]) -> None:
    for row, entry in zip(rows_of(config), entries(config()), strict=True):
        assert (row.key, row.unit, row.meaning) == (entry.name, entry.said.unit, entry.said.what)
        assert row.allowed == entry.allowed
        assert row.meaning
        if row.default:  # a part has a section of its own
            given = getattr(build(config(), {row.key: yaml.safe_load(row.default)}), row.key)
            assert given == entry.value or np.allclose(given, entry.value, rtol=1e-5, atol=0.0), row


def tried(row: Row, hint: str) -> Iterator[tuple[Any, bool]]:
    """Values at and beyond the edges of what a row allows, each with whether it is allowed."""
    whole, limits, pair = "int" in hint, ranged(row.allowed), "[low, high]" in row.allowed
    many = pair or "tuple" in hint
    for edge, allowed in limits.edges(whole) if limits else ():
        value = int(edge) if whole and math.isfinite(edge) else edge
        yield ([value] * (1 + pair) if many else value), allowed
        if allowed and pair:
            yield [value, math.nextafter(value, -math.inf)], False
    if limits and not whole and not (many and "null" in row.allowed):  # where nan is read as null
        yield ([math.nan] * (1 + pair) if many else math.nan), False
    if limits and not many:
        yield None, row.allowed.endswith(", or null")
    if row.allowed.startswith("one or more"):
        yield [], False
    words = re.fullmatch(
        r"(?:one or more, each one of )?([\w.]+(?:, (?!or )[\w.]+)+)(, or null|, or '' for none)?", row.allowed
    )
    for word in words[1].split(", ") if words else ():
        yield ([word] if many else word), True
        yield ([f"{word}x"] if many else f"{word}x"), False


@pytest.mark.parametrize("config", CONFIGS, ids=lambda config: config.__name__)
def test_a_value_at_the_end_of_its_range_is_taken_and_one_beyond_refused_with_key_value_and_range(
    config: type[Any],
) -> None:
    hints = get_type_hints(config)
    for row in rows_of(config):
        for value, allowed in tried(row, str(hints[row.key])):
            said = refusal(config, row.key, value)
            by_range = re.search(rf"\b{row.key} = .*: allowed .*{re.escape(row.allowed)}", said) is not None
            assert by_range != allowed, (row, value, said)  # a rule of several settings may still refuse a value
            if by_range:
                shown = value if isinstance(value, list) else f"{value} {row.unit}".strip()
                assert "\n" not in said
                assert value is None or f"{row.key} = {shown}: " in said


def test_every_number_has_a_range() -> None:
    without = {
        f"{table_of(config)}.{row.key}"
        for config in CONFIGS
        for row in rows_of(config)
        if re.fullmatch(r"<class '(int|float)'>", str(get_type_hints(config)[row.key])) and not ranged(row.allowed)
    }
    assert not without
