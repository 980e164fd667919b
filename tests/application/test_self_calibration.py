"""The comparison of two reconstructions of uncalibrated photographs."""

from typing import Any

import numpy as np
import pytest

from dronevio.models.rotation import exp_so3, pose_matrix


def outcome(script: Any, Ts_world_cam: Any, names: tuple[str, ...], focal_px: tuple[float, ...] = (500.0,)) -> Any:
    """Return an outcome with some cameras."""
    tool = script("self_calibration")
    distortion = np.array([[-0.1, 0.02]] * len(focal_px))
    return tool.Outcome(2.0, 1, 10, 0.5, names, Ts_world_cam, np.array(focal_px), distortion)


@pytest.fixture
def cameras() -> Any:
    """Return five poses around a scene."""
    return np.stack(
        [pose_matrix(exp_so3(np.array([0.1 * k, 0.2, 0.0])), np.array([k, k % 2, 0.3 * k])) for k in range(5)]
    )


def test_a_similarity_transformation_makes_no_difference(script: Any, cameras: Any) -> None:
    moved = cameras.copy()
    R, t = exp_so3(np.array([0.4, -0.3, 1.0])), np.array([3.0, 1.0, -2.0])
    moved[:, :3, :3], moved[:, :3, 3] = R @ cameras[:, :3, :3], 2.5 * cameras[:, :3, 3] @ R.T + t
    a, b = outcome(script, cameras, tuple("abcde")), outcome(script, moved[::-1], tuple("edcba"))
    np.testing.assert_allclose(script("self_calibration").differences(a, b), 0.0, atol=1e-4)


def test_a_turned_camera_and_a_shifted_one(script: Any, cameras: Any) -> None:
    turned = cameras.copy()
    turned[0, :3, :3] = turned[0, :3, :3] @ exp_so3(np.radians([2.0, 0.0, 0.0]))
    a, b = outcome(script, cameras[:3], tuple("abc")), outcome(script, turned, tuple("abcde"))
    rotation_deg, position_percent = script("self_calibration").differences(a, b)
    assert rotation_deg == pytest.approx(2.0)  # of two of three pairs
    assert position_percent == pytest.approx(0.0, abs=1e-9)
    shifted = cameras.copy()
    shifted[0, 2, 3] += 0.1
    _, position_percent = script("self_calibration").differences(a, outcome(script, shifted, tuple("abcde")))
    assert 0.3 < position_percent < 5.0  # of 0.1 in one of three positions, 1 to 2 apart


def test_two_cameras_are_not_compared(script: Any, cameras: Any) -> None:
    a, b = outcome(script, cameras, tuple("abcde")), outcome(script, cameras[:2], tuple("ab"))
    assert np.isnan(script("self_calibration").differences(a, b)).all()


def test_rows_have_the_same_columns_with_and_without_a_result(script: Any, cameras: Any) -> None:
    tool, images = script("self_calibration"), type("Images", (), {"names": tuple("abcdef")})
    found = outcome(script, cameras, tuple("abcde"), (490.0, 510.0))
    good = tool.row("set", "dronevio", images, found, 500.0, None)
    none = tool.row("set", "COLMAP", images, tool.Outcome(1.0), None, found)
    assert tuple(good) == tuple(none)
    assert (good["registered"], none["registered"]) == ("5 of 6", "0 of 6")
    assert (good["focal length [px]"], good["k1"]) == ("490 to 510", "-0.100")
    assert none["focal length [px]"] == "–" and none["rotation [°]"] == "–"
