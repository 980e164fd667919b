"""The dense map along a flight: submaps begin, a loss begins another local map, and loops bend the map."""

from dataclasses import replace

import numpy as np
import pytest

from dronevio.estimator.mapping.config import DenseMapConfig
from dronevio.estimator.mapping.dense_mapper import DenseMapper
from dronevio.models.arrays import Array
from dronevio.models.depth import DepthImage, Pinhole
from dronevio.models.map_correction import MapCorrection
from dronevio.models.occupancy import FREE, OCCUPIED
from dronevio.models.rig import euroc_rig
from dronevio.models.rotation import inverse_pose, pose_matrix, rotation_z
from dronevio.models.state import CameraFrame, Estimate, Health, NavState
from tests.estimator.slam.process.conftest import DRIFT_M, PLACES, keyframe, one_camera
from tests.estimator.slam.process.test_visual_slam import places, run

R_ODOM_CAM = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])  # looks along x
DEPTH_M = 2.05
CAMERA = Pinhole(64, 48, np.array([[50.0, 0.0, 31.5], [0.0, 50.0, 23.5], [0.0, 0.0, 1.0]]))


class Wall:
    """Depth images of a wall in front of the camera."""

    def depth(self, frame: CameraFrame, estimate: Estimate) -> DepthImage | None:
        """Return the depth image of a camera that looks along the x axis of the odometry frame."""
        assert estimate.T_odom_imu is not None
        depth, shape = np.full((48, 64), DEPTH_M, np.float32), (48, 64)
        T = pose_matrix(R_ODOM_CAM, estimate.T_odom_imu[:3, 3])
        return DepthImage(frame.t_ns, CAMERA, T, depth, np.full(shape, 0.01, np.float32), np.zeros(shape, np.uint8))


def mapper_of_walls(config: DenseMapConfig | None = None) -> DenseMapper:
    """Return a mapper whose depth images are those of walls."""
    return DenseMapper(euroc_rig(), config, Wall())


def estimate(
    index: int,
    x_m: float = 0.0,
    track: int = 0,
    correction: MapCorrection | None = None,
    health: Health = Health.TRACKING,
) -> Estimate:
    """Return the estimate of a frame by its position along x; the map frame of its track is not known."""
    t_ns, zeros = index * 100_000_000, np.zeros(3)
    state = NavState(t_ns, pose_matrix(np.eye(3), np.array([x_m, 0.0, 1.0])), zeros, zeros, zeros)
    return Estimate(t_ns, health, state, track=track, map_correction=correction)


def add(mapper: DenseMapper, *estimates: Estimate) -> None:
    """Add frames with their estimates."""
    for each in estimates:
        mapper.add_frame(CameraFrame(each.t_ns, ()), each)


def corrected(tracks: dict[int, Array]) -> MapCorrection:
    """Return a correction with one keyframe in each track."""
    times = np.array([10_000_000_000 * track for track in tracks], np.int64)
    starts = np.arange(max(tracks, default=0) + 1) * 10_000_000_000
    return MapCorrection(times, np.array(list(tracks.values())).reshape(-1, 4, 4), np.array(list(tracks)), starts)


def has_local_map(mapper: DenseMapper) -> bool:
    """Return whether there is a local map."""
    return mapper.local_map is not None


def test_frames_without_tracking_do_not_enter() -> None:
    mapper = mapper_of_walls()
    add(mapper, *(estimate(i, health=h) for i, h in enumerate((Health.INERTIAL_ONLY, Health.LOST))))
    assert not has_local_map(mapper) and mapper.fused() is None and len(mapper.submaps) == 0
    add(mapper, estimate(2))
    assert has_local_map(mapper) and len(mapper.submaps) == 1


@pytest.mark.parametrize("frames_hz", [5.0, 12.5, 15.0, 20.0, 24.0, 25.0, 29.97, 60.0])
def test_the_rate_of_depth_images_does_not_depend_on_that_of_the_frames(frames_hz: float) -> None:
    """Ten depth images a second, or all frames if they are fewer; after a gap there is no burst."""
    taken: list[int] = []

    class Asked:
        def depth(self, frame: CameraFrame, at: Estimate) -> None:
            taken.append(frame.t_ns)

    mapper, t_s = DenseMapper(euroc_rig(), source=Asked()), np.arange(round(4.0 * frames_hz)) / frames_hz
    for t_ns in np.rint(1e9 * np.concatenate([t_s, 10.0 + t_s])).astype(np.int64).tolist():
        mapper.add_frame(CameraFrame(t_ns, ()), replace(estimate(0), t_ns=t_ns))
    before, after = (np.count_nonzero((np.array(taken) < 5 * 10**9) == is_first) for is_first in (True, False))
    assert before == pytest.approx(4.0 * min(frames_hz, 10.0), abs=1) and after == pytest.approx(before, abs=1)
    assert np.diff(taken).min() > 0.99e9 * np.floor(frames_hz / min(frames_hz, 10.0)) / frames_hz


