"""Settings class by class against the tables of docs/configuration.md, without loading a command."""

import re
from pathlib import Path
from typing import Any

import pytest

from dqn.config import DQNConfig
from experiments.cli.reference import _table
from hardware.chibio.dosing import DosingConfig
from hardware.chibio.overflow_pump import OverflowPumpConfig
from hardware.safety.config import Responses, SafetyConfig

PAGE = (Path(__file__).parent.parent / "docs" / "configuration.md").read_text(encoding="utf-8")


@pytest.mark.parametrize(
    ("config", "heading"),
    [
        (SafetyConfig, "safety"),
        (Responses, "safety.responses"),
        (DQNConfig, "agent"),
        (DosingConfig, "backend.dosing"),
        (OverflowPumpConfig, "backend.overflow_pump"),
    ],
)
def test_defaults_units_and_ranges_are_those_of_the_page(config: type[Any], heading: str) -> None:
    found = re.search(rf"^### {re.escape(heading)}\n(.*?)(?=^#|\Z)", PAGE, re.MULTILINE | re.DOTALL)
    assert found is not None
    rows = [line for line in found[1].splitlines() if line.startswith("| `")]
    assert rows == [line for line in _table(config(), {Responses: "safety.responses"})[0].splitlines() if "| `" in line]
