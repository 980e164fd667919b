"""Messages of an odometry that passes through the same places twice."""

import cv2
import numpy as np
import pytest

from dronevio.estimator.backend.keyframe_estimate import KeyframeEstimate
from dronevio.estimator.slam.worker.map_builder import ImagedKeyframe, MarginalizedKeyframe
from dronevio.estimator.types import Observations
from dronevio.models.rig import Rig, euroc_rig
from dronevio.models.rotation import rotation_z
from tests.estimator.slam.conftest import R_LEVEL

PLACES, LANDMARKS = 8, 120
INTERVAL_NS, SECOND_LAP_NS = 250_000_000, 20_000_000_000
DRIFT_M = 0.03


def one_camera() -> Rig:
    """Return a rig with one camera."""
    rig = euroc_rig()
    return Rig(rig.cameras[:1], rig.imu, rig.T_vehicle_imu)


def keyframe(rig: Rig, place: int, lap: int) -> MarginalizedKeyframe:
    """Return a keyframe of a lap; in the second one, the odometry has drifted."""
    rng, camera = np.random.default_rng(place), rig.cameras[0]
    size = camera.model.width, camera.model.height
    noise = np.asarray(cv2.GaussianBlur(rng.normal(size=size[::-1]), (0, 0), 2.0), np.float64)
    image = np.clip(128.0 + 60.0 * noise / noise.std(), 0.0, 255.0).astype(np.uint8)
    pixels = rng.uniform(40.0, np.array(size) - 40.0, (LANDMARKS, 2))
    xy = camera.model.normalize(pixels)
    in_cam = np.column_stack([xy, np.ones(LANDMARKS)]) * rng.uniform(2.0, 6.0, (LANDMARKS, 1))
    T = np.eye(4)
    T[:3, :3] = rotation_z(0.1 * place) @ R_LEVEL
    T[:3, 3] = [0.2 * place, DRIFT_M * lap, 1.0]
    T_odom_cam = T @ camera.T_imu_cam
    number = PLACES * lap + place
    ids = np.arange(LANDMARKS) + LANDMARKS * number
    t_ns = SECOND_LAP_NS * lap + INTERVAL_NS * place
    estimate = KeyframeEstimate(
        t_ns,
        T,
        1e-5 * (1.0 + number) * np.eye(6),
        t_ns + INTERVAL_NS,
        np.eye(4),
        1e-6 * np.eye(6),
        ids,
        in_cam @ T_odom_cam[:3, :3].T + T_odom_cam[:3, 3],
    )
    observations = Observations(ids, pixels, xy, np.ones(LANDMARKS, np.int64))
    return MarginalizedKeyframe(ImagedKeyframe((image,), rig, T[:3, :3], observations), estimate)


@pytest.fixture(scope="session")
def two_laps() -> list[MarginalizedKeyframe]:
    """Return the keyframes of two laps through the same places."""
    rig = one_camera()
    return [keyframe(rig, place, lap) for lap in range(2) for place in range(PLACES)]
