"""A recording of ROS as topics and messages: ``rosbags`` says what their bytes mean."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from ..types import FrameError, InputError
from .reading import INTRINSICS_FILE
from .realsense import is_told
from .rosfiles import Place, Reader, printable
from .rosindex import find_messages

IMAGE, COMPRESSED = "sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage"
CAMERA_INFO = "sensor_msgs/msg/CameraInfo"
TRANSFORMS, OLD_TRANSFORMS = "tf2_msgs/msg/TFMessage", "tf/msg/tfMessage"
WANTED = (IMAGE, COMPRESSED, CAMERA_INFO, TRANSFORMS, OLD_TRANSFORMS)


class Recording:
    """path: as the user gave it. by_hand: where the user may tell the camera. types: of its topics. places: of the
    messages of images, cameras and transforms, by topic, in the order of recording. Raises InputError."""

    def __init__(self, path: Path, files: list[Path]) -> None:
        try:
            import lz4.frame  # noqa: F401
            from rosbags.typesys import Stores, get_types_from_msg, get_typestore
        except ImportError:
            raise InputError(f"{path}: recordings of ROS need rosbags; pip install rosbags lz4") from None
        found = find_messages(files, lambda topic, kind: kind in WANTED or is_told(topic, kind))
        self.by_hand = (path if path.is_dir() else path.parent) / INTRINSICS_FILE
        self.path, self.types, self.places, self.lost = path, found.types, found.places, tuple(found.lost)
        store = get_typestore(Stores.ROS1_NOETIC if found.ros1 else Stores.ROS2_HUMBLE)
        if TRANSFORMS not in store.types:
            store.register(get_types_from_msg("geometry_msgs/TransformStamped[] transforms", TRANSFORMS))
        self._decode = store.deserialize_ros1 if found.ros1 else store.deserialize_cdr
        self._reader = Reader()

    def of_type(self, *types: str) -> list[str]:
        """Topics of one of these types that have messages, in alphabetical order."""
        return sorted(topic for topic, places in self.places.items() if self.types[topic] in types and places)

    def message(self, topic: str, place: Place) -> Any:
        """A message of ``topic``, with the names of ROS 2 for what is of both. Raises FrameError."""
        kind = self.types[topic]
        data = self._reader.read(place)
        try:
            return self._decode(data, TRANSFORMS if kind == OLD_TRANSFORMS else kind)
        except Exception as error:  # whatever damaged bytes lead to
            raise FrameError(
                f"{self.path}: a damaged message of {topic} ({printable(str(error))}); record it again"
            ) from None
