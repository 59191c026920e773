"""ROS bags as RealSense and Azure Kinect drivers and librealsense record them."""

from __future__ import annotations

import re
from pathlib import Path

import cv2
import numpy as np
import pytest
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Writer2
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from magic_core.data import open_dataset
from magic_core.data.discovery import layout_of
from magic_core.errors import DataError
from magic_core.geometry import Camera
from tests.core.layout_writers import millimetres
from tests.core.small_flat import small_flat, small_frames

FRAMES = list(small_frames(0))[:4]
CAMERA = small_flat()[0].camera
START_S = 1_700_000_000
OPTICAL = "camera_color_optical_frame"
REALSENSE = ("/camera/color/image_raw", "/camera/aligned_depth_to_color/image_raw")
AZURE = ("/rgb/image_raw", "/depth_to_rgb/image_raw")


class BagFile:
    """Writes messages of either ROS to a bag."""

    def __init__(self, path: Path, *, plugin: StoragePlugin | None = None) -> None:
        self.path, self.two = path, path.suffix != ".bag"
        self.store = get_typestore(Stores.ROS2_HUMBLE if self.two else Stores.ROS1_NOETIC)
        tf = get_types_from_msg(
            "geometry_msgs/TransformStamped[] transforms", "tf2_msgs/msg/TFMessage"
        )
        self.store.register(tf)
        if self.two:
            plugin = plugin or StoragePlugin.MCAP
            self._writer = Writer2(path, version=9, storage_plugin=plugin)
        else:
            self._writer = Writer1(path)
        self._connections = {}

    def __enter__(self):
        self._writer.open()
        return self

    def __exit__(self, *_):
        self._writer.close()

    def type(self, name: str):
        return self.store.types[name]

    def header(self, stamp_s: float, frame_id: str):
        whole = int(stamp_s)
        stamp = self.type("builtin_interfaces/msg/Time")(whole, round((stamp_s - whole) * 1e9))
        extra = {} if self.two else {"seq": 0}
        return self.type("std_msgs/msg/Header")(stamp=stamp, frame_id=frame_id, **extra)

    def write(self, topic: str, message, logged_s: float) -> None:
        name = message.__msgtype__
        if topic not in self._connections:
            self._connections[topic] = self._writer.add_connection(
                topic, name, typestore=self.store
            )
        serialise = self.store.serialize_cdr if self.two else self.store.serialize_ros1
        self._writer.write(
            self._connections[topic], round(logged_s * 1e9), serialise(message, name)
        )

    def image(self, topic, pixels, encoding, stamp_s, *, frame_id=OPTICAL, padding=0):
        rows = pixels.reshape(len(pixels), -1).view(np.uint8)
        rows = np.pad(rows, ((0, 0), (0, padding)))
        message = self.type("sensor_msgs/msg/Image")(
            header=self.header(stamp_s, frame_id), height=pixels.shape[0], width=pixels.shape[1],
            encoding=encoding, is_bigendian=0, step=rows.shape[1], data=rows.ravel(),
        )  # fmt: skip
        self.write(topic, message, stamp_s + 0.011)  # a bag logs a message when it arrives

    def compressed(self, topic, data, form, stamp_s, *, frame_id=OPTICAL):
        message = self.type("sensor_msgs/msg/CompressedImage")(
            header=self.header(stamp_s, frame_id), format=form, data=np.frombuffer(data, np.uint8)
        )
        self.write(topic, message, stamp_s + 0.011)

    def camera_info(self, topic, camera: Camera, *, distortion=(0.0,) * 5, model="plumb_bob"):
        k = camera.matrix.ravel()
        fields = {"d": np.array(distortion), "k": k, "r": np.eye(3).ravel(), "p": np.zeros(12)}
        if not self.two:
            fields = {name.upper(): value for name, value in fields.items()}
        roi = self.type("sensor_msgs/msg/RegionOfInterest")(0, 0, 0, 0, False)
        message = self.type("sensor_msgs/msg/CameraInfo")(
            header=self.header(START_S, OPTICAL), height=camera.height, width=camera.width,
            distortion_model=model, binning_x=0, binning_y=0, roi=roi, **fields,
        )  # fmt: skip
        self.write(topic, message, START_S)

    def transform(self, translation, rotation_xyzw=(0.0, 0.0, 0.0, 1.0)):
        vector = self.type("geometry_msgs/msg/Vector3")(*map(float, translation))
        return self.type("geometry_msgs/msg/Transform")(
            vector, self.type("geometry_msgs/msg/Quaternion")(*rotation_xyzw)
        )

    def static(self, parent, child, translation, rotation_xyzw=(0.0, 0.0, 0.0, 1.0)):
        link = self.type("geometry_msgs/msg/TransformStamped")(
            self.header(START_S, parent), child, self.transform(translation, rotation_xyzw)
        )
        message = self.type("tf2_msgs/msg/TFMessage")([link])
        self.write("/tf_static", message, START_S)


