"""Reading image files that may be damaged: a FrameError that names the file, or an image of the right size."""

from __future__ import annotations

import importlib
import os
import struct
import time
import zlib
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from ecslam.datasets import images
from ecslam.datasets.images import NO_DEPTH, fill_pinholes, read_color, read_depth, read_header, to_metres
from ecslam.types import FrameError

W, H = 40, 30
SIZE = (W, H)
RNG = np.random.default_rng(0)
RGB = cv2.resize(RNG.integers(0, 256, (4, 5, 3), np.uint8), SIZE)
DEPTH = RNG.integers(0, 65536, (H, W)).astype(np.uint16)


def encode(extension: str, image: np.ndarray, *options: int) -> bytes:
    ok, data = cv2.imencode(extension, image, options)
    assert ok
    return bytes(data)


JPEG = encode(".jpg", RGB[..., ::-1], cv2.IMWRITE_JPEG_QUALITY, 95)
PNG = encode(".png", RGB[..., ::-1])
DEPTH_PNG = encode(".png", DEPTH)
FILES = {"color.jpg": JPEG, "color.png": PNG, "depth.png": DEPTH_PNG}


def read(path: Path) -> np.ndarray:
    return read_depth(path, SIZE) if path.name.startswith("depth") else read_color(path, SIZE)


@pytest.fixture(params=FILES)
def file(request: pytest.FixtureRequest, tmp_path: Path) -> Path:
    path = tmp_path / str(request.param)
    path.write_bytes(FILES[path.name])
    return path


def fails(path: Path, says: str) -> None:
    with pytest.raises(FrameError, match=says) as caught:
        read(path)
    assert str(path) in str(caught.value)
    assert "\n" not in str(caught.value)


def test_whole_files_read_back(tmp_path: Path) -> None:
    for name, data in FILES.items():
        (tmp_path / name).write_bytes(data)
    np.testing.assert_array_equal(read(tmp_path / "depth.png"), DEPTH)
    np.testing.assert_array_equal(read(tmp_path / "color.png"), RGB)
    assert np.abs(read(tmp_path / "color.jpg").astype(int) - RGB).mean() < 3


def test_the_header_agrees_with_the_decoder(file: Path) -> None:
    header = read_header(file)
    assert header.size == SIZE
    assert (header.bits, header.channels) == ((16, 1) if file.name.startswith("depth") else (8, 3))


def test_a_missing_file_and_what_is_no_file(file: Path) -> None:
    file.unlink()
    fails(file, "No such file")
    file.mkdir()
    fails(file, "not a regular file")


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="needs named pipes")
def test_a_pipe_does_not_hang_the_reader(file: Path) -> None:
    file.unlink()
    os.mkfifo(file)
    fails(file, "not a regular file")


@pytest.mark.parametrize(("data", "says"), [(b"", "empty"), (b"BM" + b"\0" * 60, "neither PNG nor JPEG")])
def test_what_is_no_image(file: Path, data: bytes, says: str) -> None:
    file.write_bytes(data)
    fails(file, says)


