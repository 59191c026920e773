"""The tracker against rendered sub-maps: poses, verdicts, faults, relocalisation, and Adam."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from box_room import CAMERA, room_frame, walk

from magic_agent.mapping import MappingConfig
from magic_agent.mapping.mapper import Mapper
from magic_agent.tracking.config import (
    AdamConfig,
    GaussNewtonConfig,
    KeyframeWindowConfig,
    TrackingConfig,
)
from magic_agent.tracking.refinement import CloudView
from magic_agent.tracking.torch_view import TorchView
from magic_agent.tracking.tracker import Tracker
from magic_core.data import Frame
from magic_core.errors import NotSupported
from magic_core.geometry import se3
from magic_core.render.backend import has_cuda
from magic_core.submap import Keyframe

CONFIG = TrackingConfig(gauss_newton=GaussNewtonConfig(levels=3))
MODEL_ALONE = replace(CONFIG, window=KeyframeWindowConfig(images=0))


POSES = walk(8)
FRAMES = [room_frame(pose, i, noise_seed=i) for i, pose in enumerate(POSES)]
ANCHOR = POSES[0]
TRUTH = [se3.inverse(ANCHOR) @ pose for pose in POSES]


@pytest.fixture(scope="module")
def view() -> CloudView:
    """A sub-map of two keyframes, mapped at their true poses."""
    mapper = Mapper(CAMERA, MappingConfig(), threads=1)
    mapper.begin(FRAMES[0])
    mapper.insert(FRAMES[5], TRUTH[5])
    return CloudView(mapper.gaussians(), CAMERA, threads=1)


def error_mm(estimate: np.ndarray, truth: np.ndarray) -> float:
    return 1e3 * float(np.linalg.norm((se3.inverse(truth) @ estimate)[:3, 3]))


def blank(frame: Frame, *, colour: bool, depth: bool) -> Frame:
    """The frame with its colour or its depth gone."""
    return replace(
        frame,
        colour=np.zeros_like(frame.colour) if colour else frame.colour,
        depth=np.zeros_like(frame.depth) if depth else frame.depth,
    )


@pytest.mark.parametrize("config", [CONFIG, MODEL_ALONE], ids=["window", "sub-map alone"])
def test_tracks_a_walk_against_the_sub_map(view, config):
    tracker = Tracker(CAMERA, config)
    pose, before = np.eye(4), None
    for previous, current in pairwise(FRAMES):
        result = tracker.track(
            current, previous, anchor_from_previous=pose,
            anchor_from_before_previous=before, reference=view,
        )  # fmt: skip
        assert result.verdict == "ok", result.reason
        assert result.inlier_share > 0.9
        assert np.linalg.eigvalsh(result.information).min() > 0.0
        before, pose = pose, result.anchor_from_camera
        assert error_mm(pose, TRUTH[current.index]) < 12.0  # 2 to 6 measured at 2 cm per pixel


@pytest.mark.parametrize("levels", [1, 2])
def test_works_with_few_pyramid_levels(view, levels):
    config = replace(CONFIG, gauss_newton=GaussNewtonConfig(levels=levels))
    result = Tracker(CAMERA, config).track(
        FRAMES[2], FRAMES[1], anchor_from_previous=TRUTH[1],
        anchor_from_before_previous=TRUTH[0], reference=view,
    )  # fmt: skip
    assert result.verdict == "ok", result.reason
    assert error_mm(result.anchor_from_camera, TRUTH[2]) < 12.0


@pytest.mark.parametrize(
    ("colour", "depth"), [(True, False), (False, True)], ids=["black", "no depth"]
)
def test_one_sense_suffices(view, colour, depth):
    tracker = Tracker(CAMERA, CONFIG)
    result = tracker.track(
        blank(FRAMES[2], colour=colour, depth=depth),
        FRAMES[1],
        anchor_from_previous=TRUTH[1],
        anchor_from_before_previous=TRUTH[0],
        reference=view,
    )
    assert not result.lost, result.reason
    assert error_mm(result.anchor_from_camera, TRUTH[2]) < 30.0


def test_a_frame_that_shows_nothing_is_lost_and_keeps_the_prediction(view):
    tracker = Tracker(CAMERA, CONFIG)
    result = tracker.track(
        blank(FRAMES[2], colour=True, depth=True),
        FRAMES[1],
        anchor_from_previous=TRUTH[1],
        anchor_from_before_previous=TRUTH[0],
        reference=view,
    )
    assert result.lost
    assert "nothing" in result.reason
    predicted = TRUTH[1] @ se3.inverse(TRUTH[0]) @ TRUTH[1]
    assert np.allclose(result.anchor_from_camera, predicted, atol=1e-9)


@pytest.mark.parametrize("turn", [0.5, 1.0, 0.25])
def test_a_kidnapped_camera_is_lost_not_moved(view, turn):
    elsewhere = ANCHOR @ se3.exp([0.3, 0.1, -0.2, 0.1, turn * np.pi, 0.1])  # another wall
    tracker = Tracker(CAMERA, CONFIG)
    tracker.track(FRAMES[1], FRAMES[0], anchor_from_previous=TRUTH[0], reference=view)
    result = tracker.track(
        room_frame(elsewhere, 2, noise_seed=50),
        FRAMES[1],
        anchor_from_previous=TRUTH[1],
        anchor_from_before_previous=TRUTH[0],
        reference=view,
    )
    assert result.lost
    assert result.reason


def test_a_lost_frame_is_found_again_from_keyframes(view):
    keyframes = [Keyframe(i, i / 30.0, TRUTH[i], FRAMES[i].colour, FRAMES[i].depth) for i in (0, 5)]
    back = ANCHOR @ se3.exp([0.12, -0.08, 0.1, 0.05, 0.12, 0.2])
    found = Tracker(CAMERA, CONFIG).relocalise(
        room_frame(back, 60, noise_seed=60), keyframes, reference=view
    )
    assert found is not None
    assert error_mm(found.anchor_from_camera, se3.inverse(ANCHOR) @ back) < 20.0


def test_a_place_that_no_keyframe_shows_is_not_found(view):
    keyframes = [Keyframe(0, 0.0, TRUTH[0], FRAMES[0].colour, FRAMES[0].depth)]
    behind = ANCHOR @ se3.exp([0.0, 0.0, 0.0, 0.0, np.pi, 0.0])
    tracker = Tracker(CAMERA, CONFIG)
    assert tracker.relocalise(room_frame(behind, 60), keyframes, reference=view) is None


def test_the_view_through_torch_is_the_kernels_view_and_has_their_gradient(view):
    """What gsplat's backend goes through, with the reference renderer in its place."""
    small = CAMERA.scaled(0.25)
    cloud = view._cloud.select(np.arange(len(view._cloud.means)) % 12 == 0)
    kernels = CloudView(cloud, small, threads=1)
    through_torch = TorchView(cloud, small, backend="reference")
    ours, theirs = kernels(TRUTH[1]), through_torch(TRUTH[1])
    assert np.abs(ours.image - theirs.image).max() < 2e-3
    assert (ours.visible == theirs.visible).mean() > 0.98
    gradient = np.random.default_rng(0).normal(size=ours.image.shape).astype(np.float32)
    expected, found = kernels.backward(gradient), through_torch.backward(gradient)
    assert np.linalg.norm(found - expected) < 0.02 * np.linalg.norm(expected)