def stamp(k: int) -> float:
    return START_S + 0.5 + k / 30


def write_driver_bag(path: Path, topics, *, plugin=None, encodings=("rgb8", "16UC1")) -> Path:
    """What `rosbag record` of a camera driver's registered topics holds."""
    colour_topic, depth_topic = topics
    with BagFile(path, plugin=plugin) as bag:
        for topic in topics:
            bag.camera_info(topic.rsplit("/", 1)[0] + "/camera_info", CAMERA)
        for k, frame in enumerate(FRAMES):
            colour, depth = frame.colour, millimetres(frame)
            if encodings[0] == "bgra8":
                colour = np.dstack([frame.colour[..., ::-1], np.full_like(depth, 255, np.uint8)])
            if encodings[1] == "32FC1":
                depth = np.where(frame.depth > 0, frame.depth, np.nan).astype(np.float32)
            bag.image(colour_topic, np.ascontiguousarray(colour), encodings[0], stamp(k), padding=4)
            bag.image(depth_topic, depth, encodings[1], stamp(k) + 0.004)
            infra = np.zeros((4, 4), np.uint8)
            bag.image("/camera/infra1/image_rect_raw", infra, "mono8", stamp(k))
    return path


def assert_frames_are_the_flat(source, *, depth_error=6e-4):
    assert len(source) == len(FRAMES)
    assert (source.camera.width, source.camera.height) == (CAMERA.width, CAMERA.height)
    assert source.camera.fx == pytest.approx(CAMERA.fx)
    for k in (2, 0, 3):  # at random
        frame = source[k]
        assert frame.timestamp_s == pytest.approx(stamp(k), abs=1e-6)
        np.testing.assert_array_equal(frame.colour, FRAMES[k].colour)
        assert np.abs(frame.depth - FRAMES[k].depth).max() < depth_error
        assert frame.world_from_camera is None


@pytest.mark.parametrize(
    ("name", "plugin"),
    [("office.bag", None), ("mcap", StoragePlugin.MCAP), ("sqlite", StoragePlugin.SQLITE3)],
)
@pytest.mark.parametrize(
    ("topics", "encodings"),
    [(REALSENSE, ("rgb8", "16UC1")), (AZURE, ("bgra8", "32FC1"))],
    ids=["realsense", "azure"],
)
def test_a_drivers_bag_is_read_at_random(tmp_path, name, plugin, topics, encodings):
    path = write_driver_bag(tmp_path / name, topics, plugin=plugin, encodings=encodings)
    assert layout_of(path).name == "ROS bag"
    (source,) = open_dataset(path)
    assert_frames_are_the_flat(source)


@pytest.mark.parametrize("plugin", [StoragePlugin.MCAP, StoragePlugin.SQLITE3])
def test_a_bare_ros2_file_is_read_too(tmp_path, plugin):
    folder = write_driver_bag(tmp_path / "bag", REALSENSE, plugin=plugin)
    (file,) = (child for child in folder.iterdir() if child.suffix in (".mcap", ".db3"))
    alone = file.rename(tmp_path / f"agent_7{file.suffix}")
    (source,) = open_dataset(alone)
    assert source.name == "agent_7"
    assert_frames_are_the_flat(source)


def test_compressed_colour_and_compressed_depth_are_read(tmp_path):
    with BagFile(tmp_path / "compressed.bag") as bag:
        bag.camera_info("/camera/color/camera_info", CAMERA)
        for k, frame in enumerate(FRAMES):
            colour = cv2.imencode(".png", frame.colour[..., ::-1])[1].tobytes()
            depth = bytes(12) + cv2.imencode(".png", millimetres(frame))[1].tobytes()
            bag.compressed("/camera/color/image_raw/compressed", colour, "rgb8; png", stamp(k))
            bag.compressed(
                "/camera/aligned_depth_to_color/image_raw/compressedDepth",
                depth, "16UC1; compressedDepth png", stamp(k),
            )  # fmt: skip
    assert_frames_are_the_flat(open_dataset(tmp_path / "compressed.bag")[0])