def test_submaps_begin_along_the_path_and_together_are_the_map() -> None:
    mapper = mapper_of_walls(DenseMapConfig(submap_m=1.0))
    add(mapper, *(estimate(i, 0.05 * i) for i in range(100)))
    submaps, grid = mapper.submaps, mapper.fused()
    assert [submap.number for submap in submaps] == [0, 1, 2, 3, 4]
    assert submaps[0].anchor_ns == 0 and np.all(np.diff([submap.anchor_ns for submap in submaps]) >= 1_000_000_000)
    assert grid is not None and grid.frame == "map"
    end = np.array([0.05 * 99 + DEPTH_M, 0.0, 1.0])
    assert grid.at(end) == OCCUPIED and grid.at(end - [1.0, 0.0, 0.0]) == FREE
    assert grid.at(np.array([1.0, 0.0, 1.0])) == FREE  # far behind the local map's middle, too


def test_the_packed_size_counts_what_is_in_files() -> None:
    kept, written = (mapper_of_walls(DenseMapConfig(submap_m=1.0, memory_mb=limit)) for limit in (32.0, 0.0))
    for mapper in (kept, written):
        add(mapper, *(estimate(i, 0.05 * i) for i in range(60)))
    assert written.packed_bytes == kept.packed_bytes > 100


def test_a_loss_begins_a_new_map_and_joining_brings_the_old_one_back() -> None:
    mapper, T = mapper_of_walls(), pose_matrix(rotation_z(1.0), np.array([0.5, 2.0, 0.0]))
    first = corrected({0: np.eye(4)})
    add(mapper, *(estimate(i, correction=first) for i in range(10)))
    before, wall = mapper.fused(), np.array([DEPTH_M, 0.0, 1.0])
    assert before is not None and before.at(wall) == OCCUPIED
    # Lost: the new track has its own local map, and is not in the map.
    add(mapper, Estimate(99 * 100_000_000, Health.LOST, None, track=1, map_correction=first))
    assert not has_local_map(mapper)
    add(mapper, *(estimate(100 + i, 3.0, 1, first) for i in range(10)))
    local, lost = mapper.local_map, mapper.fused()
    assert local is not None and local.at(wall) != OCCUPIED and local.at(wall + [3.0, 0.0, 0.0]) == OCCUPIED
    assert [submap.T_map_odom is None for submap in mapper.submaps] == [False, True]
    assert lost is not None and np.array_equal(lost.states, before.states)
    # Joined: both are placed, the local map stays where it is.
    add(mapper, estimate(110, 3.0, 1, corrected({0: np.eye(4), 1: T})))
    joined = mapper.fused()
    assert joined is not None and joined.at(wall) == OCCUPIED
    assert joined.at(T[:3, :3] @ (wall + [3.0, 0.0, 0.0]) + T[:3, 3]) == OCCUPIED
    assert mapper.local_map is not None and mapper.local_map.at(wall + [3.0, 0.0, 0.0]) == OCCUPIED
    # In a frame in which the first track is not joined, it is not shown.
    add(mapper, estimate(111, 3.0, 1, corrected({1: T})))
    assert [submap.T_map_odom is None for submap in mapper.submaps] == [True, False]


def test_a_wrong_correction_that_is_taken_back_leaves_the_map_as_it_was() -> None:
    mapper, good = mapper_of_walls(), corrected({0: pose_matrix(rotation_z(0.3), np.ones(3))})
    wrong = corrected({0: pose_matrix(rotation_z(-0.9), 5.0 * np.ones(3))})
    add(mapper, *(estimate(i, correction=good) for i in range(10)))
    before = mapper.fused()
    quiet = Health.INERTIAL_ONLY  # without further depth images
    add(mapper, estimate(10, correction=wrong, health=quiet))
    meanwhile = mapper.fused()
    add(mapper, estimate(11, correction=good, health=quiet))
    after = mapper.fused()
    assert before is not None and meanwhile is not None and after is not None
    assert not np.array_equal(meanwhile.low_m, before.low_m)
    assert np.array_equal(after.low_m, before.low_m) and after.states.tobytes() == before.states.tobytes()


def test_the_map_of_a_flight_with_a_loop_bends(monkeypatch: pytest.MonkeyPatch) -> None:
    """In the second lap the odometry has drifted along y; its submaps are moved back, the local map is not."""
    rig = one_camera()
    _, estimates = run(monkeypatch, [keyframe(rig, place, lap) for lap in range(2) for place in range(PLACES)])
    mapper = mapper_of_walls(DenseMapConfig(submap_m=0.5))
    add(mapper, *estimates)
    place = {each.t_ns: index % PLACES for index, each in enumerate(estimates)}
    submaps = mapper.submaps
    assert [place[submap.anchor_ns] for submap in submaps] == [0, 4, 0, 4]
    for first, second in zip(submaps[:2], submaps[2:], strict=True):
        assert first.T_map_odom is not None and second.T_map_odom is not None
        T_first_second = inverse_pose(first.T_map_odom) @ second.T_map_odom
        assert T_first_second[1, 3] == pytest.approx(-DRIFT_M, abs=0.4 * DRIFT_M)


def test_the_map_of_a_flight_with_a_loss_is_joined(monkeypatch: pytest.MonkeyPatch) -> None:
    _, estimates = run(monkeypatch, places(range(PLACES)))
    mapper, shown = mapper_of_walls(), []
    for each in estimates:
        add(mapper, each)
        shown.append([submap.T_map_odom is not None for submap in mapper.submaps])
    assert shown[PLACES + 1] == [True, False] and shown[-1] == [True, True]
