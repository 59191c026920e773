"""Image encoders: the converted default against a reference, DINOv2 against torch, sidecars."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import onnxruntime
import pytest
import torch

from magic_agent.places import Preprocessing, load_descriptor_model
from magic_agent.places import dinov2 as dinov2_encoder
from magic_agent.places.efficientnet_lite import PREPROCESSING
from magic_core.errors import ConfigError, InvalidInput, NotFound

DATA = Path(__file__).resolve().parents[2].parent / "shared" / "data"
REFERENCE = DATA / "models" / "efficientnet_lite0_gap1280.onnx"


@pytest.fixture(scope="module")
def cache(tmp_path_factory):
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("MAGIC_CACHE_DIR", str(tmp_path_factory.mktemp("cache")))
        yield


@pytest.fixture(scope="module")
def default_model(cache):
    return load_descriptor_model()


def picture(seed: int, height: int = 120, width: int = 160) -> np.ndarray:
    coarse = np.random.default_rng(seed).integers(0, 256, (6, 8, 3)).astype(np.float32)
    grown = torch.nn.functional.interpolate(
        torch.as_tensor(coarse).permute(2, 0, 1)[None], (height, width), mode="bicubic"
    )
    return grown[0].permute(1, 2, 0).clamp(0, 255).numpy().astype(np.uint8)


@pytest.mark.skipif(not REFERENCE.is_file(), reason=f"{REFERENCE} is absent")
def test_default_encoder_agrees_with_the_reference_conversion(default_model):
    session = onnxruntime.InferenceSession(str(REFERENCE))
    for seed in range(3):
        image = picture(seed)
        expected = session.run(None, {"image": PREPROCESSING.apply(image)})[0][0]
        expected /= np.linalg.norm(expected)
        found = default_model.describe(image).vector
        # Measured 2e-7: the same weights, batch norm folded in another order.
        np.testing.assert_allclose(found, expected, atol=1e-5)


def test_default_descriptors_are_unit_and_tell_images_apart(default_model):
    first, second = (default_model.describe(picture(seed)) for seed in (1, 2))
    again = default_model.describe(picture(1))
    assert first.model_id == default_model.model_id
    assert first.vector.shape == (default_model.dimension,) == (1280,)
    assert first.vector.dtype == np.float32
    assert np.linalg.norm(first.vector) == pytest.approx(1.0, abs=1e-5)
    np.testing.assert_array_equal(first.vector, again.vector)
    assert float(first.vector @ second.vector) < 0.99


def test_conversion_happens_once(default_model, cache, monkeypatch):
    def fail(*_: object) -> None:
        raise AssertionError("converted twice")

    monkeypatch.setattr("magic_agent.places.efficientnet_lite.convert", fail)
    assert load_descriptor_model().model_id == default_model.model_id


def test_describe_refuses_what_is_no_colour_image(default_model):
    with pytest.raises(InvalidInput):
        default_model.describe(np.zeros((10, 10), np.uint8))


def test_unknown_model_is_not_found():
    with pytest.raises(NotFound, match="no_such_model"):
        load_descriptor_model("no_such_model.onnx")


def dinov2_weights(channels: int = 128, blocks: int = 2, patch: int = 14, side: int = 5) -> dict:
    """Random weights under the names and shapes of the official files, small."""
    generator = torch.Generator().manual_seed(0)

    def normal(*shape: int, spread: float = 0.05) -> torch.Tensor:
        return torch.randn(*shape, generator=generator) * spread

    state = {
        "cls_token": normal(1, 1, channels),
        "mask_token": normal(1, channels),
        "pos_embed": normal(1, 1 + side * side, channels),
        "patch_embed.proj.weight": normal(channels, 3, patch, patch),
        "patch_embed.proj.bias": normal(channels),
        "norm.weight": 1 + normal(channels),
        "norm.bias": normal(channels),
    }
    for block in range(blocks):
        sizes = {
            "attn.qkv": (3 * channels, channels),
            "attn.proj": (channels, channels),
            "mlp.fc1": (4 * channels, channels),
            "mlp.fc2": (channels, 4 * channels),
        }
        for name, (rows, columns) in sizes.items():
            state[f"blocks.{block}.{name}.weight"] = normal(rows, columns)
            state[f"blocks.{block}.{name}.bias"] = normal(rows)
        for name in ("norm1", "norm2"):
            state[f"blocks.{block}.{name}.weight"] = 1 + normal(channels)
            state[f"blocks.{block}.{name}.bias"] = normal(channels)
        for name in ("ls1", "ls2"):
            state[f"blocks.{block}.{name}.gamma"] = normal(channels, spread=0.5)
    return state


def dinov2_in_torch(state: dict, image: torch.Tensor) -> torch.Tensor:
    """Mean of the normalised tokens, written from the paper's equations (b, 3, h, w) -> (b, d)."""
    functional = torch.nn.functional
    channels = state["cls_token"].shape[-1]
    heads = channels // 64
    patches = functional.conv2d(
        image, state["patch_embed.proj.weight"], state["patch_embed.proj.bias"], stride=14
    )
    grid = patches.shape[2:]
    patches = patches.flatten(2).transpose(1, 2)
    tokens = torch.cat([state["cls_token"].expand(len(image), -1, -1), patches], dim=1)
    positions = dinov2_encoder.resized_positions(state["pos_embed"].numpy(), tuple(grid))
    tokens = tokens + torch.as_tensor(positions)

    def norm(value: torch.Tensor, name: str) -> torch.Tensor:
        return functional.layer_norm(
            value, (channels,), state[f"{name}.weight"], state[f"{name}.bias"], eps=1e-6
        )

    def linear(value: torch.Tensor, name: str) -> torch.Tensor:
        return functional.linear(value, state[f"{name}.weight"], state[f"{name}.bias"])

    for block in range(2):
        at = f"blocks.{block}."
        qkv = linear(norm(tokens, f"{at}norm1"), f"{at}attn.qkv")
        query, key, value = qkv.unflatten(-1, (3, heads, 64)).permute(2, 0, 3, 1, 4)
        mixed = functional.scaled_dot_product_attention(query, key, value)
        mixed = mixed.transpose(1, 2).flatten(2)
        tokens = tokens + state[f"{at}ls1.gamma"] * linear(mixed, f"{at}attn.proj")
        hidden = functional.gelu(linear(norm(tokens, f"{at}norm2"), f"{at}mlp.fc1"))
        tokens = tokens + state[f"{at}ls2.gamma"] * linear(hidden, f"{at}mlp.fc2")
    return norm(tokens, "norm").mean(dim=1)