def test_quantised_inverse_depth_is_read(tmp_path):
    """compressed_depth_image_transport stores floats as 16-bit inverse depth."""
    a, b = 100.0 * 101.0, 0.0  # the transport's defaults: quantisation 100, up to some metres
    with BagFile(tmp_path / "inverse.bag") as bag:
        bag.camera_info("/camera/color/camera_info", CAMERA)
        for k, frame in enumerate(FRAMES):
            bag.image(REALSENSE[0], frame.colour, "rgb8", stamp(k))
            with np.errstate(divide="ignore"):
                units = np.where(frame.depth > 0, a / frame.depth + b, 0).round().astype(np.uint16)
            header = np.array([0], "<i4").tobytes() + np.array([a, b], "<f4").tobytes()
            data = header + cv2.imencode(".png", units)[1].tobytes()
            bag.compressed(REALSENSE[1] + "/compressedDepth", data,
                           "32FC1; compressedDepth png", stamp(k))  # fmt: skip
    assert_frames_are_the_flat(open_dataset(tmp_path / "inverse.bag")[0], depth_error=5e-3)


def wall_bag(path: Path, *, link) -> tuple[Path, Camera, Camera]:
    """A wall 2 m ahead and a board 1 m ahead, seen by a colour camera and a depth camera beside it.

    The depth camera stands 10 cm to the left of the colour camera and sees less finely.
    """
    colour = Camera(width=96, height=72, fx=80.0, fy=80.0, cx=47.5, cy=35.5)
    depth = Camera(width=64, height=48, fx=50.0, fy=50.0, cx=31.5, cy=23.5)
    column = (np.arange(64) - 31.5) / 50.0 - 0.1  # x at 1 m in the colour camera
    units = np.where((column > -0.2) & (column < 0.2), 1000, 2000).astype(np.uint16)
    with BagFile(path) as bag:
        bag.camera_info("/camera/color/camera_info", colour)
        bag.camera_info("/camera/depth/camera_info", depth)
        link(bag)
        for k in range(2):
            bag.image("/camera/color/image_raw", np.zeros((72, 96, 3), np.uint8), "rgb8", stamp(k))
            bag.image("/camera/depth/image_rect_raw", np.tile(units, (48, 1)), "16UC1", stamp(k),
                      frame_id="camera_depth_optical_frame")  # fmt: skip
    return path, colour, depth


def by_tf(bag):
    """camera_link -> depth and colour, 10 cm apart; as realsense-ros publishes them."""
    turn = (-0.5, 0.5, -0.5, 0.5)  # optical axes in camera_link's
    bag.static("camera_link", "camera_depth_optical_frame", (0, 0.1, 0), turn)
    bag.static("camera_link", "camera_color_frame", (0, 0, 0))
    bag.static("camera_color_frame", OPTICAL, (0, 0, 0), turn)


def test_depth_of_another_place_is_moved_into_the_colour_camera(tmp_path):
    path, colour, _ = wall_bag(tmp_path / "raw.bag", link=by_tf)
    (source,) = open_dataset(path)
    assert (source.camera.width, source.camera.fx) == (colour.width, colour.fx)
    row = source[0].depth[36]
    x_at_board = (np.arange(96) - colour.cx) / colour.fx
    on_board = np.abs(x_at_board) < 0.17
    np.testing.assert_allclose(row[on_board], 1.0, atol=1e-4)
    beside = (x_at_board > 0.3) & (x_at_board < 0.4)
    np.testing.assert_allclose(row[beside], 2.0, atol=1e-4)
    # What the board hides from the depth camera, and the colour camera sees, stays unknown.
    shadow = (x_at_board > 0.21) & (x_at_board < 0.24)
    assert (row[shadow] == 0).all()
    assert (source[0].depth[20:50, on_board] > 0).all()  # enlarging leaves no gaps


def test_without_extrinsics_unregistered_depth_is_refused(tmp_path):
    path, _, _ = wall_bag(tmp_path / "raw.bag", link=lambda bag: None)
    with pytest.raises(DataError, match="/tf_static"):
        open_dataset(path)


def test_topics_can_be_chosen_and_the_choice_is_listed(tmp_path):
    topics = ("/head/left", "/head/range")
    path = write_driver_bag(tmp_path / "own.bag", topics)
    with pytest.raises(DataError, match=re.escape("/head/left (4)")):
        open_dataset(path)
    (source,) = open_dataset(f"rosbag:{path}?colour=/head/left&depth=/head/range")
    assert_frames_are_the_flat(source)
    with pytest.raises(DataError, match="no images on /head/right"):
        open_dataset(f"rosbag:{path}?colour=/head/right&depth=/head/range")
    with pytest.raises(DataError, match=r"rosbag:PATH"):
        open_dataset(f"rosbag:{path}?color=/head/left")


def test_a_bag_without_calibration_takes_a_file_beside_it(tmp_path):
    with BagFile(tmp_path / "bare.bag") as bag:
        for k, frame in enumerate(FRAMES):
            bag.image(REALSENSE[0], frame.colour, "rgb8", stamp(k))
            bag.image(REALSENSE[1], millimetres(frame), "16UC1", stamp(k))
    with pytest.raises(DataError, match=r"cam_params\.json beside the bag"):
        open_dataset(tmp_path / "bare.bag")
    c = CAMERA
    (tmp_path / "cam_params.json").write_text(
        f'{{"camera": {{"w": {c.width}, "h": {c.height}, "fx": {c.fx}, "fy": {c.fy}, '
        f'"cx": {c.cx}, "cy": {c.cy}}}}}'
    )
    assert_frames_are_the_flat(open_dataset(tmp_path / "bare.bag")[0])


