"""Complete training states on disk: written atomically, read without executing anything."""

import os
from pathlib import Path
from typing import Any

import torch

FORMAT = 5


class CheckpointError(Exception):
    """Error of an unusable checkpoint; the message has file and reason."""


def save(path: Path, state: dict[str, Any]) -> None:
    """Write tensors and plain Python values atomically: the file at `path` is always complete, even after kill -9.

    Raises: OSError if the disk fails; the previous checkpoint is kept.
    """
    temporary = path.with_suffix(path.suffix + ".part")
    with open(temporary, "wb") as f:
        torch.save({"format": FORMAT, "state": state}, f)
        f.flush()
        os.fsync(f.fileno())
    os.replace(temporary, path)
    folder = os.open(path.parent, os.O_RDONLY)
    try:
        os.fsync(folder)
    finally:
        os.close(folder)


def load(path: Path) -> dict[str, Any]:
    """Read a checkpoint. The file may contain only tensors and plain values.

    Raises: CheckpointError with file and remedy.
    """
    try:
        content = torch.load(path, map_location="cpu", weights_only=True)
    except FileNotFoundError:
        raise CheckpointError(
            f"{path}: no such checkpoint, because the run ended before its first one; start a new run"
        ) from None
    except Exception as error:  # torch's unpickler raises various errors
        reason = (str(error).splitlines() or [type(error).__name__])[0]
        raise CheckpointError(
            f"{path}: not a readable checkpoint ({reason}); use a checkpoint written by this program"
        ) from None
    if not isinstance(content, dict) or content.get("format") != FORMAT:
        raise CheckpointError(
            f"{path}: checkpoint format {content.get('format') if isinstance(content, dict) else '?'}: "
            f"allowed {FORMAT}; start a new training with this version"
        )
    state: dict[str, Any] = content["state"]
    return state
