"""The greedy policy as plain arrays, read from policy.npz and evaluated with NumPy, without torch.

Format 2 of policy.npz: arrays `w0, b0, w1, b1, ...` (float32, layer k maps h to relu(h @ wk + bk), the last without
relu), `input_matrix` (F, O) and `input_offset` (F,), `observation_low` and `observation_high` (O,), `actions` (A,), and
`metadata`, a JSON text with {format, observation: names, model: {...}, config_hash, ...}. No pickled objects.

| observation | what it is | actions |
|---|---|---|
| od, setpoint (, next_setpoint, minutes_to_change) | OD x, setpoint r, and its change (envs/preview.py) | mL/s |
| error, growth_share | e = ln(x/r)/B, s = mu h/B; B: fall of ln x in one period h of full pump | share of full pump |

`add` registers other observations.
"""

import hashlib
import json
import zipfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

FORMAT = 2
LARGEST = 1e6  # largest allowed weight: up to it no value overflows single precision, and underflow is harmless
ABSOLUTE = ("od", "setpoint")
PREVIEW = (*ABSOLUTE, "next_setpoint", "minutes_to_change")
RELATIVE = ("error", "growth_share")
_known: list[tuple[str, ...]] = [ABSOLUTE, PREVIEW, RELATIVE]


def add(*observation: str) -> None:
    """Register an observation by the names of its numbers, so that `load` accepts policies that use it."""
    if observation not in _known:
        _known.append(observation)


class PolicyError(Exception):
    """Error of an unusable policy file; the message has file, reason and remedy."""


@dataclass(frozen=True, eq=False)
class Policy:
    """Greedy policy: actions[argmax_a Q(M o + c, a)] for an observation o, which is clipped to the trained range.

    weights, biases: per layer, (in, out) and (out,), float32. input_matrix: M (F, O); input_offset: c (F,).
    actions: (A,), in the unit of the observation's task. low, high: trained range of the observation, (O,).
    metadata: as in the docstring of this module.
    """

    weights: tuple[NDArray[np.float32], ...]
    biases: tuple[NDArray[np.float32], ...]
    input_matrix: NDArray[np.float32]
    input_offset: NDArray[np.float32]
    actions: NDArray[np.float64]
    low: NDArray[np.float32]
    high: NDArray[np.float32]
    metadata: dict[str, Any]

    @property
    def observation(self) -> tuple[str, ...]:
        """Names of the network's inputs, in order."""
        return tuple(self.metadata["observation"])

    def q_values(self, observation: NDArray[Any]) -> NDArray[np.float32]:
        """Compute Q(observation, .), (N, O) -> (N, A), in the scale on which the agent was trained."""
        seen = np.clip(observation.astype(np.float32), self.low, self.high)
        h = seen @ self.input_matrix.T + self.input_offset
        for weight, bias in zip(self.weights[:-1], self.biases[:-1], strict=True):
            h = np.maximum(h @ weight + bias, 0.0)
        return np.asarray(h @ self.weights[-1] + self.biases[-1], dtype=np.float32)

    def act(self, observation: NDArray[Any]) -> NDArray[np.intp]:
        """Return the index of the greedy action, (N, O) -> (N,)."""
        return np.asarray(self.q_values(observation).argmax(axis=-1))

    def chosen(self, observation: NDArray[Any]) -> NDArray[np.float64]:
        """Return the greedy action in the unit of `actions`, e.g. a pump rate in mL/s, (N, O) -> (N,)."""
        return self.actions[self.act(observation)]


STORED = {"observation_low": "low", "observation_high": "high"} | {
    name: name for name in ("input_matrix", "input_offset", "actions")
}
"""Name of an array in a policy file -> field of `Policy`, for all arrays except those of the layers."""


def _arrays(policy: Policy) -> dict[str, NDArray[Any]]:
    layers = {"w": policy.weights, "b": policy.biases}
    found: dict[str, NDArray[Any]] = {name: getattr(policy, field) for name, field in STORED.items()}
    return found | {f"{key}{k}": array for key, arrays in layers.items() for k, array in enumerate(arrays)}


