"""ONNX: the network with its bounded output, for any number of rows. Needs the extra ``export``."""

import json
from importlib.util import find_spec
from pathlib import Path

import numpy as np

from ..errors import ConfigError
from ..io.files import write_whole
from .portable import Portable

OPSET, IR = 17, 8  # old enough for every runtime that is in use


def write_onnx(path: Path, policy: Portable) -> list[Path]:
    """Write a model from ``observation`` (rows x numbers) to ``command`` (rows x 4); return its path.

    Raises:
        ConfigError: What writes it is not installed.
    """
    if find_spec("onnx") is None:
        raise ConfigError("--to onnx needs onnx: pip install 'retrim[export]'")
    import onnx
    from onnx import TensorProto, helper, numpy_helper

    nodes, values, h = [], dict[str, np.ndarray](), "observation"
    for i, (w, b) in enumerate(policy.layers):
        values |= {f"w{i}": w, f"b{i}": b}
        nodes.append(helper.make_node("Gemm", [h, f"w{i}", f"b{i}"], [f"y{i}"]))
        h = f"y{i}"
        if i < len(policy.layers) - 1:
            nodes.append(helper.make_node("Relu", [h], [f"h{i}"]))
            h = f"h{i}"
    values |= {"hover": policy.y0, "range": policy.high - policy.low, "low": policy.low}
    nodes += [
        helper.make_node("Add", [h, "hover"], ["centred"]),
        helper.make_node("Sigmoid", ["centred"], ["share"]),
        helper.make_node("Mul", ["share", "range"], ["above"]),
        helper.make_node("Add", ["above", "low"], ["command"]),
    ]
    size = policy.sizes
    graph = helper.make_graph(
        nodes,
        "policy",
        [helper.make_tensor_value_info("observation", TensorProto.FLOAT, ["rows", size[0]])],
        [helper.make_tensor_value_info("command", TensorProto.FLOAT, ["rows", 4])],
        [numpy_helper.from_array(value, name) for name, value in values.items()],
    )
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", OPSET)], ir_version=IR)
    tests = {"test_observations": policy.test_observations.tolist(), "test_commands": policy.test_commands.tolist()}
    about = {**policy.about, "observation": policy.observation, **tests}
    helper.set_model_props(model, {name: json.dumps(value) for name, value in about.items()})
    onnx.checker.check_model(model, full_check=True)
    write_whole(path, model.SerializeToString())
    return [path]
