"""What registration gets to see of a sub-map, and the images and points it makes of it."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from magic_core.geometry import Camera
from magic_server.registration.config import RegistrationConfig

Float32 = NDArray[np.float32]
Pose = NDArray[np.float64]

CONTRAST_SIGMA_SHARE = 1.0 / 40.0
"""Width of the window of local contrast normalisation, as a share of the image width."""
_REACH_M = 100.0
"""Farther points come of absurd intrinsics or poses; the matchers' voxel counts overflow there."""
CLOUD_FRAMES = 3
"""So many images make the cloud of the coarse methods on points: their time grows with it."""
CONTRAST_FLOOR = 0.02
"""Local standard deviation (intensity 0 to 1) below which texture is taken for noise."""


@dataclass(frozen=True, slots=True)
class AnchorView:
    """The RGB-D images of a sub-map that stand for it: the anchor's, and keyframes if given."""

    camera: Camera
    colour: NDArray[np.uint8]  # (h, w, 3) RGB
    depth: Float32  # (h, w) metres, 0 = no reading
    keyframes: tuple[tuple[Pose, NDArray[np.uint8], Float32], ...] = ()
    """Further images as (anchor_from_camera (4, 4), colour, depth), same camera."""
    means: Float32 | None = None
    """(n, 3) means of the sub-map's Gaussians, anchor frame; the method `means` needs them."""
    lead: int = 0
    """The image that looks like the other side: 0 the anchor's, 1 the first keyframe's, and so on;
    registration begins there."""


@dataclass(frozen=True, slots=True)
class Level:
    """One size of one image, ready for projective association."""

    camera: Camera
    depth: Float32  # (h, w) metres, 0 = no reading
    normals: Float32  # (h, w, 3) in the camera frame, towards the camera; 0 where unknown
    texture: Float32  # (h, w) intensity, local contrast normalised
    gradient: Float32  # (h, w, 2) of texture per pixel, (u, v)
    colour: Float32  # (h, w, 3) smoothed RGB, 0 to 1

    @property
    def pixels(self) -> NDArray[np.int64]:
        """Flat indices of the pixels with a depth reading."""
        return np.flatnonzero(self.depth.reshape(-1) > 0)


@dataclass(frozen=True, slots=True)
class PreparedFrame:
    """One image with its pyramid, finest level first."""

    anchor_from_camera: Pose  # (4, 4)
    levels: tuple[Level, ...]


@dataclass(frozen=True, slots=True)
class PreparedView:
    """Everything about a view that does not depend on the other one."""

    frames: tuple[PreparedFrame, ...]
    points: Float32  # (n, 3) in the anchor frame, metres, thinned to the cloud's voxel size
    keypoints: Float32  # (k, 3) in the anchor frame, metres
    keypoint_frames: NDArray[np.int64]  # (k,) which frame shows the keypoint
    keypoint_descriptors: Float32  # (k, 128) RootSIFT
    means: Float32  # (g, 3) of the Gaussians, in the anchor frame, metres; none where not given
    lead: int = 0  # the image that looks like the other side

    @property
    def of_lead(self) -> PreparedView:
        """The same with the keypoints of the leading image alone."""
        mine = self.keypoint_frames == self.lead
        return replace(
            self,
            keypoints=self.keypoints[mine],
            keypoint_frames=self.keypoint_frames[mine],
            keypoint_descriptors=self.keypoint_descriptors[mine],
        )


def prepare(view: AnchorView, config: RegistrationConfig) -> PreparedView:
    """Pyramids, point cloud and keypoints of a view; worth keeping if it is matched often."""
    images = [(np.eye(4), view.colour, view.depth), *view.keyframes]
    images = images[: 1 + config.max_keyframes]
    frames = tuple(
        _frame(view.camera, pose, colour, depth, config) for pose, colour, depth in images
    )
    keypoints = [
        _keypoints(frame, image[1], config) for frame, image in zip(frames, images, strict=True)
    ]
    owners = [np.full(len(points), index) for index, (points, _) in enumerate(keypoints)]
    return PreparedView(
        frames=frames,
        points=_thinned_cloud(frames[:CLOUD_FRAMES], config),
        keypoints=np.concatenate([points for points, _ in keypoints]),
        keypoint_frames=np.concatenate(owners).astype(np.int64),
        keypoint_descriptors=np.concatenate([descriptors for _, descriptors in keypoints]),
        means=np.zeros((0, 3), np.float32) if view.means is None else view.means,
        lead=view.lead,
    )


