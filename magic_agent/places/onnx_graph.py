"""A small writer of ONNX graphs: named weights in, nodes out, one file at the end."""

from __future__ import annotations

import os
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
import onnx
from numpy.typing import ArrayLike
from onnx import TensorProto, helper, numpy_helper

OPSET = 17
IR_VERSION = 8


class GraphWriter:
    """Collects nodes and weights; every method returns the name of the value it makes."""

    def __init__(self, name: str) -> None:
        self._name = name
        self._nodes: list[onnx.NodeProto] = []
        self._weights: dict[str, onnx.TensorProto] = {}

    def weight(self, name: str, values: ArrayLike, dtype: Any = np.float32) -> str:
        """Store a constant under a name of its own."""
        array = np.ascontiguousarray(np.asarray(values, dtype=dtype))
        self._weights[name] = numpy_helper.from_array(array, name)
        return name

    def node(self, operation: str, *inputs: str, **attributes: Any) -> str:
        """Append one node; the attributes are the ONNX operator's own."""
        output = f"{operation.lower()}_{len(self._nodes)}"
        self._nodes.append(helper.make_node(operation, list(inputs), [output], **attributes))
        return output

    def save(self, path: Path, *, image_size: tuple[int, int], output: str, dimension: int) -> None:
        """Write the checked model: `image` (b, 3, h, w) in, `embedding` (b, dimension) out."""
        self._nodes.append(helper.make_node("Identity", [output], ["embedding"]))
        graph = helper.make_graph(
            self._nodes,
            self._name,
            [helper.make_tensor_value_info("image", TensorProto.FLOAT, ["b", 3, *image_size])],
            [helper.make_tensor_value_info("embedding", TensorProto.FLOAT, ["b", dimension])],
            initializer=list(self._weights.values()),
        )
        opsets = [helper.make_opsetid("", OPSET)]
        model = helper.make_model(graph, opset_imports=opsets, ir_version=IR_VERSION)
        onnx.checker.check_model(model)
        _write_atomically(path, model.SerializeToString())


def _write_atomically(path: Path, content: bytes) -> None:
    """Several agents may convert at the same time: each writes its own file, then renames it."""
    path.parent.mkdir(parents=True, exist_ok=True)
    handle, name = tempfile.mkstemp(dir=path.parent, prefix=path.name)
    try:
        with os.fdopen(handle, "wb") as file:
            file.write(content)
        os.replace(name, path)
    except BaseException:
        Path(name).unlink(missing_ok=True)
        raise
