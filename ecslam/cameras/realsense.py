"""Intel RealSense cameras, by librealsense (``pip install pyrealsense2``), or with ``file`` what one has recorded."""

from __future__ import annotations

import re
from time import monotonic, sleep
from types import ModuleType
from typing import Any

import numpy as np

from ..datasets.recording import Rig
from ..types import InputError, Intrinsics
from .camera import Shot

OPTIONS = ("size", "fps", "serial", "file")
PATIENCE_MS, LAST_MS = 3000, 200  # for the next images, and for those that wait when a recording has been played
EXPOSING = 15  # shots until exposure has settled


def open(size: str = "640x480", fps: str = "30", serial: str = "", file: str = "") -> RealSense:
    """Switch it on. size: of colour and depth. serial: which one, where there are several. file: a recording of
    librealsense to play instead, as fast as it was made. Raises InputError."""
    asked = re.fullmatch(r"(\d{2,4})x(\d{2,4})", size)
    if asked is None or not fps.isdecimal():
        raise InputError(f"camera/realsense: size={size}, fps={fps}: write them as size=640x480&fps=30")
    return RealSense(_library(), (int(asked[1]), int(asked[2])), int(fps), serial, file)


class RealSense:
    """A ``Camera``: raw depth, and colour from beside it, as librealsense puts them together."""

    def __init__(self, library: ModuleType, size: tuple[int, int], fps: int, serial: str, file: str) -> None:
        self._library, self._played = library, None
        self._zero_s: float | None = None
        config = library.config()
        if file:
            config.enable_device_from_file(file, False)
        else:
            self._require_camera(serial)
            config.enable_stream(library.stream.depth, *size, library.format.z16, fps)
            config.enable_stream(library.stream.color, *size, library.format.rgb8, fps)
            if serial:
                config.enable_device(serial)
        self._pipeline = library.pipeline()
        try:
            started = self._pipeline.start(config)
        except RuntimeError as error:
            what = f"file={file}" if file else f"size={size[0]}x{size[1]}&fps={fps}"
            why = " ".join(str(error).split())
            raise InputError(
                f"camera/realsense: {what} does not work ({why}); `rs-enumerate-devices` lists what does"
            ) from None
        if file:
            self._played = started.get_device().as_playback()
            self._played.set_real_time(False)  # it leaves frames out where they are not taken at once
        try:
            self.rig = self._rig(started)
            for _ in range(0 if file else EXPOSING):
                self.read()
        except BaseException:
            self.close()
            raise

    def read(self) -> Shot | None:
        """See ``Camera``."""
        while True:
            try:
                frames = self._pipeline.wait_for_frames(LAST_MS if self._at_end() else PATIENCE_MS)
            except RuntimeError as error:
                if self._at_end():
                    return None
                name = self.rig.name
                raise InputError(f"{name}: brings nothing any more ({error}); is it still plugged in?") from None
            depth, color = frames.get_depth_frame(), frames.get_color_frame()
            if depth and color:
                images = (np.array(each.get_data()) for each in (color, depth))
                return self._in_time(Shot(depth.get_timestamp() / 1000, *images))

    def close(self) -> None:
        """See ``Camera``."""
        self._pipeline.stop()

    def _in_time(self, shot: Shot) -> Shot:
        """The shot, when its time has come: at once, unless it is played."""
        if self._played is not None:
            self._zero_s = monotonic() - shot.seconds if self._zero_s is None else self._zero_s
            sleep(max(self._zero_s + shot.seconds - monotonic(), 0.0))
        return shot

    def _at_end(self) -> bool:
        return self._played is not None and self._played.current_status() == self._library.playback_status.stopped

    def _require_camera(self, serial: str) -> None:
        """Raises InputError where there is none, or not that one."""
        about = self._library.camera_info
        found = [each.get_info(about.serial_number) for each in self._library.context().query_devices()]
        if not found or (serial and serial not in found):
            there = "there is " + ", ".join(found) if found else "plug one in, at USB 3; Linux needs its udev rules"
            raise InputError(f"camera/realsense: no such camera; {there}")

    def _rig(self, started: Any) -> Rig:
        """How it is built. Raises InputError where a lens bends what it sees in an unknown way."""
        library, device = self._library, started.get_device()
        depth, color = (
            started.get_stream(each).as_video_stream_profile() for each in (library.stream.depth, library.stream.color)
        )
        motion, move = depth.get_extrinsics_to(color), np.eye(4)
        move[:3, :3], move[:3, 3] = np.reshape(motion.rotation, (3, 3)).T, motion.translation
        name = device.get_info(library.camera_info.name)
        lenses = [_intrinsics(library, each.get_intrinsics()) for each in (depth, color)]
        return Rig(name, 1 / device.first_depth_sensor().get_depth_scale(), lenses[0], lenses[1], move)


def _intrinsics(library: ModuleType, k: Any) -> Intrinsics:
    kinds, bend = library.distortion, tuple(map(float, k.coeffs))
    if not any(bend):
        bend = ()
    elif k.model not in (kinds.brown_conrady, kinds.inverse_brown_conrady, kinds.modified_brown_conrady):
        raise InputError(f"camera/realsense: a lens of the kind {k.model} is not known; take another size")
    return Intrinsics(k.fx, k.fy, k.ppx, k.ppy, k.width, k.height, bend)


def _library() -> ModuleType:
    """librealsense. Raises InputError where it is not installed."""
    try:
        import pyrealsense2
    except ImportError as error:
        raise InputError(f"camera/realsense: needs librealsense ({error}); pip install pyrealsense2") from None
    return pyrealsense2
