"""From a path to the frame sources in it: one per agent."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from magic_core.data.frame import FrameSource
from magic_core.data.replica import is_replica, open_replica
from magic_core.data.sequence import FileSequence
from magic_core.data.tum import is_tum, open_tum
from magic_core.errors import DataError

SYNTHETIC_SCHEME = "synthetic:"
_LAYOUTS: tuple[tuple[str, Callable[[Path], bool], Callable[..., FileSequence]], ...] = (
    ("TUM RGB-D", is_tum, open_tum),
    ("Replica", is_replica, open_replica),
)


def open_dataset(
    path: Path | str, *, scale: float = 1.0, max_frames: int | None = None, stride: int = 1
) -> list[FrameSource]:
    """One source per agent of a dataset, sorted by name.

    A folder that holds a recording itself gives one source, named after the folder where that
    is `agent_*` and `agent_0` otherwise. A folder of recordings gives one source per sub-folder;
    where some are called `agent_*`, only those count. `synthetic://flat?agents=3&frames=120`
    renders the built-in flat. `stride` and `max_frames` choose frames, `scale` their size.
    """
    if str(path).startswith(SYNTHETIC_SCHEME):
        from magic_core.data.synthetic import open_synthetic  # loads Open3D only when asked for

        return open_synthetic(str(path), scale=scale, max_frames=max_frames, stride=stride)
    folder = Path(path).expanduser()
    sources: list[FrameSource] = []
    for name, recording in recordings(folder):
        open_layout = _layout_of(recording)
        assert open_layout is not None
        sources.append(
            open_layout(recording, name=name, scale=scale, max_frames=max_frames, stride=stride)
        )
    return sources


def recordings(folder: Path) -> list[tuple[str, Path]]:
    """(agent name, folder) of every recording at or directly under `folder`."""
    if not folder.is_dir():
        raise DataError(f"{folder}: no such folder; give the folder of a dataset")
    if _layout_of(folder) is not None:
        name = folder.resolve().name
        return [(name if name.startswith("agent_") else "agent_0", folder)]
    found = [child for child in sorted(folder.iterdir()) if child.is_dir() and _layout_of(child)]
    agents = [child for child in found if child.name.startswith("agent_")]
    if not found:
        raise DataError(
            f"{folder}: no recording found. Expected agent_*/ folders, or one recording, with "
            "results/frame%06d.jpg + results/depth%06d.png (Replica layout) or rgb.txt + "
            "depth.txt (TUM layout)"
        )
    return [(child.name, child) for child in (agents or found)]


def layout_name(folder: Path) -> str | None:
    """The name of the layout of the recording in `folder`, None where there is none."""
    return next((name for name, detect, _ in _LAYOUTS if detect(folder)), None)


def _layout_of(folder: Path) -> Callable[..., FileSequence] | None:
    return next((opened for _, detect, opened in _LAYOUTS if detect(folder)), None)
