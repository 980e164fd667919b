"""Frames drawn in parallel: the same bytes whoever draws them, and nothing half-done left behind."""

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from dronevio.models.camera import CameraModel
from dronevio.models.errors import ConfigError, GraphicsError
from dronevio.models.rig import RigCamera, euroc_rig
from dronevio.models.rotation import pose_matrix
from dronevio.sim.render import render_frames
from dronevio.sim.scenario import scenario
from dronevio.sim.solids import turn_z

SMALL = CameraModel(width=188, height=120, fx=115.0, fy=115.0, cx=92.0, cy=62.0, distortion=(-0.28, 0.07, 0.0, 0.0))
SHORT = replace(scenario("short"), rig=replace(euroc_rig(), cameras=(RigCamera(SMALL, np.eye(4)),)))
TIMES_NS = np.arange(6, dtype=np.int64) * 50_000_000
R_LEVEL = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
POSES = np.stack([pose_matrix(turn_z(0.3 * k) @ R_LEVEL, np.array([0.2 * k - 0.5, 0.1, 1.2])) for k in range(6)])


def contents(folder: Path) -> dict[str, bytes]:
    """Return the files of a folder."""
    return {file.name: file.read_bytes() for file in sorted(folder.iterdir())}


def test_images_do_not_depend_on_the_workers(tmp_path: Path) -> None:
    told: list[tuple[int, int]] = []
    render_frames(SHORT, POSES, TIMES_NS, tmp_path / "one", lambda d, n: told.append((d, n)), workers=1)
    render_frames(SHORT, POSES, TIMES_NS, tmp_path / "three", workers=3)
    one, three = contents(tmp_path / "one"), contents(tmp_path / "three")
    assert list(one) == sorted(f"{t}.png" for t in TIMES_NS)
    assert one == three
    assert told[0] == (0, 6)
    assert told[-1] == (6, 6)
    images = [cv2.imread(str(tmp_path / "one" / f"{t}.png"), cv2.IMREAD_UNCHANGED) for t in TIMES_NS]
    assert all(image.shape == (120, 188) and image.dtype == np.uint8 for image in images)
    assert all(image.std() > 20.0 for image in images)


def test_noise_differs_between_frames_and_seeds(tmp_path: Path) -> None:
    still = np.broadcast_to(POSES[0], (2, 4, 4)).copy()
    render_frames(SHORT, still, TIMES_NS[:2], tmp_path, workers=1)
    a, b = (cv2.imread(str(tmp_path / f"{t}.png"), cv2.IMREAD_UNCHANGED).astype(float) for t in TIMES_NS[:2])
    difference = a - b
    assert 1.0 < difference.std() / np.sqrt(2.0) < 4.0
    assert abs(difference.mean()) < 0.05


def test_an_interruption_leaves_no_half_image(tmp_path: Path) -> None:
    def interrupt(done: int, total: int) -> None:
        if done >= 1:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        render_frames(SHORT, POSES, TIMES_NS, tmp_path, interrupt, workers=2)
    left = sorted(tmp_path.iterdir())
    assert 1 <= len(left) <= 6
    for file in left:
        assert file.suffix == ".png"
        assert cv2.imread(str(file), cv2.IMREAD_UNCHANGED).shape == (120, 188)


def test_a_worker_s_failure_is_ours(tmp_path: Path) -> None:
    folder = tmp_path / "images"

    def take_away(done: int, total: int) -> None:
        if done == 0:
            folder.rmdir()

    with pytest.raises(GraphicsError, match="No such file"):
        render_frames(SHORT, POSES[:1], TIMES_NS[:1], folder, take_away)


def test_poses_and_times_must_match(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="expected"):
        render_frames(SHORT, POSES, TIMES_NS[:3], tmp_path)
