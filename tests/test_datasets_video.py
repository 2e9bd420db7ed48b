"""Videos: the frame that was asked for, whatever the order, from any thread; and files that are none."""

from __future__ import annotations

import struct
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ecslam.datasets.mp4 import read_track
from ecslam.datasets.video import FAR, Video
from ecslam.types import FrameError, InputError

W, H, N = 160, 120, 200
BITS, SIDE = 10, 16


def numbered(number: int) -> np.ndarray:
    """BGR with the number painted as white squares, one a bit."""
    image = np.full((H, W, 3), (40, 90, 140), np.uint8)
    for bit in range(BITS):
        image[:SIDE, bit * SIDE : (bit + 1) * SIDE] = 255 * (number >> bit & 1)
    return image


def number_in(image: np.ndarray) -> int:
    """What ``numbered`` painted."""
    squares = cv2.resize(image, (W, H))[4 : SIDE - 4].reshape(SIDE - 8, BITS, SIDE, 3)[:, :, 4:-4].mean((0, 2, 3))
    return sum(int(square > 128) << bit for bit, square in enumerate(squares))


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> bytes:
    path = tmp_path_factory.mktemp("video") / "rgb.mp4"
    video = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*"mp4v"), 60, (W, H))
    for number in range(N):
        video.write(numbered(number))
    video.release()
    return path.read_bytes()


@pytest.fixture
def path(data: bytes, tmp_path: Path) -> Path:
    (tmp_path / "rgb.mp4").write_bytes(data)
    return tmp_path / "rgb.mp4"


def test_the_tables_tell_size_and_times(path: Path) -> None:
    track = read_track(path)
    assert track.size == (W, H)
    np.testing.assert_allclose(track.times, np.arange(N) / 60)


def test_frames_in_order_are_those_that_were_written(path: Path) -> None:
    video = Video(path)
    assert [number_in(video.read(number)) for number in range(len(video))] == list(range(N))


@settings(max_examples=15)
@given(order=st.lists(st.integers(0, N - 1), min_size=1, max_size=8))
def test_the_order_does_not_matter(order: list[int], data: bytes, tmp_path_factory: pytest.TempPathFactory) -> None:
    path = tmp_path_factory.mktemp("any") / "rgb.mp4"
    path.write_bytes(data)
    video = Video(path)
    assert [number_in(video.read(number)) for number in order] == order


def test_a_frame_is_the_same_to_the_last_bit_whichever_way_it_was_reached(path: Path) -> None:
    straight, seeking = Video(path), Video(path)
    wanted = [FAR + 90, FAR + 30, 3, FAR + 31, 0]
    frames = {number: straight.read(number) for number in sorted(wanted)}
    for number in wanted:
        np.testing.assert_array_equal(seeking.read(number), frames[number])


def count_openings(video: Video) -> list[int]:
    """A list that grows by one with each start from the first frame."""
    opened: list[int] = []
    rewind = video._rewind

    def counted() -> cv2.VideoCapture:
        opened.append(1)
        return rewind()

    video._rewind = counted  # type: ignore[method-assign]
    return opened


@pytest.mark.parametrize("threads", [2, 6])
@pytest.mark.parametrize("step", [1, 3])
def test_threads_that_read_ahead_get_their_own_frames_from_one_pass(path: Path, threads: int, step: int) -> None:
    video = Video(path)
    wanted = list(range(0, N, step))
    opened = count_openings(video)
    with ThreadPoolExecutor(threads) as pool:
        assert [number_in(image) for image in pool.map(video.read, wanted)] == wanted
    assert len(opened) <= 3
    assert not video._found
    assert not video._wanted