def depth_sigma(depth: Float32, config: RegistrationConfig) -> Float32:
    """Standard deviation of depth readings, metres: grows with the square of the distance
    (Nguyen, Izadi and Lovell, "Modeling Kinect sensor noise", 2012)."""
    excess = np.maximum(depth - 0.4, 0.0)
    return (config.depth_sigma_m + config.depth_sigma_per_m * excess * excess).astype(np.float32)


def normals_of(points: Float32) -> Float32:
    """(h, w, 3) unit normals of organised points by central differences, towards the camera."""
    normals = np.zeros_like(points)
    along_u = points[1:-1, 2:] - points[1:-1, :-2]
    along_v = points[2:, 1:-1] - points[:-2, 1:-1]
    cross = np.cross(along_v, along_u)
    z = points[..., 2]
    around = np.stack([z[1:-1, 1:-1], z[1:-1, 2:], z[1:-1, :-2], z[2:, 1:-1], z[:-2, 1:-1]])
    whole = (around > 0).all(axis=0)
    smooth = np.ptp(around, axis=0) < 0.05 * z[1:-1, 1:-1] + 0.02
    length = np.linalg.norm(cross, axis=-1)
    good = whole & smooth & (length > 1e-12)
    normals[1:-1, 1:-1][good] = cross[good] / length[good, None]
    return normals


def _frame(
    camera: Camera,
    anchor_from_camera: Pose,
    colour: NDArray[np.uint8],
    depth: Float32,
    config: RegistrationConfig,
) -> PreparedFrame:
    depth = np.where((depth > 0) & (depth < config.max_depth_m), depth, 0).astype(np.float32)
    image = colour.astype(np.float32) / np.float32(255.0)
    while camera.width > config.max_width:
        camera, image, depth = _halved(camera, image, depth)
    levels = []
    for _ in range(config.pyramid_levels):
        levels.append(_level(camera, image, depth))
        camera, image, depth = _halved(camera, image, depth)
    return PreparedFrame(anchor_from_camera, tuple(levels))


def _level(camera: Camera, image: Float32, depth: Float32) -> Level:
    grey = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
    sigma = max(2.0, CONTRAST_SIGMA_SHARE * camera.width)
    mean = cv2.GaussianBlur(grey, (0, 0), sigma)
    variance = cv2.GaussianBlur(grey * grey, (0, 0), sigma) - mean * mean
    texture = (grey - mean) / np.sqrt(np.maximum(variance, 0) + CONTRAST_FLOOR**2)
    texture = cv2.GaussianBlur(texture, (0, 0), 0.8)
    gradient = np.stack(
        [cv2.Scharr(texture, cv2.CV_32F, 1, 0), cv2.Scharr(texture, cv2.CV_32F, 0, 1)], axis=-1
    )
    smoothed = cv2.bilateralFilter(depth, 5, 0.03, 1.5)
    smoothed = np.where(depth > 0, smoothed, 0).astype(np.float32)
    return Level(
        camera=camera,
        depth=depth,
        normals=normals_of(camera.back_project(_filled(smoothed, depth))),
        texture=np.ascontiguousarray(texture, dtype=np.float32),
        gradient=np.ascontiguousarray(gradient / np.float32(32.0), dtype=np.float32),
        colour=np.asarray(cv2.GaussianBlur(image, (0, 0), 1.5), dtype=np.float32),
    )


def _filled(smoothed: Float32, depth: Float32) -> Float32:
    """A bilateral filter mixes in missing readings: keep the raw value where it moved far."""
    return np.where(np.abs(smoothed - depth) < 0.03, smoothed, depth)


