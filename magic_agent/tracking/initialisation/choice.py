"""From the name of a method to the method."""

from __future__ import annotations

from magic_agent.tracking.config import TrackingConfig
from magic_agent.tracking.initialisation.base import PoseInitialiser
from magic_agent.tracking.initialisation.constant_velocity import ConstantVelocity
from magic_agent.tracking.initialisation.dense import Dense
from magic_agent.tracking.initialisation.registration_icp import (
    COLOURED,
    POINT_TO_PLANE,
    RegistrationIcp,
)
from magic_agent.tracking.initialisation.rgbd_odometry import RgbdOdometry
from magic_agent.tracking.pyramid_cache import PyramidCache
from magic_core.errors import ConfigError


def make_initialiser(config: TrackingConfig, pyramids: PyramidCache) -> PoseInitialiser:
    """The initialiser that the configuration names."""
    match config.initialisation:
        case "constant_velocity":
            return ConstantVelocity()
        case "dense":
            return Dense(config.gauss_newton, pyramids)
        case "rgbd_odometry":
            return RgbdOdometry()
        case "point_to_plane":
            return RegistrationIcp("point_to_plane", POINT_TO_PLANE)
        case "coloured_icp":
            return RegistrationIcp("coloured", COLOURED)
    raise ConfigError.field("tracking.initialisation", f"{config.initialisation!r} is unknown")
