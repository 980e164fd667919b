"""Landmarks at the final poses of a map, and the images that observe them."""

from dataclasses import replace

import numpy as np
import pytest

from dronevio.estimator.backend.keyframe_estimate import KeyframeEstimate
from dronevio.estimator.backend.observations import ObservationTable
from dronevio.estimator.imu.preintegration import PreintegrationConfig, PreintegrationParams
from dronevio.estimator.intrinsics import IntrinsicCorrections
from dronevio.estimator.slam.adjustment.bundle_adjustment import AdjustmentConfig, AdjustmentInputs, AdjustmentKeyframe
from dronevio.estimator.slam.adjustment.structure import MAX_ERROR_PX, map_structure
from dronevio.estimator.types import Calibration
from dronevio.models.arrays import Array
from dronevio.models.imu import ImuSamples
from dronevio.models.rig_presets import rig_named
from dronevio.models.rotation import inverse_pose
from dronevio.models.state import NavState
from tests.estimator.slam.conftest import pose

RIG = rig_named("euroc-stereo")
NUMBERS = 3, 4, 8, 20
STAMPS_NS = 100 * np.array(NUMBERS) + 7
POINTS = np.stack(np.meshgrid([3.0, 4.0, 5.5, 7.0], np.linspace(-0.6, 1.4, 5), [-0.6, 0.6]), axis=-1).reshape(-1, 3)
FIRST_ID = 500


def observed(number: int, T_map_imu: Array, calibration: Calibration) -> ObservationTable:
    """Return exact observations of all points by all cameras, as undistorted coordinates."""
    tables = []
    for index, camera in enumerate(calibration.rig.cameras):
        T = inverse_pose(T_map_imu @ camera.T_imu_cam)
        p = POINTS @ T[:3, :3].T + T[:3, 3]
        none = np.zeros(len(p), np.int64)
        ids = none + FIRST_ID + np.arange(len(p))
        tables.append(ObservationTable(ids, none + number, none + index, p[:, :2] / p[:, 2:], np.ones(len(p)), none))
    return ObservationTable.concatenated(tables)


def inputs(calibration: Calibration | None = None) -> AdjustmentInputs:
    """Return the measurements of four keyframes."""
    calibration = calibration or Calibration(RIG)
    poses = [pose([0.0, 0.3 * i, 0.1 * i], 0.02 * i) for i in range(4)]
    none = np.zeros(3), np.zeros(3), np.zeros(3)
    keyframes = [
        AdjustmentKeyframe(
            n,
            n,
            T,
            *none,
            np.eye(6),
            observed(n, T, calibration),
            KeyframeEstimate.of_state(NavState(n, T, *none)),
        )
        for n, T in zip(NUMBERS, poses, strict=True)
    ]
    params = PreintegrationParams.of(RIG.imu, PreintegrationConfig())
    return AdjustmentInputs(keyframes, (), ImuSamples.empty(), RIG.imu, params, calibration, NUMBERS[0], np.eye(6))


def test_exact_observations_give_the_points() -> None:
    measured = inputs()
    found = map_structure(measured, AdjustmentConfig(), STAMPS_NS)
    r = found.reconstruction
    np.testing.assert_allclose(r.points, POINTS, atol=1e-4)
    assert r.reprojection_errors_px().max() < 1e-2 and len(r.observation_px) == 4 * 2 * len(POINTS)
    names = [f"cam{camera}/{t_ns}.png" for t_ns in (307, 407, 807, 2007) for camera in (0, 1)]
    assert list(r.image_names) == names and found.stamps_ns.tolist() == np.repeat(STAMPS_NS, 2).tolist()
    for i in range(len(names)):
        expected = measured.keyframes[i // 2].T_map_imu @ RIG.cameras[i % 2].T_imu_cam
        np.testing.assert_allclose(r.Ts_world_cam[i], expected, atol=1e-12)
    assert r.cameras == tuple(camera.model for camera in RIG.cameras)


def test_observations_far_off_are_left_out() -> None:
    measured = inputs()
    first, *others = measured.keyframes
    xy = first.observations.xy.copy()
    xy[5, 0] += 4.0 * MAX_ERROR_PX / RIG.cameras[0].model.fx
    first = replace(first, observations=replace(first.observations, xy=xy))
    r = map_structure(replace(measured, keyframes=[first, *others]), AdjustmentConfig(), STAMPS_NS).reconstruction
    np.testing.assert_allclose(r.points, POINTS, atol=1e-4)
    assert len(r.observation_px) == 4 * 2 * len(POINTS) - 1
    assert np.count_nonzero((r.observation_image == 0) & (r.observation_point == 5)) == 0


def test_landmarks_of_few_views_are_left_out() -> None:
    measured = inputs()
    first, *others = measured.keyframes
    kept = [replace(k, observations=k.observations[k.observations.landmark != FIRST_ID + 7]) for k in others]
    found = map_structure(replace(measured, keyframes=[first, *kept]), AdjustmentConfig(), STAMPS_NS).reconstruction
    np.testing.assert_allclose(found.points, np.delete(POINTS, 7, axis=0), atol=1e-4)


def test_a_map_without_landmarks_has_its_images() -> None:
    measured = inputs()
    none = [replace(keyframe, observations=keyframe.observations[:0]) for keyframe in measured.keyframes]
    r = map_structure(replace(measured, keyframes=none), AdjustmentConfig(), STAMPS_NS).reconstruction
    assert len(r.image_names) == 8 and len(r.points) == len(r.observation_px) == 0


def test_cameras_have_the_corrected_intrinsics() -> None:
    """The pixels are those that the images have: by the given model, before the correction."""
    calibration = Calibration(
        RIG,
        0.0,
        IntrinsicCorrections(np.full(2, 0.01), np.full((2, 2), -0.005), np.full(2, 0.02), Calibration(RIG).models),
    )
    r = map_structure(inputs(calibration), AdjustmentConfig(), STAMPS_NS).reconstruction
    assert r.cameras[0].fx == pytest.approx(1.01 * RIG.cameras[0].model.fx)
    assert r.cameras[0].distortion[0] == pytest.approx(RIG.cameras[0].model.distortion[0] + 0.02)
    table = observed(NUMBERS[0], inputs().keyframes[0].T_map_imu, calibration)
    given = RIG.cameras[0].model
    is_central = (table.camera == 0) & (np.linalg.norm(table.xy, axis=1) < 0.15)
    xy = calibration.given_xy(table.xy, table.camera)
    pixels = given.project(np.column_stack([xy, np.ones(len(xy))]))
    for row in np.flatnonzero(is_central):
        rows = (r.observation_image == 0) & (r.observation_point == table.landmark[row] - FIRST_ID)
        np.testing.assert_allclose(r.observation_px[rows][0], pixels[row], atol=0.2)
    assert is_central.sum() > 3 and r.reprojection_errors_px().max() < 1e-2
