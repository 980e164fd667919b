"""The folder in which features and matches are kept."""

from pathlib import Path

import numpy as np

from dronevio.estimator.sfm.two_view import Geometry, TwoView
from dronevio.estimator.sfm.workspace import Workspace


def test_pairs_and_images_without_pairs(tmp_path: Path) -> None:
    workspace = Workspace(tmp_path)
    matches = np.array([[1, 2], [3, 4], [5, 6]], np.int64)
    pairs = [TwoView(0, other, matches[:other], Geometry.GENERAL, np.eye(4), 0.1) for other in (1, 3)]
    workspace.save_pairs(0, "key", pairs)
    workspace.save_pairs(1, "key", [])
    loaded = workspace.load_pairs(0, "key")
    assert loaded is not None and [(pair.second, len(pair.matches)) for pair in loaded] == [(1, 1), (3, 3)]
    assert workspace.load_pairs(1, "key") == []
    assert workspace.load_pairs(1, "another key") is None
