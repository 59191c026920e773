"""`render` with its backends: the reference by gradcheck, the kernels against the reference."""

import importlib.util

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from magic_core.errors import InvalidInput, NotSupported
from magic_core.gaussians import GaussianCloud
from magic_core.geometry import Camera, se3
from magic_core.render import GaussianTensors, Rasteriser, render
from magic_core.render.reference import render_reference

NAMES = ("means", "quaternions", "scales", "opacities", "colours")


def cloud_before(camera, n, seed, world_from_camera=None, smallest=-4.5):
    """Random Gaussians in and around the view; one in ten is degenerate (very flat or long)."""
    rng = np.random.default_rng(seed)
    z = rng.uniform(0.5, 4.0, n)
    x = (rng.uniform(-0.3, 1.3, n) * camera.width - camera.cx) / camera.fx * z
    y = (rng.uniform(-0.3, 1.3, n) * camera.height - camera.cy) / camera.fy * z
    scales = np.exp(rng.uniform(smallest, -1.5, (n, 3)))
    scales[::10, 0] = 1e-4
    quaternions = rng.normal(size=(n, 4))
    cloud = GaussianCloud.from_arrays(
        np.column_stack([x, y, z]),
        quaternions / np.linalg.norm(quaternions, axis=1, keepdims=True),
        scales=scales,
        opacities=rng.uniform(0.02, 0.98, n),
        colours=rng.uniform(0, 1, (n, 3)),
    )
    return cloud if world_from_camera is None else cloud.transformed(world_from_camera)


def gradients_of(backend, cloud, camera, world_from_camera, upstream):
    """Image and gradients (five parameters, tangent) of sum(upstream * image) in one backend."""
    dtype = torch.float64 if backend == "reference" else torch.float32
    gaussians = GaussianTensors.from_cloud(cloud, dtype=dtype).requires_grad_()
    tangent = torch.zeros(6, dtype=torch.float64, requires_grad=True)
    out = render(gaussians, camera, world_from_camera, backend, tangent=tangent)
    image = torch.cat([out.colour.permute(2, 0, 1), out.depth[None], out.alpha[None]])
    (image * torch.tensor(upstream, dtype=dtype)).sum().backward()
    grads = [t.grad.numpy() for t in (*gaussians.tensors(), tangent) if t.grad is not None]
    assert len(grads) == 6
    return image.detach().numpy(), grads, out


def relative(found, expected):
    return np.linalg.norm(found - expected) / max(np.linalg.norm(expected), 1e-9)


@settings(max_examples=20, deadline=None, derandomize=True)
@given(
    width=st.integers(1, 45),
    height=st.integers(1, 35),
    n=st.integers(0, 70),
    focal=st.floats(15.0, 90.0),
    tangent=st.tuples(*[st.floats(-3.0, 3.0)] * 6),
    seed=st.integers(0, 10_000),
)
def test_kernels_agree_with_the_float64_reference(width, height, n, focal, tangent, seed):
    camera = Camera(width, height, focal, 1.1 * focal, 0.45 * width, 0.55 * height)
    world_from_camera = se3.exp(np.array(tangent))
    cloud = cloud_before(camera, n, seed, world_from_camera)
    upstream = np.random.default_rng(seed).normal(size=(5, height, width))
    found, gradients, out = gradients_of("cpu", cloud, camera, world_from_camera, upstream)
    expected, reference, ref = gradients_of("reference", cloud, camera, world_from_camera, upstream)
    np.testing.assert_allclose(found, expected, atol=1e-4)
    assert (out.visible != ref.visible).sum() <= 1  # one on the threshold
    for name, a, b in zip((*NAMES, "pose"), gradients, reference, strict=True):
        scale = 1e-3 * np.linalg.norm(b) + 1e-4
        assert np.linalg.norm(a - b) <= scale, f"{name}: {relative(a, b):.2e}"


def test_a_dense_scene_agrees_with_the_reference():
    camera = Camera(48, 36, 45.0, 45.0, 23.5, 17.5)
    cloud = cloud_before(camera, 900, 7, smallest=-5.0)
    upstream = np.random.default_rng(0).normal(size=(5, 36, 48))
    found, gradients, _ = gradients_of("cpu", cloud, camera, np.eye(4), upstream)
    expected, reference, _ = gradients_of("reference", cloud, camera, np.eye(4), upstream)
    np.testing.assert_allclose(found, expected, atol=1e-4)
    for name, a, b in zip((*NAMES, "pose"), gradients, reference, strict=True):
        assert relative(a, b) < 1e-3, name


def test_a_flat_wall_of_equal_depths_blends_in_the_reference_s_order():
    camera = Camera(40, 30, 36.0, 36.0, 19.5, 14.5)
    cloud = cloud_before(camera, 600, 11)
    cloud.means[:, :2] *= 2.0 / cloud.means[:, 2:]
    cloud.means[:, 2] = 2.0
    upstream = np.random.default_rng(0).normal(size=(5, 30, 40))
    found, gradients, _ = gradients_of("cpu", cloud, camera, np.eye(4), upstream)
    expected, reference, _ = gradients_of("reference", cloud, camera, np.eye(4), upstream)
    np.testing.assert_allclose(found, expected, atol=1e-4)
    for name, a, b in zip((*NAMES, "pose"), gradients, reference, strict=True):
        assert relative(a, b) < 1e-3, name


