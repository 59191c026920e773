"""The CPU rasteriser: the stages in order, their buffers, and what comes out.

project -> sort -> bin -> blend, and for gradients blend backward -> project backward.
"""

from __future__ import annotations

import time
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from magic_core.errors import InvalidInput, WrongState
from magic_core.gaussians import GaussianCloud
from magic_core.geometry import Camera, se3
from magic_core.render import layout, threads
from magic_core.render.binning import bin_gaussians, chunk_slots, tile_starts
from magic_core.render.blend import BATCH, blend
from magic_core.render.blend_backward import PAIR_GRADIENT, blend_backward
from magic_core.render.lanes import LANES
from magic_core.render.layout import CHUNK, RECORD, TILE, aligned_zeros
from magic_core.render.project import project, view_of
from magic_core.render.project_backward import project_backward
from magic_core.render.sort import sort_by_depth

Float32 = NDArray[np.float32]
ALPHA_TINY = 1e-4  # below this alpha a pixel has no expected depth
_MAX_SIDE = TILE * 0x7FFF  # tile numbers are packed in 16 bits


@dataclass(frozen=True, slots=True)
class RenderedView:
    """What a camera sees of a cloud of Gaussians. The arrays are the caller's own."""

    image: Float32  # (5, h, w) red, green, blue, accumulated depth in metres, alpha
    visible: NDArray[np.bool_]  # (n,) the Gaussian reached at least one pixel
    radii: Float32  # (n,) half extent in pixels where alpha >= 1/255; 0 when not drawn
    culled_not_finite: int
    """Gaussians left out because a parameter is NaN, infinite or beyond 1e18."""

    @property
    def colour(self) -> Float32:
        """(h, w, 3) RGB on black, not divided by alpha (a view of `image`)."""
        return self.image[:3].transpose(1, 2, 0)

    @property
    def depth(self) -> Float32:
        """(h, w) accumulated depth: sum of weight times z, metres."""
        return self.image[3]

    @property
    def alpha(self) -> Float32:
        """(h, w) accumulated opacity, 0 to 1."""
        return self.image[4]

    @property
    def expected_depth(self) -> Float32:
        """(h, w) depth / alpha in metres; 0 where alpha is below 1e-4."""
        seen = self.alpha > ALPHA_TINY
        return np.where(seen, self.depth / np.where(seen, self.alpha, 1.0), 0.0).astype(np.float32)


@dataclass(frozen=True, slots=True)
class Gradients:
    """Gradients of a scalar loss by natural parameters, and by the camera's pose."""

    means: Float32  # (n, 3)
    quaternions: Float32  # (n, 4) orthogonal to the quaternion
    scales: Float32  # (n, 3)
    opacities: Float32  # (n,)
    colours: Float32  # (n, 3)
    pose: NDArray[np.float64]
    """(6,) by the right perturbation of world_from_camera, (translation, rotation)."""


