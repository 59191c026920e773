"""The live RealSense source, on librealsense itself: a software device recorded, then played."""

from __future__ import annotations

import sys
import time

import numpy as np
import pytest

from magic_core.data import UNLIMITED, EndOfFrames, open_dataset
from magic_core.data.realsense import parse_address
from magic_core.errors import DataError, NotSupported

WIDTH, HEIGHT, BASELINE_M, FRAMES = 64, 48, 0.015, 30


@pytest.fixture(scope="module")
def recording(tmp_path_factory):
    """Thirty frames of a wall at 1 m + 1 mm per frame, colour 15 mm beside depth, as librealsense
    writes them."""
    rs = pytest.importorskip("pyrealsense2", reason="needs the realsense extra")
    path = tmp_path_factory.mktemp("realsense") / "wall.db3"
    device = rs.software_device()
    device.register_info(rs.camera_info.name, "software")
    sensors, profiles = [], []
    for uid, (name, stream, form, size, focal) in enumerate(
        (
            ("Stereo Module", rs.stream.depth, rs.format.z16, 2, 60.0),
            ("RGB Camera", rs.stream.color, rs.format.rgb8, 3, 50.0),
        )
    ):
        sensor = device.add_sensor(name)
        video = rs.video_stream()
        video.type, video.index, video.uid, video.fmt, video.bpp = stream, 0, uid, form, size
        video.width, video.height, video.fps = WIDTH, HEIGHT, 30
        lens = rs.intrinsics()
        lens.width, lens.height, lens.fx, lens.fy = WIDTH, HEIGHT, focal, focal
        lens.ppx, lens.ppy, lens.coeffs = (WIDTH - 1) / 2, (HEIGHT - 1) / 2, [0.0] * 5
        lens.model = rs.distortion.brown_conrady
        video.intrinsics = lens
        profiles.append(sensor.add_video_stream(video, True))
        sensors.append(sensor)
    sensors[0].add_read_only_option(rs.option.depth_units, 0.0005)
    extrinsics = rs.extrinsics()
    extrinsics.rotation, extrinsics.translation = np.eye(3).ravel().tolist(), [BASELINE_M, 0, 0]
    profiles[0].register_extrinsics_to(profiles[1], extrinsics)
    device.create_matcher(rs.matchers.default)
    _record(rs, path, device, sensors, profiles)
    return path


def _record(rs, path, device, sensors, profiles):
    recorder = rs.recorder(str(path), device)
    queues = []
    for sensor in recorder.query_sensors():
        queues.append(rs.frame_queue(50))
        sensor.open(sensor.get_stream_profiles()[0])
        sensor.start(queues[-1])
    for k in range(FRAMES):
        depth = np.full((HEIGHT, WIDTH), 2 * (1000 + k), np.uint16)
        colour = np.full((HEIGHT, WIDTH, 3), (5 * k, 20, 30), np.uint8)
        for sensor, profile, pixels, size in (
            (sensors[0], profiles[0], depth, 2),
            (sensors[1], profiles[1], colour, 3),
        ):
            frame = rs.software_video_frame()
            frame.pixels, frame.stride, frame.bpp = pixels, WIDTH * size, size
            frame.timestamp, frame.domain = 5000 + 33.333 * k, rs.timestamp_domain.hardware_clock
            frame.frame_number, frame.profile = k, profile.as_video_stream_profile()
            sensor.on_video_frame(frame)
        time.sleep(0.02)  # the recorder stamps by arrival
    for sensor in recorder.query_sensors():
        sensor.stop()
        sensor.close()


def test_frames_arrive_in_order_with_depth_aligned_to_colour(recording):
    (source,) = open_dataset(f"realsense:?file={recording}")
    assert len(source) == UNLIMITED
    assert (source.camera.width, source.camera.fx) == (WIDTH, pytest.approx(50.0))
    frames = list(source)
    assert len(frames) >= FRAMES // 2  # librealsense may pass over some while it starts
    assert [frame.index for frame in frames] == list(range(len(frames)))
    times = [frame.timestamp_s for frame in frames]
    assert (np.diff(times) > 0.03).all()
    for frame in frames:
        k = round((frame.timestamp_s - 5.0) / 0.033333)
        assert frame.colour[5, 5].tolist() == [5 * k, 20, 30]
        assert frame.depth[24, 32] == pytest.approx(1.0 + 1e-3 * k, abs=1e-6)
        assert frame.world_from_camera is None


def test_a_limit_and_a_stride_are_kept(recording):
    (source,) = open_dataset(f"realsense:?file={recording}", max_frames=2, scale=0.5)
    assert len(source) == 2
    first = source[0]
    assert source[0] is first  # asking again does not skip a frame
    assert first.depth.shape == (HEIGHT // 2, WIDTH // 2)
    source[1]
    with pytest.raises(EndOfFrames):
        source[2]


def test_the_same_recording_is_read_as_a_bag_with_its_extrinsics(recording):
    (source,) = open_dataset(recording)
    assert (source.camera.width, source.camera.fx) == (WIDTH, 50.0)
    assert len(source) == FRAMES
    depth = source[3].depth
    assert source[3].colour[5, 5].tolist() == [15, 20, 30]
    assert depth[24, 32] == pytest.approx(1.003)
    (played,) = open_dataset(f"realsense:?file={recording}")
    aligned = played[0].depth  # librealsense's own alignment of the same wall
    assert ((aligned > 0) != (source[0].depth > 0)).mean() < 0.05


@pytest.mark.slow  # librealsense looks for one for 15 s
def test_no_camera_is_a_clear_error():
    pytest.importorskip("pyrealsense2", reason="needs the realsense extra")
    with pytest.raises(DataError, match="plugged into USB 3"):
        open_dataset("realsense://123456789012")


def test_without_the_extra_it_says_what_to_install(monkeypatch):
    monkeypatch.setitem(sys.modules, "pyrealsense2", None)
    with pytest.raises(NotSupported, match=r"pip install 'magic-slam\[realsense\]'"):
        open_dataset("realsense:")


def test_addresses_say_serial_size_and_rate():
    options = parse_address("realsense://0042?width=848&height=480&fps=60")
    assert (options.serial, options.width, options.height, options.fps) == ("0042", 848, 480, 60)
    assert parse_address("realsense:").serial == ""
    for bad in ("realsense:?width=big", "realsense:?size=3", "realsense:?fps=0"):
        with pytest.raises(DataError, match="expected realsense://"):
            parse_address(bad)
