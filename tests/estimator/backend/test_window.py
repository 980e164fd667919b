"""The window: how much each sighting weighs, and what marginalizing leaves."""

from dataclasses import replace

import gtsam
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from dronevio.estimator.backend.landmarks import LandmarkConfig, LandmarkDatabase
from dronevio.estimator.backend.linalg import CholeskyFactor
from dronevio.estimator.backend.marginal_prior import KeyframeState
from dronevio.estimator.backend.window import LinearSystem, Window, medians_of_each
from dronevio.estimator.types import Observations

FOCAL_PX, LANDMARKS, KEYFRAMES, PIXEL_SIGMA = 450.0, 30, 5, 0.4


def window(
    shift_px: float = 0.0,
    zncc: float = 1.0,
    scale: float = 1.0,
    noise_sigmas: float = 0.0,
    robust_sigmas: float = 1.0,
) -> Window:
    """Return a window of cameras side by side.

    Landmark 0 is last seen off by a shift, landmark 1 is badly seen, landmark 2 came nearer since it was first seen.
    All observations have noise of some standard deviations, in truth; landmarks are where they are.
    """
    rng = np.random.default_rng(0)
    points = np.column_stack([rng.uniform(-2.0, 2.0, (LANDMARKS, 2)), rng.uniform(4.0, 8.0, LANDMARKS)])
    landmarks = LandmarkDatabase(FOCAL_PX, LandmarkConfig())
    states = [
        KeyframeState(
            gtsam.Pose3(gtsam.Rot3(), np.array([0.3 * k, 0.0, 0.0])), np.zeros(3), gtsam.imuBias.ConstantBias()
        )
        for k in range(KEYFRAMES)
    ]
    made = Window(states[0], 1e4 * np.eye(15), landmarks, np.eye(4)[None], PIXEL_SIGMA / FOCAL_PX, robust_sigmas)
    noise = noise_sigmas * PIXEL_SIGMA / FOCAL_PX * unit_noise()
    for k, state in enumerate(states):
        if k > 0:
            held = [
                gtsam.PriorFactorPose3(gtsam.symbol("x", k), state.pose, _sure(6)),
                gtsam.PriorFactorVector(gtsam.symbol("v", k), np.zeros(3), _sure(3)),
                gtsam.PriorFactorConstantBias(gtsam.symbol("b", k), state.bias, _sure(6)),
            ]
            made.append(state, held)
        p = points - state.pose.translation()
        xy = p[:, :2] / p[:, 2:] + noise[k]
        if k == KEYFRAMES - 1:
            xy[0, 0] += shift_px / FOCAL_PX
        znccs, scales = np.ones(LANDMARKS), np.ones(LANDMARKS)
        znccs[1], scales[2] = zncc, scale
        ids, ages = np.arange(LANDMARKS), np.full(LANDMARKS, k + 1)
        landmarks.add_observations(k, Observations(ids, FOCAL_PX * xy, xy, ages, zncc=znccs, scale=scales))
    assert len(landmarks.triangulate(made.cameras, newest=KEYFRAMES - 1)) == 0
    if noise_sigmas > 0.0:
        landmarks.points = points
    return made


def unit_noise() -> np.ndarray:
    """Return noise (K, L, 2) of unit variance: its sizes are the quantiles of their distribution, in a random order."""
    rng, n = np.random.default_rng(1), KEYFRAMES * LANDMARKS
    size = rng.permutation(np.sqrt(-2.0 * np.log((np.arange(n) + 0.5) / n)))
    angle = rng.uniform(0.0, 2.0 * np.pi, n)
    return (size * np.stack([np.cos(angle), np.sin(angle)])).T.reshape(KEYFRAMES, LANDMARKS, 2)


def _sure(n: int) -> gtsam.noiseModel.Isotropic:
    return gtsam.noiseModel.Isotropic.Sigma(n, 0.01)


def weights(system: LinearSystem) -> np.ndarray:
    """Return how much is known of each landmark (L,)."""
    return np.trace(system.visual.point, axis1=1, axis2=2)