def test_the_reference_passes_gradcheck():
    camera = Camera(6, 5, 7.0, 7.0, 2.5, 2.0)
    cloud = cloud_before(camera, 6, 3, smallest=-2.5)
    inputs = GaussianTensors.from_cloud(cloud, dtype=torch.float64).requires_grad_().tensors()
    tangent = torch.tensor([0.01, -0.02, 0.03, 0.02, 0.01, -0.03]).double().requires_grad_()

    def image(*parameters):
        gaussians = GaussianTensors(*parameters[:5])
        out = render(gaussians, camera, np.eye(4), "reference", tangent=parameters[5])
        return out.colour, out.depth, out.alpha

    assert torch.autograd.gradcheck(image, (*inputs, tangent), eps=1e-6, fast_mode=True)


def test_pose_gradient_agrees_with_finite_differences_of_the_kernels():
    # Each Gaussian covers the whole image: where alpha is cut off at 1/255 the image jumps, and
    # finite differences would see those jumps, which no gradient has (some 3 % with small ones).
    camera = Camera(64, 64, 60.0, 60.0, 31.5, 31.5)
    world_from_camera = se3.exp(np.array([0.3, -0.2, 0.1, 0.4, -0.3, 0.2]))
    rng = np.random.default_rng(5)
    z = np.linspace(1.5, 2.5, 8)
    points = np.column_stack([rng.uniform(-0.15, 0.15, (8, 2)) * z[:, None], z])
    quaternions = rng.normal(size=(8, 4))
    cloud = GaussianCloud.from_arrays(
        points,
        quaternions / np.linalg.norm(quaternions, axis=1, keepdims=True),
        scales=rng.uniform(0.8, 1.6, (8, 3)),
        opacities=rng.uniform(0.1, 0.3, 8),
        colours=rng.uniform(0, 1, (8, 3)),
    ).transformed(world_from_camera)
    y, x = np.mgrid[0:64, 0:64] / 64.0
    upstream = np.stack([x, y, x * y, x - y, 1 - x], dtype=np.float32, casting="same_kind")
    rasteriser = Rasteriser(1)

    def loss(xi):
        view = rasteriser.render(cloud, camera, world_from_camera @ se3.exp(xi))
        return float((view.image.astype(np.float64) * upstream).sum())

    loss(np.zeros(6))
    gradient = rasteriser.backward(upstream).pose
    numeric = [(loss(2e-3 * e) - loss(-2e-3 * e)) / 4e-3 for e in np.eye(6)]
    np.testing.assert_allclose(gradient, numeric, atol=2e-3 * np.abs(numeric).max())


def test_pose_gradient_reaches_a_matrix_and_a_nonzero_tangent():
    camera = Camera(30, 20, 25.0, 25.0, 14.5, 9.5)
    cloud = cloud_before(camera, 50, 1, smallest=-2.5)
    base = torch.tensor(se3.exp(np.array([0.1, 0, 0, 0.0, 0.1, 0])), requires_grad=True)
    results = {}
    for backend in ("cpu", "reference"):
        dtype = torch.float64 if backend == "reference" else torch.float32
        tangent = torch.tensor([0.02, 0.1, -0.1, 0.3, -0.2, 0.1]).double().requires_grad_()
        gaussians = GaussianTensors.from_cloud(cloud, dtype=dtype)
        out = render(gaussians, camera, base, backend, tangent=tangent)
        (out.colour.sum() + out.depth.square().sum()).backward()
        results[backend] = tangent.grad
    np.testing.assert_allclose(results["cpu"], results["reference"], rtol=2e-3, atol=1e-2)
    assert base.grad is not None
    assert base.grad.abs().sum() > 0


def test_two_graphs_at_once_keep_their_own_buffers():
    camera = Camera(40, 30, 30.0, 30.0, 19.5, 14.5)
    clouds = [cloud_before(camera, n, n) for n in (40, 90)]
    upstream = np.ones((5, 30, 40))
    alone = [gradients_of("cpu", c, camera, np.eye(4), upstream)[1] for c in clouds]
    tensors = [GaussianTensors.from_cloud(c).requires_grad_() for c in clouds]
    outs = [render(t, camera, np.eye(4), threads=1) for t in tensors]
    for out in reversed(outs):
        (out.colour.sum() + out.depth.sum() + out.alpha.sum()).backward()
    for one, gaussians in zip(alone, tensors, strict=True):
        np.testing.assert_array_equal(one[0], gaussians.means.grad)


def test_auto_takes_the_cpu_for_cpu_tensors_and_clouds():
    camera = Camera(20, 20, 20.0, 20.0, 9.5, 9.5)
    cloud = cloud_before(camera, 30, 2)
    auto, cpu = render(cloud, camera, np.eye(4)), render(cloud, camera, np.eye(4), "cpu")
    assert torch.equal(auto.colour, cpu.colour)
    reference = render(cloud, camera, np.eye(4), "reference")  # float32 like its input
    np.testing.assert_allclose(auto.colour, reference.colour, atol=1e-4)
    assert auto.radii[auto.visible].min() > 0


def test_wrong_backends_are_refused_with_a_remedy():
    camera = Camera(20, 20, 20.0, 20.0, 9.5, 9.5)
    with pytest.raises(InvalidInput, match="opengl"):
        render(GaussianCloud.empty(), camera, np.eye(4), "opengl")  # pyright: ignore
    if importlib.util.find_spec("gsplat") is None:
        with pytest.raises(NotSupported, match="cuda"):
            render(GaussianCloud.empty(), camera, np.eye(4), "cuda")


def test_the_reference_leaves_out_what_is_not_finite():
    camera = Camera(20, 20, 20.0, 20.0, 9.5, 9.5)
    cloud = cloud_before(camera, 10, 4)
    cloud.scales[3, 1] = np.nan
    tensors = GaussianTensors.from_cloud(cloud, dtype=torch.float64).tensors()
    image, visible, _ = render_reference(tensors, camera, torch.eye(4, dtype=torch.float64))
    assert torch.isfinite(image).all()
    assert not visible[3]
