"""LPIPS: how different two images look, measured in the features of AlexNet.

Zhang et al., "The Unreasonable Effectiveness of Deep Features as a Perceptual Metric" (CVPR 2018),
the variant `alex`, version 0.1. Weights come from a safetensors file with the convolutions `c.0` to
`c.4` and the linear heads `lin.0` to `lin.4`; nothing is downloaded.
"""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import torch
import torch.nn.functional as functional
from numpy.typing import NDArray
from safetensors import SafetensorError
from safetensors.torch import load_file

from magic_core.errors import ConfigError, InvalidInput

WEIGHTS_VARIABLE = "MAGIC_LPIPS_WEIGHTS"
WEIGHTS_FILE = "lpips_alexnet_fp16.safetensors"
MIN_SIDE = 32  # below this the deepest features have no pixel left

# (out, in, kernel, stride, padding) of each convolution; pooling precedes the second and third.
_LAYERS = ((64, 3, 11, 4, 2), (192, 64, 5, 1, 2), (384, 192, 3, 1, 1),
           (256, 384, 3, 1, 1), (256, 256, 3, 1, 1))  # fmt: skip
_POOLED_BEFORE = (1, 2)
_SHIFT = (-0.030, -0.088, -0.188)
_SCALE = (0.458, 0.448, 0.450)
_TINY = 1e-8


class Lpips:
    """The metric with its weights loaded; call it with two images."""

    def __init__(self, weights: Path | str) -> None:
        """Load the weights. ConfigError where the file is missing or is not what it should be."""
        self.weights = Path(weights)
        tensors = _load(self.weights)
        self._convolutions = [
            (tensors[f"c.{i}.weight"], tensors[f"c.{i}.bias"]) for i in range(len(_LAYERS))
        ]
        self._heads = [tensors[f"lin.{i}.weight"] for i in range(len(_LAYERS))]
        self._shift = torch.tensor(_SHIFT)[None, :, None, None]
        self._scale = torch.tensor(_SCALE)[None, :, None, None]

    def __call__(
        self, rendered: NDArray[np.uint8] | NDArray[np.float32], reference: NDArray
    ) -> float:
        """Distance of two (h, w, 3) RGB images, uint8 or float 0 to 1; 0 = equal, about 1 = unlike.

        NaN for images with a side below 32 pixels, on which AlexNet has nothing to say.
        """
        if rendered.shape != reference.shape:
            message = f"shape {rendered.shape} against {reference.shape}"
            raise InvalidInput.field("rendered", message)
        if min(rendered.shape[:2]) < MIN_SIDE:
            return float("nan")
        with torch.inference_mode():
            pair = torch.cat([_tensor(rendered), _tensor(reference)])
            features = self._features((pair - self._shift) / self._scale)
            parts = [
                functional.conv2d((_unit(layer[:1]) - _unit(layer[1:])) ** 2, head).mean()
                for layer, head in zip(features, self._heads, strict=True)
            ]
        return float(sum(parts))

    def _features(self, images: torch.Tensor) -> list[torch.Tensor]:
        """The five rectified layers of AlexNet for images (n, 3, h, w)."""
        layers = []
        for i, (weight, bias) in enumerate(self._convolutions):
            if i in _POOLED_BEFORE:
                images = functional.max_pool2d(images, kernel_size=3, stride=2)
            _, _, _, stride, padding = _LAYERS[i]
            images = functional.conv2d(images, weight, bias, stride=stride, padding=padding).relu()
            layers.append(images)
        return layers


def find_weights(given: Path | str | None = None) -> Path | None:
    """The weights' file: as given, else named by MAGIC_LPIPS_WEIGHTS, else in one of the places
    where it usually lies (MAGIC_CACHE_DIR, `shared/data/models` beside the project); or None.

    ConfigError where a file that was named does not exist.
    """
    environment = os.environ.get(WEIGHTS_VARIABLE)
    for field, named in (("lpips_weights", given), (WEIGHTS_VARIABLE, environment)):
        if named:
            path = Path(named).expanduser()
            if not path.is_file():
                raise ConfigError.field(field, f"{path}: no such file")
            return path
    project = Path(__file__).resolve().parents[2]
    places = [project.parent / "shared", project / "shared", Path.cwd().parent / "shared"]
    usual = [place / "data" / "models" / WEIGHTS_FILE for place in places]
    if cache := os.environ.get("MAGIC_CACHE_DIR"):
        usual.insert(0, Path(cache).expanduser() / WEIGHTS_FILE)
    return next((path for path in usual if path.is_file()), None)


def _load(path: Path) -> dict[str, torch.Tensor]:
    expected = {f"c.{i}.weight": (o, n, k, k) for i, (o, n, k, _, _) in enumerate(_LAYERS)}
    expected |= {f"c.{i}.bias": (o,) for i, (o, *_) in enumerate(_LAYERS)}
    expected |= {f"lin.{i}.weight": (1, o, 1, 1) for i, (o, *_) in enumerate(_LAYERS)}
    try:
        tensors = load_file(path)
    except (OSError, SafetensorError) as error:
        raise ConfigError.field("lpips_weights", f"{path}: not readable ({error})") from error
    for name, shape in expected.items():
        found = tuple(tensors[name].shape) if name in tensors else None
        if found != shape:
            text = f"{path}: {name} is {found}, expected {shape} of AlexNet's LPIPS weights"
            raise ConfigError.field("lpips_weights", text)
    return {name: tensors[name].float() for name in expected}


def _tensor(image: NDArray) -> torch.Tensor:
    """(1, 3, h, w), -1 to 1."""
    values = np.asarray(image, np.float32) / (255.0 if image.dtype == np.uint8 else 1.0)
    values = np.clip(values, 0.0, 1.0) * 2.0 - 1.0
    return torch.from_numpy(np.ascontiguousarray(values.transpose(2, 0, 1)))[None]


def _unit(features: torch.Tensor) -> torch.Tensor:
    """Features (n, c, h, w) with unit length over the channels."""
    return features / (features.square().sum(dim=1, keepdim=True) + _TINY).sqrt()