def test_doubtful_sightings_weigh_less() -> None:
    """One that is off by some pixels, those of a feature that has changed its looks, and of one that came nearer."""
    clean = weights(window().linearize())
    spoilt = weights(window(shift_px=4.0, zncc=0.9, scale=2.0).linearize())
    assert spoilt[0] < clean[0] / 1.15
    np.testing.assert_allclose(spoilt[1], clean[1] / 3.0**2, rtol=1e-3)  # 1 + 20 · (1 − 0.9) times less certain
    np.testing.assert_allclose(spoilt[2], clean[2] / 2.0**2, rtol=1e-3)
    np.testing.assert_allclose(spoilt[3:], clean[3:], rtol=0.05)
    np.testing.assert_allclose(weights(window(scale=0.5).linearize()), clean, rtol=1e-6)  # further is no reason


@pytest.mark.parametrize(("noise_sigmas", "weight"), [(0.5, 1.0), (1.0, 1.0), (2.0, 1.0 / 4.0), (3.0, 1.0 / 9.0)])
def test_noisier_observations_weigh_less(noise_sigmas: float, weight: float) -> None:
    """Noise s times as large as assumed makes the weights 1/s² as large; smaller noise makes them no larger."""
    clean = weights(window(robust_sigmas=1e6).linearize())
    noisy = weights(window(noise_sigmas=noise_sigmas, robust_sigmas=1e6).linearize())
    np.testing.assert_allclose(noisy, weight * clean, rtol=0.01)


@pytest.mark.parametrize(
    ("off_sigmas", "weight"), [(0.0, 1.0), (3.0**0.5, 1.0), (28.0**0.5, 0.5), (103.0**0.5, 0.2), (500.0, 1e-4)]
)
def test_what_noise_does_not_explain_of_a_motion_weighs_less(off_sigmas: float, weight: float) -> None:
    """Of three numbers, noise explains a square of three."""
    made = window()
    off_m_s = np.array([0.0, 0.0, 0.01 * off_sigmas])
    made.states[2] = replace(made.states[2], velocity=off_m_s)
    system, velocity = made.linearize(), 15 * 2 + np.arange(6, 9)
    np.testing.assert_allclose(system.H[np.ix_(velocity, velocity)], weight * 1e4 * np.eye(3), rtol=1e-3)
    np.testing.assert_allclose(system.b[velocity], -weight * 1e4 * off_m_s, rtol=1e-3, atol=1e-9)


def test_a_keyframe_that_is_wrong_has_no_outliers() -> None:
    """Where all that a keyframe shows is far off, it keeps the weight of half of it, and the others keep all."""
    clean, wrong = window().linearize().visual.pose, window()
    shifted = wrong.states[2].pose.compose(gtsam.Pose3(gtsam.Rot3(), np.array([0.3, 0.0, 0.0])))
    wrong.states[2] = replace(wrong.states[2], pose=shifted)
    ratio = np.trace(wrong.linearize().visual.pose, axis1=1, axis2=2) / np.trace(clean, axis1=1, axis2=2)
    assert 0.4 < ratio[2] < 0.6  # each for itself, at 20 pixels and more, they would keep a thousandth
    np.testing.assert_allclose(np.delete(ratio, 2), 1.0, rtol=0.05)


@given(st.lists(st.tuples(st.integers(0, 5), st.floats(0.0, 1e6)), max_size=60))
def test_medians_are_those_of_each_group(pairs: list[tuple[int, float]]) -> None:
    group, values = np.array([k for k, _ in pairs], dtype=np.int64), np.array([v for _, v in pairs])
    expected = [np.median(values[group == k]) for k in group]
    np.testing.assert_array_equal(medians_of_each(group, values), expected)


@pytest.mark.parametrize("persistent", [0, 10])
def test_what_stays_knows_what_it_knew(persistent: int) -> None:
    """A keyframe that is marginalized leaves the others' states and covariances as they were."""
    made = window()
    system = made.linearize()
    before = CholeskyFactor(system.H).inverse_block(np.arange(15, 15 * KEYFRAMES))
    made.marginalize(0, persistent)
    assert list(made.states) == [1, 2, 3, 4] and len(made.persistent) == persistent
    system = made.linearize()
    columns = np.arange(15 * (KEYFRAMES - 1))
    solver = CholeskyFactor(system.H)
    np.testing.assert_allclose(solver.inverse_block(columns), before, rtol=1e-4, atol=1e-9)
    np.testing.assert_allclose(solver.solve(system.b)[columns], 0.0, atol=1e-8)