def test_images_without_a_partner_in_time_are_left_out(tmp_path):
    with BagFile(tmp_path / "gaps.bag") as bag:
        bag.camera_info("/camera/color/camera_info", CAMERA)
        for k, frame in enumerate(FRAMES):
            bag.image(REALSENSE[0], frame.colour, "rgb8", stamp(k))
            if k != 1:
                bag.image(REALSENSE[1], millimetres(frame), "16UC1", stamp(k))
    (source,) = open_dataset(tmp_path / "gaps.bag")
    assert (len(source), source.left_out) == (3, 1)


@pytest.mark.parametrize(
    ("write", "message"),
    [
        (lambda bag: bag.image("/camera/color/image_raw", np.zeros((4, 4), np.uint8), "jpeg9",
                               stamp(0)), "encoding 'jpeg9'"),
        (lambda bag: bag.image("/camera/color/image_raw", np.zeros((2, 4, 3), np.uint8), "bgra8",
                               stamp(0)), "the recording is damaged"),
    ],
)  # fmt: skip
def test_images_that_cannot_be_understood_are_named(tmp_path, write, message):
    with BagFile(tmp_path / "odd.bag") as bag:
        bag.camera_info("/camera/color/camera_info", CAMERA)
        write(bag)
        bag.image(REALSENSE[1], millimetres(FRAMES[0]), "16UC1", stamp(0))
    (source,) = open_dataset(tmp_path / "odd.bag")
    with pytest.raises(DataError, match=re.escape(message)):
        source[0]


def test_a_fisheye_lens_is_refused(tmp_path):
    with BagFile(tmp_path / "wide.bag") as bag:
        bag.camera_info("/camera/color/camera_info", CAMERA, distortion=(0.1,) * 4,
                        model="equidistant")  # fmt: skip
        bag.image(REALSENSE[0], FRAMES[0].colour, "rgb8", stamp(0))
        bag.image(REALSENSE[1], millimetres(FRAMES[0]), "16UC1", stamp(0))
    with pytest.raises(DataError, match="equidistant"):
        open_dataset(tmp_path / "wide.bag")


@pytest.mark.parametrize("name", ["cut.bag", "cut.mcap", "cut.db3"])
def test_a_file_that_is_no_bag_is_named(tmp_path, name):
    (tmp_path / name).write_bytes(b"\x00" * 100)
    with pytest.raises(DataError, match="reindex"):
        open_dataset(tmp_path / name)


def test_a_bag_that_was_cut_short_is_named(tmp_path):
    path = write_driver_bag(tmp_path / "cut.bag", REALSENSE)
    path.write_bytes(path.read_bytes()[:-20000])
    with pytest.raises(DataError, match="reindex"):
        open_dataset(path)


def test_a_librealsense_recording_of_ros1_is_read_with_its_unit_and_extrinsics(tmp_path):
    """realsense-viewer's .bag: /device_0/sensor_N/..., tf/0 from the reference into the stream."""
    colour_base, depth_base = "/device_0/sensor_1/Color_0", "/device_0/sensor_0/Depth_0"
    with BagFile(tmp_path / "viewer.bag") as bag:
        number = bag.type("std_msgs/msg/Float32")
        bag.write("/device_0/sensor_0/option/Depth Units/value", number(0.0001), START_S)
        for base in (colour_base, depth_base):
            bag.camera_info(f"{base}/info/camera_info", CAMERA, model="Inverse Brown Conrady")
        bag.write(f"{colour_base}/tf/0", bag.transform((0.015, 0, 0)), START_S)
        bag.write(f"{depth_base}/tf/0", bag.transform((0, 0, 0)), START_S)
        wall = np.full((72, 96), 15000, np.uint16)
        for k in range(2):
            bag.image(f"{colour_base}/image/data", FRAMES[k].colour, "rgb8", stamp(k),
                      frame_id="0")  # fmt: skip
            bag.image(f"{depth_base}/image/data", wall, "mono16", stamp(k), frame_id="1")
    (source,) = open_dataset(tmp_path / "viewer.bag")
    depth = source[0].depth
    np.testing.assert_allclose(depth[:, 2:], 1.5, atol=1e-5)
    # 15 mm at 1.5 m: what colour sees lies shift = f * 0.015 / 1.5 pixels further right.
    assert CAMERA.fx * 0.01 > 0.5
    assert (depth[:, 0] == 0).all()
