"""Settings of mapping: our fast schedule, and the paper's."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Literal

from magic_core.errors import ConfigError, FieldViolation
from magic_core.geometry import Camera

_UNBOUNDED = 10_000_000
_PER_PIXEL = 2
"""45 frames of a room take 0.8 to 1.0 per pixel at 640x480 and at half that size."""


@dataclass(frozen=True, slots=True)
class KeyframeConfig:
    """When a frame becomes a keyframe (fast schedule): it moved, turned or sees new surface."""

    translation: float = 0.05
    """Motion since the last keyframe as a share of the median depth."""
    rotation_deg: float = 5.0
    """Turn since the last keyframe in degrees."""
    novelty: float = 0.06
    """Share of the frame's pixels that the sub-map does not explain."""
    urgent_novelty: float = 0.3
    """The same, above which a live agent takes a keyframe even when it has no time."""
    min_gap: int = 2
    """Frames between keyframes at least, so that mapping cannot starve tracking."""
    max_gap: int = 10
    """Frames between keyframes at most."""


@dataclass(frozen=True, slots=True)
class MappingConfig:
    """How an agent turns keyframes into Gaussians.

    With `schedule = "paper"` the paper's values replace the settings that `paper_schedule` lists.
    """

    schedule: Literal["paper", "fast"] = "fast"
    """`fast`: adaptive seeding, keyframes by novelty, few iterations. `paper`: every 5th frame,
    uniform seeding, 100 iterations."""
    device: Literal["auto", "cpu", "cuda"] = "auto"
    """Where the map is optimised; `auto` is cuda where a device and gsplat are, else cpu."""
    keyframes: KeyframeConfig = field(default_factory=KeyframeConfig)
    keyframe_every: int = 0
    """Fixed keyframe interval in frames; 0 chooses keyframes by novelty."""
    iterations: int = 14
    """Optimisation steps per keyframe."""
    anchor_iterations: int = 28
    """Optimisation steps on the first keyframe of a sub-map."""
    least_iterations: int = 3
    """Optimisation steps per keyframe that a live agent takes even when it has no time."""
    closing_iterations: int = 0
    """Optimisation steps over all keyframes before a finished sub-map is handed over. They sharpen
    it more than as many steps on the way, but the frame of the hand-over waits for them; a live
    agent takes those that it has time for."""
    settle: float = 0.01
    """Stop early when an iteration gains less than this share of the loss; 0 never stops early."""
    newest_share: float = 0.4
    """Share of the steps that go to the newest keyframe; the rest is spread over the sub-map."""
    seeding: Literal["adaptive", "uniform"] = "adaptive"
    """`adaptive`: a quadtree of flat Gaussians. `uniform`: the paper's sample of pixels."""
    fill_holes: bool = True
    """Seed where there is no depth reading too, at the depth of the surroundings."""
    seeds_per_keyframe: int = 30_000
    """Most Gaussians that one keyframe may add (M_k of the paper)."""
    seed_opacity: float = 0.9
    """Opacity of a new Gaussian."""
    seed_spread: float = 0.6
    """Standard deviation of a new Gaussian in sides of the pixel block it stands for."""
    seed_colour_deviation: float = 0.03
    """Colour deviation up to which a block of pixels becomes one Gaussian (0 to 1)."""
    alpha_threshold: float = 0.9
    """Rendered alpha below which a pixel needs new Gaussians."""
    depth_error_factor: float = 40.0
    """A depth error above this multiple of the frame's median error needs new Gaussians."""
    prune_opacity: float = 0.1
    """Gaussians below this opacity are removed after each keyframe."""
    prune_scale: float = 0.25
    """Gaussians with a standard deviation above this share of the median depth are removed."""
    max_gaussians: int = 0
    """Bound of one sub-map: when it is reached nothing more is seeded. 0 allows two per pixel of
    the image. With `max_keyframes` it bounds the agent's memory."""
    max_keyframes: int = 40
    """Keyframes of one sub-map whose images are kept; the one that the others cover best makes
    room."""
    exposure_step: float = 0.2
    """Change of brightness, as a share of full scale, from which a keyframe is brought to the
    sub-map's exposure before it is mapped; 0 never does."""
    ssim_weight: float = 0.2
    """lambda of the colour loss: (1 - lambda) L1 + lambda (1 - SSIM)."""
    depth_weight: float = 1.0
    """Weight of the depth loss."""
    regularisation_weight: float = 1.0
    """Weight of the scale regularisation."""

    means_rate_m: float = 1e-3
    """Adam step of the means in metres: larger than in offline 3DGS, as few steps are taken."""

    def gaussian_bound(self, camera: Camera) -> int:
        """Most Gaussians of one sub-map of a camera's images."""
        return self.max_gaussians or _PER_PIXEL * camera.width * camera.height

    def resolved(self) -> MappingConfig:
        """This config with the schedule's values put in, after checking the ranges."""
        config = paper_schedule(self) if self.schedule == "paper" else self
        config.validate()
        return config

    def validate(self) -> None:
        """Raise ConfigError naming each value that mapping cannot work with."""
        rules = {
            "iterations": (self.iterations >= 1, "expected at least 1"),
            "anchor_iterations": (self.anchor_iterations >= 1, "expected at least 1"),
            "closing_iterations": (self.closing_iterations >= 0, "expected 0 or more"),
            "least_iterations": (self.least_iterations >= 0, "expected 0 or more"),
            "keyframe_every": (self.keyframe_every >= 0, "expected 0 or more frames"),
            "newest_share": (0.0 <= self.newest_share <= 1.0, "expected 0 to 1"),
            "seed_opacity": (0.0 < self.seed_opacity < 1.0, "expected between 0 and 1"),
            "seed_spread": (self.seed_spread > 0.0, "expected more than 0"),
            "alpha_threshold": (0.0 < self.alpha_threshold <= 1.0, "expected 0 to 1"),
            "seeds_per_keyframe": (self.seeds_per_keyframe >= 1, "expected at least 1"),
            "exposure_step": (self.exposure_step >= 0.0, "expected 0 or more"),
            "max_keyframes": (self.max_keyframes >= 3, "expected at least 3"),
            "max_gaussians": (self.max_gaussians >= 0, "expected 0 (by image size) or more"),
        }
        found = [
            FieldViolation(f"mapping.{name}", f"{getattr(self, name)}: {rule}")
            for name, (holds, rule) in rules.items()
            if not holds
        ]
        if found:
            raise ConfigError(f"{found[0].field}: {found[0].description}", violations=tuple(found))


def paper_schedule(config: MappingConfig) -> MappingConfig:
    """The values of the paper's supplement, "Mapping", put into a config; it knows no bound."""
    return replace(
        config,
        keyframe_every=5,
        iterations=100,
        anchor_iterations=100,
        closing_iterations=0,
        settle=0.0,
        seeding="uniform",
        seeds_per_keyframe=60_000,
        seed_opacity=0.5,
        alpha_threshold=0.98,
        depth_error_factor=40.0,
        prune_opacity=0.1,
        max_gaussians=_UNBOUNDED,
        exposure_step=0.0,
        fill_holes=False,
    )
