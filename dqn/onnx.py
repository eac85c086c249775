"""Export of a `dqn.policy.Policy` to an ONNX file: the observation is clipped, then Gemm and Relu layers follow."""

import json
from pathlib import Path

import numpy as np
import onnx
from onnx import TensorProto, helper, numpy_helper

from dqn.policy import Policy


def write(policy: Policy, path: Path) -> None:
    """Write the network, (N, O) float32 `observation` -> (N, A) float32 `q`; the greedy action is the argmax of `q`.

    The file's metadata contain the names of the observations and the values of the actions. Raises: OSError.
    """
    floats = {"low": policy.low, "high": policy.high, "w": policy.input_matrix.T, "b": policy.input_offset}
    floats |= {f"w{k}": weight for k, weight in enumerate(policy.weights)}
    floats |= {f"b{k}": bias for k, bias in enumerate(policy.biases)}
    nodes = [
        helper.make_node("Max", ["observation", "low"], ["above"]),
        helper.make_node("Min", ["above", "high"], ["inside"]),
        helper.make_node("Gemm", ["inside", "w", "b"], ["h0"]),
    ]
    last = len(policy.weights) - 1
    for k in range(last):
        nodes += [
            helper.make_node("Gemm", [f"h{k}", f"w{k}", f"b{k}"], [f"g{k}"]),
            helper.make_node("Relu", [f"g{k}"], [f"h{k + 1}"]),
        ]
    nodes.append(helper.make_node("Gemm", [f"h{last}", f"w{last}", f"b{last}"], ["q"]))
    seen: list[str | int] = ["N", policy.low.size]
    found: list[str | int] = ["N", policy.actions.size]
    graph = helper.make_graph(
        nodes,
        "policy",
        [helper.make_tensor_value_info("observation", TensorProto.FLOAT, seen)],
        [helper.make_tensor_value_info("q", TensorProto.FLOAT, found)],
        [numpy_helper.from_array(np.ascontiguousarray(a, dtype=np.float32), name) for name, a in floats.items()],
    )
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=9)
    said = {"observation": list(policy.observation), "actions": policy.actions.tolist()}
    helper.set_model_props(model, {key: json.dumps(value) for key, value in said.items()})
    onnx.checker.check_model(model)
    onnx.save(model, str(path))