class Rasteriser:
    """Renders clouds and takes gradients; holds the buffers between both, so use one per thread.

    `threads` is how many cores one call may use (None: this process's fair share, see
    `threads.default_threads`). Results do not depend on it. `stage_ms` tells how long each stage of
    the last calls took.
    """

    def __init__(self, threads: int | None = None) -> None:
        self._threads = threads
        self.stage_ms: dict[str, float] = {}
        self._pattern = layout.tile_pattern()
        self._gaussians_room = 0
        self._pairs_room = 0
        self._tiles_room = 0
        self._parameters: tuple[Float32, ...] | None = None

    @property
    def threads(self) -> int:
        """Cores that the next call uses."""
        return self._threads if self._threads is not None else threads.default_threads()

    def use_threads(self, count: int | None) -> None:
        """Set the number of cores; None for the fair share."""
        self._threads = count

    def render(
        self, cloud: GaussianCloud, camera: Camera, world_from_camera: ArrayLike
    ) -> RenderedView:
        """Render the cloud, given in the frame called world here."""
        return self.render_flat(tuple(_flat(a) for a in cloud.arrays()), camera, world_from_camera)

    def render_flat(
        self, parameters: tuple[Float32, ...], camera: Camera, world_from_camera: ArrayLike
    ) -> RenderedView:
        """Like `render`, for flat parameter arrays as in `forward`."""
        _check_size(camera)
        image = self.forward(parameters, camera, world_from_camera)
        n = len(parameters[3])
        radii = self.records.reshape(-1, RECORD)[:n, layout.RADIUS]
        return RenderedView(
            image=image.copy(),
            visible=self.visible[:n].view(np.bool_).copy(),
            radii=np.where(self.touched[:n] > 0, radii, 0.0).astype(np.float32),
            culled_not_finite=self.culled_not_finite,
        )

    def forward(
        self, parameters: tuple[Float32, ...], camera: Camera, world_from_camera: ArrayLike
    ) -> Float32:
        """The image (5, h, w) of flat parameter arrays, in a buffer that the next call reuses.

        parameters: means, quaternions, scales, opacities, colours, flat float32.
        """
        self._parameters = None
        n = len(parameters[3])
        self._camera = camera
        self._view = view_of(camera, se3.inverse(world_from_camera))
        self._make_room(n, camera)
        self._project(parameters)
        self._sort_and_bin()
        self._blend()
        self._parameters = parameters
        return self.image

    def backward(self, gradient: Float32) -> Gradients:
        """Gradients of the last render, given the loss's gradient by its image (5, h, w)."""
        n = self.accumulate(gradient)
        means, quaternions, scales, opacities, colours = self.d_parameters
        return Gradients(
            means=means[: 3 * n].reshape(n, 3).copy(),
            quaternions=quaternions[: 4 * n].reshape(n, 4).copy(),
            scales=scales[: 3 * n].reshape(n, 3).copy(),
            opacities=opacities[:n].copy(),
            colours=colours[: 3 * n].reshape(n, 3).copy(),
            pose=self.d_pose,
        )

    def accumulate(self, gradient: Float32) -> int:
        """Like `backward`, leaving flat gradients in `d_parameters` and `d_pose`; returns n."""
        if self._parameters is None:
            raise WrongState("no render to take gradients of: call render() first")
        if gradient.shape != self.image.shape:
            raise InvalidInput.field(
                "gradient", f"shape {gradient.shape}, expected that of the image {self.image.shape}"
            )
        n, camera = len(self._parameters[3]), self._camera
        self._make_gradient_room(n)
        self.pair_written[: self._slots] = 0
        self._run(
            blend_backward,
            (self._tiles, self._tiles_x, camera.width, camera.height, self.records,
             self.record_ints, self.lists, self.starts, self.kept, self.masks, self.slot_starts,
             self._pattern, self.image.reshape(-1),
             np.ascontiguousarray(gradient, np.float32).reshape(-1),
             self.pair_gradients, self.pair_written),
        )  # fmt: skip
        self._run(
            project_backward,
            (*self._parameters, self._view, self.touched, self.record_ints, self.slot_starts,
             self.pair_gradients, self.pair_written, *self.d_parameters, self._chunk_pose),
        )  # fmt: skip
        # exp(xi) on the right of world_from_camera is exp(-xi) on the left of its inverse.
        self.d_pose = -self._chunk_pose[: self._chunks].sum(axis=0)
        return n

    def _run(self, kernel: Any, arguments: tuple) -> None:
        """Run one stage on this rasteriser's threads and note its time."""
        start = time.perf_counter()
        threads.run(kernel, arguments, threads=self.threads)
        self.stage_ms[kernel.__name__] = (time.perf_counter() - start) * 1e3

    def _project(self, parameters: tuple[Float32, ...]) -> None:
        self.corners[:] = 0
        arguments = (
            *parameters, self._view, self._camera.width, self._camera.height, self._tiles_x,
            self.records, self.record_ints, self.columns, self.rows, self.touched,
            self.keys, self.ids, self.chunks, self.corners,
        )  # fmt: skip
        self._run(project, arguments)
        self.culled_not_finite = int(self.chunks[2 : 3 * self._chunks : 3].sum())

    def _sort_and_bin(self) -> None:
        start = time.perf_counter()
        result, count = sort_by_depth(
            self.chunks, self._chunks, self.keys, self.ids, self.key_buffers, self.id_buffers
        )
        self.stage_ms["sort_by_depth"] = (time.perf_counter() - start) * 1e3
        pairs = tile_starts(self.corners, self._tiles_x, self._tiles_y, self.starts)
        self._slots = chunk_slots(self.chunks, self._chunks, self.slot_starts)
        self._make_pair_room(int(pairs))
        arguments = (
            self.threads, self.id_buffers[result], count, self.columns, self.rows,
            self._tiles_x, self._tiles_y, self.starts, self.lists,
        )  # fmt: skip
        self._run(bin_gaussians, arguments)

    def _blend(self) -> None:
        self.visible[:] = 0
        camera = self._camera
        arguments = (
            self._tiles, self._tiles_x, camera.width, camera.height, self.records, self.lists,
            self.starts, self._pattern, self.image.reshape(-1), self.masks, self.kept, self.visible,
        )  # fmt: skip
        self._run(blend, arguments)

    def _make_room(self, n: int, camera: Camera) -> None:
        """Grow the buffers that depend on the number of Gaussians or the image's size."""
        self._chunks = -(-n // CHUNK)
        if n > self._gaussians_room:
            room = self._gaussians_room = -(-(n + n // 4) // CHUNK) * CHUNK
            self.records = aligned_zeros(RECORD * room)
            self.record_ints = self.records.view(np.int32)
            self.columns, self.rows, self.touched = np.zeros((3, room), np.int32)
            self.keys, self.ids = np.zeros(room, np.uint32), np.zeros(room, np.int32)
            self.key_buffers, self.id_buffers = (
                np.zeros((2, room), np.uint32), np.zeros((2, room), np.int32)
            )  # fmt: skip
            self.chunks = np.zeros(3 * room // CHUNK, np.int64)
            self.slot_starts = np.zeros(room // CHUNK, np.int64)
            self.visible = np.zeros(room, np.uint8)
        if self._gaussians_room == 0:
            self._make_room(1, camera)
            self._chunks = 0
        shape = (5, camera.height, camera.width)
        if getattr(self, "image", None) is None or self.image.shape != shape:
            pixels = 5 * camera.height * camera.width
            self.image_with_margin = aligned_zeros(pixels + LANES)  # vectors may read past the end
            self.image = self.image_with_margin[:pixels].reshape(shape)
            self._tiles_x, self._tiles_y = -(-camera.width // TILE), -(-camera.height // TILE)
            self._tiles = self._tiles_x * self._tiles_y
            self.corners = np.zeros((self._tiles_x + 1) * (self._tiles_y + 1), np.int32)
            self.starts = np.zeros(self._tiles + 1, np.int64)
            self.kept = np.zeros(self._tiles, np.int64)

    def _make_pair_room(self, pairs: int) -> None:
        if pairs > self._pairs_room or self._pairs_room == 0:
            self._pairs_room = pairs + pairs // 4 + 64
            self.lists = aligned_zeros(self._pairs_room + BATCH, np.int32)
            self.masks = aligned_zeros(self._pairs_room + BATCH, np.uint32)
            self.pair_gradients = np.zeros(0, np.float32)

    def _make_gradient_room(self, n: int) -> None:
        if len(self.pair_gradients) < PAIR_GRADIENT * self._pairs_room:
            self.pair_gradients = aligned_zeros(PAIR_GRADIENT * self._pairs_room)
            self.pair_written = np.zeros(self._pairs_room, np.uint8)
        if getattr(self, "_gradient_room", -1) < n:
            self._gradient_room = room = n + n // 4 + LANES
            self.d_parameters = tuple(aligned_zeros(k * (room + LANES)) for k in (3, 4, 3, 1, 3))
            self._chunk_pose = np.zeros((room // CHUNK + 1, 6))


def _flat(array: Float32) -> Float32:
    return np.ascontiguousarray(array, np.float32).reshape(-1)


def _check_size(camera: Camera) -> None:
    camera.validate()
    if max(camera.width, camera.height) > _MAX_SIDE:
        size = f"{camera.width}x{camera.height}"
        raise InvalidInput.field("camera.width", f"{size}: at most {_MAX_SIDE} pixels a side")
