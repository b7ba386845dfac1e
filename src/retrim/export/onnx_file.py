"""Export ONNX models: the network with its bounded output, for any number of rows.

This module needs the extra ``export``.
"""

import json
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np

from ..errors import ConfigError
from ..io.files import write_whole
from .portable import Portable
from .runner import LARGEST

OPSET, IR = 17, 8  # old enough for all current runtimes


def write_onnx(path: Path, policy: Portable) -> list[Path]:
    """Write a model that maps ``observation`` (rows x numbers) to ``command`` (rows x 4) and ``finite`` (rows x 1).

    The model has no memory: if an observation or a command is not finite, the command is NaN and ``finite`` is false.

    Returns:
        The path of the model.

    Raises:
        ConfigError: The package ``onnx`` is not installed.
    """
    if find_spec("onnx") is None:
        raise ConfigError("--to onnx needs onnx: pip install onnx onnxruntime")
    import onnx
    from onnx import TensorProto, helper, numpy_helper

    values = {"largest": _scalar(LARGEST), "zero": _scalar(0.0), "nan": _scalar(np.nan)}

    def finite(x: str, out: str) -> list[onnx.NodeProto]:
        """Return nodes that test whether all numbers of a row are below LARGEST; a comparison with NaN is false."""
        steps: tuple[tuple[str, list[str], dict[str, Any]], ...] = (
            ("Abs", [x], {}),
            ("Less", [f"{out}_Abs", "largest"], {}),
            ("Cast", [f"{out}_Less"], {"to": TensorProto.FLOAT}),
            ("ReduceMin", [f"{out}_Cast"], {"axes": [1], "keepdims": 1}),
            ("Greater", [f"{out}_ReduceMin", "zero"], {}),
        )
        return [
            helper.make_node(kind, inputs, [out if kind == "Greater" else f"{out}_{kind}"], **how)
            for kind, inputs, how in steps
        ]

    nodes = [
        *finite("observation", "observation_is_finite"),
        helper.make_node("Where", ["observation_is_finite", "observation", "zero"], ["kept"]),
    ]
    h = "kept"
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
        helper.make_node("Add", ["above", "low"], ["within"]),
        *finite("within", "command_is_finite"),
        helper.make_node("And", ["observation_is_finite", "command_is_finite"], ["finite"]),
        helper.make_node("Where", ["finite", "within", "nan"], ["command"]),
    ]
    size = policy.sizes
    graph = helper.make_graph(
        nodes,
        "policy",
        [helper.make_tensor_value_info("observation", TensorProto.FLOAT, ["rows", size[0]])],
        [
            helper.make_tensor_value_info("command", TensorProto.FLOAT, ["rows", 4]),
            helper.make_tensor_value_info("finite", TensorProto.BOOL, ["rows", 1]),
        ],
        [numpy_helper.from_array(value, name) for name, value in values.items()],
    )
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", OPSET)], ir_version=IR)
    tests = {"test_observations": policy.test_observations.tolist(), "test_commands": policy.test_commands.tolist()}
    about = {**policy.about, "observation": policy.observation, **tests}
    helper.set_model_props(model, {name: json.dumps(value) for name, value in about.items()})
    onnx.checker.check_model(model, full_check=True)
    write_whole(path, model.SerializeToString())
    return [path]


def _scalar(value: float) -> np.ndarray:
    return np.asarray(value, dtype=np.float32)
