"""Errors of depth images: their size, edges, and the state of their random numbers."""

import pickle
from typing import Any

import numpy as np
import pytest

from dronevio.envs import STEREO_DEPTH, DepthErrors, DroneEnv

FOCAL_PX, FARTHEST_M = 60.0, 20.0
HOVER = np.zeros(4, np.float32)


def measured(errors: DepthErrors, depth_m: np.ndarray, seed: int = 0) -> np.ndarray:
    """Return a measured depth image (H, W)."""
    image = depth_m.astype(np.float32)[None, :, :, None]
    return errors.applied(image, FOCAL_PX, FARTHEST_M, np.random.default_rng(seed))[0, :, :, 0]


@pytest.mark.parametrize("depth_m", [1.0, 2.0, 4.0])
def test_the_error_grows_with_the_square_of_the_depth(depth_m: float) -> None:
    errors = DepthErrors(disparity_sigma_px=0.03, baseline_m=0.05)
    found = measured(errors, np.full((200, 200), depth_m))
    assert found.std() == pytest.approx(depth_m**2 * 0.03 / (FOCAL_PX * 0.05), rel=0.03)
    assert np.median(found) == pytest.approx(depth_m, rel=1e-3)


def test_the_preset_errs_by_two_percent_at_two_metres() -> None:
    env = DroneEnv("navigate", depth_errors=STEREO_DEPTH)
    [focal_px] = env.settings.depth_focal_px.values()
    sigma = 2.0 * STEREO_DEPTH.disparity_sigma_px / (focal_px * STEREO_DEPTH.baseline_m)
    assert sigma == pytest.approx(0.02, rel=0.1)


def test_pixels_without_a_measurement_have_the_largest_depth() -> None:
    depth_m = np.full((100, 100), 3.0)
    depth_m[:, 50:] = 6.0
    depth_m[:10] = 0.2
    at_edges = measured(DepthErrors(edge_px=2), depth_m) == FARTHEST_M
    assert at_edges[50:, 48:52].all() and not at_edges[50:, :48].any() and not at_edges[50:, 52:].any()
    assert at_edges[8:12].all() and not at_edges[:8, :40].any()
    too_near = measured(DepthErrors(nearest_m=0.3), depth_m) == FARTHEST_M
    np.testing.assert_array_equal(too_near, depth_m == 0.2)
    lost = measured(DepthErrors(lost=0.25), depth_m) == FARTHEST_M
    assert lost.mean() == pytest.approx(0.25, abs=0.02)
    far = measured(DepthErrors(disparity_sigma_px=5.0), np.full((50, 50), 19.0))
    assert far.max() == FARTHEST_M and far.min() > 0.0 and np.isfinite(far).all()
    sky = measured(DepthErrors(disparity_sigma_px=5.0), np.full((50, 50), FARTHEST_M))
    assert (sky == FARTHEST_M).all()


def test_slopes_are_no_edges() -> None:
    slope = np.tile(np.linspace(2.0, 6.0, 100), (50, 1))
    assert (measured(DepthErrors(edge_px=1), slope) < FARTHEST_M).all()


def images(env: DroneEnv, steps: int) -> list[Any]:
    """Return the depth images of some steps."""
    return [env.step(HOVER)[0]["depth"] for _ in range(steps)]


def test_environments_measure_with_errors() -> None:
    settings: dict[str, Any] = {"world": "low-texture", "observations": ("depth",), "image_size": (32, 32)}
    exact, noisy = DroneEnv(**settings), DroneEnv(**settings, depth_errors=DepthErrors(disparity_sigma_px=0.02))
    true, seen = (env.reset(seed=1)[0]["depth"] for env in (exact, noisy))
    scaled = (1.0 / seen - 1.0 / true) * noisy.settings.depth_focal_px["depth"] * 0.05 / 0.02
    assert scaled.std() == pytest.approx(1.0, abs=0.1)
    saved = noisy.save_state()
    expected = images(noisy, 3)
    noisy.restore_state(saved)
    copy = pickle.loads(pickle.dumps(noisy))
    np.testing.assert_array_equal(images(noisy, 3), expected)
    np.testing.assert_array_equal(images(copy, 3), expected)
    np.testing.assert_array_equal(noisy.reset(seed=1)[0]["depth"], seen)
    exact.close()
    noisy.close()
    copy.close()
