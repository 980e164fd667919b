"""The sliding window: the weights of observations and IMU factors, and marginalization."""

from dataclasses import replace

import gtsam
import numpy as np
import pytest

from dronevio.estimator.backend.landmarks import LandmarkConfig, LandmarkDatabase
from dronevio.estimator.backend.linear_system import LinearSystem
from dronevio.estimator.backend.marginal_prior import KeyframeState
from dronevio.estimator.backend.observations import CORRELATED_KEYFRAMES
from dronevio.estimator.backend.window import Window
from dronevio.estimator.optimization.linalg import CholeskyFactor
from dronevio.estimator.types import Observations
from dronevio.models.arrays import Array

FOCAL_PX, LANDMARKS, KEYFRAMES, PIXEL_SIGMA = 450.0, 30, 5, 0.4


def window(
    shift_px: float = 0.0,
    zncc: float = 1.0,
    scale: float = 1.0,
    noise_sigmas: float = 0.0,
    robust_sigmas: float = 1.0,
) -> Window:
    """Return a window of keyframes side by side, with exact states and landmarks.

    Args:
        shift_px: Error of the last observation of landmark 0 [px].
        zncc: Correlation of landmark 1 with its first view.
        scale: Magnification of landmark 2 since its first view.
        noise_sigmas: Noise of all observations, in assumed standard deviations.
        robust_sigmas: Threshold of the robust loss.
    """
    rng = np.random.default_rng(0)
    points = np.column_stack([rng.uniform(-2.0, 2.0, (LANDMARKS, 2)), rng.uniform(4.0, 8.0, LANDMARKS)])
    landmarks = LandmarkDatabase(FOCAL_PX, LandmarkConfig())
    poses = [gtsam.Pose3(gtsam.Rot3(), np.array([0.3 * k, 0.0, 0.0])) for k in range(KEYFRAMES)]
    states = [KeyframeState(pose, np.zeros(3), gtsam.imuBias.ConstantBias()) for pose in poses]
    made = Window(states[0], 1e4 * np.eye(15), landmarks, np.eye(4)[None], PIXEL_SIGMA / FOCAL_PX, robust_sigmas)
    noise = noise_sigmas * PIXEL_SIGMA / FOCAL_PX * unit_noise()
    for k, state in enumerate(states):
        if k > 0:
            made.append(state, prior_factors(k, state))
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
        landmarks.set_points(points)
    return made


def unit_noise() -> Array:
    """Return noise (K, L, 2) of unit variance whose lengths are the quantiles of their distribution, permuted."""
    rng, n = np.random.default_rng(1), KEYFRAMES * LANDMARKS
    length = rng.permutation(np.sqrt(-2.0 * np.log((np.arange(n) + 0.5) / n)))
    angle = rng.uniform(0.0, 2.0 * np.pi, n)
    noise = (length * np.stack([np.cos(angle), np.sin(angle)])).T
    return np.asarray(noise.reshape(KEYFRAMES, LANDMARKS, 2))


def prior_factors(k: int, state: KeyframeState) -> list[gtsam.NoiseModelFactor]:
    """Return factors that hold keyframe k at a state with σ = 0.01."""

    def isotropic(n: int) -> gtsam.noiseModel.Isotropic:
        return gtsam.noiseModel.Isotropic.Sigma(n, 0.01)

    return [
        gtsam.PriorFactorPose3(gtsam.symbol("x", k), state.pose, isotropic(6)),
        gtsam.PriorFactorVector(gtsam.symbol("v", k), np.zeros(3), isotropic(3)),
        gtsam.PriorFactorConstantBias(gtsam.symbol("b", k), state.bias, isotropic(6)),
    ]


def weights(system: LinearSystem) -> Array:
    """Return the trace (L,) of the information on each landmark."""
    return np.asarray(np.trace(system.visual.H_point, axis1=1, axis2=2))


def test_uncertain_observations_have_less_weight() -> None:
    """Weights after an outlier of some pixels, a decorrelated patch, and a patch that is twice as large as at first."""
    clean = weights(window().linearize())
    changed = weights(window(shift_px=4.0, zncc=0.9, scale=2.0).linearize())
    assert changed[0] < clean[0] / 1.15
    np.testing.assert_allclose(changed[1], clean[1] / 3.0**2, rtol=1e-3)  # sigma scale 1 + 20 · (1 − 0.9)
    np.testing.assert_allclose(changed[2], clean[2] / 2.0**2, rtol=1e-3)
    np.testing.assert_allclose(changed[3:], clean[3:], rtol=0.05)
    np.testing.assert_allclose(weights(window(scale=0.5).linearize()), clean, rtol=1e-6)  # a smaller patch is no worse


def test_exact_observations_have_the_information_of_their_sigma() -> None:
    """J = [1 0 −x/z; 0 1 −y/z] / z of a landmark at (x, y, z) in a camera that is not turned; the sum of JᵀJ / σ².

    σ² grows from the second keyframe on, because the errors of a track are correlated.
    """
    made = window()
    p = made.landmarks.points[:, None] - [state.pose.translation() for state in made.states.values()]
    x, y, z = np.moveaxis(p, 2, 0)
    traces = (2.0 + (x / z) ** 2 + (y / z) ** 2) / z**2 / (PIXEL_SIGMA / FOCAL_PX) ** 2
    growth = 1.0 + (np.arange(KEYFRAMES) / CORRELATED_KEYFRAMES) ** 2
    np.testing.assert_allclose(weights(made.linearize()), (traces / growth).sum(axis=1), rtol=1e-6)