def test_a_frame_is_shrunk_by_area_and_in_rgb(path: Path) -> None:
    small = Video(path, (W // 4, H // 4)).read(5)
    assert small.shape == (H // 4, W // 4, 3)
    np.testing.assert_allclose(small[H // 8, W // 8], (140, 90, 40), atol=4)


def test_a_rate_that_changes_confuses_nothing(data: bytes, tmp_path: Path) -> None:
    at = data.index(b"stts") + 8
    runs, count, step = struct.unpack_from(">III", data, at)
    assert (runs, count) == (1, N)
    slower = struct.pack(">5I", 2, N // 2, step, N // 2, 3 * step)
    changed = bytearray(data[:at] + slower + data[at + 12 :])
    for box in (b"moov", b"trak", b"mdia", b"minf", b"stbl", b"stts"):
        place = data.index(box) - 4
        struct.pack_into(">I", changed, place, struct.unpack_from(">I", data, place)[0] + 8)
    (tmp_path / "rgb.mp4").write_bytes(changed)
    video = Video(tmp_path / "rgb.mp4")
    np.testing.assert_allclose(video.track.times[-1], (N // 2 + 3 * (N // 2 - 1)) / 60)
    assert [number_in(video.read(number)) for number in (150, 20, 199, 90, 110, 0)] == [150, 20, 199, 90, 110, 0]


def test_a_first_frame_before_time_0_is_there_and_moves_no_other(data: bytes, tmp_path: Path) -> None:
    step = struct.unpack_from(">I", data, data.index(b"stts") + 16)
    at = data.index(b"elst") + 16
    (tmp_path / "rgb.mp4").write_bytes(data[:at] + struct.pack(">I", *step) + data[at + 4 :])
    video = Video(tmp_path / "rgb.mp4")
    assert [number_in(video.read(number)) for number in (0, 1, 2, 130)] == [0, 1, 2, 130]


def test_pictures_that_a_player_would_turn_stay_as_they_were_recorded(data: bytes, tmp_path: Path) -> None:
    matrix = struct.pack(">9i", 0, 1 << 16, 0, -(1 << 16), 0, 0, 0, 0, 1 << 30)
    at = data.index(b"tkhd") + 4 + 40
    path = tmp_path / "rgb.mp4"
    path.write_bytes(data[:at] + matrix + data[at + 36 :])
    assert number_in(Video(path).read(77)) == 77


@pytest.mark.parametrize(
    ("damage", "says"),
    [
        (lambda data: data[: len(data) // 2], "truncated"),
        (lambda data: data[:4], "truncated"),
        (lambda data: b"", "truncated"),
        (lambda data: b"not a video at all", "not an MP4"),
        (lambda data: data.replace(b"vide", b"soun"), "no video"),
        (lambda data: data.replace(b"stsz", b"free"), "damaged tables"),
        (lambda data: data.replace(b"stbl", b"free"), "damaged tables"),
        (lambda data: with_count(data, 0), "no frames"),
        (lambda data: with_count(data, 1 << 31), "damaged tables"),
    ],
)
def test_what_is_no_whole_video_is_refused(data: bytes, tmp_path: Path, damage: object, says: str) -> None:
    path = tmp_path / "rgb.mp4"
    path.write_bytes(damage(data))  # type: ignore[operator]
    with pytest.raises(InputError, match=says) as caught:
        Video(path)
    assert str(path) in str(caught.value)
    assert "\n" not in str(caught.value)


def with_count(data: bytes, count: int) -> bytes:
    """The file claiming to have so many frames."""
    at = data.index(b"stsz") + 12
    return data[:at] + struct.pack(">I", count) + data[at + 4 :]


def test_a_missing_video_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="cannot be read"):
        Video(tmp_path / "rgb.mp4")


@settings(max_examples=40)
@given(at=st.floats(0, 1), value=st.integers(0, 255))
def test_a_flipped_byte_in_the_tables_is_an_input_error_or_harmless(
    data: bytes, at: float, value: int, tmp_path_factory: pytest.TempPathFactory
) -> None:
    start = data.index(b"moov")
    place = start + int(at * (len(data) - start - 1))
    path = tmp_path_factory.mktemp("flipped") / "rgb.mp4"
    path.write_bytes(data[:place] + bytes([value]) + data[place + 1 :])
    with suppress(InputError):
        assert len(read_track(path).times) >= 1


def test_frames_that_cannot_be_decoded_are_frame_errors_and_spare_the_rest(data: bytes, tmp_path: Path) -> None:
    path = tmp_path / "rgb.mp4"
    start, end = data.index(b"mdat") + 4, data.index(b"moov")
    third = (end - start) // 3
    path.write_bytes(data[: start + third] + bytes(third) + data[start + 2 * third :])
    video = Video(path)
    opened, broken = count_openings(video), []
    for number in range(N):
        try:
            video.read(number)
        except FrameError as error:
            broken.append((number, str(error)))
    assert len(opened) == 1
    assert {N // 2} <= {number for number, _ in broken} <= set(range(N // 3 - 8, 2 * N // 3 + 24))
    assert all(f"{path}: frame {number} cannot be decoded" in text for number, text in broken)
    assert [number_in(video.read(number)) for number in (N - 1, N - 1, 2)] == [N - 1, N - 1, 2]


def test_a_video_that_ends_early_keeps_the_frames_it_has(data: bytes, tmp_path: Path) -> None:
    path = tmp_path / "rgb.mp4"
    start, end = data.index(b"mdat") + 4, data.index(b"moov")
    half = (start + end) // 2
    path.write_bytes(data[:half] + bytes(end - 4 - half) + data[end - 4 :])
    video = Video(path)
    with pytest.raises(FrameError, match=f"frame {N - 1} cannot"):
        video.read(N - 1)
    assert [number_in(video.read(number)) for number in (0, 70, 71)] == [0, 70, 71]
