"""What an encoder wants its input image to look like, and what to make of its output."""

from __future__ import annotations

import json
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any, Literal

import cv2
import numpy as np
import yaml
from numpy.typing import NDArray

from magic_core.errors import ConfigError

SIDECAR_SUFFIXES = (".yaml", ".yml", ".json")


@dataclass(frozen=True, slots=True)
class Preprocessing:
    """Image in, tensor out; read from a sidecar file beside the ONNX file.

    The input tensor is (RGB / `pixel_divisor` - mean) / std, float32 (1, 3, height, width).
    """

    height: int = 224
    """Input height in pixels; the whole image is resized, its aspect is not kept."""
    width: int = 224
    """Input width in pixels."""
    mean: tuple[float, float, float] = (0.485, 0.456, 0.406)
    """Subtracted per channel R, G, B, after the division by `pixel_divisor`."""
    std: tuple[float, float, float] = (0.229, 0.224, 0.225)
    """Divisor per channel R, G, B."""
    pixel_divisor: float = 255.0
    """255 where the statistics are for pixels in 0 to 1, 1 where they are for 0 to 255."""
    pooling: Literal["none", "mean", "first"] = "none"
    """Of an output (1, tokens, d): the mean of all tokens, or the first one (CLS)."""
    output: str = ""
    """Name of the output to use; empty means the first."""
    name: str = ""
    """Name in the model id; empty means the file's stem."""

    def __post_init__(self) -> None:
        if min(self.height, self.width) < 8 or max(self.height, self.width) > 4096:
            size = f"{self.height}x{self.width}"
            raise ConfigError.field("preprocessing.height", f"{size}: expected 8 to 4096 pixels")
        if len(self.mean) != 3 or len(self.std) != 3 or min(self.std) <= 0:
            raise ConfigError.field("preprocessing.std", "mean and std are three numbers, std > 0")
        if self.pixel_divisor <= 0:
            raise ConfigError.field("preprocessing.pixel_divisor", "must be > 0")
        if self.pooling not in ("none", "mean", "first"):
            raise ConfigError.field(
                "preprocessing.pooling", f"{self.pooling!r}: expected none, mean or first"
            )

    def apply(self, colour: NDArray[np.uint8]) -> NDArray[np.float32]:
        """The (1, 3, height, width) input tensor of an RGB image (h, w, 3)."""
        shrinks = colour.shape[0] > self.height or colour.shape[1] > self.width
        resized = cv2.resize(
            np.ascontiguousarray(colour),
            (self.width, self.height),
            interpolation=cv2.INTER_AREA if shrinks else cv2.INTER_LINEAR,
        )
        mean = np.asarray(self.mean, dtype=np.float32)
        std = np.asarray(self.std, dtype=np.float32)
        tensor = (resized.astype(np.float32) / np.float32(self.pixel_divisor) - mean) / std
        return np.ascontiguousarray(tensor.transpose(2, 0, 1)[None])

    def pool(self, output: NDArray) -> NDArray[np.float32]:
        """The unit vector (d,) of the encoder's output (1, d) or (1, tokens, d)."""
        output = np.asarray(output, dtype=np.float32)
        if output.ndim == 3 and self.pooling == "mean":
            output = output.mean(axis=1)
        elif output.ndim == 3 and self.pooling == "first":
            output = output[:, 0]
        vector = np.asarray(output.reshape(-1), dtype=np.float32)
        norm = float(np.linalg.norm(vector))
        return (vector / norm).astype(np.float32) if norm > 0 else vector


def read_sidecar(model_path: Path) -> Preprocessing | None:
    """The preprocessing that stands beside an ONNX file (same stem, .yaml or .json), if any."""
    for suffix in SIDECAR_SUFFIXES:
        path = model_path.with_suffix(suffix)
        if path.is_file():
            text = path.read_text(encoding="utf-8")
            content = json.loads(text) if suffix == ".json" else yaml.safe_load(text)
            return _from_mapping(content, path)
    return None


def _from_mapping(content: Any, path: Path) -> Preprocessing:
    known = {field.name for field in fields(Preprocessing)}
    if not isinstance(content, dict) or not set(content) <= known:
        unknown = sorted(set(content) - known) if isinstance(content, dict) else content
        raise ConfigError.field(str(path), f"unknown settings {unknown}, expected {sorted(known)}")
    for name in ("mean", "std"):
        if name in content:
            content[name] = tuple(float(value) for value in content[name])
    return Preprocessing(**content)
