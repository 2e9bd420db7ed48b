"""Stray Scanner: rgb.mp4, depth/000000.png (millimetres), confidence/, camera_matrix.csv and odometry.csv.

An iPhone's or iPad's LiDAR, from https://github.com/strayrobots/scanner: docs/format.md, and its encoders for what that
leaves open. Depth has the number of its frame in the video, and none where the phone had none; older recordings have it
as NumPy files. ``OdometryEncoder`` turns ARKit's camera to OpenCV's axes; ARKit's world has y up. ``VideoEncoder``
shows the first frame before time 0 and leaves the picture lying as the sensor does.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from ..types import InputError, Intrinsics
from .arrays import array_size, read_depth_array
from .files import FileSequence
from .images import read_depth, read_levels, to_metres
from .odometry import Odometry, read_odometry
from .reading import common_size, numbered, read_intrinsics, same_shape
from .video import Video

FINER = 2
SAME_SURFACE = 0.05  # of the distance
LEAST_CONFIDENCE = 1  # of 0, 1 and 2; the app's own viewer has the same
LEVEL = 0.3  # least part of gravity in the picture's plane that tells which way it was held
LENS_VARIES = 0.02
ARKIT_TRUTH = "the ground truth is ARKit's estimate: a difference from it need not be an error"
TURN = np.array([[0.0, 1, 0, 0], [-1, 0, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]])  # to the camera of a picture turned right


def sniff(path: Path) -> bool:
    """Whether the folder has rgb.mp4 and camera_matrix.csv."""
    return (path / "rgb.mp4").is_file() and (path / "camera_matrix.csv").is_file()


@dataclass(eq=False, kw_only=True)
class PhoneRecording(FileSequence):
    """Colour comes from a video, shrunk; depth is made ``FINER`` and loses what the phone was not sure of.

    numbers: of the frames in the video. confidence_files: one a frame, or none at all. depth_size: (width, height) as
    stored. turns: quarter turns to the right that put the pictures upright.
    """

    video: Video
    numbers: list[int]
    confidence_files: list[Path]
    depth_size: tuple[int, int]
    turns: int

    def _images(self, index: int) -> tuple[NDArray[np.uint8], NDArray[np.float32]]:
        color = self.video.read(self.numbers[index])
        file = self.depth_files[index]
        raw = (read_depth_array if file.suffix == ".npy" else read_depth)(file, self.depth_size)
        depth = to_metres(raw, self.depth_scale)
        if self.confidence_files:
            depth[read_levels(self.confidence_files[index], self.depth_size) < LEAST_CONFIDENCE] = 0
        depth = finer(depth, self.video.size)
        return np.ascontiguousarray(np.rot90(color, -self.turns)), np.ascontiguousarray(np.rot90(depth, -self.turns))


def open(path: Path) -> PhoneRecording:
    """Open the folder. Raises InputError."""
    depth = numbered(path / "depth", r"(\d{1,9})\.(?:png|npy)")
    if not depth:
        raise InputError(f"{path}: no images in {path.name}/depth; export it again, or record with a phone with LiDAR")
    first = next(iter(depth.values()))
    depth_size = array_size(first) if first.suffix == ".npy" else common_size(list(depth.values()))
    video = Video(path / "rgb.mp4", (FINER * depth_size[0], FINER * depth_size[1]))
    same_shape(video.track.size, depth_size, path)
    odometry = read_odometry(path / "odometry.csv") if (path / "odometry.csv").is_file() else None
    numbers = [number for number in depth if number < len(video)]
    if not numbers:
        raise InputError(f"{path}: rgb.mp4 ends before the first depth image, {first.name}; copy it again")
    poses = None if odometry is None else _poses(odometry, numbers)
    turns = 0 if poses is None else quarter_turns(poses)
    confidence = path / "confidence"
    return PhoneRecording(
        name=path.name,
        layout="stray",
        preset="lite",
        intrinsics=turned(_lens(path, video.track.size, odometry).resized(*video.size), turns),
        color_files=[],
        depth_files=[depth[number] for number in numbers],
        depth_scale=1000.0,
        times=_times(odometry, numbers, video),
        poses=None if poses is None else poses @ np.linalg.matrix_power(TURN, turns),
        color_size=video.track.size,
        notes=tuple(_notes(path, video, depth, odometry, turns)),
        video=video,
        numbers=numbers,
        confidence_files=[confidence / f"{depth[n].stem}.png" for n in numbers] if confidence.is_dir() else [],
        depth_size=depth_size,
        turns=turns,
    )


def finer(depth: NDArray[np.float32], size: tuple[int, int]) -> NDArray[np.float32]:
    """Depth [H, W], 0 = none, at ``size`` (width, height): between pixels of one surface interpolated, else nearest."""
    around = np.ones((3, 3), np.uint8)
    near = cv2.erode(depth, around)
    smooth = (near > 0) & (cv2.dilate(depth, around) - near < SAME_SURFACE * near)
    nearest = cv2.resize(depth, size, interpolation=cv2.INTER_NEAREST)
    within = cv2.resize(smooth.view(np.uint8), size, interpolation=cv2.INTER_NEAREST) > 0
    between = cv2.resize(depth, size, interpolation=cv2.INTER_LINEAR)
    return np.where(within, between, nearest).astype(np.float32, copy=False)


def quarter_turns(poses: NDArray[np.float64]) -> int:
    """How many quarter turns to the right put the pictures of poses [N, 4, 4] upright, in a world with y up."""
    right, down = -np.nanmean(poses[:, 1, :2], axis=0) if np.isfinite(poses).any() else (0.0, 0.0)
    return int(np.rint(2 * np.arctan2(right, down) / np.pi)) % 4 if np.hypot(right, down) > LEVEL else 0


def turned(camera: Intrinsics, turns: int) -> Intrinsics:
    """The camera of pictures that were turned to the right by so many quarters."""
    for _ in range(turns):
        camera = Intrinsics(camera.fy, camera.fx, camera.height - 1 - camera.cy, camera.cx, camera.height, camera.width)
    return camera


def focus_note(focal: NDArray[np.float64]) -> Iterator[str]:
    """What to say of focal lengths [M] that vary."""
    if len(focal):
        low, high = np.nanmin(focal), np.nanmax(focal)
        if high - low > LENS_VARIES * high:
            yield f"autofocus moves the focal length by {1 - low / high:.1%}; the median is used for all frames"


def _lens(path: Path, size: tuple[int, int], odometry: Odometry | None) -> Intrinsics:
    """Of the video. The median over the frames, where they have one each: autofocus moves it a little."""
    if odometry is not None and odometry.lens is not None:
        known = odometry.lens[np.isfinite(odometry.lens).all(1)]
        if len(known):
            fx, fy, cx, cy = np.median(known, axis=0).tolist()
            return Intrinsics(fx, fy, cx, cy, *size)
    return read_intrinsics(path / "camera_matrix.csv", *size)


def _poses(odometry: Odometry, numbers: list[int]) -> NDArray[np.float64]:
    """[N, 4, 4], NaN for a frame without a line."""
    place = {frame: i for i, frame in enumerate(odometry.frames.tolist())}
    nowhere = np.full((1, 4, 4), np.nan)
    return np.concatenate([odometry.poses, nowhere])[[place.get(number, -1) for number in numbers]]


def _times(odometry: Odometry | None, numbers: list[int], video: Video) -> NDArray[np.float64]:
    """[N] seconds: by the frame's line, else by the video from the next frame that has a line."""
    shown = video.track.times
    if odometry is None or odometry.frames[0] >= len(shown):
        return shown[numbers]
    frames = odometry.frames[odometry.frames < len(shown)]
    at = np.searchsorted(frames, numbers).clip(0, len(frames) - 1)
    times: NDArray[np.float64] = odometry.times[at] + shown[numbers] - shown[frames[at]]
    return times


def _notes(path: Path, video: Video, depth: dict[int, Path], odometry: Odometry | None, turns: int) -> Iterator[str]:
    if odometry is not None:
        yield ARKIT_TRUTH
        yield from odometry.notes
        without = len(depth.keys() - set(odometry.frames.tolist()))
        if without:
            yield f"{without} of {len(depth)} frames have no line in odometry.csv, and so no ground truth"
        if odometry.lens is not None:
            yield from focus_note(odometry.lens[:, 0])
    if turns:
        yield f"pictures are turned by {90 * turns} degrees to the right, for so the phone was held"
    late = sum(number >= len(video) for number in depth)
    if late:
        yield f"{late} depth images come after the end of rgb.mp4 and are left out"
    if len(video) > len(depth) - late:
        yield f"{len(video) - len(depth) + late} frames of rgb.mp4 have no depth and are left out"
    if not (path / "confidence").is_dir():
        yield "no confidence folder: depth at edges may be wrong by much"
