"""Mapping iterations: losses and gradients against torch, convergence, extend and prune."""

import numpy as np
import pytest
import torch

from magic_core.errors import InvalidInput
from magic_core.gaussians import GaussianCloud
from magic_core.geometry import Camera
from magic_core.render import GaussianOptimiser, LearningRates, LossWeights, Rasteriser

CAMERA = Camera(width=45, height=34, fx=40.0, fy=40.0, cx=22.0, cy=16.5)


def wall(n=400, seed=0):
    """Gaussians on a bumpy wall that fills the image."""
    rng = np.random.default_rng(seed)
    z = rng.uniform(1.5, 1.7, n)
    xy = rng.uniform(-0.6, 0.6, (n, 2)) * z[:, None]
    quaternions = rng.normal(size=(n, 4))
    return GaussianCloud.from_arrays(
        np.column_stack([xy, z]),
        quaternions / np.linalg.norm(quaternions, axis=1, keepdims=True),
        scales=rng.uniform(0.03, 0.09, (n, 3)),
        opacities=rng.uniform(0.5, 0.9, n),
        colours=rng.uniform(0, 1, (n, 3)),
    )


def observed(seed=5):
    rng = np.random.default_rng(seed)
    view = Rasteriser(1).render(wall(seed=seed), CAMERA, np.eye(4))
    colour = (np.clip(view.colour, 0, 1) * 255).round().astype(np.uint8)
    depth = view.expected_depth.copy()
    depth[rng.uniform(size=depth.shape) < 0.2] = 0.0
    return colour, depth


def torch_losses(image, colour, depth, weight, ssim_share):
    """The same losses in torch, float64; SSIM by an 11 x 11 convolution with zero padding."""
    x = image[:3]
    y = torch.tensor(colour.transpose(2, 0, 1) / 255.0)
    offsets = torch.arange(-5, 6, dtype=torch.float64)
    line = torch.exp(-0.5 * (offsets / 1.5) ** 2)
    window = torch.outer(line / line.sum(), line / line.sum())[None, None].repeat(3, 1, 1, 1)

    def mean(a):
        return torch.nn.functional.conv2d(a[None], window, padding=5, groups=3)[0]

    mu_x, mu_y = mean(x), mean(y)
    a2 = 2 * (mean(x * y) - mu_x * mu_y) + 0.03**2
    b2 = mean(x * x) - mu_x**2 + mean(y * y) - mu_y**2 + 0.03**2
    similarity = (2 * mu_x * mu_y + 0.01**2) * a2 / ((mu_x**2 + mu_y**2 + 0.01**2) * b2)
    l1 = (weight * (x - y).abs()).mean()
    valid = torch.tensor(depth > 0)
    depth_l1 = (weight * (image[3] - image[4] * torch.tensor(depth)).abs())[valid].mean()
    total = (1 - ssim_share) * l1 + ssim_share * (weight * (1 - similarity)).mean() + depth_l1
    return total, l1, (weight * similarity).mean(), depth_l1


@pytest.mark.parametrize("weighted", [False, True])
def test_image_losses_and_their_gradient_agree_with_torch(weighted):
    colour, depth = observed()
    weight = np.random.default_rng(1).uniform(0, 2, depth.shape).astype(np.float32)
    optimiser = GaussianOptimiser(wall(), weights=LossWeights(scale=0.0), threads=2)
    report = optimiser.step(CAMERA, np.eye(4), colour, depth, weight=weight if weighted else None)
    rendered = Rasteriser(1).render(wall(), CAMERA, np.eye(4)).image
    image = torch.tensor(rendered.astype(np.float64), requires_grad=True)
    w = torch.tensor(weight.astype(np.float64) if weighted else np.ones(depth.shape))
    total, l1, ssim, depth_l1 = torch_losses(image, colour, depth.astype(np.float64), w, 0.2)
    expected = [float(v.detach()) for v in (total, l1, ssim, depth_l1)]
    found = [report.loss, report.colour_l1, report.ssim, report.depth_l1]
    np.testing.assert_allclose(found, expected, rtol=2e-5)
    total.backward()
    gradient = optimiser._targets.gradient[: image.numel()].reshape(image.shape)
    assert image.grad is not None
    reference = image.grad.numpy()
    np.testing.assert_allclose(gradient, reference, atol=2e-5 * np.abs(reference).max())


