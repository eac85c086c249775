"""Checkpoints: whole on disk, exact in content, and never executed."""

import os
import pickle
from pathlib import Path

import pytest
import torch

from dqn import checkpoint


def test_a_failed_write_leaves_the_previous_checkpoint(tmp_path: Path) -> None:
    path = tmp_path / "checkpoint.pt"
    checkpoint.save(path, {"step": 1})
    with pytest.raises((pickle.PicklingError, AttributeError, TypeError)):
        checkpoint.save(path, {"step": 2, "unpicklable": lambda: None})
    assert checkpoint.load(path) == {"step": 1}


def test_a_checkpoint_is_on_the_disk_before_it_takes_the_name_and_its_name_before_the_call_returns(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Order of what reaches the disk; otherwise a power cut can leave an empty checkpoint, or the old one's name."""
    path, order = tmp_path / "checkpoint.pt", []
    fsync, replace = os.fsync, os.replace

    def synced(file: int) -> None:
        order.append(("fsync", os.readlink(f"/proc/self/fd/{file}"), os.fstat(file).st_size))
        fsync(file)

    def renamed(source: Path, target: Path) -> None:
        order.append(("replace", str(source), str(target)))
        replace(source, target)

    monkeypatch.setattr(os, "fsync", synced)
    monkeypatch.setattr(os, "replace", renamed)
    checkpoint.save(path, {"numbers": torch.arange(10_000)})
    part, size = str(path) + ".part", path.stat().st_size
    assert size > 40_000
    assert [step[:2] for step in order] == [("fsync", part), ("replace", part), ("fsync", str(tmp_path))]
    assert order[0][2] == size
    assert order[1][2] == str(path)


class _Malicious:
    """Runs a command when unpickled by an unrestricted reader."""

    def __init__(self, marker: Path) -> None:
        self.marker = marker

    def __reduce__(self) -> tuple[object, tuple[str]]:
        return os.system, (f"touch {self.marker}",)


def test_code_in_a_checkpoint_is_refused_and_not_run(tmp_path: Path) -> None:
    marker, path = tmp_path / "ran", tmp_path / "checkpoint.pt"
    torch.save({"format": checkpoint.FORMAT, "state": _Malicious(marker)}, path)
    with pytest.raises(checkpoint.CheckpointError, match=r"checkpoint\.pt: not a readable checkpoint"):
        checkpoint.load(path)
    assert not marker.exists()


@pytest.mark.parametrize("content", [b"", b"nonsense", b"PK\x03\x04 torn"], ids=["empty", "text", "torn"])
def test_unreadable_files_are_named(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "checkpoint.pt"
    with pytest.raises(checkpoint.CheckpointError, match="no such checkpoint"):
        checkpoint.load(path)
    path.write_bytes(content)
    with pytest.raises(checkpoint.CheckpointError, match=r"checkpoint\.pt: not a readable checkpoint"):
        checkpoint.load(path)


@pytest.mark.parametrize("content", [{"format": 99, "state": {}}, [1, 2]])
def test_another_format_is_refused(tmp_path: Path, content: object) -> None:
    path = tmp_path / "checkpoint.pt"
    torch.save(content, path)
    with pytest.raises(checkpoint.CheckpointError, match="format"):
        checkpoint.load(path)
