"""The engine as a whole, on a few small frames of a built-in room."""

import numpy as np

from ecslam.config import apply_settings, load_preset
from ecslam.datasets import open_sequence
from ecslam.slam import Slam


def test_restored_engine_goes_on_bit_for_bit():
    room = open_sequence("synthetic/studio?size=160x120&frames=14")
    settings = ["mapping.first_iterations=20", "mapping.rays=500", "tracking.rays=300"]
    config = apply_settings(load_preset("lite"), settings)
    one = Slam(config, room.intrinsics, first_pose=room[0].c2w_gt, bounds=room.bounds)
    for i in range(11):
        one.step(room[i])
    two = Slam.restore(config, room.intrinsics, one.state())
    for i in range(11, 14):
        one.step(room[i])
        two.step(room[i])
    assert np.array_equal(one.trajectory.poses(), two.trajectory.poses())
