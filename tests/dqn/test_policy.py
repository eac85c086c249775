"""Exported policies and checkpoints: whole on disk, exact in content, never executed; and files that are none."""

import json
import os
import pickle
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from dqn import checkpoint, policy
from dqn.network import QNetwork, action_basis, export, initial_weights
from tests.patience import PATIENCE_S

pytestmark = pytest.mark.numeric

SIZES = (3, 64, 64, 17)
RATES = np.linspace(0.0, 0.02, 17)
ANY = (np.full(2, -np.inf), np.full(2, np.inf))
MATRIX = torch.tensor([[3.0, -3.0], [0.0, 3.0], [1.0, 1.0]])
OFFSET = torch.tensor([0.0, -1.8, 0.5])


def _network(decay: float = 0.0) -> QNetwork:
    flat = np.stack([initial_weights(SIZES, np.random.SeedSequence(i)) for i in range(3)])
    basis = action_basis(SIZES[-1], decay) if decay else None
    return QNetwork(torch.from_numpy(flat), SIZES, MATRIX, OFFSET, basis)


def _policy(agent: int = 1, decay: float = 0.0) -> policy.Policy:
    network = _network(decay)
    metadata = {"observation": ["od", "setpoint"], "control_min": 1.0, "model": {"mu": 0.03, "tau": 1 / 3}}
    return export(network, agent, network.flat, RATES, ANY, metadata)


def _observations() -> np.ndarray:
    od, setpoint = np.meshgrid(np.linspace(0.01, 1.5, 40), np.linspace(0.2, 1.0, 9))
    return np.stack([od.ravel(), setpoint.ravel()], axis=1)


@pytest.mark.parametrize(("agent", "decay"), [(0, 0.0), (2, 0.0), (0, 0.5)])
def test_numpy_policy_agrees_with_torch(tmp_path: Path, agent: int, decay: float) -> None:
    policy.save(tmp_path / "policy.npz", _policy(agent, decay))
    read = policy.load(tmp_path / "policy.npz")
    observation = _observations()
    expected = _network(decay)(torch.from_numpy(observation.astype(np.float32)).expand(3, -1, -1))[agent].numpy()
    np.testing.assert_allclose(read.q_values(observation), expected, rtol=1e-5, atol=1e-6)
    action = expected.argmax(1)
    assert len(set(action.tolist())) > 1
    np.testing.assert_array_equal(read.act(observation), action)
    np.testing.assert_array_equal(read.chosen(observation), RATES[action])
    assert read.metadata == {**_policy(agent, decay).metadata, "format": policy.FORMAT}


def test_reading_needs_no_torch(tmp_path: Path) -> None:
    policy.save(tmp_path / "policy.npz", _policy())
    code = (
        "import sys; sys.modules['torch'] = None\n"
        "from pathlib import Path\n"
        "from dqn import policy\n"
        f"print(policy.load(Path({str(tmp_path / 'policy.npz')!r})).chosen(__import__('numpy').array([[0.9, 0.3]]))[0])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, timeout=PATIENCE_S)
    assert float(done.stdout) == _policy().chosen(np.array([[0.9, 0.3]]))[0]


def _change(path: Path, **changes: Any) -> None:
    """Rewrite a policy file with some arrays replaced, or removed where None."""
    with np.load(path) as content:
        arrays = {name: content[name] for name in content.files}
    for name, value in changes.items():
        if value is None:
            del arrays[name]
        else:
            arrays[name] = value
    np.savez(path, **arrays)


def _metadata(**changes: Any) -> np.ndarray:
    return np.array(json.dumps({"format": policy.FORMAT, "observation": ["od", "setpoint"], **changes}))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"w1": None}, "arrays missing or of mismatched shapes"),
        ({"b0": np.zeros(5, np.float32)}, "arrays missing or of mismatched shapes"),
        ({"metadata": np.array("not json")}, "arrays missing or of mismatched shapes"),
        ({"metadata": _metadata(format=3)}, "format 3: allowed 2"),
        ({"metadata": _metadata(observation=["od"])}, "observation"),
        ({"actions": np.zeros(16)}, "17 Q values for 16 actions"),
        ({"b2": np.full(17, np.nan, np.float32)}, "a weight of size nan"),
        ({"b1": np.full(64, -np.inf, np.float32)}, "a weight of size inf"),
        ({"b0": np.full(64, -1e25, np.float32)}, "a weight of size 1e\\+25"),
        ({"w0": np.array([{"a": 1}], dtype=object)}, "not a policy file"),
        (
            {"observation_low": np.array([1.0, 0.0], np.float32), "observation_high": np.ones(2, np.float32)},
            "low < high",
        ),
    ],
)
def test_bad_contents_are_named(tmp_path: Path, changes: dict[str, Any], message: str) -> None:
    path = tmp_path / "policy.npz"
    policy.save(path, _policy())
    _change(path, **changes)
    with pytest.raises(policy.PolicyError, match=message):
        policy.load(path)


