"""Where in a sub-map was this frame taken, without any idea of the last pose?

Keypoints of the frame are matched with those of the sub-map's keyframes, whose depth makes them
points of the anchor frame. Perspective-n-point with RANSAC gives one pose per keyframe. Where
keypoints do not suffice, the depth images are registered by shape, with the keyframes whose
descriptors match best. The best few hypotheses are refined against the rendered sub-map, and one is
accepted only if the refined view agrees with the frame as well as a tracked one must, and
refinement stayed near the hypothesis.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from magic_agent.tracking.config import RelocalisationConfig
from magic_agent.tracking.result import TrackingResult
from magic_agent.tracking.shape_registration import match_shapes, points_of
from magic_core.data import Frame
from magic_core.geometry import Camera, se3
from magic_core.submap import Keyframe

Pose = NDArray[np.float64]
Refine = Callable[[Pose], TrackingResult]


@dataclass(frozen=True, slots=True)
class Hypothesis:
    """A pose that one keyframe supports."""

    anchor_from_camera: Pose
    inliers: int
    """Keypoints, or matches of shape, that agree on it."""
    keyframe_index: int
    """Frame index of the keyframe."""


@dataclass(frozen=True, slots=True)
class _Features:
    """Keypoints of an image with their descriptors."""

    pixels: NDArray[np.float32]  # (n, 2) u, v
    descriptors: NDArray[np.float32]  # (n, 128), square roots of L1-normalised SIFT


class Relocaliser:
    """Finds frames in a sub-map; keeps the keypoints of keyframes it has seen."""

    def __init__(self, camera: Camera, config: RelocalisationConfig) -> None:
        self._camera = camera
        self._config = config
        self._sift = cv2.SIFT_create(nfeatures=config.keypoints)  # pyright: ignore
        self._kept: dict[int, tuple[Keyframe, _Features]] = {}
        self._failures = 0

    def relocalise(
        self, frame: Frame, keyframes: Sequence[Keyframe], *, refine: Refine
    ) -> TrackingResult | None:
        """The refined pose of a frame in the sub-map, or None if no hypothesis convinces.

        Registration by shape is slow: of the frames lost in a row only every few are tried.
        refine: refines a pose hypothesis `anchor_from_camera` against the rendered sub-map.
        """
        found = self._best(self.hypotheses(frame.colour, keyframes), refine)
        if found is None and self._failures % self._config.shape_every == 0:
            found = self._best(self.shape_hypotheses(frame, keyframes), refine)
        self._failures = self._failures + 1 if found is None else 0
        return found

    def hypotheses(
        self, colour: NDArray[np.uint8], keyframes: Sequence[Keyframe]
    ) -> list[Hypothesis]:
        """Poses that enough keypoints support, those with most first."""
        frame = self._features(colour)
        found = [self._hypothesis(frame, keyframe) for keyframe in keyframes]
        self._forget(keyframes)
        return _most_first([each for each in found if each is not None])

    def shape_hypotheses(self, frame: Frame, keyframes: Sequence[Keyframe]) -> list[Hypothesis]:
        """Poses by shape from the keyframes with most descriptors in common, best first."""
        source = points_of(frame.depth, self._camera)
        found = []
        for keyframe in self._likeliest(frame.colour, keyframes):
            match = match_shapes(source, points_of(keyframe.depth, self._camera))
            if match is not None and match.inliers >= self._config.min_shape_inliers:
                pose = keyframe.anchor_from_camera @ match.target_from_source
                found.append(Hypothesis(pose, match.inliers, keyframe.frame_index))
        return _most_first(found)

    def _likeliest(
        self, colour: NDArray[np.uint8], keyframes: Sequence[Keyframe]
    ) -> list[Keyframe]:
        frame = self._features(colour)
        common = [len(self._matches(frame, self._keyframe_features(each))) for each in keyframes]
        order = sorted(range(len(keyframes)), key=lambda i: -common[i])
        return [keyframes[i] for i in order[: self._config.shape_keyframes]]

    def _best(self, hypotheses: Sequence[Hypothesis], refine: Refine) -> TrackingResult | None:
        """The result that agrees best with the sub-map among those that convince."""
        best = None
        for hypothesis in hypotheses[: self._config.refined]:
            result = refine(hypothesis.anchor_from_camera)
            if self._convinces(hypothesis, result) and (
                best is None or result.inlier_share > best.inlier_share
            ):
                best = result
        return best

    def _convinces(self, hypothesis: Hypothesis, result: TrackingResult) -> bool:
        if result.lost or result.inlier_share < self._config.min_inlier_share:
            return False
        moved = se3.inverse(hypothesis.anchor_from_camera) @ result.anchor_from_camera
        return (
            float(np.linalg.norm(moved[:3, 3])) <= self._config.max_correction_m
            and float(np.degrees(se3.rotation_angle(moved))) <= self._config.max_correction_deg
        )

    def _hypothesis(self, frame: _Features, keyframe: Keyframe) -> Hypothesis | None:
        features = self._keyframe_features(keyframe)
        pairs = self._matches(frame, features)
        points = self._points(features.pixels[pairs[:, 1]], keyframe.depth)
        pairs, points = pairs[points[:, 2] > 0.0], points[points[:, 2] > 0.0]
        if len(pairs) < self._config.min_inliers:
            return None
        cv2.setRNGSeed(0)
        ok, rotation, translation, inliers = cv2.solvePnPRansac(
            points.astype(np.float64),
            frame.pixels[pairs[:, 0]].astype(np.float64),
            self._camera.matrix,
            None,
            iterationsCount=300,
            reprojectionError=self._config.reprojection_px,
            flags=cv2.SOLVEPNP_EPNP,
        )
        if not ok or inliers is None or len(inliers) < self._config.min_inliers:
            return None
        camera_from_keyframe = se3.from_rotation_translation(
            se3.rotation_exp(rotation.ravel()), translation.ravel()
        )
        pose = keyframe.anchor_from_camera @ se3.inverse(camera_from_keyframe)
        return Hypothesis(pose, len(inliers), keyframe.frame_index)

    def _keyframe_features(self, keyframe: Keyframe) -> _Features:
        kept = self._kept.get(keyframe.frame_index)
        if kept is None or kept[0] is not keyframe:
            kept = (keyframe, self._features(keyframe.colour))
            self._kept[keyframe.frame_index] = kept
        return kept[1]

    def _forget(self, keyframes: Sequence[Keyframe]) -> None:
        """Drop the keypoints of keyframes of other sub-maps."""
        present = {keyframe.frame_index for keyframe in keyframes}
        self._kept = {index: kept for index, kept in self._kept.items() if index in present}

    def _features(self, colour: NDArray[np.uint8]) -> _Features:
        grey = cv2.cvtColor(colour, cv2.COLOR_RGB2GRAY)
        keypoints, descriptors = self._sift.detectAndCompute(grey, None)
        if descriptors is None or not len(keypoints):
            return _Features(np.zeros((0, 2), np.float32), np.zeros((0, 128), np.float32))
        pixels = np.array([keypoint.pt for keypoint in keypoints], np.float32)
        total = np.maximum(descriptors.sum(axis=1, keepdims=True), 1e-6)
        return _Features(pixels, np.sqrt(descriptors / total).astype(np.float32))

    def _matches(self, frame: _Features, keyframe: _Features) -> NDArray[np.int64]:
        """(m, 2) indices of keypoints that are each other's nearest and pass the ratio test."""
        if min(len(frame.pixels), len(keyframe.pixels)) < 2:
            return np.zeros((0, 2), np.int64)
        likeness = frame.descriptors @ keyframe.descriptors.T  # unit vectors: cosine
        forward, backward = likeness.argmax(axis=1), likeness.argmax(axis=0)
        rows = np.arange(len(forward))
        best = likeness[rows, forward].copy()
        likeness[rows, forward] = -1.0
        second = likeness.max(axis=1)
        squared = 2.0 - 2.0 * best
        distinct = squared < self._config.ratio**2 * (2.0 - 2.0 * second)
        keep = distinct & (backward[forward] == rows)
        return np.stack([rows[keep], forward[keep]], axis=1)

    def _points(
        self, pixels: NDArray[np.float32], depth: NDArray[np.float32]
    ) -> NDArray[np.float64]:
        """(n, 3) points in the keyframe's camera frame; z = 0 where there is no depth."""
        u = np.clip(np.rint(pixels[:, 0]).astype(int), 0, self._camera.width - 1)
        v = np.clip(np.rint(pixels[:, 1]).astype(int), 0, self._camera.height - 1)
        z = depth[v, u].astype(np.float64)
        x = (pixels[:, 0] - self._camera.cx) / self._camera.fx * z
        y = (pixels[:, 1] - self._camera.cy) / self._camera.fy * z
        return np.stack([x, y, z], axis=1)


def _most_first(hypotheses: list[Hypothesis]) -> list[Hypothesis]:
    return sorted(hypotheses, key=lambda each: -each.inliers)
