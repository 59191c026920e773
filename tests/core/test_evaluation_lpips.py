"""LPIPS against the reference implementation's graph and published heads."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from safetensors.torch import load_file, save_file

from magic_core.errors import ConfigError, InvalidInput
from magic_core.evaluation import Lpips
from magic_core.evaluation.lpips import WEIGHTS_FILE, WEIGHTS_VARIABLE, find_weights
from tests.core.small_flat import small_frames

SHARED = Path(__file__).resolve().parents[3] / "shared" / "data" / "models" / WEIGHTS_FILE
SHAPES = ((64, 3, 11), (192, 64, 5), (384, 192, 3), (256, 384, 3), (256, 256, 3))


def random_weights(path: Path) -> Path:
    """Weights of the right shapes: the graph is the same whatever they are."""
    generator = torch.Generator().manual_seed(0)
    tensors = {}
    for i, (out, into, k) in enumerate(SHAPES):
        scale = (2.0 / (into * k * k)) ** 0.5
        tensors[f"c.{i}.weight"] = scale * torch.randn((out, into, k, k), generator=generator)
        tensors[f"c.{i}.bias"] = 0.1 * torch.randn(out, generator=generator)
        tensors[f"lin.{i}.weight"] = torch.rand((1, out, 1, 1), generator=generator)
    save_file(tensors, path)
    return path


def reference_metric(path: Path, monkeypatch):
    """torchmetrics' LPIPS module with the weights of a file."""
    module = pytest.importorskip("torchmetrics.functional.image.lpips")
    nn = torch.nn
    weights = load_file(path)
    layers: list[nn.Module] = []
    for i, (out, into, k) in enumerate(SHAPES):
        if i in (1, 2):
            layers.append(nn.MaxPool2d(kernel_size=3, stride=2))
        layers.append(
            nn.Conv2d(into, out, k, stride=4 if i == 0 else 1, padding=(2, 2, 1, 1, 1)[i])
        )
        layers[-1].load_state_dict({p: weights[f"c.{i}.{p}"].float() for p in ("weight", "bias")})
        layers.append(nn.ReLU())
    features = nn.Sequential(*layers)
    monkeypatch.setattr(module, "_get_tv_model_features", lambda *_, **__: features)
    metric = module._LPIPS(pretrained=False, net="alex", use_dropout=False)
    for i, head in enumerate(metric.lins):
        head.model[0].load_state_dict({"weight": weights[f"lin.{i}.weight"].float()})
    return metric.eval()


def image_pair() -> tuple[np.ndarray, np.ndarray]:
    first, second = small_frames(0)[0].colour, small_frames(0)[4].colour
    return cv2.resize(first, (200, 150)), cv2.resize(second, (200, 150))


def assert_agrees(path: Path, monkeypatch) -> None:
    first, second = image_pair()
    a, b = (torch.tensor(i / 127.5 - 1).permute(2, 0, 1)[None].float() for i in (first, second))
    expected = float(reference_metric(path, monkeypatch)(a, b))
    assert expected > 0.01
    assert Lpips(path)(first, second) == pytest.approx(expected, rel=1e-4)


def test_the_graph_is_that_of_torchmetrics(tmp_path, monkeypatch):
    assert_agrees(random_weights(tmp_path / "w.safetensors"), monkeypatch)


def test_the_shared_weights_agree_with_torchmetrics_own_heads(monkeypatch):
    if not SHARED.is_file():
        pytest.skip(f"{SHARED} is not there")
    module = pytest.importorskip("torchmetrics.functional.image.lpips")
    assert_agrees(SHARED, monkeypatch)
    published = torch.load(
        Path(module.__file__).parent / "lpips_models" / "alex.pth",
        map_location="cpu",
        weights_only=True,
    )
    ours = load_file(SHARED)
    for i in range(5):
        heads = published[f"lin{i}.model.1.weight"]
        assert torch.allclose(ours[f"lin.{i}.weight"].float(), heads, rtol=1e-3, atol=1e-6)


def test_equal_images_have_no_distance_and_worse_ones_more(tmp_path):
    metric = Lpips(SHARED if SHARED.is_file() else random_weights(tmp_path / "w.safetensors"))
    real, _ = image_pair()
    assert metric(real, real) == 0.0
    noise = np.random.default_rng(0).normal(0, 1, real.shape)
    slight, strong = (np.clip(real + s * noise, 0, 255).astype(np.uint8) for s in (4, 30))
    assert 0.0 < metric(slight, real) < metric(strong, real)
    assert metric((slight / 255).astype(np.float32), real) == pytest.approx(
        metric(slight, real), abs=1e-5
    )


def test_images_too_small_or_of_different_size_are_said_so(tmp_path):
    metric = Lpips(random_weights(tmp_path / "w.safetensors"))
    assert np.isnan(metric(np.zeros((31, 40, 3), np.uint8), np.zeros((31, 40, 3), np.uint8)))
    assert np.isfinite(metric(np.zeros((32, 40, 3), np.uint8), np.ones((32, 40, 3), np.uint8)))
    with pytest.raises(InvalidInput, match="shape"):
        metric(np.zeros((40, 40, 3), np.uint8), np.zeros((40, 41, 3), np.uint8))


def test_files_that_are_no_weights_are_named(tmp_path):
    junk = tmp_path / "junk.safetensors"
    junk.write_bytes(b"not weights at all")
    with pytest.raises(ConfigError, match=r"junk\.safetensors"):
        Lpips(junk)
    other = tmp_path / "other.safetensors"
    save_file({"c.0.weight": torch.zeros(3)}, other)
    with pytest.raises(ConfigError, match=r"c\.0\.weight is \(3,\)"):
        Lpips(other)


def test_weights_are_found_by_option_then_environment(tmp_path, monkeypatch):
    path = random_weights(tmp_path / "w.safetensors")
    monkeypatch.setenv(WEIGHTS_VARIABLE, str(tmp_path / "absent"))
    assert find_weights(path) == path
    with pytest.raises(ConfigError, match=WEIGHTS_VARIABLE):
        find_weights()
    monkeypatch.setenv(WEIGHTS_VARIABLE, str(path))
    assert find_weights() == path