def test_first_step_moves_by_the_learning_rates_against_the_gradient():
    # Adam's first step is rate * sign(gradient), whatever the gradient's size.
    colour, depth = observed()
    cloud, rates = wall(), LearningRates()
    weights = LossWeights(scale=0.0)
    rasteriser = Rasteriser(1)
    optimiser = GaussianOptimiser(cloud, learning_rates=rates, weights=weights, threads=1)
    optimiser.step(CAMERA, np.eye(4), colour, depth)
    after = optimiser.gaussians()
    view = rasteriser.render(cloud, CAMERA, np.eye(4))
    gradient = optimiser._targets.gradient[: view.image.size].reshape(view.image.shape)
    gradients = rasteriser.backward(gradient)
    for name, rate, moved in (
        ("means", rates.means, after.means - cloud.means),
        ("scales", rates.scales, np.log(after.scales) - np.log(cloud.scales)),
        ("colours", rates.colours, after.colours - cloud.colours),
    ):
        slope = getattr(gradients, name)
        clear = np.abs(slope) > 1e-9
        if name == "colours":
            clear &= (cloud.colours > 0.01) & (cloud.colours < 0.99)
        assert clear.mean() > 0.3
        np.testing.assert_allclose(moved[clear], -rate * np.sign(slope[clear]), rtol=2e-2)
        np.testing.assert_array_equal(moved[~view.visible & ~clear.all(axis=-1)] != 0, False)


def test_scale_regularisation_has_the_exact_gradient():
    cloud = wall(50)
    scales = torch.tensor(cloud.scales.astype(np.float64), requires_grad=True)
    loss = (scales - scales.mean()).abs().sum() / 50
    loss.backward()
    from magic_core.render import adam

    mean, deviation, sign = adam.scale_statistics(cloud.scales.reshape(-1), 150)
    np.testing.assert_allclose(deviation / 50, float(loss.detach()), rtol=1e-5)
    found = (np.sign(cloud.scales - mean) - sign) / 50
    assert scales.grad is not None
    np.testing.assert_allclose(found, scales.grad.numpy(), atol=1e-7)


def test_a_few_hundred_steps_bring_a_grey_cloud_to_the_image():
    colour, depth = observed()
    grey = wall(600, seed=9)
    grey.colours[:] = 0.5
    optimiser = GaussianOptimiser(grey)
    reports = [optimiser.step(CAMERA, np.eye(4), colour, depth) for _ in range(250)]
    first, last = reports[0], reports[-1]
    assert last.loss < 0.35 * first.loss
    assert last.colour_l1 < 0.4 * first.colour_l1
    assert last.depth_l1 < 0.5 * first.depth_l1
    assert last.ssim > first.ssim + 0.2
    optimiser.gaussians().validate()


def test_gaussians_out_of_view_keep_their_values_and_moments():
    colour, depth = observed()
    cloud = wall(100)
    cloud.means[40:60, 0] += 50.0
    optimiser = GaussianOptimiser(cloud)
    for _ in range(3):
        optimiser.step(CAMERA, np.eye(4), colour, depth)
    after = optimiser.gaussians()
    for before, now in zip(cloud.arrays(), after.arrays(), strict=True):
        np.testing.assert_array_equal(before[40:60], now[40:60])
        assert (before[:40] != now[:40]).any()


def test_extend_and_prune_keep_the_moments_of_the_rest():
    colour, depth = observed()
    plain, edited = GaussianOptimiser(wall(203)), GaussianOptimiser(wall(203))
    far = wall(77)
    far.means[:, 2] += 1000.0
    far.means[:, 0] += 5000.0  # never drawn
    for _ in range(4):
        plain.step(CAMERA, np.eye(4), colour, depth)
        edited.step(CAMERA, np.eye(4), colour, depth)
    edited.extend(far)
    assert len(edited) == 280
    weights = LossWeights(scale=0.0)  # the mean scale differs while `far` is there
    plain.weights = edited.weights = weights
    plain.step(CAMERA, np.eye(4), colour, depth)
    edited.step(CAMERA, np.eye(4), colour, depth)
    edited.prune(np.arange(280) < 203)
    for _ in range(3):
        plain.step(CAMERA, np.eye(4), colour, depth)
        edited.step(CAMERA, np.eye(4), colour, depth)
    for a, b in zip(plain.gaussians().arrays(), edited.gaussians().arrays(), strict=True):
        np.testing.assert_array_equal(a, b)


def test_an_empty_optimiser_steps_and_grows():
    colour, depth = observed()
    optimiser = GaussianOptimiser(GaussianCloud.empty())
    report = optimiser.step(CAMERA, np.eye(4), colour, depth)
    assert np.isfinite(report.loss)
    optimiser.extend(wall(10))
    optimiser.prune(np.zeros(10, bool))
    assert len(optimiser) == 0
    assert not optimiser.render(CAMERA, np.eye(4)).image.any()


def test_images_of_another_shape_are_refused():
    colour, depth = observed()
    optimiser = GaussianOptimiser(wall(5))
    with pytest.raises(InvalidInput, match="colour"):
        optimiser.step(CAMERA, np.eye(4), colour[:-1], depth)
    with pytest.raises(InvalidInput, match="depth"):
        optimiser.step(CAMERA, np.eye(4), colour, depth[:, 1:])
    with pytest.raises(InvalidInput, match="keep_mask"):
        optimiser.prune(np.ones(4, bool))