def _halved(camera: Camera, image: Float32, depth: Float32) -> tuple[Camera, Float32, Float32]:
    """Half the size; a depth pixel is the mean of its four where they lie on one surface."""
    height, width = depth.shape[0] // 2, depth.shape[1] // 2
    whole = image[: 2 * height, : 2 * width]
    shrunk = cv2.resize(whole, (width, height), interpolation=cv2.INTER_AREA)
    image = np.asarray(shrunk, dtype=np.float32)
    four = depth[: 2 * height, : 2 * width].reshape(height, 2, width, 2).swapaxes(1, 2)
    four = four.reshape(height, width, 4)
    valid = four > 0
    nearest = np.where(valid, four, np.inf).min(axis=-1)
    mates = valid & (four < (nearest * 1.03 + 0.01)[..., None])
    total = np.where(mates, four, 0).sum(axis=-1)
    count = mates.sum(axis=-1)
    depth = np.where(count > 0, total / np.maximum(count, 1), 0).astype(np.float32)
    halved = Camera(
        width=width, height=height, fx=camera.fx / 2, fy=camera.fy / 2,
        cx=(camera.cx - 0.5) / 2, cy=(camera.cy - 0.5) / 2,
    )  # fmt: skip
    return halved, image, depth


def _thinned_cloud(frames: tuple[PreparedFrame, ...], config: RegistrationConfig) -> Float32:
    """The mean point of every occupied voxel, in a fixed order."""
    points = np.concatenate([_anchor_points(frame) for frame in frames])
    points = points[np.abs(points).max(axis=1, initial=0.0) <= _REACH_M]
    if not len(points):
        return np.zeros((0, 3), np.float32)
    cells = np.floor(points / config.cloud_voxel_m).astype(np.int64)
    cells -= cells.min(axis=0)
    extent = cells.max(axis=0) + 1
    keys = (cells[:, 0] * extent[1] + cells[:, 1]) * extent[2] + cells[:, 2]
    _, group, count = np.unique(keys, return_inverse=True, return_counts=True)
    sums = np.stack(
        [np.bincount(group, weights=points[:, axis], minlength=len(count)) for axis in range(3)],
        axis=1,
    )
    return (sums / count[:, None]).astype(np.float32)


def _anchor_points(frame: PreparedFrame) -> Float32:
    level = frame.levels[0]
    points = level.camera.back_project(level.depth)[level.depth > 0]
    rotation, translation = frame.anchor_from_camera[:3, :3], frame.anchor_from_camera[:3, 3]
    return (points @ rotation.T + translation).astype(np.float32)


def _keypoints(
    frame: PreparedFrame, colour: NDArray[np.uint8], config: RegistrationConfig
) -> tuple[Float32, Float32]:
    """3D keypoints (k, 3) in the anchor frame and their RootSIFT descriptors (k, 128)."""
    level = frame.levels[0]
    grey = cv2.cvtColor(np.ascontiguousarray(colour), cv2.COLOR_RGB2GRAY)
    size = (level.camera.width, level.camera.height)
    if grey.shape[1] != size[0]:
        grey = cv2.resize(grey, size, interpolation=cv2.INTER_AREA)
    create_sift: Any = getattr(cv2, "SIFT_create")  # noqa: B009 - missing in the type stubs
    sift = create_sift(nfeatures=config.max_keypoints, contrastThreshold=0.01)
    found, descriptors = sift.detectAndCompute(grey, None)
    if not found or descriptors is None:
        return np.zeros((0, 3), np.float32), np.zeros((0, 128), np.float32)
    pixels = np.array([point.pt for point in found])
    column = np.clip(np.rint(pixels[:, 0]).astype(int), 0, size[0] - 1)
    row = np.clip(np.rint(pixels[:, 1]).astype(int), 0, size[1] - 1)
    z = level.depth[row, column]
    camera = level.camera
    x = (pixels[:, 0] - camera.cx) / camera.fx * z
    y = (pixels[:, 1] - camera.cy) / camera.fy * z
    seen = z > 0
    rotation, translation = frame.anchor_from_camera[:3, :3], frame.anchor_from_camera[:3, 3]
    points = np.stack([x, y, z], axis=1)[seen] @ rotation.T + translation
    descriptors = descriptors[seen]
    descriptors = np.sqrt(descriptors / np.maximum(descriptors.sum(axis=1, keepdims=True), 1e-6))
    return points.astype(np.float32), descriptors.astype(np.float32)