@pytest.mark.parametrize("content", [b"", b"text, not numbers", b"PK\x03\x04"], ids=["empty", "text", "torn"])
def test_other_files_are_refused(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "policy.npz"
    path.write_bytes(content)
    with pytest.raises(policy.PolicyError, match=r"policy\.npz: not a policy file") as refused:
        policy.load(path)
    assert "pickle" not in str(refused.value)  # NumPy's advice would load whatever it is
    with pytest.raises(policy.PolicyError, match="no such file"):
        policy.load(tmp_path / "none.npz")


def test_an_observation_beyond_the_limits_is_seen_at_them(tmp_path: Path) -> None:
    limited = replace(_policy(), low=np.array([-1.0, 0.1], np.float32), high=np.array([1.0, 0.9], np.float32))
    policy.save(tmp_path / "policy.npz", limited)
    read = policy.load(tmp_path / "policy.npz")
    beyond = np.array([[5.0, 0.5], [-7.0, 2.0], [0.3, -1.0]])
    at = np.array([[1.0, 0.5], [-1.0, 0.9], [0.3, 0.1]])
    np.testing.assert_array_equal(read.q_values(beyond), _policy().q_values(at))
    assert (_policy().q_values(beyond) != _policy().q_values(at)).any()


@pytest.mark.parametrize(
    ("part", "changes"),
    [
        ("limits", {"low": np.array([-np.inf, 0.1], np.float32)}),
        ("map of the inputs", {"input_matrix": (MATRIX * 1.001).numpy()}),
        ("weights", {"biases": tuple(b + np.float32(k == 2) for k, b in enumerate(_policy().biases))}),
        ("observation or model", {"metadata": {**_policy().metadata, "control_min": 2.0}}),
        ("observation or model", {"metadata": {**_policy().metadata, "observation": ["error", "growth_share"]}}),
    ],
    ids=["low", "matrix", "last bias", "period", "observation"],
)
def test_whatever_of_a_policy_decides_is_in_its_fingerprint(part: str, changes: dict[str, Any]) -> None:
    own, other = policy.fingerprints(_policy()), policy.fingerprints(replace(_policy(), **changes))
    assert [name for name in own if own[name] != other[name]] == [part]


def test_what_is_exported_are_the_weights_and_the_limits_that_are_given() -> None:
    """Not those that the network has now: the best ones may be of long ago."""
    network = _network()
    kept = network.flat.flip(0) * 0.5
    limits = np.array([-2.0, 0.1]), np.array([3.0, 0.9])
    own = export(network, 0, kept, RATES, limits, {"seed": 4})
    expected = network.with_weights(kept.clone())(torch.tensor([[[0.4, 0.6]]]).expand(3, -1, -1))[0].numpy()
    kept += 1.0  # the policy holds copies
    np.testing.assert_allclose(own.q_values(np.array([[0.4, 0.6]])), expected, rtol=1e-5, atol=1e-6)
    np.testing.assert_allclose([own.low, own.high], limits)
    assert own.metadata == {"format": policy.FORMAT, "seed": 4}


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
