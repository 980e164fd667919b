"""What an interrupted reconstruction has stored is read as it was."""

from pathlib import Path

import numpy as np
import pytest

from dronevio.estimator.sfm.two_view import Geometry, TwoView
from dronevio.estimator.sfm.workspace import Workspace


@pytest.mark.parametrize("counts", [(), (0,), (3,), (2, 0, 5), (0, 0)])
def test_pairs_are_read_as_they_were_stored(tmp_path: Path, counts: tuple[int, ...]) -> None:
    rng = np.random.default_rng(0)
    pairs = [
        TwoView(4, 5 + n, rng.integers(0, 99, (count, 2)), Geometry.GENERAL, rng.normal(size=(4, 4)), 0.1 * n)
        for n, count in enumerate(counts)
    ]
    workspace = Workspace(tmp_path)
    assert workspace.load_pairs(4, "key") is None
    workspace.save_pairs(4, "key", pairs)
    assert workspace.load_pairs(4, "another key") is None
    read = workspace.load_pairs(4, "key")
    assert read is not None and len(read) == len(pairs)
    for stored, pair in zip(read, pairs, strict=True):
        assert (stored.first, stored.second, stored.geometry, stored.angle_rad) == (
            pair.first,
            pair.second,
            pair.geometry,
            pair.angle_rad,
        )
        np.testing.assert_array_equal(stored.matches, pair.matches)
        np.testing.assert_array_equal(stored.T_first_second, pair.T_first_second)
