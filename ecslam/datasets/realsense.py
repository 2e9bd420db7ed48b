"""What Intel's own recorder (librealsense, as in realsense-viewer) puts into a .bag of ROS 1: names and conventions.

A stream, as device_0/sensor_1/Color_0, has topics of its own, and none is registered to another. What ROS tells by the
frame of an image, librealsense leaves open; here a stream's own name is its frame. ``tf/0`` takes points in metres
*from* the reference of group 0 *to* the stream, so it is the inverse of a transform of ROS: librealsense asks its graph
for the way from the reference when it records, joins two of them accordingly when it plays, and the values recorded of
a D455's accelerometer are those that it reports from depth to there. The quaternion is that of the rotation.
"""

from __future__ import annotations

import re

TRANSFORM, NUMBER = "geometry_msgs/msg/Transform", "std_msgs/msg/Float32"
_STREAM = r"(device_\d+)/(sensor_\d+)/([A-Za-z]+_\d+)"
_IMAGES = re.compile(rf"/{_STREAM}/image/data")
_MOTION = re.compile(rf"/{_STREAM}/tf/(\d+)")
_UNITS = re.compile(r"/(device_\d+/sensor_\d+)/option/Depth[ _]Units/value")


def stream_of(topic: str) -> str:
    """The stream whose images a topic has; "" where it is none of librealsense's."""
    match = _IMAGES.fullmatch(topic)
    return "/".join(match.groups()) if match else ""


def info_of(stream: str) -> str:
    """The topic of a stream's camera."""
    return f"/{stream}/info/camera_info"


def motion_of(topic: str) -> tuple[str, str] | None:
    """The reference from which a topic's transform leads, and the stream to which it does."""
    match = _MOTION.fullmatch(topic)
    if match is None:
        return None
    device, sensor, name, group = match.groups()
    return f"{device}/reference_{group}", f"{device}/{sensor}/{name}"


def measures(topic: str, stream: str) -> bool:
    """Whether the topic tells the metres of a unit of this stream of depth."""
    match = _UNITS.fullmatch(topic)
    return match is not None and stream.startswith(f"{match[1]}/")


def is_told(topic: str, kind: str) -> bool:
    """Whether messages of this type are about a camera; others of the type are anybody's."""
    return bool((kind == TRANSFORM and _MOTION.fullmatch(topic)) or (kind == NUMBER and _UNITS.fullmatch(topic)))
