"""Which keyframes of a sub-map are described beside its anchor: those that show something else."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from magic_agent.odometry import anchor_overlap
from magic_core.geometry import Camera, se3
from magic_core.submap import Descriptor, Keyframe, Submap

MOST_SEEN = 0.7
"""A keyframe that shares more of its view with one described before says nothing new."""
_THIN = 8  # every so many pixels are looked at, each way


def with_described_keyframes(
    submap: Submap, describe: Callable[[NDArray[np.uint8]], Descriptor], *, count: int
) -> Submap:
    """The same sub-map with descriptors of at most `count` keyframes; itself for 0.

    Takes `count` runs of the encoder, and a millisecond or so per keyframe to choose.
    """
    if not count:
        return submap
    chosen = spread_keyframes(submap.keyframes, submap.camera, count)
    vectors = {place: describe(submap.keyframes[place].colour).vector for place in chosen}
    keyframes = [
        replace(keyframe, descriptor=vectors.get(place))
        for place, keyframe in enumerate(submap.keyframes)
    ]
    return replace(submap, keyframes=tuple(keyframes))


def spread_keyframes(keyframes: Sequence[Keyframe], camera: Camera, count: int) -> list[int]:
    """At most `count` places among keyframes, the anchor left out: each time the one that shares
    least of its view with the anchor and those chosen before, until none shows anything new."""
    depths = [keyframe.depth[::_THIN, ::_THIN] for keyframe in keyframes]
    camera = _thinned(camera)
    # Without depth nothing could be registered from there.
    seen = np.array([float(not (depth > 0.0).any()) for depth in depths])
    chosen = [0]
    while len(chosen) <= count:
        seen[chosen] = 1.0
        for place in np.flatnonzero(seen < 1.0).tolist():
            shared = _shared(keyframes, depths, camera, pair=(chosen[-1], place))
            seen[place] = max(seen[place], shared)
        newest = int(seen.argmin())
        if seen[newest] > MOST_SEEN:
            break
        chosen.append(newest)
    return chosen[1:]


def _shared(
    keyframes: Sequence[Keyframe],
    depths: Sequence[NDArray[np.float32]],
    camera: Camera,
    *,
    pair: tuple[int, int],
) -> float:
    """Share of the readings of one that the other sees, the smaller of both directions: a close-up
    of what the other shows from afar is another view."""
    a, b = pair
    a_from_anchor = se3.inverse(keyframes[a].anchor_from_camera)
    a_from_b = a_from_anchor @ keyframes[b].anchor_from_camera
    forward = anchor_overlap(
        depths[a], depths[b], camera=camera, anchor_from_camera=a_from_b, thin=1
    )
    back = anchor_overlap(
        depths[b], depths[a], camera=camera, anchor_from_camera=se3.inverse(a_from_b), thin=1
    )
    return min(forward, back)


def _thinned(camera: Camera) -> Camera:
    """The camera of every `_THIN`th pixel each way, from the first on."""
    return Camera(
        width=-(-camera.width // _THIN),
        height=-(-camera.height // _THIN),
        fx=camera.fx / _THIN,
        fy=camera.fy / _THIN,
        cx=camera.cx / _THIN,
        cy=camera.cy / _THIN,
    )
