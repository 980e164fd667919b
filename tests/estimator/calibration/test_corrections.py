"""Corrections of a calibration as a vector and as text."""

import numpy as np
import pytest

from dronevio.estimator.calibration.corrections import Corrections


def test_parameters_of_two_cameras_keep_their_order() -> None:
    found = Corrections.from_vector(np.arange(23.0) - 2.0)
    assert (found.time_offset_s, found.gravity_m_s2, found.gyro_scale) == (-2.0, -1.0, 0.0)
    np.testing.assert_array_equal(found.rotation_rad, [[1, 2, 3], [11, 12, 13]])
    np.testing.assert_array_equal(found.translation_m, [[4, 5, 6], [14, 15, 16]])
    np.testing.assert_array_equal(found.focal, [[7], [17]])
    np.testing.assert_array_equal(found.principal, [[8, 9], [18, 19]])
    np.testing.assert_array_equal(found.radial, [[10], [20]])


@pytest.mark.parametrize(
    ("index", "value", "text"),
    [
        (0, 0.0042, "time offset +4.2 ms"),
        (1, -0.0304, "gravity -0.030 m/s²"),
        (4, np.radians(-0.5), "camera 0 rotation +0.00 -0.50 +0.00°"),
        (16, 0.011, "camera 1 translation +11 +0 +0 mm"),
        (9, -0.0125, "camera 0 focal length -1.25 %"),
        (21, 0.002, "camera 1 principal point +0.0 +2.0 mrad"),
        (12, -0.0123, "camera 0 radial distortion -0.0123"),
    ],
)
def test_text_names_what_is_corrected(index: int, value: float, text: str) -> None:
    x = np.zeros(23)
    x[index] = value
    assert str(Corrections.from_vector(x)) == text


def test_text_of_no_correction_is_none() -> None:
    assert str(Corrections.from_vector(np.zeros(23))) == "none"
