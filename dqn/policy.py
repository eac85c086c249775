"""The greedy policy as plain arrays: read from policy.npz and evaluated with NumPy alone, where torch is absent.

Format 1 of policy.npz: arrays `w0, b0, w1, b1, ...` (float32, layer k maps h to relu(h @ wk + bk), the last without
relu), `input_matrix` (F, O) and `input_offset` (F,), `pump_rates` (A,) in mL/s, and `metadata`, a JSON text with
{format, observation: names, control_min, model: {mu, tau, ...}, config_hash, ...}. No pickled objects.
"""

import json
import zipfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

__all__ = ["FORMAT", "OBSERVATION", "Policy", "PolicyError", "load", "save"]

FORMAT = 1
OBSERVATION = ("od", "setpoint")


class PolicyError(Exception):
    """A policy file cannot be used; the message says which, why, and what to do."""


@dataclass(frozen=True, eq=False)
class Policy:
    """pump rate = rates[argmax_a Q(M [od, setpoint] + c, a)].

    weights, biases: per layer (in, out) and (out,), float32. input_matrix: M (F, O); input_offset: c (F,).
    pump_rates: (A,), mL/s. metadata: as in the module's description.
    """

    weights: tuple[NDArray[np.float32], ...]
    biases: tuple[NDArray[np.float32], ...]
    input_matrix: NDArray[np.float32]
    input_offset: NDArray[np.float32]
    pump_rates: NDArray[np.float64]
    metadata: dict[str, Any]

    def q_values(self, observation: NDArray[Any]) -> NDArray[np.float32]:
        """Q(observation, .), (N, O) -> (N, A), in the scale the agent was trained in."""
        h = observation.astype(np.float32) @ self.input_matrix.T + self.input_offset
        for weight, bias in zip(self.weights[:-1], self.biases[:-1], strict=True):
            h = np.maximum(h @ weight + bias, 0.0)
        return np.asarray(h @ self.weights[-1] + self.biases[-1], dtype=np.float32)

    def act(self, observation: NDArray[Any]) -> NDArray[np.intp]:
        """Index of the greedy action, (N, O) -> (N,)."""
        return np.asarray(self.q_values(observation).argmax(axis=-1))

    def rate(self, observation: NDArray[Any]) -> NDArray[np.float64]:
        """Greedy pump rate in mL/s, (N, O) -> (N,)."""
        return self.pump_rates[self.act(observation)]


def save(path: Path, policy: Policy) -> None:
    """Write policy.npz atomically."""
    arrays: dict[str, NDArray[Any]] = {
        "input_matrix": policy.input_matrix,
        "input_offset": policy.input_offset,
        "pump_rates": policy.pump_rates,
        "metadata": np.array(json.dumps(policy.metadata, sort_keys=True)),
    }
    for k, (weight, bias) in enumerate(zip(policy.weights, policy.biases, strict=True)):
        arrays[f"w{k}"], arrays[f"b{k}"] = weight, bias
    temporary = path.with_suffix(".part.npz")
    np.savez(temporary, **arrays)  # type: ignore[arg-type]
    temporary.replace(path)


def load(path: Path) -> Policy:
    """Read and check policy.npz.

    Raises: PolicyError naming the file, what is wrong with it and the remedy.
    """
    remedy = "give the policy.npz of a training run"
    try:
        with open(path, "rb") as f, np.load(f, allow_pickle=False) as content:
            arrays = {name: content[name] for name in content.files}
    except FileNotFoundError:
        raise PolicyError(f"policy {path}: no such file; {remedy}") from None
    except (OSError, ValueError, EOFError, zipfile.BadZipFile, KeyError) as error:
        reason = (str(error).splitlines() or [type(error).__name__])[0]
        raise PolicyError(f"policy {path}: not a policy file ({reason}); {remedy}") from None
    try:
        metadata = json.loads(str(arrays["metadata"]))
        if metadata.get("format") != FORMAT:
            raise PolicyError(f"policy {path}: format {metadata.get('format')}: allowed {FORMAT}; export it anew")
        if tuple(metadata.get("observation", ())) != OBSERVATION:
            raise PolicyError(f"policy {path}: observation {metadata.get('observation')}: allowed {list(OBSERVATION)}")
        layers = sum(name.startswith("w") for name in arrays)
        policy = Policy(
            weights=tuple(arrays[f"w{k}"] for k in range(layers)),
            biases=tuple(arrays[f"b{k}"] for k in range(layers)),
            input_matrix=arrays["input_matrix"],
            input_offset=arrays["input_offset"],
            pump_rates=arrays["pump_rates"],
            metadata=metadata,
        )
        q = policy.q_values(np.array([[0.5, 0.5]]))
    except (KeyError, IndexError, ValueError, AttributeError) as error:
        raise PolicyError(f"policy {path}: incomplete or of mismatched shapes ({error}); {remedy}") from None
    if q.shape != (1, policy.pump_rates.size) or not np.isfinite(q).all():
        raise PolicyError(
            f"policy {path}: {q.shape[-1]} Q values, {policy.pump_rates.size} pump rates, or not finite; {remedy}"
        )
    return policy
