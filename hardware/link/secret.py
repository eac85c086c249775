"""A secret in a file of its own, which only its owner may read."""

import re
from pathlib import Path

from hardware.errors import LinkError

__all__ = ["read_secret"]


def read_secret(key: str, path: str, least: int, remedy: str, printable: str = r"[!-~]") -> str:
    """One line of `least` to 256 characters, for the config value `key`.

    Raises: LinkError naming the file and the remedy; never the secret.
    """
    file = Path(path).expanduser()
    try:
        mode, secret = file.stat().st_mode, file.read_bytes()[:2048].decode("utf-8", "replace").strip()
    except OSError as error:
        raise LinkError(f"{key} = {path}: {error.strerror}; {remedy}") from None
    if mode & 0o077:
        raise LinkError(f"{key} = {path}: others may use it (mode {mode & 0o777:o}); chmod 600 {path}")
    if not re.fullmatch(f"{printable}{{{least},256}}", secret):
        raise LinkError(f"{key} = {path}: not one line of {least} to 256 characters; {remedy}")
    return secret