@pytest.mark.skipif(has_cuda(), reason="this machine has a CUDA device with gsplat")
def test_a_cuda_backend_without_a_device_says_what_to_do(view):
    with pytest.raises(NotSupported, match=r"tracking\.backend cpu"):
        TorchView(view._cloud, CAMERA)


@pytest.mark.gpu
def test_tracks_through_gsplat(view):
    result = Tracker(CAMERA, CONFIG).track(
        FRAMES[2], FRAMES[1], anchor_from_previous=TRUTH[1],
        anchor_from_before_previous=TRUTH[0], reference=TorchView(view._cloud, CAMERA),
    )  # fmt: skip
    assert result.verdict == "ok", result.reason
    assert error_mm(result.anchor_from_camera, TRUTH[2]) < 12.0


def test_adam_descends_the_papers_loss(view):
    config = replace(
        CONFIG,
        solver="adam",
        initialisation="constant_velocity",
        rotation_prealignment=False,
        adam=AdamConfig(iterations=60, rotation_rate=1e-3, translation_rate=1e-3),
    )
    off = se3.exp([0.008, -0.006, 0.008, 0.003, -0.003, 0.002])
    result = Tracker(CAMERA, config).refine(
        FRAMES[1], anchor_from_camera=TRUTH[1] @ off, reference=view
    )
    assert result.renders == 61
    assert error_mm(result.anchor_from_camera, TRUTH[1]) < 0.7 * error_mm(off, np.eye(4))


def test_adam_gradient_is_that_of_its_loss(view):
    """Central differences of the loss by the rendered values, with the masks held still."""
    from magic_agent.tracking.adam import AdamRefiner

    config = AdamConfig()
    refiner = AdamRefiner(config, CONFIG.gauss_newton)
    image = view(TRUTH[1]).image.astype(np.float64)
    target = np.concatenate(
        [np.moveaxis(FRAMES[1].colour / 255.0, -1, 0), FRAMES[1].depth[None]]
    ).astype(np.float32)
    gradient = refiner.loss_gradient(image.astype(np.float32), target)
    weight = refiner._mask(
        image.astype(np.float32), target,
        (image[3] / np.maximum(image[4], 1e-6) - target[3]).astype(np.float32),
    )  # fmt: skip
    weight = weight / weight.sum()

    def loss(values: np.ndarray) -> float:
        colour = np.abs(values[:3] - target[:3]).sum(axis=0)
        depth = np.abs(values[3] / np.maximum(values[4], 1e-6) - target[3])
        return float((weight * (0.95 * colour + 0.05 * depth)).sum())

    rng = np.random.default_rng(0)
    direction = rng.normal(size=image.shape) * 1e-8
    slope = (loss(image + direction) - loss(image - direction)) / 2.0
    assert slope == pytest.approx(float((gradient * direction).sum()), rel=2e-2)
