"""What front ends share."""

import numpy as np
import pytest

from dronevio.estimator.frontend.protocol import is_inside
from dronevio.models.camera import CameraModel

CAMERA = CameraModel(100, 60, 80.0, 80.0, 49.5, 29.5)


@pytest.mark.parametrize(
    ("x", "y", "inside"),
    [
        (12.0, 12.0, True),
        (11.9, 12.0, False),
        (12.0, 11.9, False),
        (87.0, 47.0, True),
        (87.1, 47.0, False),
        (87.0, 47.1, False),
        (np.nan, 30.0, False),
        (50.0, np.nan, False),
    ],
)
def test_borders_belong_to_the_inside(x: float, y: float, inside: bool) -> None:
    """The outermost pixels of a row are 0 and 99, of a column 0 and 59, and 12 px away from them is inside."""
    np.testing.assert_array_equal(is_inside(np.array([[x, y], [50.0, 30.0]]), CAMERA, 12.0), [inside, True])
