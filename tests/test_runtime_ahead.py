"""What the reading threads do for a frame before its turn."""

from contextlib import nullcontext

import numpy as np
import pytest
import torch

from ecslam import keyframes, pixels
from ecslam.config import Config
from ecslam.config_files import apply_settings, load_preset
from ecslam.datasets import Prefetch, open_sequence
from ecslam.denoising import denoised
from ecslam.earlier import light, relief
from ecslam.keyframes import make_keyframe
from ecslam.pixels import choose_pixels, feature_points, find_corners
from ecslam.runtime import ahead
from ecslam.runtime.ahead import preparation

ROOM = open_sequence("synthetic/studio?size=160x120&frames=8")
FEW = apply_settings(Config(), ["feature_count=40"])


@pytest.mark.parametrize(("preset", "found"), [("lite", range(8)), ("live", (0, 5))])
def test_corners_are_found_ahead_for_the_frames_that_need_them(preset, found):
    config = load_preset(preset)
    frames = [frame for _, frame in Prefetch(ROOM, prepare=preparation(lambda: config, ROOM.intrinsics, "cpu"))]
    assert [frame.index for frame in frames if frame.corners is not None] == list(found)


@pytest.mark.parametrize(("movers", "exposure"), [("true", "true"), ("false", "false"), ("true", "false")])
def test_what_is_held_against_earlier_views_is_looked_at_ahead(movers, exposure):
    config = apply_settings(load_preset("live"), [f"movers={movers}", f"exposure={exposure}"])
    prepared = preparation(lambda: config, ROOM.intrinsics, "cpu")(ROOM[1])
    assert (prepared.relief is None) == (movers == "true" and exposure == "false")
    assert (prepared.light is None) == (exposure == "false")
    if prepared.relief is not None:
        assert np.array_equal(prepared.relief, relief(prepared.depth))
    if prepared.light is not None:
        assert np.array_equal(prepared.light, light(prepared.color))


def test_other_depth_has_another_relief():
    config = apply_settings(load_preset("live"), [])
    noisy = open_sequence("synthetic/studio?size=160x120&frames=8&noise=1")[0]
    prepared = preparation(lambda: config, ROOM.intrinsics, "cpu")(noisy)
    raw = denoised(prepared, apply_settings(config, ["denoise=false"]))
    assert raw.relief is None
    assert np.array_equal(raw.depth, noisy.depth)


def test_without_fus_nobody_looks_for_corners():
    config = apply_settings(load_preset("lite"), ["fus=false"])
    assert preparation(lambda: config, ROOM.intrinsics, "cpu")(ROOM[0]).corners is None


@pytest.mark.parametrize("limit", [1, 7, 40, 500])
def test_the_first_corners_are_the_strongest_whoever_found_them(limit):
    frame = ROOM[0]
    prepared = preparation(lambda: FEW, ROOM.intrinsics, "cpu")(frame)
    one, other = (feature_points(f, FEW, limit) for f in (frame, prepared))
    assert np.array_equal(one, other)
    assert np.array_equal(one, find_corners(frame.color, apply_settings(FEW, [f"feature_count={limit}"])).index[:40])


def test_prepared_frames_are_not_searched_again(monkeypatch):
    frame = preparation(lambda: FEW, ROOM.intrinsics, "cpu")(ROOM[0])
    expected = choose_pixels(ROOM[0], ROOM.intrinsics, 200, FEW, np.random.default_rng(0))
    monkeypatch.setattr(pixels, "find_corners", lambda *_: pytest.fail("searched again"))
    found = choose_pixels(frame, ROOM.intrinsics, 200, FEW, np.random.default_rng(0))
    assert np.array_equal(found.direction, expected.direction)


@pytest.mark.parametrize(
    "change", ["feature_count=30", "feature_quality=0.3", "feature_distance_px=20", "border_px=25"]
)
def test_corners_found_with_other_settings_are_looked_for_again(change):
    now = apply_settings(FEW, [change])
    stale = preparation(lambda: FEW, ROOM.intrinsics, "cpu")(ROOM[0])
    assert np.array_equal(feature_points(stale, now, 40), find_corners(ROOM[0].color, now).index)
    assert not np.array_equal(feature_points(stale, now, 40), stale.corners.index)


def test_keyframes_are_made_ahead_for_the_frames_whose_turn_it_is(monkeypatch):
    config = load_preset("live")
    frames = [frame for _, frame in Prefetch(ROOM, prepare=preparation(lambda: config, ROOM.intrinsics, "cpu"))]
    assert [frame.index for frame in frames if frame.keyframe is not None] == [0, 5]
    expected = make_keyframe(denoised(ROOM[5], config), ROOM.intrinsics, config)
    monkeypatch.setattr(keyframes, "choose_pixels", lambda *_, **__: pytest.fail("chosen again"))
    assert np.array_equal(make_keyframe(frames[5], ROOM.intrinsics, config).record, expected.record)


def test_a_keyframe_made_with_other_settings_is_made_again():
    now = apply_settings(FEW, ["keyframe_share=0.1"])
    frame = preparation(lambda: FEW, ROOM.intrinsics, "cpu")(ROOM[0])
    assert len(make_keyframe(frame, ROOM.intrinsics, now)) == 2 * len(make_keyframe(frame, ROOM.intrinsics, FEW))


def test_images_for_a_gpu_are_put_where_it_can_fetch_them(monkeypatch):
    monkeypatch.setattr(ahead, "pinned", lambda array, device: array.copy() + int(device[-1]))
    frame = denoised(ROOM[0], FEW)
    prepared = preparation(lambda: FEW, ROOM.intrinsics, "cuda:3")(ROOM[0])
    assert np.array_equal(prepared.color, frame.color + 3)
    assert np.array_equal(prepared.depth, frame.depth + 3)


def test_a_copy_for_a_gpu_is_in_one_piece_however_the_image_lies_in_memory(monkeypatch):
    empty = torch.empty
    monkeypatch.setattr(torch, "empty", lambda *size, pin_memory, **how: empty(*size, **how))
    monkeypatch.setattr(torch.cuda, "device", lambda _: nullcontext())
    for image in (ROOM[0].color[..., ::-1], ROOM[0].depth[:, 1:]):
        copy = ahead.pinned(image, "cuda")
        assert copy is not image
        assert copy.flags.c_contiguous
        assert copy.dtype == image.dtype
        assert np.array_equal(copy, image)


@pytest.mark.skipif(torch.cuda.is_available(), reason="this machine has it")
def test_without_page_locked_memory_images_stay_where_they_are():
    frame = ROOM[0]
    assert preparation(lambda: FEW, ROOM.intrinsics, "cuda")(frame).color is frame.color
