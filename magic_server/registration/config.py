"""Settings of registration and verification."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from magic_core.errors import ConfigError

Method = Literal["visual", "kiss", "fpfh", "means"]
METHODS: tuple[Method, ...] = ("visual", "kiss", "fpfh", "means")


@dataclass(frozen=True, slots=True)
class RegistrationConfig:
    """How two views are registered and which results count. Gates: measured on real pairs of
    anchors, see benchmarks/loops."""

    methods: tuple[Method, ...] = ("visual", "kiss")
    """Coarse methods, each giving hypotheses: `visual` (SIFT with depth), `kiss` (KISS-Matcher),
    `fpfh` (the paper's FPFH + RANSAC), `means` (the same on the means of a sub-map's Gaussians, the
    paper's ablation; an image that is to be localised has none)."""
    seed: int = 0
    """Seed of all random sampling; the same views give the same result."""
    max_hypotheses: int = 3
    """Hypotheses per method that are refined and compared."""

    max_keyframes: int = 4
    """How many images besides the anchor's are used, where the view has them: four find half as
    many loops again as the anchors alone, and all of them bear witness in verification."""
    max_depth_m: float = 6.0
    """Farther readings are ignored."""
    max_width: int = 360
    """Images wider than this are halved first (until they are not)."""
    pyramid_levels: int = 3
    """Sizes of the refinement, each half the one before."""
    cloud_voxel_m: float = 0.02
    """Voxel size of the point clouds of the coarse methods."""
    max_keypoints: int = 1500
    """SIFT keypoints per image."""

    depth_sigma_m: float = 0.0025
    """Noise of a depth reading near the camera."""
    depth_sigma_per_m: float = 0.003
    """Its growth with the squared distance (per metre squared, beyond 0.4 m)."""
    texture_sigma: float = 0.35
    """Noise of the contrast-normalised intensity (which has standard deviation about 1)."""
    correlated_pixels: float = 60.0
    """Neighbouring residuals are not independent: so many count as one in the information."""
    systematic_m: float = 0.005
    """Error of translation that no number of pixels averages out."""
    systematic_rad: float = 0.003
    """The same for rotation."""
    keyframe_drift_m: float = 0.004
    """Added where keyframes take part: the tracker drifts within their sub-maps."""
    keyframe_drift_rad: float = 0.002
    """The same for rotation."""
    residual_share: float = 1.5
    """Added to an accepted loop's error of translation for each metre that the aligned surfaces
    stay apart (point-to-plane root mean square): drift within sub-maps keeps them apart."""
    residual_lever_m: float = 2.0
    """Distance at which that acts as rotation."""

    min_inliers: int = 4
    """Least inliers of the coarse method (its own count)."""
    min_overlap: float = 0.15
    """Least share of either view's readings that the other one confirms."""
    min_fitness: float = 0.45
    """Least share of the readings that fall on readings of the other view and agree in depth."""
    max_rmse_m: float = 0.04
    """Largest point-to-plane root mean square of agreeing readings."""
    min_texture_correlation: float = 0.5
    """Least correlation of contrast-normalised intensity where both views agree in depth."""
    min_colour_correlation: float = 0.5
    """Least correlation of the opponent colours there, where the place has colours."""
    max_free_space: float = 0.04
    """Largest share of readings that stand in space which the other view saw through."""
    min_information: float = 100.0
    """Least eigenvalue of the information, 1/m^2 and 1/rad^2 (100: 10 cm, 0.1 rad)."""

    def __post_init__(self) -> None:
        unknown = [name for name in self.methods if name not in METHODS]
        if unknown or not self.methods:
            raise ConfigError.field(
                "registration.methods", f"{self.methods}: expected some of {', '.join(METHODS)}"
            )
        if self.pyramid_levels < 1 or self.max_hypotheses < 1 or self.max_keyframes < 0:
            raise ConfigError.field(
                "registration", "pyramid_levels and max_hypotheses are at least 1"
            )
        if self.residual_share < 0:
            raise ConfigError.field("registration.residual_share", "must not be negative")
        for name in (
            "cloud_voxel_m", "max_depth_m", "depth_sigma_m", "texture_sigma", "residual_lever_m",
        ):  # fmt: skip
            if getattr(self, name) <= 0:
                raise ConfigError.field(f"registration.{name}", "must be > 0")