def test_dinov2_graph_agrees_with_torch(tmp_path, cache):
    state = dinov2_weights()
    path = tmp_path / "dinov2_tiny_pretrain.pth"
    torch.save(state, path)
    model = load_descriptor_model(str(path))
    image = picture(3)
    tensor = torch.as_tensor(Preprocessing(pooling="mean").apply(image))
    expected = dinov2_in_torch(state, tensor)[0]
    found = model.describe(image)
    assert model.dimension == 128
    assert found.model_id.startswith("dinov2_tiny_pretrain-")
    np.testing.assert_allclose(found.vector, expected / expected.norm(), atol=1e-4)
    np.testing.assert_array_equal(found.vector, model.describe(image).vector)


def test_dinov2_graph_takes_batches(tmp_path):
    state = dinov2_weights()
    path = tmp_path / "tiny.onnx"
    weights = {name: tensor.numpy() for name, tensor in state.items()}
    dinov2_encoder.write_graph(weights, path, image_size=(70, 84))
    images = torch.randn(3, 3, 70, 84, generator=torch.Generator().manual_seed(1))
    session = onnxruntime.InferenceSession(str(path))
    (found,) = session.run(None, {"image": images.numpy()})
    np.testing.assert_allclose(found, dinov2_in_torch(state, images), atol=1e-4)


def test_dinov2_refuses_sizes_that_patches_do_not_tile(tmp_path):
    weights = {name: tensor.numpy() for name, tensor in dinov2_weights().items()}
    with pytest.raises(ConfigError, match="14"):
        dinov2_encoder.write_graph(weights, tmp_path / "x.onnx", image_size=(70, 80))


def token_encoder(path: Path) -> None:
    """An encoder of another make: patches as tokens, (b, tokens, 8)."""
    from magic_agent.places.onnx_graph import GraphWriter

    writer = GraphWriter("tokens")
    kernel = np.random.default_rng(0).normal(size=(8, 3, 16, 16))
    patches = writer.node("Conv", "image", writer.weight("k", kernel), strides=[16, 16])
    shape = writer.weight("shape", [0, 8, -1], np.int64)
    tokens = writer.node("Transpose", writer.node("Reshape", patches, shape), perm=[0, 2, 1])
    writer.save(path, image_size=(32, 48), output=writer.node("Flatten", tokens), dimension=48)


def test_any_onnx_encoder_runs_with_its_sidecar(tmp_path):
    path = tmp_path / "mine.onnx"
    token_encoder(path)
    with pytest.raises(ConfigError, match=r"mine\.yaml"):
        load_descriptor_model(str(path))
    (tmp_path / "mine.yaml").write_text("height: 32\nwidth: 48\nname: patches\n")
    model = load_descriptor_model(str(path))
    assert model.model_id.startswith("patches-")
    assert np.linalg.norm(model.describe(picture(4)).vector) == pytest.approx(1.0, abs=1e-5)


def test_sidecar_with_unknown_setting_is_refused(tmp_path):
    path = tmp_path / "mine.onnx"
    token_encoder(path)
    (tmp_path / "mine.json").write_text('{"heigth": 32}')
    with pytest.raises(ConfigError, match="heigth"):
        load_descriptor_model(str(path))


@pytest.mark.parametrize(("pooling", "expected"), [("mean", [0.6, 0.8]), ("first", [1.0, 0.0])])
def test_pooling_of_tokens(pooling, expected):
    tokens = np.array([[[3.0, 0.0], [0.0, 4.0]]], dtype=np.float32)
    np.testing.assert_allclose(Preprocessing(pooling=pooling).pool(tokens), expected, atol=1e-6)
