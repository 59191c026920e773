"""Finding the pose of an RGB-D image in a session's stored map."""

from __future__ import annotations

import asyncio
import math
from collections.abc import Callable
from concurrent.futures import Executor
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from magicslam.v1 import mapping_service_pb2 as mapping_pb

from magic_core.errors import FieldViolation, InvalidInput, MagicError, NotLocalized, Overloaded
from magic_core.geometry import Camera
from magic_core.submap import Descriptor
from magic_core.wire import geometry, images, names, records
from magic_server.coordinator import SessionCoordinator
from magic_server.jobs import JobExecutor
from magic_server.jobs.tasks import QueryImage, localize_image
from magic_server.store import Store, StoredSubmap, require_model

if TYPE_CHECKING:
    from magic_server.config import ServerConfig
    from magic_server.registration.register import RegistrationResult

RETRY_AFTER_S = 2.0


@dataclass(frozen=True, slots=True)
class _Candidate:
    similarity: float
    pose: mapping_pb.CorrectedPose
    stored: StoredSubmap
    keyframe: int
    """Which of its keyframes looks like the image; 0 is the anchor."""


class Localizer:
    """Takes images, a bounded number at a time; registers and verifies them as loops are."""

    def __init__(
        self, store: Store, *, jobs: JobExecutor, threads: Executor, config: ServerConfig
    ) -> None:
        self._store = store
        self._jobs = jobs
        self._threads = threads
        self._config = config
        self._under_way = 0

    async def localize(
        self, request: mapping_pb.LocalizeRequest, coordinator: SessionCoordinator
    ) -> records.Localization:
        """The pose of an image, of the first sub-map that passes verification.

        Raises InvalidInput or CorruptData for a request that breaks a rule, NotLocalized when no
        sub-map passes, Overloaded when too many others wait.
        """
        limit = self._config.localize.waiting
        if self._under_way >= limit:
            raise Overloaded(
                f"{limit} images are being localised already; try again",
                retry_after_s=RETRY_AFTER_S,
            )
        self._under_way += 1
        try:
            image, descriptor = await self._in_thread(_checked, request, self._config)
            require_model(coordinator.session, descriptor.model_id, len(descriptor.vector))
            candidates = await self._candidates(descriptor, coordinator)
            stored = tuple(candidate.stored for candidate in candidates)
            keyframes = tuple(candidate.keyframe for candidate in candidates)
            registration = self._config.registration
            results = await self._jobs.run(localize_image, image, stored, registration, keyframes)
        finally:
            self._under_way -= 1
        return _answer(candidates, results, coordinator)

    async def _candidates(
        self, descriptor: Descriptor, coordinator: SessionCoordinator
    ) -> list[_Candidate]:
        """The placed sub-maps that look alike, most similar first; NotLocalized without any."""
        count = self._config.localize.candidates
        threshold = self._config.loops.threshold(coordinator.session.model_id)
        hits = await coordinator.nearest(descriptor.vector, count=count, min_similarity=-1.0)
        placed = {pose.submap: pose for pose in coordinator.board.snapshot.poses}
        session = names.session_name(coordinator.session.name)
        if not placed or not hits:
            raise NotLocalized(f"{session} has no placed sub-maps yet; try again later")
        alike = [hit for hit in hits if hit.similarity >= threshold and hit.target in placed]
        if not alike:
            raise NotLocalized(
                f"no sub-map of {session} looks like the image: the most similar, "
                f"{hits[0].target}, has a similarity of {hits[0].similarity:.2f}, "
                f"{threshold:.2f} is needed"
            )
        found = []
        for hit in alike:
            _, agent, index = names.parse_submap(hit.target)
            stored = await self._store.submaps.stored(coordinator.session, agent, index)
            place = placed[hit.target]
            found.append(_Candidate(hit.similarity, place, stored, hit.target_keyframe))
        return found

    async def _in_thread(self, function: Callable[..., Any], *arguments: Any) -> Any:
        return await asyncio.get_running_loop().run_in_executor(self._threads, function, *arguments)


def _answer(
    candidates: list[_Candidate],
    results: list[RegistrationResult | None],
    coordinator: SessionCoordinator,
) -> records.Localization:
    # The graph may have moved while the image was registered: the newest pose counts.
    placed = {pose.submap: pose for pose in coordinator.board.snapshot.poses}
    for candidate, result in zip(candidates, results, strict=False):
        pose = placed.get(candidate.pose.submap)
        if result is None or not result.accepted or pose is None:
            continue
        world_from_anchor = geometry.pose_from_proto(pose.world_from_anchor)
        agreement = max(result.texture_correlation, 0.0) * (1.0 - result.free_space)
        return records.Localization(
            world_from_camera=world_from_anchor @ result.target_from_source,
            component=pose.component,
            revision=coordinator.board.revision,
            submap=pose.submap,
            anchor_from_camera=result.target_from_source,
            fitness=result.fitness,
            rmse_m=result.rmse_m,
            inliers=result.inliers,
            overlap=result.overlap,
            similarity=candidate.similarity,
            confidence=min(result.fitness * agreement, 1.0),
            information=result.information,
        )
    tried = ", ".join(
        f"{candidate.pose.submap} ({'UNREADABLE' if result is None else result.reason})"
        for candidate, result in zip(candidates, results, strict=False)
    )
    raise NotLocalized(f"the image fits none of the sub-maps that look like it: {tried}")


def _checked(
    request: mapping_pb.LocalizeRequest, config: ServerConfig
) -> tuple[QueryImage, Descriptor]:
    """The image and descriptor of a request; raises unless every field keeps its rule."""
    camera = geometry.camera_from_proto(request.camera)
    _check_fields(request, camera, config)
    size = (camera.width, camera.height)
    parts = {
        "colour": (request.colour, request.colour_media_type, False),
        "depth_png": (request.depth_png, images.PNG, True),
    }
    for field, (data, media_type, depth) in parts.items():
        try:
            images.check_image(data, media_type, size=size, depth=depth)
        except MagicError as error:
            violation = FieldViolation(field, error.message)
            raise type(error)(f"{field}: {error.message}", violations=(violation,)) from error
    image = QueryImage(
        camera=camera,
        colour=request.colour,
        colour_media_type=request.colour_media_type,
        depth_png=request.depth_png,
        metres_per_unit=request.metres_per_unit,
    )
    return image, geometry.descriptor_from_proto(request.image_descriptor)


def _check_fields(
    request: mapping_pb.LocalizeRequest, camera: Camera, config: ServerConfig
) -> None:
    pixels, limit = camera.width * camera.height, config.localize.max_pixels
    if pixels > limit:
        raise InvalidInput.field(
            "camera.width", f"{pixels} pixels, at most {limit}; send a smaller image"
        )
    if request.colour_media_type not in images.COLOUR_MEDIA_TYPES:
        expected = " or ".join(images.COLOUR_MEDIA_TYPES)
        raise InvalidInput.field(
            "colour_media_type", f"{request.colour_media_type!r}, expected {expected}"
        )
    if not (math.isfinite(request.metres_per_unit) and request.metres_per_unit > 0.0):
        raise InvalidInput.field(
            "metres_per_unit", f"{request.metres_per_unit}, expected a finite number > 0"
        )
    longest = config.limits.submap.max_descriptor_dimension
    if problem := geometry.descriptor_problem(request.image_descriptor, max_dimension=longest):
        raise InvalidInput.field("image_descriptor", problem)
