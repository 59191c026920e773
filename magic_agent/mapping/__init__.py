"""Mapping: the active sub-map of one agent, its keyframes and their optimisation.

`Mapper`, `MappingBudget` and `MappingReport` load the rasteriser; they are imported on first use,
so that reading a config or showing help stays quick.
"""

from typing import TYPE_CHECKING, Any

from magic_agent.mapping.config import KeyframeConfig, MappingConfig

if TYPE_CHECKING:
    from magic_agent.mapping.mapper import Mapper, MappingBudget, MappingReport

__all__ = ["KeyframeConfig", "Mapper", "MappingBudget", "MappingConfig", "MappingReport"]


def __getattr__(name: str) -> Any:
    if name in ("Mapper", "MappingBudget", "MappingReport"):
        from magic_agent.mapping import mapper

        return getattr(mapper, name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
