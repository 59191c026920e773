"""Sources of RGB-D frames: one layout per file behind one protocol."""

from magic_core.data.check import DatasetReport, Finding, check_dataset
from magic_core.data.discovery import open_dataset
from magic_core.data.frame import Frame, FrameSource
from magic_core.data.replica_writer import write_replica

__all__ = [
    "DatasetReport",
    "Finding",
    "Frame",
    "FrameSource",
    "check_dataset",
    "open_dataset",
    "write_replica",
]
