"""What an agent writes of every frame: cost, inliers, conditioning, lost or recovered."""

from __future__ import annotations

import math
from pathlib import Path

from magic_agent.slam import FrameResult
from magic_core.evaluation.frame_records import FrameLog, FrameRecord, state_of


class FrameReport:
    """Turns results into lines of `frames.csv`."""

    def __init__(self, folder: Path) -> None:
        self._log = FrameLog(folder)
        self._lost = False

    def add(self, result: FrameResult) -> None:
        """Write one frame."""
        tracked = result.tracked
        verdict = tracked.verdict if tracked is not None else ("lost" if result.lost else None)
        state = state_of(verdict, lost_before=self._lost)
        self._lost = state == "lost"
        unknown = math.nan
        self._log.add(
            FrameRecord(
                frame=result.frame_index,
                timestamp_s=result.timestamp_s,
                submap=result.submap_index,
                state=state,
                reason=tracked.reason if tracked else "",
                cost=tracked.cost if tracked else unknown,
                inlier_share=tracked.inlier_share if tracked else unknown,
                visible_share=tracked.visible_share if tracked else unknown,
                colour_error=tracked.colour_error if tracked else unknown,
                condition_number=tracked.condition_number if tracked else unknown,
                gain=tracked.gain if tracked else unknown,
                bias=tracked.bias if tracked else unknown,
                renders=tracked.renders if tracked else 0,
                tracking_ms=result.tracking_ms,
                mapping_ms=result.mapping_ms,
                keyframe=result.is_keyframe,
            )
        )

    def close(self) -> None:
        """Close the file."""
        self._log.close()
