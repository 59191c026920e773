"""Sources of RGB-D frames: one layout per file behind one protocol."""

from magic_core.data.check import check_dataset
from magic_core.data.discovery import open_dataset
from magic_core.data.findings import DatasetReport, Finding
from magic_core.data.frame import UNLIMITED, EndOfFrames, Frame, FrameSource
from magic_core.data.replica_writer import write_replica

__all__ = [
    "UNLIMITED",
    "DatasetReport",
    "EndOfFrames",
    "Finding",
    "Frame",
    "FrameSource",
    "check_dataset",
    "open_dataset",
    "write_replica",
]
