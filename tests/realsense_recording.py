"""What librealsense would record from a camera in a room, made with its own software device and recorder."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import numpy as np
import pyrealsense2 as rs

from ecslam.types import Frame, Intrinsics

UNITS_M = 0.001
BASELINE_M = 0.015


def write(file: Path, frames: Iterable[Frame], camera: Intrinsics, *, bend: tuple[float, ...] = (0.0,) * 5) -> None:
    """Depth and colour of ``frames`` as a .db3, as two cameras beside each other; ``bend`` is of the one of colour."""
    device = rs.software_device()
    device.register_info(rs.camera_info.name, "Soft D435")
    device.register_info(rs.camera_info.serial_number, "1234")
    sensors = depth, color = device.add_sensor("Depth"), device.add_sensor("Color")
    depth.add_read_only_option(rs.option.depth_units, UNITS_M)
    profiles = (
        depth.add_video_stream(_stream(camera, rs.stream.depth, rs.format.z16, 0, 2, (0.0,) * 5)),
        color.add_video_stream(_stream(camera, rs.stream.color, rs.format.rgb8, 1, 3, bend)),
    )
    beside = rs.extrinsics()
    beside.rotation, beside.translation = list(np.eye(3).ravel()), [BASELINE_M, 0.0, 0.0]
    profiles[0].register_extrinsics_to(profiles[1], beside)
    recorder, queue = rs.recorder(str(file), device), rs.frame_queue(1)
    for sensor, profile in zip(recorder.query_sensors(), profiles, strict=True):
        sensor.open(profile)
        sensor.start(queue)
    for frame in frames:
        raw = np.rint(frame.depth / UNITS_M).astype(np.uint16)
        for sensor, profile, pixels in zip(sensors, profiles, (raw, frame.color), strict=True):
            sensor.on_video_frame(_image(frame, profile, pixels))
    for sensor in recorder.query_sensors():
        sensor.stop()
        sensor.close()


def _stream(
    camera: Intrinsics, kind: rs.stream, layout: rs.format, number: int, pixel_bytes: int, bend: tuple[float, ...]
) -> rs.video_stream:
    stream, lens = rs.video_stream(), rs.intrinsics()
    lens.width, lens.height = stream.width, stream.height = camera.width, camera.height
    lens.fx, lens.fy, lens.ppx, lens.ppy = camera.fx, camera.fy, camera.cx, camera.cy
    lens.model, lens.coeffs = rs.distortion.inverse_brown_conrady, list(bend)
    stream.type, stream.fmt, stream.index, stream.uid = kind, layout, 0, number
    stream.fps, stream.bpp, stream.intrinsics = 30, pixel_bytes, lens
    return stream


def _image(frame: Frame, profile: rs.stream_profile, pixels: np.ndarray) -> rs.software_video_frame:
    image = rs.software_video_frame()
    image.pixels, image.bpp = np.ascontiguousarray(pixels), pixels[0, 0].nbytes
    image.stride, image.timestamp, image.frame_number = pixels[0].nbytes, 1000 * frame.timestamp, frame.index
    image.profile, image.domain = profile.as_video_stream_profile(), rs.timestamp_domain.system_time
    if pixels.ndim == 2:
        image.depth_units = UNITS_M
    return image