def fingerprints(policy: Policy) -> dict[str, str]:
    """Return, by name, the SHA-256 of each part of a policy that determines the chosen action or its meaning."""
    said = {key: policy.metadata.get(key) for key in ("observation", "control_min", "model")}
    arrays, limits = _arrays(policy), ("observation_low", "observation_high")
    parts = {"map of the inputs": ("input_matrix", "input_offset"), "actions": ("actions",), "limits": limits}
    found = {"observation or model": hashlib.sha256(json.dumps(said, sort_keys=True).encode()).hexdigest()}
    for part, names in {"weights": sorted(arrays.keys() - STORED), **parts}.items():
        digest = hashlib.sha256()
        for name in names:
            digest.update(f"{name} {arrays[name].dtype.str} {arrays[name].shape}".encode())
            digest.update(np.ascontiguousarray(arrays[name]).tobytes())
        found[part] = digest.hexdigest()
    return found


def save(path: Path, policy: Policy) -> None:
    """Write policy.npz atomically."""
    arrays = {**_arrays(policy), "metadata": np.array(json.dumps(policy.metadata, sort_keys=True))}
    temporary = path.with_suffix(".part.npz")
    np.savez(temporary, **arrays)  # type: ignore[arg-type]
    temporary.replace(path)


def load(path: Path) -> Policy:
    """Read and check policy.npz.

    Raises: PolicyError with file, reason and remedy.
    """
    remedy = "give the policy.npz of a training run"
    try:
        with open(path, "rb") as f, np.load(f, allow_pickle=False) as content:
            arrays = {name: content[name] for name in content.files}
    except FileNotFoundError:
        raise PolicyError(f"policy {path}: no such file; {remedy}") from None
    except (OSError, ValueError, EOFError, zipfile.BadZipFile, KeyError) as error:
        reason = (str(error).splitlines() or [type(error).__name__])[0]
        if "pickle" in reason:  # NumPy's own message advises to trust the file
            reason = "no NumPy archive"
        raise PolicyError(f"policy {path}: not a policy file ({reason}); {remedy}") from None
    try:
        metadata = json.loads(str(arrays["metadata"]))
        if metadata.get("format") != FORMAT:
            raise PolicyError(f"policy {path}: format {metadata.get('format')}: allowed {FORMAT}; export it again")
        if tuple(metadata.get("observation", ())) not in _known:
            allowed = " or ".join(str(list(names)) for names in _known)
            raise PolicyError(f"policy {path}: observation {metadata.get('observation')}: allowed {allowed}")
        layers = range(sum(name.startswith("w") for name in arrays))
        weights, biases = (tuple(arrays[f"{key}{k}"] for k in layers) for key in "wb")
        policy = Policy(weights, biases, metadata=metadata, **{f: arrays[name] for name, f in STORED.items()})
        largest = float(np.max([np.max(np.abs(a), initial=0.0) for a in (*weights, *biases)]))
        if not largest <= LARGEST:
            raise PolicyError(f"policy {path}: a weight of size {largest:g}: allowed up to {LARGEST:g}; train it again")
        q = policy.q_values(np.full((1, len(metadata["observation"])), 0.5))
    except (KeyError, IndexError, ValueError, AttributeError) as error:
        raise PolicyError(f"policy {path}: arrays missing or of mismatched shapes ({error}); {remedy}") from None
    if q.shape != (1, policy.actions.size) or not np.isfinite(q).all():
        raise PolicyError(
            f"policy {path}: {q.shape[-1]} Q values for {policy.actions.size} actions, or values not finite; {remedy}"
        )
    if not (policy.low < policy.high).all():
        raise PolicyError(
            f"policy {path}: observation from {policy.low.tolist()} to {policy.high.tolist()}: allowed low < high; "
            f"{remedy}"
        )
    return policy
