"""Triangulation of many landmarks at once."""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import pytest
from scipy.optimize import least_squares

from dronevio.estimator.backend.triangulation import triangulate
from dronevio.models.arrays import Array
from dronevio.models.rotation import exp_so3

PIXEL = 1.0 / 458.0
LANDMARKS, CAMERAS = 30, 12


@dataclass(frozen=True, eq=False)
class Views:
    """Cameras on a curve that observe landmarks in front of them."""

    R: Array  # (K, 3, 3)
    p: Array  # (K, 3)
    points: Array  # (L, 3)
    xy: Array  # (K, L, 2)

    def of(self, counts: npt.NDArray[np.int64]) -> tuple[npt.NDArray[np.int64], Array, Array, Array]:
        """Return the arguments of `triangulate`, where the first counts[l] cameras observe landmark l."""
        camera = np.concatenate([np.arange(n) for n in counts])
        landmark = np.repeat(np.arange(len(counts)), counts)
        return np.cumsum(counts) - counts, self.R[camera], self.p[camera], self.xy[camera, landmark]


def views(seed: int, noise_px: float = 0.0) -> Views:
    """Return views whose image coordinates have some noise."""
    rng = np.random.default_rng(seed)
    R = exp_so3(0.1 * rng.normal(size=(CAMERAS, 3)))
    p = np.linspace(0.0, 1.0, CAMERAS)[:, None] * [1.0, 0.4, 0.3] + 0.02 * rng.normal(size=(CAMERAS, 3))
    points = rng.uniform([-2.0, -1.5, 3.5], [3.0, 1.5, 6.5], (LANDMARKS, 3))
    in_camera = np.einsum("kij,lki->klj", R, points[:, None] - p)
    xy = in_camera[..., :2] / in_camera[..., 2:]
    return Views(R, p, points, xy + noise_px * PIXEL * rng.normal(size=xy.shape))


@pytest.mark.parametrize("seed", range(3))
def test_exact_observations_give_exact_points(seed: int) -> None:
    exact = views(seed)
    found = triangulate(*exact.of(np.random.default_rng(seed).integers(3, CAMERAS + 1, LANDMARKS)))
    np.testing.assert_allclose(found.points, exact.points, atol=1e-3)
    assert found.in_front.all()
    assert found.rms.max() < 1e-3 * PIXEL and found.newest.max() < 1e-3 * PIXEL


def test_points_minimize_the_reprojection_error() -> None:
    noisy = views(1, noise_px=1.0)
    found = triangulate(*noisy.of(np.full(LANDMARKS, CAMERAS)))

    def residual(point: Array, landmark: int) -> Array:
        q = np.einsum("kij,ki->kj", noisy.R, point - noisy.p)
        return np.asarray((q[:, :2] / q[:, 2:] - noisy.xy[:, landmark]).ravel())

    for landmark in range(LANDMARKS):
        start = noisy.points[landmark]
        best = least_squares(residual, start, args=(landmark,), xtol=1e-12, ftol=1e-12, gtol=1e-14)
        assert found.rms[landmark] == pytest.approx(np.sqrt(np.sum(best.fun**2) / CAMERAS), rel=1e-3)
        newest = np.linalg.norm(residual(found.points[landmark], landmark)[-2:])
        assert found.newest[landmark] == pytest.approx(newest, rel=1e-9)


def test_landmarks_are_independent_of_each_other() -> None:
    exact, counts = views(2), np.random.default_rng(1).integers(2, CAMERAS + 1, LANDMARKS)
    together = triangulate(*exact.of(counts))
    for landmark, n in enumerate(counts):
        alone = triangulate(np.array([0]), exact.R[:n], exact.p[:n], exact.xy[:n, landmark].copy())
        for name in ("points", "in_front", "rms", "newest", "parallax_rad", "baseline_m", "depth_m"):
            np.testing.assert_allclose(getattr(alone, name)[0], getattr(together, name)[landmark], atol=1e-9)


def test_parallax_is_the_largest_angle_to_the_first_ray() -> None:
    """A landmark at 2 m, seen from positions 0 m, 1 m and 0.5 m along the x axis."""
    R, p = np.tile(np.eye(3), (3, 1, 1)), np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.5, 0.0, 0.0]])
    q = np.array([0.0, 0.0, 2.0]) - p
    found = triangulate(np.array([0]), R, p, q[:, :2] / q[:, 2:])
    assert found.parallax_rad[0] == pytest.approx(np.arctan2(1.0, 2.0))
    assert found.baseline_m[0] == pytest.approx(1.0)
    assert found.depth_m[0] == pytest.approx(2.0)


def test_points_behind_a_camera_are_marked() -> None:
    """The rays of two cameras diverge, so that their lines meet behind both."""
    R, p = np.tile(np.eye(3), (2, 1, 1)), np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0]])
    assert not triangulate(np.array([0]), R, p, np.array([[-0.2, 0.0], [0.2, 0.0]])).in_front[0]


@pytest.mark.parametrize("repeated", [1, 4])
def test_results_are_finite_without_parallax(repeated: int) -> None:
    exact = views(3)
    R, p, xy = (np.repeat(x[:1], repeated, axis=0) for x in (exact.R, exact.p, exact.xy[:, 0]))
    found = triangulate(np.array([0]), R, p, xy)
    assert np.isfinite(found.points).all() and found.parallax_rad[0] < 1e-7
