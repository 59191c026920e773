"""The normal equations of tracking: against the page of formulas they implement, and as laws."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from magic_core.geometry import Camera, se3
from magic_core.render.linearisation import ResidualModel, estimate_scales, linearise

CAMERA = Camera(width=70, height=52, fx=60.0, fy=58.0, cx=34.0, cy=25.5)
WIDE = Camera(width=350, height=40, fx=300.0, fy=300.0, cx=170.0, cy=20.0)
MOTION = se3.exp([0.02, -0.015, 0.03, 0.01, -0.02, 0.015])


def smooth(rng: np.random.Generator, camera: Camera, low: float, high: float) -> np.ndarray:
    """A random smooth image between two values."""
    v, u = np.mgrid[: camera.height, : camera.width] / 16.0
    waves = [np.sin(a * u + b * v + c) for a, b, c in rng.uniform(-1.5, 1.5, (5, 3))]
    mean = np.mean(waves, axis=0)
    return (low + (high - low) * (mean + 1.0) / 2.0).astype(np.float32)


def views(seed: int, camera: Camera = CAMERA) -> tuple[np.ndarray, np.ndarray]:
    """A random reference view (5, h, w) and a random image (h, w, 4), with holes in both depths."""
    rng = np.random.default_rng(seed)
    planes = [smooth(rng, camera, 0.1, 0.9) for _ in range(6)]
    depths = [smooth(rng, camera, 1.5, 2.2) for _ in range(2)]
    for depth in depths:
        depth[rng.random(depth.shape) < 0.03] = 0.0
    mask = rng.uniform(0.0, 1.0, depths[0].shape).astype(np.float32)
    reference = np.stack([*planes[:3], depths[0], mask])
    image = np.stack([*planes[3:], depths[1]], axis=-1)
    return reference, np.ascontiguousarray(image)


def by_the_page(
    reference: np.ndarray,
    image: np.ndarray,
    *,
    camera: Camera,
    camera_from_reference: np.ndarray,
    model: ResidualModel,
    gain: float,
    bias: float,
) -> tuple[np.ndarray, np.ndarray, float]:
    """(hessian, gradient, cost) pixel by pixel in float64, straight from the docstring."""
    hessian, gradient, cost = np.zeros((8, 8)), np.zeros(8), 0.0
    depth = reference[3].astype(float)
    reference_from_camera = se3.inverse(camera_from_reference)
    for y in range(1, camera.height - 1):
        for x in range(1, camera.width - 1):
            z, mask = depth[y, x], float(reference[4, y, x])
            if z <= 0:
                continue
            ray = np.array([(x - camera.cx) / camera.fx, (y - camera.cy) / camera.fy, 1.0])
            point = z * ray
            seen = se3.transform_points(camera_from_reference, point[None])[0]
            u = camera.fx * seen[0] / seen[2] + camera.cx
            v = camera.fy * seen[1] / seen[2] + camera.cy
            if not (0 <= u <= camera.width - 1.001 and 0 <= v <= camera.height - 1.001):
                continue
            left, top = int(u), int(v)
            a, b = u - left, v - top
            corners = image[top : top + 2, left : left + 2].astype(float)
            weights = np.array([[(1 - b) * (1 - a), (1 - b) * a], [b * (1 - a), b * a]])
            sample = (weights[..., None] * corners).sum(axis=(0, 1))

            neighbours = depth[[y, y, y - 1, y + 1], [x - 1, x + 1, x, x]]
            z_u, z_v = (neighbours[1] - neighbours[0]) / 2, (neighbours[3] - neighbours[2]) / 2
            smooth_here = abs(z_u) + abs(z_v) < model.depth_step * z and neighbours.min() > 0
            four = corners[..., 3]
            steady = four.min() > 0 and four.max() - four.min() < model.depth_step * four.max()
            keep = True
            if smooth_here and steady:
                n = np.array([-camera.fx * z_u / z, -camera.fy * z_v / z, 0.0])
                n[2] = 1.0 + (camera.fx * point[0] * z_u + camera.fy * point[1] * z_v) / z**2
                back = np.array([(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, 1.0])
                measured = se3.transform_points(reference_from_camera, (sample[3] * back)[None])[0]
                error = n @ (measured - point)
                variance = model.depth_sigma**2 * (
                    (model.k0_m + model.k2_per_m * z**2) ** 2 + model.k_slope**2 * (z_u**2 + z_v**2)
                )
                squared = error**2 / variance
                keep = squared <= model.gate**2
                if keep:
                    tail = 1.0 / (1.0 + squared / model.depth_width**2)
                    row = np.concatenate([n, np.cross(measured, n), [0.0, 0.0]])
                    weight = mask * model.depth_weight * tail**2 / variance
                    hessian += weight * np.outer(row, row)
                    gradient += weight * row * error
                    cost += 0.5 * mask * model.depth_weight * squared * tail
            if not keep:
                continue
            jacobian_pi = np.array(
                [
                    [camera.fx / z, 0.0, -camera.fx * point[0] / z**2],
                    [0.0, camera.fy / z, -camera.fy * point[1] / z**2],
                ]
            )
            moves = jacobian_pi @ np.hstack([np.eye(3), -se3.hat(point)])
            for channel in range(3):
                plane = reference[channel].astype(float)
                slope = np.array(
                    [plane[y, x + 1] - plane[y, x - 1], plane[y + 1, x] - plane[y - 1, x]]
                )
                row = np.concatenate([slope / 2 @ moves, [-sample[channel], -1.0]])
                error = plane[y, x] - (gain * sample[channel] + bias)
                squared = error**2 / model.colour_sigma**2
                tail = 1.0 / (1.0 + squared / model.colour_width**2)
                weight = mask * model.colour_weight * tail**2 / model.colour_sigma**2
                hessian += weight * np.outer(row, row)
                gradient += weight * row * error
                cost += 0.5 * mask * model.colour_weight * squared * tail
    return hessian, gradient, cost


@pytest.mark.parametrize(("seed", "camera"), [(0, CAMERA), (1, CAMERA), (2, WIDE)])
def test_kernel_sums_what_the_page_says(seed, camera):
    reference, image = views(seed, camera)
    model = ResidualModel(colour_sigma=0.1, depth_sigma=20.0, gate=10.0)
    arguments = {"camera": camera, "camera_from_reference": MOTION, "model": model}
    expected = by_the_page(reference, image, gain=1.1, bias=-0.03, **arguments)
    got = linearise(reference, image, gain=1.1, bias=-0.03, **arguments)
    # float32 sums of a few thousand terms, and rays that fall within rounding of a pixel border.
    scale = np.sqrt(np.outer(np.diag(expected[0]), np.diag(expected[0])))
    assert np.abs(got.hessian - expected[0]).max() <= 2e-3 * scale.max()
    assert np.all(np.abs(got.hessian - expected[0]) <= 5e-3 * scale)
    norm = np.sqrt(np.diag(expected[0]) * 2 * expected[2])
    assert np.all(np.abs(got.gradient - expected[1]) <= 2e-3 * norm)
    assert got.cost == pytest.approx(expected[2], rel=2e-3)


def test_number_of_threads_does_not_change_a_bit():
    camera = Camera(width=200, height=120, fx=150.0, fy=150.0, cx=99.5, cy=59.5)
    reference, image = views(3, camera)
    sums = [
        linearise(
            reference, image, camera=camera, camera_from_reference=MOTION,
            model=ResidualModel(), threads=threads,
        )
        for threads in (1, 2, 3)
    ]  # fmt: skip
    for other in sums[1:]:
        assert np.array_equal(sums[0].hessian, other.hessian)
        assert np.array_equal(sums[0].gradient, other.gradient)
        assert sums[0].cost == other.cost


def slanted_plane(camera: Camera, world_from_camera: np.ndarray) -> np.ndarray:
    """(h, w) depth of the plane n . p = 2 seen from a pose."""
    normal = np.array([0.3, -0.2, 1.0])
    rays = camera.rays().astype(float)
    in_world = rays @ world_from_camera[:3, :3].T
    return ((2.0 - normal @ world_from_camera[:3, 3]) / (in_world @ normal)).astype(np.float32)


@pytest.mark.parametrize("shift_m", [0.001, 0.02, 0.05])
def test_one_depth_step_finds_the_distance_to_a_plane(shift_m):
    """Point to plane is linear in translation: one step ends on the plane, however far away."""
    normal = np.array([0.3, -0.2, 1.0])
    truth = se3.from_rotation_translation(np.eye(3), shift_m * normal / np.linalg.norm(normal))
    grey = np.full((3, CAMERA.height, CAMERA.width), 0.5, np.float32)
    still = slanted_plane(CAMERA, np.eye(4))
    reference = np.concatenate([grey, still[None], np.ones_like(still)[None]])
    moved = slanted_plane(CAMERA, truth)
    image = np.ascontiguousarray(np.stack([*grey, moved], axis=-1))
    got = linearise(
        reference, image, camera=CAMERA, camera_from_reference=np.eye(4),
        model=ResidualModel(colour_weight=0.0, depth_width=1e4, gate=1e6),
    )  # fmt: skip
    hessian = got.hessian[:3, :3] + 1e-6 * np.trace(got.hessian[:3, :3]) * np.eye(3)
    step = np.linalg.solve(hessian, -got.gradient[:3])
    along = normal / np.linalg.norm(normal)
    assert step @ along == pytest.approx(shift_m, rel=1e-2, abs=2e-5)


def test_gain_and_bias_of_a_brighter_image_are_found_in_one_step():
    reference, _ = views(4)
    reference[3], reference[4] = 2.0, 1.0
    image = np.ascontiguousarray(np.moveaxis(reference[:4], 0, -1))
    image[..., :3] = (image[..., :3] - 0.05) / 1.2  # so that 1.2 I + 0.05 is the reference
    got = linearise(
        reference, image, camera=CAMERA, camera_from_reference=np.eye(4),
        model=ResidualModel(colour_sigma=1.0, colour_width=1e3),
    )  # fmt: skip
    gain, bias = np.linalg.solve(got.hessian[6:, 6:], -got.gradient[6:])
    assert gain == pytest.approx(0.2, abs=1e-3)
    assert bias == pytest.approx(0.05, abs=1e-3)


def test_scales_are_those_of_the_noise_despite_outliers():
    rng = np.random.default_rng(5)
    reference, _ = views(6, WIDE)
    reference[3], reference[4] = 2.0, 1.0
    image = np.ascontiguousarray(np.moveaxis(reference[:4], 0, -1))
    model = ResidualModel()
    sigma_z = model.k0_m + model.k2_per_m * 4.0
    image[..., 3] += 3.0 * sigma_z * rng.standard_normal(image.shape[:2])
    outliers = rng.random(image.shape[:2]) < 0.2
    image[outliers, 3] += 0.08
    found = estimate_scales(
        reference, image, camera=WIDE, camera_from_reference=np.eye(4), model=model
    )
    assert 2.5 <= found.depth_sigma <= 4.5  # 20 % outliers raise a median by a third


def test_pixels_beyond_the_gate_count_for_nothing():
    reference, image = views(7)
    reference[3], reference[4], image[..., 3] = 2.0, 1.0, 2.0
    model = ResidualModel(colour_sigma=0.1, depth_sigma=1.0, gate=5.0)
    pose = {"camera": CAMERA, "camera_from_reference": np.eye(4), "model": model}
    occluded = image.copy()
    occluded[:, 30:, 3] = 1.0  # a hand in front of the right part
    partly = linearise(reference, occluded, **pose)
    blind = reference.copy()
    blind[4, :, 29:] = 0.0  # column 29 interpolates across the edge
    alone = linearise(blind, image, **pose)
    edge = reference.copy()
    edge[4, :, 29] = 0.0
    partly = linearise(edge, occluded, **pose)
    assert np.allclose(partly.hessian, alone.hessian, rtol=1e-4, atol=1e-2)
    assert partly.agreeing < 0.6 * partly.measured
    everything = linearise(reference, occluded, **{**pose, "model": replace(model, gate=1e9)})
    assert everything.cost > partly.cost