@pytest.mark.parametrize(("noise_sigmas", "weight"), [(0.5, 1.0), (1.0, 1.0), (2.0, 1.0 / 4.0), (3.0, 1.0 / 9.0)])
def test_noisier_observations_weigh_less(noise_sigmas: float, weight: float) -> None:
    """Noise s times as large as assumed makes the weights 1/s² as large; smaller noise makes them no larger."""
    clean = weights(window(robust_sigmas=1e6).linearize())
    noisy = weights(window(noise_sigmas=noise_sigmas, robust_sigmas=1e6).linearize())
    np.testing.assert_allclose(noisy, weight * clean, rtol=0.01)


@pytest.mark.parametrize(
    ("off_sigmas", "weight"), [(0.0, 1.0), (3.0**0.5, 1.0), (28.0**0.5, 0.5), (103.0**0.5, 0.2), (500.0, 1e-4)]
)
def test_implausible_factors_weigh_less(off_sigmas: float, weight: float) -> None:
    """A squared residual of three is expected of three numbers; an excess of 5² halves the weight."""
    made = window()
    off_m_s = np.array([0.0, 0.0, 0.01 * off_sigmas])
    made.states[2] = replace(made.states[2], velocity=off_m_s)
    system, velocity = made.linearize(), 15 * 2 + np.arange(6, 9)
    np.testing.assert_allclose(system.H[np.ix_(velocity, velocity)], weight * 1e4 * np.eye(3), rtol=1e-3)
    np.testing.assert_allclose(system.b[velocity], -weight * 1e4 * off_m_s, rtol=1e-3, atol=1e-9)


def test_a_wrong_keyframe_pose_makes_no_outliers() -> None:
    """Where all residuals of a keyframe are large, it keeps half of its weight, and the others keep all of theirs."""
    clean, wrong = window().linearize().visual.H_pose, window()
    shifted = wrong.states[2].pose.compose(gtsam.Pose3(gtsam.Rot3(), np.array([0.3, 0.0, 0.0])))
    wrong.states[2] = replace(wrong.states[2], pose=shifted)
    ratio = np.trace(wrong.linearize().visual.H_pose, axis1=1, axis2=2) / np.trace(clean, axis1=1, axis2=2)
    assert 0.4 < ratio[2] < 0.6  # with a threshold of one sigma it would keep a thousandth
    np.testing.assert_allclose(np.delete(ratio, 2), 1.0, rtol=0.05)


@pytest.mark.parametrize("persistent", [0, 10])
def test_marginalization_keeps_states_and_covariances(persistent: int) -> None:
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


def test_a_prior_computed_later_is_that_of_the_marginalization() -> None:
    """Neither new estimates nor removed landmarks in between change it."""
    now, later = window(noise_sigmas=1.0), window(noise_sigmas=1.0)
    for each in (now, later):
        each.marginalize(0, 10, drift_rad=1e-3)
        if each is now:
            each.complete()
        moved = each.states[4].pose.compose(gtsam.Pose3(gtsam.Rot3(), np.array([0.1, 0.0, 0.0])))
        each.states[4] = replace(each.states[4], pose=moved)
        each.landmarks.set_points(1.1 * each.landmarks.points)
        each.landmarks.remove_keyframe(3)
    expected, found = now._prior, later._prior
    np.testing.assert_array_equal(found.H, expected.H)
    np.testing.assert_array_equal(found.b, expected.b)
    assert list(found.states) == list(expected.states) == [1, 2, 3, 4]
    assert list(found.points) == list(expected.points) and len(found.points) == 10


def test_unobserved_persistent_landmarks_leave_the_prior() -> None:
    """A landmark that only the dropped keyframe still observes is marginalized."""
    made = window()
    made.marginalize(0, 10)
    first, *others = sorted(made.persistent)
    table = made.landmarks.all_observations
    made.landmarks.replace_observations(table[(table.landmark != first) | (table.keyframe == 3)])
    made.drop_keyframe(3)
    assert made.persistent == set(others) <= set(made.landmarks.ids.tolist())
    assert np.isfinite(CholeskyFactor(made.linearize().H).inverse_block(np.arange(15))).all()


def test_variances_do_not_grow_with_two_cameras() -> None:
    """Two cameras observe the depth at every keyframe, and all observations of a landmark have the same weight."""
    grown, equal = window(noise_sigmas=1.0), window(noise_sigmas=1.0)
    equal._Ts_imu_cam = np.concatenate([equal._Ts_imu_cam, equal._Ts_imu_cam])
    ratio = weights(equal.linearize()) / weights(grown.linearize())
    assert ratio.min() > 1.02
    costs = [each.objective.cost(each.estimate, each.linearize().scales) for each in (equal, grown)]
    assert costs[0] > 1.02 * costs[1]
