"""Maps that are saved by one flight and continued by another one."""

from collections.abc import Sequence
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from dronevio.estimator.slam import final_map, visual_slam
from dronevio.estimator.slam.adjustment.adjuster import AdjustmentOutcome, LocalAdjuster
from dronevio.estimator.slam.adjustment.bundle_adjustment import AdjustmentConfig, AdjustmentInputs
from dronevio.estimator.slam.adjustment.final_graph import at_optimum
from dronevio.estimator.slam.config import SlamConfig
from dronevio.estimator.slam.files.map_file import read_map
from dronevio.estimator.slam.files.saved_map import FIRST_KNOWN_LANDMARK, LAST_KNOWN_NS, SavedMap, saved_map
from dronevio.estimator.slam.map.odometry_factors import RelativePose, first_node
from dronevio.estimator.slam.map.pose_graph import ADJUSTED_VARIANCE, optimize
from dronevio.estimator.slam.map.submap import Adjustment, Submap
from dronevio.estimator.slam.visual_slam import VisualSlam
from dronevio.estimator.slam.worker.map_builder import MapBuilder, MarginalizedKeyframe
from dronevio.models.arrays import Array
from dronevio.models.errors import ConfigError, InputError
from dronevio.models.imu import ImuSamples
from dronevio.models.rig import Rig, euroc_rig
from dronevio.models.rotation import inverse_pose, pose_matrix
from dronevio.models.state import CameraFrame, Estimate
from tests.estimator.slam.process.conftest import DRIFT_M, PLACES, keyframe, one_camera
from tests.estimator.slam.process.test_visual_slam import (
    CORRECTION_DELAY,
    DELAY,
    T_SECOND_FIRST,
    ScriptedOdometry,
    in_second_frame,
)


@cache
def lap_map() -> SavedMap:
    """Return the map of one lap through the places."""
    rig = one_camera()
    builder = MapBuilder(rig, SlamConfig(), None, LocalAdjuster(AdjustmentConfig()))
    for place in range(PLACES):
        builder.process(keyframe(rig, place, 0))
    solution = builder.mapper.final_solution()
    assert solution is not None
    return saved_map(rig.cameras, solution.without_rejected, builder.mapper.keyframes, builder.mapper.patches)


def fly(
    monkeypatch: pytest.MonkeyPatch,
    second_lap: Sequence[int],
    saved: SavedMap | Path,
    *,
    localize_only: bool = False,
    with_imu: bool = False,
) -> tuple[VisualSlam, list[Estimate]]:
    """Return visual SLAM and its estimates after another flight, whose odometry has another frame."""
    rig = one_camera()
    keyframes = [in_second_frame(keyframe(rig, place, 1)) for place in second_lap]
    monkeypatch.setattr(visual_slam, "VisualInertialOdometry", ScriptedOdometry(keyframes))
    config = SlamConfig(worker=False, correction_delay=CORRECTION_DELAY)
    slam = VisualSlam(rig, config=config, map=saved, localize_only=localize_only)
    estimates = []
    for message in keyframes:
        if with_imu:
            slam.add_imu(_imu(message))
        estimates.append(slam.add_frame(_frame(message)))
    return slam, estimates


def _imu(message: MarginalizedKeyframe) -> ImuSamples:
    return ImuSamples(np.array([message.estimate.t_ns]), np.zeros((1, 3)), np.zeros((1, 3)))


def _frame(message: MarginalizedKeyframe) -> CameraFrame:
    return CameraFrame(message.estimate.t_ns, message.keyframe.images)


@pytest.mark.parametrize("localize_only", [False, True])
def test_a_flight_is_joined_with_a_saved_map(monkeypatch: pytest.MonkeyPatch, localize_only: bool) -> None:
    saved = lap_map()
    slam, estimates = fly(monkeypatch, range(PLACES), saved, localize_only=localize_only)
    joined = next(i for i, estimate in enumerate(estimates) if estimate.T_map_odom is not None)
    assert DELAY <= joined < PLACES - 1
    assert estimates[joined].events == ("track joined with the map",)
    for estimate in estimates[joined:]:
        assert estimate.T_map_odom is not None
        offset = estimate.T_map_odom @ T_SECOND_FIRST
        np.testing.assert_allclose(offset[:3, 3], [0.0, -DRIFT_M, 0.0], atol=0.5 * DRIFT_M)
        assert all(t_ns > 0 for pair in estimate.closed_loops_ns for t_ns in pair)
        assert estimate.map_covariance is not None and np.trace(estimate.map_covariance[3:, 3:]) < 0.1**2
    assert all(estimate.T_map_odom is None for estimate in estimates[:joined])
    final = slam.final_map()
    assert final is not None and len(final.t_ns) == 2 * PLACES - DELAY
    np.testing.assert_allclose(final.Ts_map_imu[:PLACES], saved.Ts_map_imu, atol=1e-5 if localize_only else 1e-3)


