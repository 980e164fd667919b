"""Changes of the correction at keyframes: what is reported, and that both sides know the same."""

import numpy as np
import pytest

from dronevio.estimator.slam.correction_changes import NO_CHANGES, REPORTED_M, REPORTED_RAD, changes_since
from dronevio.estimator.slam.map.keyframe import NO_KEYFRAME_FEATURES, MapKeyframe
from dronevio.models.arrays import Array
from dronevio.models.map_correction import MapCorrection
from dronevio.models.rotation import exp_so3, inverse_pose, pose_matrix

NONE = np.zeros(0, np.int64), np.zeros((0, 3))


def poses(rng: np.random.Generator, count: int) -> Array:
    """Return random poses (K, 4, 4), far from the origin."""
    return pose_matrix(exp_so3(rng.normal(size=(count, 3))), 100.0 * rng.normal(size=(count, 3)))


def keyframes(Ts_odom_imu: Array) -> list[MapKeyframe]:
    """Return keyframes, the last three of another track."""
    first = len(Ts_odom_imu) - 3
    return [MapKeyframe(i, i, T, NO_KEYFRAME_FEATURES, *NONE, int(i >= first)) for i, T in enumerate(Ts_odom_imu)]


def moved(Ts: Array, move_m: float, turn_rad: float) -> Array:
    """Return poses moved along x and turned about the last axis."""
    T = pose_matrix(exp_so3(np.array([0.0, 0.0, turn_rad])), np.array([move_m, 0.0, 0.0]))
    return np.asarray(Ts @ T)


def test_both_sides_know_the_same() -> None:
    """Whatever is added, moved and culled, the poses are known to the tolerance, and those of the newest exactly."""
    rng = np.random.default_rng(0)
    odometry = poses(rng, 30)
    Ts, all_keyframes, known = poses(rng, 30), keyframes(odometry), MapCorrection.empty()
    for step in range(100):
        count = 3 + step // 4
        Ts[:count] = moved(Ts[:count], rng.choice([0.0, 0.3, 5.0]) * REPORTED_M, rng.choice([0.0, 0.3]) * REPORTED_RAD)
        stays = np.flatnonzero(rng.random(count) < 0.8)
        mapped = [all_keyframes[i] for i in stays]
        stamps_ns = 1000 * stays + 7
        known = changes_since(known, stamps_ns, mapped, Ts[stays]).applied(known)
        assert known.t_ns.tolist() == stamps_ns.tolist()
        assert known.track is not None and known.track.tolist() == [keyframe.track for keyframe in mapped]
        found = known.Ts_map_odom @ odometry[stays]
        assert np.linalg.norm(found[:, :3, 3] - Ts[stays, :3, 3], axis=1).max(initial=0.0) <= REPORTED_M + 1e-9
        assert changes_since(known, stamps_ns, mapped, found).applied(known) is known


@pytest.mark.parametrize(
    ("move_m", "turn_rad", "is_reported"),
    [(0.9, 0.0, False), (1.1, 0.0, True), (0.0, 0.9, False), (0.0, 1.1, True)],
)
def test_small_movements_are_not_reported(move_m: float, turn_rad: float, is_reported: bool) -> None:
    rng = np.random.default_rng(1)
    odometry, Ts, stamps_ns = poses(rng, 5), poses(rng, 5), np.arange(5)
    known = changes_since(MapCorrection.empty(), stamps_ns, keyframes(odometry), Ts).applied(MapCorrection.empty())
    np.testing.assert_allclose(known.Ts_map_odom, Ts @ inverse_pose(odometry), atol=1e-12)
    Ts[2] = moved(Ts[2:3], move_m * REPORTED_M, turn_rad * REPORTED_RAD)[0]
    assert changes_since(known, stamps_ns, keyframes(odometry), Ts).t_ns.tolist() == ([2] if is_reported else [])


def test_no_changes_change_nothing() -> None:
    known = MapCorrection.empty()
    assert NO_CHANGES.applied(known) is known
