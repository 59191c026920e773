"""The optimiser for torch devices against the fused one, here on the CPU device."""

import numpy as np
import pytest
import torch

from magic_core.errors import InvalidInput, NotSupported
from magic_core.gaussians import GaussianCloud
from magic_core.geometry import Camera
from magic_core.render import GaussianOptimiser, LossWeights, Rasteriser, device_benchmark
from magic_core.render.backend import has_cuda, new_optimiser
from magic_core.render.torch_optimiser import TorchOptimiser

torch.set_num_threads(1)  # of such small tensors, more only wait for each other
CAMERA = Camera(width=45, height=34, fx=40.0, fy=40.0, cx=22.0, cy=16.5)


def wall(n=300, seed=0, spread=0.6):
    rng = np.random.default_rng(seed)
    z = rng.uniform(1.5, 1.7, n)
    quaternions = rng.normal(size=(n, 4))
    return GaussianCloud.from_arrays(
        np.column_stack([rng.uniform(-spread, spread, (n, 2)) * z[:, None], z]),
        quaternions / np.linalg.norm(quaternions, axis=1, keepdims=True),
        scales=rng.uniform(0.03, 0.09, (n, 3)),
        opacities=rng.uniform(0.5, 0.9, n),
        colours=rng.uniform(0, 1, (n, 3)),
    )


def observed():
    view = Rasteriser(1).render(wall(seed=5), CAMERA, np.eye(4))
    depth = view.expected_depth.copy()
    depth[np.random.default_rng(3).uniform(size=depth.shape) < 0.2] = 0.0
    return (np.clip(view.colour, 0, 1) * 255).round().astype(np.uint8), depth


def rows(cloud):
    return np.column_stack([a.reshape(len(cloud), -1) for a in cloud.arrays()])


@pytest.mark.parametrize("weighted", [False, True])
def test_follows_the_fused_optimiser_step_by_step(weighted):
    colour, depth = observed()
    weight = np.random.default_rng(1).uniform(0, 2, depth.shape).astype(np.float32)
    start, weights = wall(spread=1.5), LossWeights(ssim=0.2, depth=0.7, scale=0.3)
    fused = GaussianOptimiser(start, weights=weights, threads=1)
    ours = TorchOptimiser(start, weights=weights, device="cpu")
    for _ in range(4):
        a = fused.step(CAMERA, np.eye(4), colour, depth, weight=weight if weighted else None)
        b = ours.step(CAMERA, np.eye(4), colour, depth, weight=weight if weighted else None)
        reports = [(r.loss, r.colour_l1, r.ssim, r.depth_l1) for r in (a, b)]
        np.testing.assert_allclose(*reports, rtol=1e-3)
    # Adam divides by the gradient's size, so the few gradients near zero may step either way.
    moved = np.abs(rows(fused.gaussians()) - rows(start))
    apart = np.abs(rows(fused.gaussians()) - rows(ours.gaussians()))
    assert np.quantile(apart, 0.98) < 0.02 * np.quantile(moved, 0.98)
    unseen = moved.max(axis=1) == 0.0
    assert unseen.any()
    np.testing.assert_allclose(rows(ours.gaussians())[unseen], rows(start)[unseen], atol=1e-6)


def test_a_hundred_steps_bring_the_cloud_to_the_image():
    colour, depth = observed()
    ours = TorchOptimiser(wall(), device="cpu")
    losses = [ours.step(CAMERA, np.eye(4), colour, depth).loss for _ in range(100)]
    assert losses[-1] < 0.5 * losses[0]


def test_extend_and_prune_keep_the_rest_and_leave_out_what_is_not_finite():
    ours = TorchOptimiser(GaussianCloud.empty(), device="cpu")
    assert len(ours) == 0
    bad = wall(10)
    bad.means[3] = np.nan
    ours.extend(bad)
    assert len(ours) == 9
    keep = np.arange(9) % 2 == 0
    before = rows(ours.gaussians())
    ours.prune(keep)
    np.testing.assert_array_equal(rows(ours.gaussians()), before[keep])
    with pytest.raises(InvalidInput, match=r"keep_mask.*expected \(5,\)"):
        ours.prune(keep)


def test_rendering_agrees_with_the_rasteriser():
    cloud = wall()
    ours = TorchOptimiser(cloud, device="cpu").render(CAMERA, np.eye(4))
    np.testing.assert_allclose(
        ours.image, Rasteriser(1).render(cloud, CAMERA, np.eye(4)).image, atol=1e-5
    )
    assert ours.visible.any()


def test_a_machine_without_cuda_gets_the_fused_optimiser_or_a_remedy():
    if has_cuda():
        pytest.skip("this machine has CUDA")
    assert isinstance(new_optimiser(wall()), GaussianOptimiser)
    with pytest.raises(NotSupported, match=r"magic-slam\[cuda\]"):
        new_optimiser(wall(), device="cuda")
    with pytest.raises(InvalidInput, match="expected auto, cpu or cuda"):
        new_optimiser(wall(), device="tpu")  # pyright: ignore[reportArgumentType]


def test_device_benchmark_times_render_and_iteration():
    result = device_benchmark.run("cpu", cells=[(64, 48, 500)], repeats=2)
    (cell,) = result["cells"]
    assert cell["size"] == "64x48"
    assert cell["forward_backward_ms"] > 0
    assert cell["iteration_ms"] > 0
