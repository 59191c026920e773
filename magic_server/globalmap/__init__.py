"""The global map: coarse merge, hole filling and fine optimisation from keyframes.

`build_global_map` and `GlobalMap` load the rasteriser; they are imported on first use, so that
reading a config or showing help stays quick.
"""

from typing import TYPE_CHECKING, Any

from magic_server.globalmap.config import MergeConfig, MeshConfig
from magic_server.globalmap.placement import PlacedSubmap

if TYPE_CHECKING:
    from magic_server.globalmap.merge import GlobalMap, build_global_map

__all__ = ["GlobalMap", "MergeConfig", "MeshConfig", "PlacedSubmap", "build_global_map"]


def __getattr__(name: str) -> Any:
    if name in ("GlobalMap", "build_global_map"):
        from magic_server.globalmap import merge

        return getattr(merge, name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
