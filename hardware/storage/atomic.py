"""A file that is either whole or as it was before."""

import os
import secrets
from contextlib import suppress
from pathlib import Path


def write(path: Path, data: bytes | str, fsync: bool = True) -> None:
    """Replace the content of `path` in one step: nobody ever reads half a file. Text is written as UTF-8.

    The data go into `path` + ".xxxxxxxx.part", which then takes the place of `path`. Each call has its own x: of
    several processes that write one file at once, on one machine or on a shared disk, the last one's stands. With fsync
    file and folder are on the disk when this returns. Raises: OSError where the disk refuses; `path` is then as it was.
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
    """Put the names in a folder on the disk: a new file can be found after a power cut only then."""
    folder = os.open(path, os.O_RDONLY)
    try:
        os.fsync(folder)
    finally:
        os.close(folder)
