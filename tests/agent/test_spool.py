"""The agent's spool: what lies on disk is whole, ordered, and survives the process."""

import numpy as np
import pytest

from magic_agent.spool import Spool
from magic_core.errors import CorruptData
from magic_core.gaussians import GaussianCloud
from magic_core.geometry import Camera, se3
from magic_core.submap import Descriptor, Keyframe, Submap, TrackedFrame
from magic_core.wire import decode_submap, encode_submap


def submap(index: int) -> Submap:
    rng = np.random.default_rng(index)
    camera = Camera(width=8, height=6, fx=8.0, fy=8.0, cx=3.5, cy=2.5)
    cloud = GaussianCloud.from_arrays(
        rng.normal(size=(5, 3)),
        np.tile([1.0, 0.0, 0.0, 0.0], (5, 1)),
        scales=np.full((5, 3), 0.02),
        opacities=np.full(5, 0.7),
        colours=rng.uniform(size=(5, 3)),
    )
    colour = rng.integers(0, 255, (6, 8, 3), dtype=np.uint8)
    depth = np.full((6, 8), 1.5, np.float32)
    return Submap(
        session="kitchen",
        agent="robot",
        index=index,
        camera=camera,
        gaussians=cloud,
        keyframes=(Keyframe(0, 0.0, se3.identity(), colour, depth),),
        trajectory=(TrackedFrame(0, 0.0, se3.identity()),),
        descriptor=Descriptor("test-model", np.array([1.0, 0.0], np.float32)),
    )


def add(spool: Spool, index: int) -> None:
    spool.add(index, encode_submap(submap(index), request_id=f"request-{index}"))


def test_a_spooled_submap_reads_back_bit_for_bit(tmp_path):
    encoded = encode_submap(submap(3), request_id="request-3")
    Spool(tmp_path).add(3, encoded)
    loaded = Spool(tmp_path).load(3)
    assert loaded.header == encoded.header
    assert loaded.blobs == encoded.blobs
    assert decode_submap(loaded.header, loaded.blobs).index == 3


def test_pending_submaps_come_in_order_and_leave_once_removed(tmp_path):
    spool = Spool(tmp_path)
    for index in (2, 0, 11):
        add(spool, index)
    assert Spool(tmp_path).pending() == [0, 2, 11]
    spool.remove(2)
    spool.remove(2)
    assert spool.pending() == [0, 11]


def test_what_a_crash_left_half_written_is_not_pending(tmp_path):
    (tmp_path / ".000004.partial").write_bytes(b"half")
    assert Spool(tmp_path).pending() == []
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("damage", [lambda data: data[:-3], lambda data: b"other" + data])
def test_a_damaged_file_is_named(tmp_path, damage):
    spool = Spool(tmp_path)
    add(spool, 1)
    path = tmp_path / "000001.submap"
    path.write_bytes(damage(path.read_bytes()))
    with pytest.raises(CorruptData, match=r"000001\.submap"):
        spool.load(1)
