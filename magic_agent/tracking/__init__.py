"""Tracking: the pose of each frame against the active sub-map."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from magic_agent.tracking.config import TrackingConfig

if TYPE_CHECKING:
    from magic_agent.tracking.result import TrackingResult
    from magic_agent.tracking.tracker import Tracker

__all__ = ["Tracker", "TrackingConfig", "TrackingResult"]


def __getattr__(name: str) -> Any:
    """Load the tracker (and with it numba) only when it is used; settings load without it."""
    if name == "Tracker":
        from magic_agent.tracking.tracker import Tracker

        return Tracker
    if name == "TrackingResult":
        from magic_agent.tracking.result import TrackingResult

        return TrackingResult
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
