"""Poses kept in little memory, and given back bit by bit."""

from __future__ import annotations

import tracemalloc

import numpy as np
from numpy.testing import assert_array_equal

from air.pose_log import PoseLog
from common.se3 import SE3, rotation_vector_to_matrix


def test_poses_come_back_as_they_were_also_while_more_are_added() -> None:
    rng = np.random.default_rng(1)
    poses = [SE3(rotation_vector_to_matrix(rng.normal(size=3)), rng.normal(size=3)) for _ in range(20)]
    log, seen = PoseLog(), []
    assert len(log.positions) == len(log.sigmas) == len(log.t_ns) == 0
    for k, T in enumerate(poses):
        log.add(10**18 + k, T, T.t**2)
        seen.append((log.positions, log.sigmas, log.t_ns))
    assert len(log) == 20
    for T, back in zip(poses, log, strict=True):
        assert_array_equal(back.matrix, T.matrix)
    assert_array_equal(seen[9][0], [T.t for T in poses[:10]])
    assert_array_equal(seen[9][1], [T.t**2 for T in poses[:10]])
    assert_array_equal(log.t_ns, 10**18 + np.arange(20))


def test_half_an_hour_at_200_hz_needs_less_than_60_megabytes() -> None:
    log, T, sigma = PoseLog(), SE3.identity(), np.ones(3)
    tracemalloc.start()
    for k in range(20_000):
        log.add(k, T, sigma)
    used = tracemalloc.get_traced_memory()[0] / 20_000
    tracemalloc.stop()
    assert used * 200 * 1800 < 60e6
