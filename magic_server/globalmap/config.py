"""Settings of the merge, and of the mesh that is made of a map."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from magic_core.errors import ConfigError, FieldViolation


@dataclass(frozen=True, slots=True)
class MergeConfig:
    """How sub-maps become one map (paper, "Global Map Construction")."""

    refine: bool = True
    """Run the fine stage; without it the merged map is the sub-maps appended."""
    iterations: int = 3000
    """Most optimisation steps of the fine stage (the paper takes 3,000)."""
    passes: int = 30
    """Most visits per keyframe on average; the smaller of both budgets counts."""
    converged: float = 0.002
    """Stop early when keyframes' losses fall by less than this share from visit to visit, on the
    mean of each of two passes in a row; 0 spends the budget."""
    fill: bool = True
    """Seed Gaussians where the keyframes see surface that the appended sub-maps do not show."""
    fill_unmeasured: bool = True
    """Also where colour was seen but depth never measured, on the continued nearest surface."""
    alpha_threshold: float = 0.8
    """Rendered alpha below which a pixel counts as not shown."""
    prune_opacity: float = 0.05
    """Gaussians below this opacity are removed."""
    min_contribution: float = 0.3
    """Gaussians whose blending weights sum to less, in pixels, in every keyframe are removed:
    duplicates where sub-maps overlap, and what is hidden. 0 keeps them."""
    max_gaussians: int = 2_000_000
    """Bound of the merged map; nothing is seeded beyond it."""
    ssim_weight: float = 0.2
    """lambda of the colour loss: (1 - lambda) L1 + lambda (1 - SSIM)."""
    depth_weight: float = 1.0
    """Weight of the depth loss."""
    regularisation_weight: float = 1.0
    """Weight of the scale regularisation."""
    means_rate_m: float = 2e-3
    """Adam step of the means in metres at the start; all steps shrink to `final_rate`."""
    final_rate: float = 0.1
    """Share of the learning rates that is left when the budget is spent."""
    exposure: bool = False
    """Fit a gain and an offset per keyframe and channel, and undo them in what the map learns:
    for cameras with automatic exposure, or of different kinds."""
    block_views: int = 400
    """Most keyframes of one block of space, which is refined by itself: bounds the memory."""
    threads: int = 0
    """Threads of the rasteriser; 0 takes its own default."""
    device: Literal["auto", "cpu", "cuda"] = "auto"
    """Where maps are optimised; `auto` is cuda where a device and gsplat are, else cpu."""
    seed: int = 0
    """Seed of the order in which keyframes are visited; equal seeds give equal maps."""

    def validate(self) -> None:
        """Raise ConfigError naming each value that the merge cannot work with."""
        rules = {
            "iterations": (self.iterations >= 0, "expected 0 or more"),
            "passes": (self.passes >= 1, "expected at least 1"),
            "final_rate": (0.0 < self.final_rate <= 1.0, "expected more than 0, at most 1"),
            "converged": (self.converged >= 0.0, "expected 0 or more"),
            "alpha_threshold": (0.0 <= self.alpha_threshold <= 1.0, "expected 0 to 1"),
            "prune_opacity": (0.0 <= self.prune_opacity < 1.0, "expected 0 to 1"),
            "max_gaussians": (self.max_gaussians >= 1, "expected at least 1"),
            "block_views": (self.block_views >= 1, "expected at least 1"),
            "threads": (self.threads >= 0, "expected 0 or more"),
        }
        found = [
            FieldViolation(f"merge.{name}", f"{getattr(self, name)}: {rule}")
            for name, (holds, rule) in rules.items()
            if not holds
        ]
        if found:
            raise ConfigError(f"{found[0].field}: {found[0].description}", violations=tuple(found))


@dataclass(frozen=True, slots=True)
class MeshConfig:
    """How a mesh is made of a map."""

    voxel_m: float = 0.01
    """Side of a voxel, metres."""
    truncation_m: float = 0.04
    """Distance from the surface up to which voxels learn of it, metres."""
    max_depth_m: float = 6.0
    """Depths beyond this are left out, metres."""
    min_alpha: float = 0.9
    """Pixels of the map less opaque than this are left out."""
    min_triangles: int = 200
    """Connected pieces of fewer triangles are dropped; 0 keeps all."""
    views: int = 240
    """Most views that are fused, spread evenly over all poses."""

    def validate(self) -> None:
        """Raise ConfigError naming each value that no mesh can be made with."""
        rules = {
            "voxel_m": (self.voxel_m > 0, "expected more than 0 m"),
            "truncation_m": (self.truncation_m >= self.voxel_m, "expected at least mesh.voxel_m"),
            "max_depth_m": (self.max_depth_m > 0, "expected more than 0 m"),
            "min_alpha": (0.0 < self.min_alpha <= 1.0, "expected more than 0, at most 1"),
            "min_triangles": (self.min_triangles >= 0, "expected 0 or more"),
            "views": (self.views >= 1, "expected at least 1"),
        }
        found = [
            FieldViolation(f"mesh.{name}", f"{getattr(self, name)}: {rule}")
            for name, (holds, rule) in rules.items()
            if not holds
        ]
        if found:
            raise ConfigError(f"{found[0].field}: {found[0].description}", violations=tuple(found))
