"""Atomic files: the new content or the old one, never a part, and nothing left beside them."""

from pathlib import Path

import pytest

from hardware.storage import atomic


@pytest.mark.parametrize("fsync", [True, False])
@pytest.mark.parametrize("data", ["µ = 0.04\n", b"\x00\xff", ""])
def test_a_file_is_replaced_whole(tmp_path: Path, data: bytes | str, fsync: bool) -> None:
    path = tmp_path / "state.json"
    path.write_text("old")
    atomic.write(path, data, fsync)
    assert path.read_bytes() == (data.encode() if isinstance(data, str) else data)
    assert list(tmp_path.iterdir()) == [path]


def test_a_write_that_fails_leaves_the_old_content(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(_: int) -> None:
        raise OSError(28, "No space left on device")

    path = tmp_path / "state.json"
    atomic.write(path, "old")
    monkeypatch.setattr("os.fsync", full)
    with pytest.raises(OSError, match="No space left"):
        atomic.write(path, "new")
    assert path.read_text() == "old"
