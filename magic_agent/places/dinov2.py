"""DINOv2 vision transformers as ONNX graphs, from the official state dict layout.

Oquab et al., "DINOv2: Learning Robust Visual Features without Supervision" (2023). The official
weights (`dinov2_vits14_pretrain.pth` for ViT-S/14) are not part of any package: download them once
and give their path as the descriptor model. The embedding is the mean of all normalised tokens,
as in the MAGiC-SLAM paper's code.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from magic_agent.places.onnx_graph import GraphWriter
from magic_agent.places.preprocessing import Preprocessing
from magic_core.errors import ConfigError

HEAD_CHANNELS = 64
"""Every official DINOv2 size uses heads of 64 channels."""
LAYER_NORM_EPSILON = 1e-6
PREPROCESSING = Preprocessing(pooling="mean")

Weights = Mapping[str, NDArray]


def convert(weights_path: Path, onnx_path: Path) -> None:
    """Write official weights as ONNX: `image` (b, 3, 224, 224) in, `embedding` (b, d) out."""
    import torch

    state = torch.load(weights_path, map_location="cpu", weights_only=True)
    weights = {name: tensor.float().numpy() for name, tensor in state.items()}
    size = (PREPROCESSING.height, PREPROCESSING.width)
    write_graph(weights, onnx_path, image_size=size)


def write_graph(weights: Weights, onnx_path: Path, *, image_size: tuple[int, int]) -> None:
    """The graph of a state dict with the official names; the size is a multiple of the patch."""
    missing = [n for n in ("cls_token", "pos_embed", "patch_embed.proj.weight") if n not in weights]
    if missing:
        raise ConfigError.field("descriptor_model", f"not a DINOv2 state dict: {missing} missing")
    if any(".w12." in name for name in weights) or "register_tokens" in weights:
        raise ConfigError.field(
            "descriptor_model", "DINOv2 giant and register variants: export these to ONNX yourself"
        )
    graph = _TransformerGraph(weights)
    tokens = graph.embed("image", image_size)
    blocks = 1 + max(int(name.split(".")[1]) for name in weights if name.startswith("blocks."))
    for block in range(blocks):
        tokens = graph.block(tokens, f"blocks.{block}.")
    tokens = graph.layer_norm(tokens, "norm")
    embedding = graph.writer.node("ReduceMean", tokens, axes=[1], keepdims=0)
    graph.writer.save(onnx_path, image_size=image_size, output=embedding, dimension=graph.channels)


def resized_positions(positions: NDArray, grid: tuple[int, int]) -> NDArray[np.float32]:
    """Position embeddings (1, 1 + rows * cols, d) for another grid of patches.

    As the official code: bicubic, the scale factor offset by 0.1 of a patch.
    """
    import torch

    side = round((positions.shape[1] - 1) ** 0.5)
    if (side, side) == grid:
        return positions.astype(np.float32)
    tokens = torch.as_tensor(np.array(positions, dtype=np.float32))
    patches = tokens[:, 1:].reshape(1, side, side, -1).permute(0, 3, 1, 2)
    factors = ((grid[0] + 0.1) / side, (grid[1] + 0.1) / side)
    patches = torch.nn.functional.interpolate(patches, scale_factor=factors, mode="bicubic")
    patches = patches.permute(0, 2, 3, 1).reshape(1, grid[0] * grid[1], -1)
    return torch.cat([tokens[:, :1], patches], dim=1).numpy()


class _TransformerGraph:
    """Pre-norm transformer blocks with layer scale."""

    def __init__(self, weights: Weights) -> None:
        self.weights = weights
        self.writer = GraphWriter("dinov2")
        self.channels = int(weights["cls_token"].shape[-1])
        if self.channels % HEAD_CHANNELS:
            raise ConfigError.field(
                "descriptor_model", f"{self.channels} channels: expected a multiple of 64"
            )
        self.heads = self.channels // HEAD_CHANNELS

    def embed(self, image: str, image_size: tuple[int, int]) -> str:
        """Patches to tokens (b, 1 + n, d), class token first, positions added."""
        kernel = self.weights["patch_embed.proj.weight"]
        patch = int(kernel.shape[-1])
        if image_size[0] % patch or image_size[1] % patch:
            raise ConfigError.field(
                "preprocessing.height", f"{image_size}: expected multiples of {patch} pixels"
            )
        positions = resized_positions(
            self.weights["pos_embed"], (image_size[0] // patch, image_size[1] // patch)
        )
        writer = self.writer
        patches = writer.node(
            "Conv",
            image,
            writer.weight("patch_embed.weight", kernel),
            writer.weight("patch_embed.bias", self.weights["patch_embed.proj.bias"]),
            strides=[patch, patch],
        )
        flat = writer.weight("flat_shape", [0, self.channels, -1], np.int64)
        patches = writer.node("Transpose", writer.node("Reshape", patches, flat), perm=[0, 2, 1])
        patches = writer.node("Add", patches, writer.weight("positions", positions[:, 1:]))
        return writer.node("Concat", self._class_token(patches, positions), patches, axis=1)

    def _class_token(self, patches: str, positions: NDArray) -> str:
        """(b, 1, d): the learnt class token repeated for each image of the batch."""
        writer = self.writer
        token = self.weights["cls_token"] + positions[:, :1]
        first = writer.node(
            "Slice",
            patches,
            *(writer.weight(f"slice_{n}", [v], np.int64) for n, v in
              (("start", 0), ("end", 1), ("axis", 1))),
        )  # fmt: skip
        nothing = writer.node("Mul", first, writer.weight("nothing", 0.0))
        return writer.node("Add", nothing, writer.weight("class_token", token))

    def block(self, tokens: str, prefix: str) -> str:
        """x + ls1(attention(norm1(x))), then x + ls2(mlp(norm2(x)))."""
        attended = self._attention(self.layer_norm(tokens, f"{prefix}norm1"), f"{prefix}attn.")
        tokens = self._add_scaled(tokens, attended, f"{prefix}ls1.gamma")
        hidden = self._linear(self.layer_norm(tokens, f"{prefix}norm2"), f"{prefix}mlp.fc1")
        hidden = self._linear(self._gelu(hidden), f"{prefix}mlp.fc2")
        return self._add_scaled(tokens, hidden, f"{prefix}ls2.gamma")

    def layer_norm(self, tokens: str, layer: str) -> str:
        gain = self.writer.weight(f"{layer}.weight", self.weights[f"{layer}.weight"])
        shift = self.writer.weight(f"{layer}.bias", self.weights[f"{layer}.bias"])
        return self.writer.node(
            "LayerNormalization", tokens, gain, shift, axis=-1, epsilon=LAYER_NORM_EPSILON
        )

    def _attention(self, tokens: str, prefix: str) -> str:
        """Multi-head self-attention; the scale 1/8 is folded into the queries' weights."""
        writer, channels = self.writer, self.channels
        kernel = self.weights[f"{prefix}qkv.weight"].copy()
        bias = self.weights[f"{prefix}qkv.bias"].copy()
        kernel[:channels] *= HEAD_CHANNELS**-0.5
        bias[:channels] *= HEAD_CHANNELS**-0.5
        shape = writer.weight("heads_shape", [0, 0, self.heads, HEAD_CHANNELS], np.int64)
        parts = []
        for index, name in enumerate("qkv"):
            rows = slice(index * channels, (index + 1) * channels)
            value = self._affine(tokens, f"{prefix}{name}", kernel[rows], bias[rows])
            perm = [0, 2, 3, 1] if name == "k" else [0, 2, 1, 3]
            parts.append(writer.node("Transpose", writer.node("Reshape", value, shape), perm=perm))
        scores = writer.node("Softmax", writer.node("MatMul", parts[0], parts[1]), axis=-1)
        mixed = writer.node("Transpose", writer.node("MatMul", scores, parts[2]), perm=[0, 2, 1, 3])
        joined = writer.weight("joined_shape", [0, 0, channels], np.int64)
        return self._linear(writer.node("Reshape", mixed, joined), f"{prefix}proj")

    def _linear(self, tokens: str, layer: str) -> str:
        weight, bias = self.weights[f"{layer}.weight"], self.weights[f"{layer}.bias"]
        return self._affine(tokens, layer, weight, bias)

    def _affine(self, tokens: str, name: str, weight: NDArray, bias: NDArray) -> str:
        writer = self.writer
        product = writer.node("MatMul", tokens, writer.weight(f"{name}.weight", weight.T))
        return writer.node("Add", product, writer.weight(f"{name}.bias", bias))

    def _gelu(self, value: str) -> str:
        """x (1 + erf(x / sqrt(2))) / 2: ONNX has no Gelu before opset 20."""
        writer = self.writer
        scaled = writer.node("Mul", value, writer.weight("inverse_sqrt_2", 0.5**0.5))
        gate = writer.node("Add", writer.node("Erf", scaled), writer.weight("one", 1.0))
        half = writer.node("Mul", value, writer.weight("half", 0.5))
        return writer.node("Mul", half, gate)

    def _add_scaled(self, tokens: str, update: str, gamma: str) -> str:
        scaled = self.writer.node("Mul", update, self.writer.weight(gamma, self.weights[gamma]))
        return self.writer.node("Add", tokens, scaled)
