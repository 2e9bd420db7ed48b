"""Records colour and depth as a robot does, in any storage and encoding of ROS 1 and 2."""

from __future__ import annotations

import struct
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import Writer as Writer2
from rosbags.rosbag2.enums import CompressionFormat, CompressionMode, StoragePlugin
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from scipy.spatial.transform import Rotation

from ecslam.types import Sequence

STORAGES = ("bag", "bag-lz4", "bag-bz2", "mcap", "mcap-zstd", "db3", "db3-zstd")
COLOR, DEPTH = "/camera/color/image_raw", "/camera/aligned_depth_to_color/image_raw"
CAMERA = "camera_color_optical_frame"
TRANSFORMS = "tf2_msgs/msg/TFMessage"
START = 1_600_000_000


class Robot:
    """Publishes messages, each recorded a little after the time that its header tells."""

    def __init__(self, writer: Any, store: Any, ros1: bool) -> None:
        self._writer, self._store, self._ros1 = writer, store, ros1
        self._connections: dict[str, Any] = {}
        self._count = 0

    def type(self, name: str) -> Any:
        return self._store.types[name]

    def header(self, time: float, frame: str = CAMERA) -> Any:
        ns = round(time * 1e9)
        stamp = self.type("builtin_interfaces/msg/Time")(ns // 10**9, ns % 10**9)
        header = self.type("std_msgs/msg/Header")
        return header(seq=0, stamp=stamp, frame_id=frame) if self._ros1 else header(stamp=stamp, frame_id=frame)

    def send(self, topic: str, message: Any) -> None:
        kind = message.__msgtype__
        if topic not in self._connections:
            self._connections[topic] = self._writer.add_connection(topic, kind, typestore=self._store)
        encode = self._store.serialize_ros1 if self._ros1 else self._store.serialize_cdr
        self._count += 1
        self._writer.write(self._connections[topic], 10**9 * START + 10**6 * self._count, bytes(encode(message, kind)))

    def image(
        self, topic: str, time: float, values: np.ndarray, encoding: str, *, frame: str = CAMERA, fill: int = 0,
        big: bool = False, **changed: Any,
    ) -> None:  # fmt: skip
        """fill: bytes after each row. big: values with the largest byte first."""
        height, width = values.shape[:2]
        stored = values.astype(values.dtype.newbyteorder(">" if big else "<"))
        rows = np.frombuffer(stored.tobytes(), np.uint8).reshape(height, -1)
        rows = np.pad(rows, ((0, 0), (0, fill)), constant_values=77)
        fields = {
            "header": self.header(time, frame), "height": height, "width": width, "encoding": encoding,
            "is_bigendian": int(big), "step": rows.shape[1], "data": rows.ravel(),
        }  # fmt: skip
        self.send(topic, self.type("sensor_msgs/msg/Image")(**(fields | changed)))

    def compressed(self, topic: str, time: float, data: bytes, format: str, *, frame: str = CAMERA) -> None:
        kind = self.type("sensor_msgs/msg/CompressedImage")
        self.send(topic, kind(self.header(time, frame), format, np.frombuffer(data, np.uint8)))

    def camera(
        self, topic: str, matrix: np.ndarray, size: tuple[int, int], distortion: tuple[float, ...] = (0.0,) * 5,
        *, projection: np.ndarray | None = None, model: str = "plumb_bob",
    ) -> None:  # fmt: skip
        p = np.zeros((3, 4))
        p[:, :3] = matrix if projection is None else projection
        name = str.upper if self._ros1 else str.lower
        region = self.type("sensor_msgs/msg/RegionOfInterest")(0, 0, 0, 0, False)
        fields = {
            "header": self.header(START), "width": size[0], "height": size[1], "distortion_model": model,
            name("d"): np.array(distortion), name("k"): matrix.ravel().astype(float), name("r"): np.eye(3).ravel(),
            name("p"): p.ravel(), "binning_x": 0, "binning_y": 0, "roi": region,
        }  # fmt: skip
        self.send(topic, self.type("sensor_msgs/msg/CameraInfo")(**fields))

    def transform(self, time: float, parent: str, child: str, pose: np.ndarray, topic: str = "/tf") -> None:
        stamped = self.type("geometry_msgs/msg/TransformStamped")(self.header(time, parent), child, self.motion(pose))
        self.send(topic, self.type(TRANSFORMS)([stamped]))

    def motion(self, matrix: np.ndarray) -> Any:
        move = self.type("geometry_msgs/msg/Vector3")(*matrix[:3, 3])
        turn = self.type("geometry_msgs/msg/Quaternion")(*Rotation.from_matrix(matrix[:3, :3]).as_quat())
        return self.type("geometry_msgs/msg/Transform")(move, turn)


@contextmanager
def recording(path: Path, storage: str = "bag") -> Iterator[Robot]:
    """path: the file of a ``bag``, else the folder."""
    kind, _, packing = storage.partition("-")
    writer: Any
    if kind == "bag":
        writer = Writer1(path)
        if packing:
            writer.set_compression(Writer1.CompressionFormat[packing.upper()])
    else:
        plugin = StoragePlugin.MCAP if kind == "mcap" else StoragePlugin.SQLITE3
        writer = Writer2(path, version=9, storage_plugin=plugin)
        if packing:
            mode = CompressionMode.STORAGE if kind == "mcap" else CompressionMode.MESSAGE
            writer.set_compression(mode, CompressionFormat.ZSTD)
    with writer:
        store = get_typestore(Stores.ROS1_NOETIC if kind == "bag" else Stores.ROS2_HUMBLE)
        if TRANSFORMS not in store.types:
            store.register(get_types_from_msg("geometry_msgs/TransformStamped[] transforms", TRANSFORMS))
        yield Robot(writer, store, kind == "bag")


def record(path: Path, room: Sequence, storage: str = "bag", encodings: tuple[str, str] = ("rgb8", "16UC1")) -> Path:
    """A room as RealSense's driver would publish it, with the truth as transforms."""
    k = room.intrinsics
    with recording(path, storage) as robot:
        robot.camera("/camera/color/camera_info", k.matrix(), (k.width, k.height))
        for frame in room:
            time = START + frame.timestamp
            send_color(robot, time, frame.color, encodings[0])
            send_depth(robot, time, frame.depth, encodings[1])
            if frame.c2w_gt is not None:
                robot.transform(time, "world", "camera_link", frame.c2w_gt)
                robot.transform(time, "camera_link", CAMERA, np.eye(4))
    return path


def send_color(robot: Robot, time: float, rgb: np.ndarray, encoding: str) -> None:
    bgr = np.ascontiguousarray(rgb[..., ::-1])
    if encoding in ("jpeg", "png"):
        data = cv2.imencode(f".{encoding}", bgr)[1].tobytes()
        robot.compressed(f"{COLOR}/compressed", time, data, f"rgb8; {encoding} compressed bgr8")
        return
    opaque = np.full((*rgb.shape[:2], 1), 255, np.uint8)
    made = {
        "rgb8": rgb, "bgr8": bgr, "rgba8": np.concatenate([rgb, opaque], 2), "bgra8": np.concatenate([bgr, opaque], 2),
        "mono8": cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY),
    }  # fmt: skip
    robot.image(COLOR, time, made[encoding], encoding)


def send_depth(robot: Robot, time: float, metres: np.ndarray, encoding: str) -> None:
    millimetres = np.rint(1000 * metres).astype(np.uint16)
    if encoding in ("16UC1", "32FC1"):
        values = millimetres if encoding == "16UC1" else np.where(metres > 0, metres, np.float32(np.nan))
        robot.image(DEPTH, time, values, encoding)
        return
    if encoding == "packed 32FC1":
        a, b = 100 * (100 + 1), 1 - 100 * (100 + 1) / 10  # as the transport has it: quantisation 100, at most 10 m
        values = np.where(metres > 0, np.rint(a / np.maximum(metres, 0.01) + b), 0).astype(np.uint16)
    else:
        a, b, values = 0.0, 0.0, millimetres
    data = struct.pack("<iff", 0, a, b) + cv2.imencode(".png", values)[1].tobytes()
    robot.compressed(f"{DEPTH}/compressedDepth", time, data, f"{encoding.split()[-1]}; compressedDepth png")
