"""The CUDA backend against the CPU backend (needs a CUDA machine and the [cuda] extra)."""

import numpy as np
import pytest
import torch

from magic_core.gaussians import GaussianCloud
from magic_core.geometry import Camera, se3
from magic_core.render import GaussianTensors, Rasteriser, render
from magic_core.render.backend import has_cuda, new_optimiser
from magic_core.render.benchmark_scene import benchmark_scene

pytestmark = pytest.mark.gpu


def test_optimiser_on_cuda_lowers_the_loss_like_the_fused_one():
    if not has_cuda():
        pytest.skip("no CUDA device with gsplat")
    cloud, camera = benchmark_scene(160, 120, 3000)
    view = Rasteriser().render(cloud, camera, np.eye(4))
    colour, depth = (np.clip(view.colour, 0, 1) * 255).astype(np.uint8), view.expected_depth
    grey = GaussianCloud(*cloud.arrays()[:4], np.full_like(cloud.colours, 0.5))
    losses = []
    for device in ("cpu", "cuda"):
        optimiser = new_optimiser(grey, device=device)
        losses.append([optimiser.step(camera, np.eye(4), colour, depth).loss for _ in range(50)])
    np.testing.assert_allclose(losses[1], losses[0], rtol=0.05)


def test_cuda_agrees_with_the_cpu_in_image_and_gradients():
    if not torch.cuda.is_available():
        pytest.skip("no CUDA device")
    pytest.importorskip("gsplat")
    rng = np.random.default_rng(0)
    n, camera = 2000, Camera(160, 120, 140.0, 140.0, 79.5, 59.5)
    z = rng.uniform(1.0, 4.0, n)
    quaternions = rng.normal(size=(n, 4))
    cloud = GaussianCloud.from_arrays(
        np.column_stack([rng.uniform(-0.5, 0.5, (n, 2)) * z[:, None], z]),
        quaternions / np.linalg.norm(quaternions, axis=1, keepdims=True),
        scales=np.exp(rng.uniform(-4.5, -2.5, (n, 3))),
        # Opaque Gaussians end a ray at slightly different places in the two definitions.
        opacities=rng.uniform(0.05, 0.7, n),
        colours=rng.uniform(0, 1, (n, 3)),
    )
    pose = se3.exp(np.array([0.05, -0.02, 0.03, 0.02, -0.04, 0.01]))
    upstream = torch.tensor(rng.normal(size=(120, 160, 3)), dtype=torch.float32)
    images, gradients = [], []
    for device in ("cpu", "cuda"):
        gaussians = GaussianTensors.from_cloud(cloud, device=device).requires_grad_()
        tangent = torch.zeros(6, device=device, requires_grad=True)
        out = render(gaussians, camera, pose, tangent=tangent)
        ((out.colour * upstream.to(device)).sum() + out.depth.sum()).backward()
        images.append(torch.cat([out.colour, out.depth[..., None], out.alpha[..., None]], -1))
        found = [t.grad for t in (*gaussians.tensors(), tangent)]
        gradients.append([g.cpu().numpy() for g in found if g is not None])
    difference = (images[0].detach() - images[1].detach().cpu()).abs()
    assert float(difference.mean()) < 1e-4
    assert float(difference.quantile(0.999)) < 5e-3
    for cpu, cuda in zip(*gradients, strict=True):
        assert np.linalg.norm(cpu - cuda) < 0.02 * np.linalg.norm(cpu)
