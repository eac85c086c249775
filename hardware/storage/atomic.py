"""Atomic writes: afterwards a file is either complete or unchanged."""

import os
import secrets
from contextlib import suppress
from pathlib import Path


def write(path: Path, data: bytes | str, fsync: bool = True) -> None:
    """Replace the content of `path` in one step: nobody ever reads half a file. Text is written as UTF-8.

    The data go into `path` + ".xxxxxxxx.part", which then replaces `path`. The x are random, so several processes may
    write one file at once, also on a shared disk: the last one wins. With fsync, file and folder are on the disk when
    this returns. Raises: OSError if the disk refuses; `path` is then unchanged.
    """
    temporary = path.with_name(f"{path.name}.{secrets.token_hex(4)}.part")
    try:
        with open(temporary, "xb") as f:
            f.write(data.encode() if isinstance(data, str) else data)
            if fsync:
                f.flush()
                os.fsync(f.fileno())
        os.replace(temporary, path)
    except BaseException:
        with suppress(OSError):
            temporary.unlink()
        raise
    if fsync:
        sync_folder(path.parent)


def sync_folder(path: Path) -> None:
    """Flush the names in a folder to the disk, so that a new file in it survives a power cut."""
    folder = os.open(path, os.O_RDONLY)
    try:
        os.fsync(folder)
    finally:
        os.close(folder)
