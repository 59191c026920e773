"""Settings of the tracker; units stand in the names, defaults are the measured best."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

from magic_core.errors import ConfigError
from magic_core.render.linearisation import ResidualModel

Solver = Literal["gauss_newton", "gn", "adam"]
Initialisation = Literal[
    "constant_velocity", "dense", "rgbd_odometry", "point_to_plane", "coloured_icp"
]


@dataclass(frozen=True, slots=True)
class GaussNewtonConfig:
    """Second-order refinement against the rendered sub-map."""

    levels: int = 4
    """Pyramid levels, the full image included; coarse to fine."""
    finest_level: int = 0
    """Level at which to stop; 0 is the full image."""
    initialised_level: int = 1
    """Level at which refinement begins after a successful registration to the previous frame."""
    iterations: tuple[int, ...] = (4, 5, 6, 8)
    """Most iterations per level, full image first; the last number serves all coarser levels."""
    renders: int = 2
    """Most renders of the sub-map per frame."""
    rerender_pixels: float = 3.0
    """Render again where the solution lies farther than this from the pose of the last render."""
    converged_pixels: float = 0.05
    """A level is done when a step moves the image by less than this, in pixels of that level; the
    next step would move it by far less."""
    photometric: bool = True
    """Estimate gain and bias of each frame."""
    gain_deviation: float = 0.1
    """Expected deviation of the gain from that of the frame before."""
    bias_deviation: float = 0.05
    """Expected deviation of the bias from that of the frame before, in units of full scale."""
    alpha_power: int = 3
    """Soft alpha mask: alpha to this power (paper, supplementary: 3)."""
    inlier_factor: float = 50.0
    """Inlier mask: depth errors beyond this many medians are left out (paper: 50)."""
    residuals: ResidualModel = field(default_factory=ResidualModel)
    """Noise model and robust widths."""
    min_contrast: float = 0.01
    """Below this standard deviation of grey values colour does not count (dark, covered lens)."""
    pixels_per_sample: float = 60.0
    """Neighbouring residuals are correlated: this many pixels count as one measurement."""
    prior_translation_m: float = 0.05
    """Deviation of the motion prior; it decides only where the images do not."""
    prior_rotation_deg: float = 3.0
    """Deviation of the motion prior; it decides only where the images do not."""
    degenerate_below: float = 10.0
    """A direction with less information than this, in units of the motion prior's, is degenerate:
    the pose follows the prior there. 10 is a deviation of 1.6 cm or 0.9 degrees."""
    probe_pixels: float = 6.0
    """Weak directions are probed: poses that move the image so far must fit visibly worse."""


@dataclass(frozen=True, slots=True)
class KeyframeWindowConfig:
    """Earlier images that Gauss-Newton aligns with, beside the rendered sub-map."""

    images: int = 2
    """Most images in the window; 0 aligns with the sub-map alone, as the paper does."""
    new_overlap: float = 0.8
    """The current image joins when the newest one's overlap with it falls below this share."""
    min_overlap: float = 0.45
    """An image leaves when its overlap with the current one falls below this share."""
    min_inlier_share: float = 0.6
    """An image leaves when fewer of its depths agree with the current one."""
    finest_level: int = 1
    """Finest pyramid level at which images are compared."""


@dataclass(frozen=True, slots=True)
class AdamConfig:
    """The paper's first-order refinement (section Tracking; supplementary, hyperparameters)."""

    iterations: int = 60
    """Gradient steps per frame (paper: 60 on Replica, 200 on Aria)."""
    rotation_rate: float = 2e-4
    """Learning rate of the rotation (paper: 2e-4 on Replica, 2e-3 on Aria)."""
    translation_rate: float = 2e-3
    """Learning rate of the translation (paper: 2e-3 on Replica, 1e-2 on Aria)."""
    colour_weight: float = 0.95
    """lambda_c, the weight of colour against depth (paper: 0.95 on Replica, 0.6 on Aria)."""
    alpha_power: int = 3
    """Soft alpha mask: alpha to this power (paper: 3)."""
    inlier_factor: float = 50.0
    """Inlier mask: errors beyond this many medians are left out (paper: 50)."""


@dataclass(frozen=True, slots=True)
class LostConfig:
    """When a pose is not to be believed."""

    min_inlier_share: float = 0.6
    """Least share of visible depths that agree with the sub-map, by the sensor's noise."""
    min_visible_share: float = 0.1
    """Least share of the image that shows known parts of the sub-map."""
    max_colour_error: float = 0.04
    """Colour residuals up to this deviation are never a reason, in units of full scale."""
    max_colour_growth: float = 2.5
    """Colour residuals beyond this many times their recent level do not show the same place."""
    max_gain: float = 2.5
    """Largest factor between the gain expected and the one found; more is no likeness."""
    max_jump_m: float = 0.35
    """Largest translation between consecutive frames."""
    max_turn_deg: float = 25.0
    """Largest rotation between consecutive frames."""
    min_valid_depth_share: float = 0.02
    """Least share of pixels with a depth reading for a frame to be tracked with depth."""
    min_contrast: float = 0.01
    """Least standard deviation of the grey image, in units of full scale (black frames)."""


@dataclass(frozen=True, slots=True)
class RelocalisationConfig:
    """How a lost frame is found again in the active sub-map."""

    keypoints: int = 500
    """SIFT keypoints per image."""
    ratio: float = 0.85
    """Nearest against second nearest descriptor distance of a match, at most."""
    reprojection_px: float = 3.0
    """Reprojection error of an inlier, at most."""
    min_inliers: int = 15
    """Keypoints that must support a pose."""
    shape_every: int = 4
    """Of the frames lost in a row every so many are registered by shape, where keypoints fail."""
    shape_keyframes: int = 2
    """Keyframes that a frame is registered with by shape: those with most descriptors in common."""
    min_shape_inliers: int = 10
    """Matches of shape that must support a pose."""
    refined: int = 3
    """Best hypotheses that are refined against the sub-map."""
    min_inlier_share: float = 0.6
    """Share of depths that must agree with the sub-map after refinement."""
    max_correction_m: float = 0.15
    """Refinement that moves farther than this went to another minimum."""
    max_correction_deg: float = 8.0
    """Refinement that turns farther than this went to another minimum."""


@dataclass(frozen=True, slots=True)
class TrackingConfig:
    """How each frame's pose is found."""

    solver: Solver = "gauss_newton"
    """Refinement against the sub-map; `gn` is short for gauss_newton, `adam` is the paper's."""
    initialisation: Initialisation = "dense"
    """Registration to the previous frame that starts the refinement."""
    backend: Literal["cpu", "cuda"] = "cpu"
    """What renders the sub-map for tracking: our kernels, or gsplat on a CUDA device."""
    rotation_prealignment: bool = True
    """Align the rotation on tiny images first where the prediction does not fit (fast turns)."""
    gauss_newton: GaussNewtonConfig = field(default_factory=GaussNewtonConfig)
    window: KeyframeWindowConfig = field(default_factory=KeyframeWindowConfig)
    adam: AdamConfig = field(default_factory=AdamConfig)
    lost: LostConfig = field(default_factory=LostConfig)
    relocalisation: RelocalisationConfig = field(default_factory=RelocalisationConfig)

    def __post_init__(self) -> None:
        if self.solver == "gn":
            object.__setattr__(self, "solver", "gauss_newton")
        if not 1 <= self.gauss_newton.levels <= 8:
            raise ConfigError.field("tracking.gauss_newton.levels", "expected 1 to 8")
        if self.gauss_newton.renders < 1:
            raise ConfigError.field("tracking.gauss_newton.renders", "expected at least 1")