def test_loops_do_not_move_a_map_that_is_localized_in() -> None:
    saved, last = lap_map(), PLACES - 1
    free, fixed = saved.graph, saved.known(is_fixed=True).graph
    assert not fixed.odometry and not fixed.loops and not fixed.gravity
    T = inverse_pose(free.poses[0]) @ free.poses[last]
    T[:3, 3] += 0.005
    loops = [RelativePose.measured(0, last, T, 1e-6 * np.eye(6))]
    moved_m = [
        np.linalg.norm(optimize(graph.with_loops(loops), robust=False).graph.poses[last][:3, 3] - T_last[:3, 3])
        for graph, T_last in ((free, free.poses[last]), (fixed, fixed.poses[last]))
    ]
    assert moved_m[0] > 1e-3 and moved_m[1] < 1e-4


def test_merged_flights_are_one_map(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    first, path = lap_map(), tmp_path / "room.map"
    slam, _ = fly(monkeypatch, range(PLACES), first)
    slam.save_map(path)
    both = read_map(path)
    new = PLACES - DELAY
    assert len(both.t_ns) == PLACES + new and len(both.loops) > 0 and both.joined.tolist() == [PLACES]
    np.testing.assert_array_equal(np.diff(both.t_ns)[: PLACES - 1], np.diff(first.t_ns))
    assert both.t_ns[PLACES] - both.t_ns[PLACES - 1] == 1_000_000_000
    # Landmarks of the two flights are different ones.
    count = int(both.landmark_counts[:PLACES].sum())
    assert not np.intersect1d(both.landmark_ids[:count], both.landmark_ids[count:]).size
    np.testing.assert_array_equal(both.descriptors[: len(first.descriptors)], first.descriptors)
    third, estimates = fly(monkeypatch, range(PLACES), path)
    assert estimates[-1].T_map_odom is not None
    assert third.summary.keyframes == 2 * PLACES - DELAY + new


def test_exports_of_a_merged_map(monkeypatch: pytest.MonkeyPatch) -> None:
    """The graph has the keyframes of both flights, at its optimum; there are images of the second one alone."""
    rig = one_camera()
    slam, _ = fly(monkeypatch, range(PLACES), lap_map(), with_imu=True)
    keyframes = [keyframe(rig, place, 1) for place in range(PLACES)]
    graph, final = slam.final_graph(), slam.final_map()
    assert final is not None and len(graph.poses) == len(final.t_ns) == 2 * PLACES - DELAY
    for number, T in at_optimum(graph).poses.items():
        np.testing.assert_allclose(T, graph.poses[number], atol=1e-5)
    assert [loop.T_first_second.tolist() for loop in graph.loops] == final.Ts_then_now[~final.rejected].tolist()
    found = slam.reconstruction()
    assert found.stamps_ns.tolist() == [message.estimate.t_ns for message in keyframes[:-DELAY]]
    Ts_map_cam = final.Ts_map_imu[PLACES:] @ rig.cameras[0].T_imu_cam
    np.testing.assert_allclose(found.reconstruction.Ts_world_cam, Ts_map_cam, atol=1e-9)


def test_patches_of_a_loaded_map_know_their_landmarks() -> None:
    known = lap_map().known()
    for each in known.keyframes:
        patches = known.patches[each.number]
        assert len(patches.landmark) and np.all(patches.landmark >= FIRST_KNOWN_LANDMARK)
        rows = np.searchsorted(each.landmark_ids, patches.landmark)
        np.testing.assert_array_equal(each.landmark_ids[rows], patches.landmark)
        np.testing.assert_array_equal(each.landmarks_imu[rows], patches.points_imu)


@pytest.mark.parametrize("localize_only", [False, True])
def test_a_flight_in_a_loaded_map_is_adjusted_in_the_end(monkeypatch: pytest.MonkeyPatch, localize_only: bool) -> None:
    """Its keyframes have measurements, and those of the file their corners and their graph, or they are fixed."""
    started, up = [], np.array([0.0, 0.0, 0.01])

    def raised(inputs: AdjustmentInputs, config: AdjustmentConfig) -> AdjustmentOutcome:
        started.append(inputs)
        of_flight = {keyframe.number for keyframe in inputs.keyframes}
        poses = {n: pose_matrix(T[:3, :3], T[:3, 3] + (n in of_flight) * up) for n, T in inputs.poses.items()}
        return AdjustmentOutcome(poses, "raised")

    monkeypatch.setattr(final_map, "solved", raised)
    slam, _ = fly(monkeypatch, range(PLACES), lap_map(), localize_only=localize_only, with_imu=True)
    final = slam.final_map()
    (inputs,) = started
    assert final is not None and final.adjustment == "raised"
    new = [keyframe.number for keyframe in inputs.keyframes]
    assert new == list(range(PLACES, 2 * PLACES - DELAY))
    assert inputs.loops and all(loop.first < PLACES <= loop.second for loop in inputs.loops)
    assert inputs.saved is not None and list(inputs.saved.graph.poses) == list(range(PLACES))
    assert inputs.saved.graph.fixed == (tuple(range(PLACES)) if localize_only else ())
    assert len(inputs.saved.graph.odometry) == (0 if localize_only else PLACES - 1)
    seen = np.concatenate([loop.observations.landmark for loop in inputs.loops])
    table = inputs.saved.observations
    assert len(table) and np.all(np.isin(table.landmark, seen)) and np.all(table.landmark >= FIRST_KNOWN_LANDMARK)
    np.testing.assert_allclose(final.Ts_map_imu[PLACES:], [inputs.poses[n] + _raise(up) for n in new], atol=1e-12)


def _raise(up: Array) -> Array:
    change = np.zeros((4, 4))
    change[:3, 3] = up
    return change


def test_a_flight_without_measurements_is_not_adjusted(monkeypatch: pytest.MonkeyPatch) -> None:
    slam, _ = fly(monkeypatch, range(PLACES), lap_map())
    final = slam.final_map()
    assert final is not None and final.adjustment == ""


def test_the_frame_of_a_loaded_map_stays(monkeypatch: pytest.MonkeyPatch) -> None:
    """An adjustment that moves the keyframes of the flight does not move the frame of the file with them."""
    saved = lap_map().known()
    submap = Submap.of_graph(saved.graph, 0)
    last = max(saved.graph.poses)
    node = first_node(last, keyframe(one_camera(), last, 0).estimate)
    _, submap = submap.extended(node, last + 1, keyframe(one_camera(), last + 1, 0).estimate)
    poses = {n: T.copy() for n, T in submap.graph.poses.items()}
    poses[last + 1][0, 3] += 0.1
    after = submap.adjusted(poses, Adjustment(last + 1, submap.graph.first, 1.0), 0)
    for number, T in poses.items():
        np.testing.assert_allclose(after.graph.poses[number], T, atol=1e-6)
    before = {each.second: each.covariance for each in submap.graph.odometry}
    for each in after.graph.odometry:
        ratio = ADJUSTED_VARIANCE if each.second > last else 1.0  # those of the file have been adjusted
        np.testing.assert_allclose(each.covariance, ratio * before[each.second])


def test_a_flight_elsewhere_stays_apart(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    slam, estimates = fly(monkeypatch, range(20, 20 + PLACES), lap_map())
    assert all(estimate.T_map_odom is None for estimate in estimates)
    with pytest.raises(ConfigError, match="the flight is not joined with the loaded map"):
        slam.save_map(tmp_path / "room.map")
    assert not list(tmp_path.iterdir())
    final = slam.final_map()
    assert final is not None and len(final.t_ns) == PLACES


def test_saved_poses_are_the_optimum(monkeypatch: pytest.MonkeyPatch) -> None:
    slam, _ = fly(monkeypatch, range(PLACES), lap_map())
    solution = slam.mapper.final_solution()
    assert solution is not None and solution.graph.loops
    mapper = slam.mapper
    saved = saved_map(one_camera().cameras, solution.without_rejected, mapper.keyframes, mapper.patches)
    graph, rng = saved.graph, np.random.default_rng(0)
    moved = {k: T.copy() for k, T in graph.poses.items()}
    for k, T in moved.items():
        T[:3, 3] += 0.02 * rng.normal(size=3) * (k != graph.first)
    found = optimize(replace(graph, poses=moved)).graph.poses
    # The prior of the joined track is where its first keyframe begins; its standard deviation is 100 m.
    for k, T in graph.poses.items():
        np.testing.assert_allclose(found[k], T, atol=1e-5)


def test_known_keyframes_are_before_all_flights() -> None:
    known = lap_map().known()
    assert [keyframe.number for keyframe in known.keyframes] == list(range(PLACES))
    assert known.keyframes[-1].t_ns == LAST_KNOWN_NS and {keyframe.track for keyframe in known.keyframes} == {0}
    for k in known.keyframes:
        assert k.landmark_ids.min() >= FIRST_KNOWN_LANDMARK
        marked = k.features.landmark[k.features.landmark >= 0]
        assert len(marked) and np.isin(marked, k.landmark_ids).all()
        assert (k.features.landmark == -1).any()


def test_a_map_keeps_what_is_compared(tmp_path: Path) -> None:
    """The keyframes of a loaded map equal those that were saved, to the precision of their types."""
    rig = one_camera()
    builder = MapBuilder(rig, SlamConfig(), None, LocalAdjuster(AdjustmentConfig()))
    for place in range(PLACES):
        builder.process(keyframe(rig, place, 0))
    known = lap_map().known()
    for old, new in zip(builder.mapper.keyframes, known.keyframes, strict=True):
        np.testing.assert_allclose(new.T_odom_imu, old.T_odom_imu, atol=1e-9)
        np.testing.assert_allclose(new.landmarks_imu, old.landmarks_imu, rtol=1e-6)
        np.testing.assert_allclose(new.features.pixels, old.features.pixels, atol=5e-5)
        np.testing.assert_allclose(new.features.xy, old.features.xy, atol=1e-7)
        np.testing.assert_array_equal(new.features.descriptors, old.features.descriptors)
        np.testing.assert_array_equal(new.features.landmark >= 0, old.features.landmark >= 0)
        old_patches, new_patches = builder.mapper.patches[old.number], known.patches[new.number]
        assert len(new_patches.tiles) > 10
        np.testing.assert_array_equal(new_patches.tiles, old_patches.tiles)
        np.testing.assert_array_equal(np.rint(new_patches.pixels), np.rint(old_patches.pixels))


def test_options_that_contradict_each_other(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="localize_only without a map"):
        VisualSlam(one_camera(), localize_only=True)
    slam, _ = fly(monkeypatch, range(PLACES), lap_map(), localize_only=True)
    with pytest.raises(ConfigError, match="the map stays as it is"):
        slam.save_map(tmp_path / "room.map")
    slam, _ = fly(monkeypatch, [], lap_map())
    with pytest.raises(ConfigError, match="not joined"):
        slam.save_map(tmp_path / "room.map")
    with pytest.raises(ConfigError, match="map without keyframes of this flight"):
        slam.save_ply(tmp_path / "points.ply")


def shifted(rig: Rig, **camera: object) -> Rig:
    """Return a rig whose camera has another calibration."""
    return replace(rig, cameras=(replace(rig.cameras[0], **camera),))  # type: ignore[arg-type]


def test_maps_of_another_calibration_are_refused() -> None:
    saved, rig = lap_map(), one_camera()
    saved.check_rig(rig)
    old = rig.cameras[0]
    saved.check_rig(shifted(rig, model=replace(old.model, fx=old.model.fx * 1.002)))  # as an online calibration
    moved = old.T_imu_cam.copy()
    moved[0, 3] += 0.03
    turned = old.T_imu_cam.copy()
    turned[:3, :3] = turned[:3, [1, 0, 2]] * [1.0, -1.0, 1.0]
    for other, message in (
        (shifted(rig, model=old.model.resized(640, 480)), "camera 0 has 752 × 480 px; expected 640 × 480 px"),
        (shifted(rig, model=replace(old.model, fx=old.model.fx * 1.05)), r"by 0\.000 m and"),
        (shifted(rig, T_imu_cam=moved), r"by 0\.030 m and 0\.0°"),
        (shifted(rig, T_imu_cam=turned), r"by 0\.000 m and 69\.7°"),
        (replace(euroc_rig(), cameras=(*rig.cameras, *rig.cameras)), "a rig with 1 cameras; expected 2, as"),
    ):
        with pytest.raises(ConfigError, match=message):
            saved.check_rig(other)


def test_a_file_that_does_not_fit_is_named(tmp_path: Path) -> None:
    slam = VisualSlam(one_camera(), config=SlamConfig(worker=False))
    with pytest.raises(ConfigError, match="map with 0 keyframes; expected 5 or more to save it"):
        slam.save_map(tmp_path / "room.map")
    with pytest.raises(InputError, match=r"room\.map: no such file; expected a map that dronevio has saved"):
        VisualSlam(one_camera(), map=tmp_path / "room.map")
