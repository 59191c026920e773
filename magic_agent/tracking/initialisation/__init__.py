"""Registration of a frame to the one before it: the start of the refinement."""

from __future__ import annotations

from magic_agent.tracking.initialisation.base import InitialPose, PoseInitialiser
from magic_agent.tracking.initialisation.choice import make_initialiser

__all__ = ["InitialPose", "PoseInitialiser", "make_initialiser"]
