"""Which poses are trusted, and when a camera counts as lost and as found."""

import numpy as np
import pytest
from planes import pose

from ecslam.recovery import FOUND_FIT, LOST_FIT, PATIENCE, USUAL_OVER, Recovery, around
from ecslam.rigid import rotation_angle_deg
from ecslam.tracker import TrackResult

HERE = np.eye(4)


def result(fit=0.9, c2w=HERE):
    return TrackResult(c2w, {}, fit)


class Places:
    """``Elsewhere`` with these results; ``asked`` says for which."""

    def __init__(self, recognised=None, searched=None, agrees=lambda c2w: True):
        self.results, self.agrees, self.asked = {"recognised": recognised, "searched": searched}, agrees, []

    def recognised(self):
        self.asked.append("recognised")
        return self.results["recognised"]

    def searched(self):
        self.asked.append("searched")
        return self.results["searched"]


NOWHERE = Places()


def usual(fit=0.9, frames=5):
    recovery = Recovery()
    for _ in range(frames):
        recovery.judge(result(fit), HERE, NOWHERE)
    return recovery


@pytest.mark.parametrize(
    ("track", "trusted"),
    [
        (result(), True),
        (result(0.6), True),
        (result(0.5), False),  # of a usual 0.9
        (result(c2w=pose(centre=(0.4, 0, 0))), True),
        (result(c2w=pose(centre=(0.6, 0, 0))), False),
        (result(c2w=pose((0, 30, 0))), True),
        (result(c2w=pose((0, 40, 0))), False),
        (result(c2w=np.full((4, 4), np.nan)), False),
    ],
)
def test_a_pose_is_trusted_where_the_map_explains_it_and_it_is_near(track, trusted):
    recovery = usual()
    found = recovery.judge(track, HERE, NOWHERE)
    assert recovery.missed == (not trusted)
    assert found.c2w is (track.c2w if trusted else HERE)


def test_what_is_usual_follows_slowly_and_only_what_was_trusted():
    recovery = usual(0.5)
    assert recovery.usual_fit == pytest.approx(0.5)
    recovery.judge(result(0.9), HERE, NOWHERE)
    assert recovery.usual_fit == pytest.approx(0.5 + 0.4 / USUAL_OVER)
    before = recovery.usual_fit
    recovery.judge(result(0.1), HERE, NOWHERE)
    assert recovery.usual_fit == before


def test_the_first_frames_need_some_fit_at_all():
    for fit, missed in ((LOST_FIT + 0.01, False), (LOST_FIT - 0.01, True)):
        recovery = Recovery()
        recovery.judge(result(fit), HERE, NOWHERE)
        assert recovery.missed == missed


def test_lost_after_some_misses_in_a_row_and_found_again_where_nearly_all_is_explained():
    recovery = usual()

    def found_at(fit):
        return Places(searched=result(fit, pose(centre=(2, 0, 0))))

    for miss in range(1, PATIENCE + 1):
        held = recovery.judge(result(0.1, pose(centre=(1, 0, 0))), HERE, NOWHERE)
        assert held.c2w is HERE
        assert recovery.missed
        assert recovery.lost == (miss >= PATIENCE)
        assert recovery.note.startswith("lost" if recovery.lost else "not tracked")
    recovery.judge(result(0.9), HERE, found_at(0.80))  # a good fit near by is no proof any more, nor is 89 % of it
    assert recovery.lost
    again = Recovery()
    again.load(recovery.state())
    for each in (recovery, again):
        found = each.judge(result(0.9), HERE, found_at(0.85))
        assert found.c2w[0, 3] == 2
        assert (each.lost, each.missed, each.note) == (False, False, "relocalised")


def test_a_map_that_explains_little_is_still_not_found_by_less_than_most_of_it():
    recovery = usual(0.3)
    recovery.judge(result(0.1), HERE, Places(searched=result(FOUND_FIT - 0.01)))
    assert recovery.missed
    recovery.judge(result(0.1), HERE, Places(searched=result(FOUND_FIT)))
    assert (recovery.missed, recovery.note) == (False, "recovered")


def test_what_is_recognised_spares_the_search_and_a_good_frame_both():
    recovery = usual()
    there, far = pose(centre=(1, 0, 0)), pose(centre=(2, 0, 0))
    for fit, asked, x in ((0.9, [], 0), (0.1, ["recognised"], 1)):
        places = Places(result(0.9, there), result(0.95, far))
        assert recovery.judge(result(fit), HERE, places).c2w[0, 3] == x
        assert places.asked == asked
    places = Places(result(0.5, there), result(0.95, far))
    assert recovery.judge(result(0.1), HERE, places).c2w[0, 3] == 2


@pytest.mark.parametrize("lost", [False, True])
def test_a_place_that_fits_but_looks_otherwise_is_not_taken(lost):
    recovery = usual()
    recovery.lost = lost
    alike = pose(centre=(2, 0, 0))
    recovery.judge(result(0.1), HERE, Places(searched=result(0.95, alike), agrees=lambda c2w: c2w is not alike))
    assert recovery.missed


def test_a_sudden_motion_or_a_gap_is_trusted_where_the_looks_agree():
    sudden = pose(centre=(0.2, 0, 0))
    for gap, fit, c2w in ((False, 0.7, sudden), (True, 0.9, HERE)):
        for agrees in (True, False):
            recovery, places = usual(), Places(agrees=lambda c2w, answer=agrees: answer)
            recovery.judge(result(fit, c2w), HERE, places, gap)
            assert recovery.missed == (not agrees)
            assert places.asked == ["recognised", "searched"][: 2 if fit < 0.8 or not agrees else 1]
    recovery = usual()
    recovery.judge(result(0.9, sudden), HERE, Places(agrees=lambda c2w: False))
    assert not recovery.missed
    recovery = usual()
    for _ in range(2):  # nor is a good fit near a pose that was held
        recovery.judge(result(0.7, sudden), HERE, Places(agrees=lambda c2w: False))
        recovery.judge(result(0.9), HERE, Places(agrees=lambda c2w: False))
        assert recovery.missed
    recovery = usual()
    found = recovery.judge(result(0.85, sudden), HERE, Places(result(0.9, pose(centre=(0.3, 0, 0)))))
    assert found.c2w[0, 3] == 0.3
    assert not recovery.note


def test_a_good_frame_between_two_misses_starts_the_count_anew():
    recovery = usual()
    for fit in (0.1, 0.1, 0.9, 0.1, 0.1):
        recovery.judge(result(fit), HERE, NOWHERE)
    assert not recovery.lost


def test_around_a_pose_lie_a_step_and_a_turn_each_way():
    start = pose((0, 20, 0), (1, 2, 3))
    found = np.stack(around(start))
    assert len(found) == 13
    assert np.allclose(found[0], start)
    steps = np.linalg.norm(found[:, :3, 3] - start[:3, 3], axis=1)
    turns = rotation_angle_deg(np.broadcast_to(start, found.shape), found)
    assert np.allclose(sorted(steps), [0] * 7 + [0.1] * 6)
    assert np.allclose(sorted(np.radians(turns)), [0] * 7 + [0.1] * 6)
    assert np.allclose(found[1:].mean(0)[:3, 3], start[:3, 3])
