"""Sub-maps as the files that the example clients submit."""

from __future__ import annotations

import json
from pathlib import Path

from google.protobuf import json_format

from magic_core.wire import encode_submap
from tests.small_world import LARGE, make_submap


def write_submap(folder: Path, *, agent: int) -> list[str]:
    """header.json and its blobs, lengths and digests left out as a person would; their paths."""
    made = encode_submap(make_submap(agent=agent, camera=LARGE, submaps=3), request_id="")
    header = json_format.MessageToDict(made.header)
    for blob in header["blobs"]:
        del blob["length"], blob["sha256"]
    folder.mkdir()
    paths = [folder / "header.json", *(folder / f"{i}.blob" for i in range(len(made.blobs)))]
    contents = [json.dumps(header).encode(), *made.blobs]
    for path, content in zip(paths, contents, strict=True):
        path.write_bytes(content)
    return [str(path) for path in paths]


def blobs_of(files: list[str]) -> list[bytes]:
    """What lies in the files of blobs."""
    return [Path(file).read_bytes() for file in files[1:]]


def spoil(files: list[str]) -> None:
    """Make it another agent's sub-map, with Gaussians that are none."""
    Path(files[1]).write_bytes(b"MGSC")
    header = json.loads(Path(files[0]).read_text())
    header["name"] = header["name"].replace("agent_0", "agent_1")
    Path(files[0]).write_text(json.dumps(header))
