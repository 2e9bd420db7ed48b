"""The stored pixels of keyframes."""

from dataclasses import fields

import numpy as np

from ecslam.config import Config
from ecslam.datasets import open_sequence
from ecslam.keyframes import Keyframe, Shelf, make_keyframe, make_thumbnail, most_similar, surface_points
from ecslam.landmarks import KEPT, LANDMARK_BYTES, Landmarks
from ecslam.pixels import Pixels
from ecslam.saving import pack_keyframes, unpack_keyframes

NONE = Landmarks(np.empty((0, 3), np.float32), np.empty((0, 32), np.uint8))


def flat(count):
    """So many white pixels a metre away."""
    white = np.full((count, 3), 255, np.uint8)
    return Pixels(np.zeros((count, 2), np.float32), np.ones(count, np.float32), white, np.zeros(count, bool))


def test_a_shelf_keeps_keyframes_as_they_are_side_by_side():
    room = open_sequence("synthetic/studio?size=160x120&frames=3")
    made = [make_keyframe(room[i], room.intrinsics, Config()) for i in range(3)]
    shelf = Shelf()
    kept = [shelf.keep(keyframe) for keyframe in made]
    for before, after in zip(made, kept, strict=True):
        assert before.frame == after.frame
        arrays = [(before.thumbnail, after.thumbnail)]
        arrays += [(getattr(before.pixels, f.name), getattr(after.pixels, f.name)) for f in fields(Pixels)]
        arrays += [(getattr(before.landmarks, f.name), getattr(after.landmarks, f.name)) for f in fields(Landmarks)]
        for old, new in arrays:
            assert old.dtype == new.dtype
            np.testing.assert_array_equal(old, new)
            assert np.shares_memory(new, after.record)
            assert new.ctypes.data % new.itemsize == 0
        assert len(after) == len(before.pixels)
    ends = [k.record.ctypes.data + k.record.nbytes for k in kept[:-1]]
    starts = [k.record.ctypes.data for k in kept[1:]]
    assert all(0 <= start - end < 64 for end, start in zip(ends, starts, strict=True))


def test_a_shelf_takes_what_is_larger_than_its_blocks_and_what_is_empty():
    shelf = Shelf()
    for count in (0, 2 << 20, 3):
        pixels = flat(count)
        kept = shelf.keep(Keyframe.of(0, pixels, np.full(1200, 7, np.float32), NONE))
        assert len(kept.pixels) == count
        assert kept.pixels.depth.sum() == count
        assert (kept.thumbnail == 7).all()


def test_what_a_keyframe_is_known_by_goes_into_a_checkpoint_and_back():
    room = open_sequence("synthetic/studio?size=160x120&frames=3")
    made = make_keyframe(room[0], room.intrinsics, Config())
    assert KEPT * LANDMARK_BYTES < 10_000
    assert len(made.landmarks) == KEPT
    (back,) = unpack_keyframes(pack_keyframes([made]))
    np.testing.assert_array_equal(back.landmarks.points, made.landmarks.points)
    np.testing.assert_array_equal(back.landmarks.descriptors, made.landmarks.descriptors)
    assert len(back) == len(made.pixels)


def picture(seed):
    coarse = np.random.default_rng(seed).integers(60, 140, (6, 8, 3), np.uint8)
    return np.kron(coarse, np.ones((20, 20, 1), np.uint8))


def test_a_picture_is_most_similar_to_itself_however_bright_it_is():
    kept = [Keyframe.of(k, flat(3), make_thumbnail(picture(k)), NONE) for k in range(6)]
    for k in range(6):
        brighter = make_thumbnail((1.5 * picture(k) + 20).astype(np.uint8))
        assert abs(brighter.mean()) < 1e-6
        assert abs(np.linalg.norm(brighter) - 1) < 1e-5
        assert kept[k].thumbnail @ brighter > 0.99
        found = most_similar(kept, brighter, 3)
        assert found[0] == k
        score = [float(kept[i].thumbnail @ brighter) for i in found]
        assert score == sorted(score, reverse=True)
        assert score[-1] >= sorted(float(one.thumbnail @ brighter) for one in kept)[-3]


def test_surface_points_are_thinned_to_the_limit_and_lie_where_their_cameras_saw_them():
    kept = [Keyframe.of(k, flat(1000), np.zeros(1200, np.float32), NONE) for k in range(3)]
    poses = np.tile(np.eye(4), (3, 1, 1))
    poses[:, 0, 3] = 10, 20, 30
    assert len(surface_points(kept, poses, 10_000)) == 3000
    few = surface_points(kept, poses, 300)
    assert 250 <= len(few) <= 303
    assert {tuple(point) for point in few.tolist()} == {(10, 0, 1), (20, 0, 1), (30, 0, 1)}