def test_every_truncation_is_found(file: Path) -> None:
    whole = FILES[file.name]
    for length in range(1, len(whole) - 1, max(1, len(whole) // 150)):
        file.write_bytes(whole[:length])
        fails(file, r"truncated|neither|damaged")


@settings(max_examples=150, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.sampled_from([n for n in FILES if n.endswith("png")]), st.data())
def test_every_flipped_bit_of_a_png_is_found(tmp_path: Path, name: str, data: st.DataObject) -> None:
    content = bytearray(FILES[name])
    at = data.draw(st.integers(0, 8 * len(content) - 1))
    content[at // 8] ^= 1 << at % 8
    (tmp_path / name).write_bytes(content)
    with pytest.raises(FrameError):
        read(tmp_path / name)


@settings(max_examples=150, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.data())
def test_a_damaged_jpeg_is_found_or_has_the_right_size(tmp_path: Path, data: st.DataObject) -> None:
    content = bytearray(JPEG)
    flips = data.draw(st.lists(st.integers(0, 8 * len(content) - 1), min_size=1, max_size=8))
    for at in flips:
        content[at // 8] ^= 1 << at % 8
    (tmp_path / "color.jpg").write_bytes(content)
    try:
        image = read(tmp_path / "color.jpg")
    except FrameError:
        return
    assert image.shape == (H, W, 3)


@settings(max_examples=150, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.sampled_from([b"", b"\xff\xd8", b"\xff\xd8\xff", b"\x89PNG\r\n\x1a\n", PNG[:30]]), st.binary(max_size=200))
def test_any_bytes_are_a_frame_error(tmp_path: Path, start: bytes, rest: bytes) -> None:
    (tmp_path / "color.jpg").write_bytes(start + rest)
    with pytest.raises(FrameError):
        read(tmp_path / "color.jpg")


def chunk(kind: bytes, data: bytes) -> bytes:
    return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))


@pytest.mark.parametrize("version", [4, 5])
def test_opencv_keeps_quiet_in_both_versions(monkeypatch: pytest.MonkeyPatch, version: int) -> None:
    levels: list[int] = []
    if version == 4:
        monkeypatch.delattr(cv2.utils, "logging", raising=False)
        monkeypatch.setattr(cv2, "setLogLevel", levels.append, raising=False)
    else:
        monkeypatch.setattr(cv2.utils, "logging", SimpleNamespace(setLogLevel=levels.append), raising=False)
    importlib.reload(images)
    assert levels == [0]


def test_pixels_that_cannot_be_unpacked_are_a_frame_error(tmp_path: Path) -> None:
    header = chunk(b"IHDR", struct.pack(">IIBBBBB", W, H, 8, 2, 0, 0, 0))
    (tmp_path / "color.png").write_bytes(PNG[:8] + header + chunk(b"IDAT", b"not zlib") + chunk(b"IEND", b""))
    fails(tmp_path / "color.png", "cannot be decoded")


def test_a_decompression_bomb_is_refused_from_its_header(tmp_path: Path) -> None:
    header = chunk(b"IHDR", struct.pack(">IIBBBBB", 30000, 30000, 8, 2, 0, 0, 0))
    body = chunk(b"IDAT", zlib.compress(bytes(50_000_000), 9))
    bomb = tmp_path / "color.png"
    bomb.write_bytes(PNG[:8] + header + body + chunk(b"IEND", b""))
    start = time.perf_counter()
    fails(bomb, "30000x30000")
    assert time.perf_counter() - start < 0.2


def test_a_file_far_too_large_for_its_pixels_is_not_read_to_the_end(file: Path) -> None:
    with file.open("ab") as handle:
        handle.truncate(1 << 31)
    fails(file, "too much")


def test_padding_after_the_jpeg_end_is_no_damage(tmp_path: Path) -> None:
    (tmp_path / "color.jpg").write_bytes(JPEG + b"\0" * 16)
    assert read(tmp_path / "color.jpg").shape == (H, W, 3)


def test_an_orientation_tag_does_not_turn_the_image(tmp_path: Path) -> None:
    tiff = b"II*\0\x08\0\0\0\x01\0\x12\x01\x03\0\x01\0\0\0\x06\0\0\0\0\0\0\0"
    exif = b"Exif\0\0" + tiff
    tagged = JPEG[:2] + b"\xff\xe1" + struct.pack(">H", len(exif) + 2) + exif + JPEG[2:]
    (tmp_path / "color.jpg").write_bytes(tagged)
    turned = cv2.imdecode(np.frombuffer(tagged, np.uint8), cv2.IMREAD_COLOR)
    assert turned is not None
    assert turned.shape == (W, H, 3)
    assert read(tmp_path / "color.jpg").shape == (H, W, 3)


def test_images_of_the_wrong_kind_are_named(tmp_path: Path) -> None:
    (tmp_path / "depth.png").write_bytes(encode(".png", RGB[..., 0]))
    fails(tmp_path / "depth.png", "8-bit PNG with 1 channels")
    (tmp_path / "depth.jpg").write_bytes(JPEG)
    fails(tmp_path / "depth.jpg", "8-bit JPEG")
    (tmp_path / "color.png").write_bytes(DEPTH_PNG)
    fails(tmp_path / "color.png", "16-bit")


@pytest.mark.parametrize("channels", [1, 4])
def test_grey_and_transparent_colour_files_become_rgb(tmp_path: Path, channels: int) -> None:
    (tmp_path / "color.png").write_bytes(encode(".png", np.full((H, W, channels), 77, np.uint8)))
    assert (read(tmp_path / "color.png") == 77).all()


@given(st.sampled_from([1000.0, 5000.0, 6553.5]), st.lists(st.integers(0, 65535), min_size=1, max_size=50))
def test_metres_are_the_nearest_float_and_zero_only_without_depth(scale: float, values: list[int]) -> None:
    raw = np.array([values], np.uint16)
    metres = to_metres(raw, scale)
    none = (raw == 0) | (raw == NO_DEPTH)
    assert metres.dtype == np.float32
    assert (metres[none] == 0).all()
    assert (metres[~none] > 0).all()
    np.testing.assert_allclose(metres[~none], raw[~none] / scale, rtol=1e-7)


def slope() -> np.ndarray:
    """A floor that falls away behind a box."""
    depth = np.repeat(np.linspace(2.0, 2.5, 90, dtype=np.float32)[:, None], 120, 1)
    depth[30:60, 40:80] = 1.0
    return depth


@pytest.mark.parametrize("sieve", ["random", "grid"])
def test_pinholes_get_the_depth_around_them_but_none_across_an_edge(sieve: str) -> None:
    true, seen = slope(), slope()
    seen[
        RNG.random(seen.shape) < 0.3 if sieve == "random" else np.add.outer(np.arange(90) % 2, np.arange(120) % 2) > 0
    ] = 0
    filled = fill_pinholes(seen)
    assert filled.dtype == np.float32
    assert (filled[seen > 0] == seen[seen > 0]).all()
    assert (filled > 0).mean() > 0.95
    assert np.abs(filled - true)[filled > 0].max() < 0.01


def test_depth_that_is_missing_in_whole_patches_stays_missing() -> None:
    seen = slope()
    seen[10:20, 10:90] = seen[:, 100:] = seen[5, 5] = 0
    assert fill_pinholes(seen) is seen
