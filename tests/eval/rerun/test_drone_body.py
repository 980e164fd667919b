"""The body of the drone in the 3D view."""

from dataclasses import replace

import numpy as np
import pytest

from dronevio.eval.rerun.drone_body import SPAN_M, DroneBody
from dronevio.models.rig import EUROC_T_IMU_CAM0, Rig, RigCamera
from dronevio.models.rig_presets import rig_named
from dronevio.models.rotation import exp_so3, pose_matrix


@pytest.mark.parametrize("span_m", [SPAN_M, 3.0])
def test_body_is_level_in_the_vehicle_frame(span_m: float) -> None:
    T_vehicle_imu = pose_matrix(exp_so3(np.array([0.4, -1.0, 2.0])), np.array([0.07, 0.02, -0.03]))
    rig = replace(rig_named("euroc"), T_vehicle_imu=T_vehicle_imu)
    body = DroneBody.of(rig, span_m)
    R, t = T_vehicle_imu[:3, :3], T_vehicle_imu[:3, 3]
    corners = body.triangles.reshape(-1, 3) @ R.T + t
    size = np.ptp(corners, axis=0) / span_m
    assert size[2] < 0.15 and np.allclose(size[:2], (0.2 * np.sqrt(2.0) + 0.16) / SPAN_M, atol=0.01)
    light = np.repeat(body.lightness == body.lightness.max(), 3)
    nose = corners[light].mean(axis=0)
    assert nose[0] > 0.1 * span_m and abs(nose[1]) < 1e-9  # forward
    rotors = corners[np.repeat(np.arange(len(body.triangles)) >= len(body.triangles) - 20, 3)]
    assert np.allclose(rotors[:, 2], rotors[0, 2]) and rotors[0, 2] > 0.0
    assert body.edges[-1].shape == (21, 3)


def test_the_camera_looks_ahead_where_the_mounting_is_not_known() -> None:
    """EuRoC's IMU has x up and z forward, and its recordings do not say so."""
    rig = rig_named("euroc")
    unknown = Rig(cameras=(RigCamera(rig.cameras[0].model, EUROC_T_IMU_CAM0),))
    corners = DroneBody.of(unknown).triangles.reshape(-1, 3)
    known = DroneBody.of(replace(rig, T_vehicle_imu=pose_matrix(rig.T_vehicle_imu[:3, :3], np.zeros(3)))).triangles
    assert np.abs(corners - known.reshape(-1, 3)).max() < 0.02  # the camera is tilted by a few degrees
    assert np.ptp(corners[:, 0]) < 0.12  # x is up


def test_colours_are_shades_of_one_colour() -> None:
    body = DroneBody.of(rig_named("euroc"))
    colours = body.colours((0, 158, 115))
    assert colours.shape == (3 * len(body.triangles), 3)
    darkest = colours[colours.sum(axis=1).argmin()]
    assert darkest[0] == 0 and darkest[1] > darkest[2] > 50
