"""Settings of the merge."""

from __future__ import annotations

from dataclasses import dataclass

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
    converged: float = 0.0
    """Stop early when a keyframe's loss falls by less than this share from visit to visit, on the
    mean of a pass; 0 spends the budget, which real images repay."""
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
    means_rate_m: float = 1e-3
    """Adam step of the means in metres at the start; all steps shrink to `final_rate`."""
    final_rate: float = 0.3
    """Share of the learning rates that is left when the budget is spent."""
    threads: int = 0
    """Threads of the rasteriser; 0 takes its own default."""
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
            "threads": (self.threads >= 0, "expected 0 or more"),
        }
        found = [
            FieldViolation(f"merge.{name}", f"{getattr(self, name)}: {rule}")
            for name, (holds, rule) in rules.items()
            if not holds
        ]
        if found:
            raise ConfigError(f"{found[0].field}: {found[0].description}", violations=tuple(found))
