"""With which presets and values a run was started, as its folder tells."""

import re
from pathlib import Path

__all__ = ["choices", "given"]

BLOCK = re.compile(r"^    choices:\n((?:      .*\n)+)", re.MULTILINE)


def given(folder: Path) -> list[str]:
    """List the words of the command line of a run folder, `key=value` each; [] where it does not say."""
    path = folder / ".hydra" / "overrides.yaml"
    return re.findall(r"^- \+*(.+)$", path.read_text(encoding="utf-8"), re.MULTILINE) if path.is_file() else []


def choices(folder: Path) -> dict[str, str]:
    """Map group to preset of a run folder, {} where it does not say; a group without a preset is left out."""
    path = folder / ".hydra" / "hydra.yaml"
    block = BLOCK.search(path.read_text(encoding="utf-8")) if path.is_file() else None
    pairs = (line.strip().partition(": ") for line in (block[1].splitlines() if block else ()))
    return {key: value for key, _, value in pairs if value and value != "null" and not key.startswith("hydra/")}
