"""The right-hand side of every member of the least-squares core is the negative gradient of its cost.

Scales and linearization points are those of the linearization. Data have outliers, unequal noise, and a pose or a
velocity that is off by 0.3.
"""

from collections.abc import Callable
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import gtsam
import numpy as np
import numpy.typing as npt
from gtsam.symbol_shorthand import B, V, X

from dronevio.estimator.backend.factors import KeyframeFactor
from dronevio.estimator.backend.window_objective import WindowObjective
from dronevio.estimator.calibration.objective import CalibrationObjective
from dronevio.estimator.calibration.window import AdjustmentConfig, WindowKeyframe
from dronevio.estimator.imu.preintegration import Preintegration, PreintegrationConfig, PreintegrationParams
from dronevio.estimator.initialization.closed_form import NoiseModel, WindowState
from dronevio.estimator.initialization.gauge import BiasPrior
from dronevio.estimator.initialization.refinement import RefinementObjective
from dronevio.estimator.optimization.objective import Linearized, Objective
from dronevio.estimator.sfm.resection import ResectionObjective
from dronevio.estimator.slam.places.matching import Correspondences
from dronevio.estimator.slam.places.relative_pose import RelativePoseConfig, RelativePoseObjective, Views
from dronevio.estimator.types import Calibration
from dronevio.models.arrays import Array
from dronevio.models.imu import GRAVITY_M_S2
from dronevio.models.rig import euroc_rig
from dronevio.models.rotation import exp_so3, inverse_pose, pose_matrix
from tests.estimator.backend.test_window import KEYFRAMES, LANDMARKS, window
from tests.estimator.calibration.test_online import Errors, keyframes
from tests.estimator.initialization.test_dynamic import CONFIG, window_of
from tests.estimator.initialization.test_robust_start import corrupted, measured, random_errors

if TYPE_CHECKING:
    from tests.estimator.conftest import SyntheticFlight

MakeFlight = Callable[..., "SyntheticFlight"]


def settled(objective: Objective[Any, Any], x: Any) -> Linearized[Any, Any]:
    """Return the equations where the eliminated landmarks are at their optimum, so that elimination changes no b."""
    equations = objective.linearize(x)
    for _ in range(60):
        equations = objective.linearize(equations.retract(np.zeros(len(equations.b))))
    return equations


def gradient(objective: Objective[Any, Any], equations: Linearized[Any, Any], step: Array) -> Array:
    """Return the gradient of the cost at the scales of the equations, by central differences of given lengths (n,)."""
    return np.array(
        [
            (
                objective.cost(equations.retract(delta), equations.scales)
                - objective.cost(equations.retract(-delta), equations.scales)
            )
            / (2.0 * delta.sum())
            for delta in np.diag(step)
        ]
    )


def assert_gradient(
    objective: Objective[Any, Any],
    equations: Linearized[Any, Any],
    b: Array,
    rtol: float = 1e-4,
    atol: float = 1e-3,
    step: float = 1e-3,
) -> None:
    """Compare b with the gradient of the cost, in standard deviations of the variables with the others known."""
    sigma = 1.0 / np.sqrt(np.diag(equations.H))
    found = -gradient(objective, equations, step * sigma)
    np.testing.assert_allclose(sigma * found, sigma * b, rtol=rtol, atol=atol)


def imu_factor(rate_rad_s: float) -> gtsam.CombinedImuFactor:
    """Return an IMU factor between the first two keyframes, which disagrees with them."""
    params = PreintegrationParams.of(euroc_rig().imu, PreintegrationConfig())
    preintegration = Preintegration(params, gtsam.imuBias.ConstantBias())
    measurements = preintegration.measurements
    for _ in range(40):
        measurements.integrateMeasurement(np.array([0.5, -0.4, GRAVITY_M_S2]), np.array([rate_rad_s, 0.0, 0.1]), 0.005)
    return gtsam.CombinedImuFactor(X(0), V(0), X(1), V(1), B(0), B(1), measurements)


def window_objective() -> tuple[WindowObjective, Any]:
    """Return a window with an outlier, a wrong keyframe, unequal noise, and factors that disagree with it."""
    made = window(zncc=0.9, scale=2.0, noise_sigmas=3.0)
    made._factors.append(KeyframeFactor.of(imu_factor(0.3)))
    off = made.states[2].pose.compose(gtsam.Pose3(gtsam.Rot3.Expmap(np.array([0.02, 0.0, -0.01])), np.full(3, 0.17)))
    made.states[2] = replace(made.states[2], pose=off)
    made.landmarks.set_points(made.landmarks.points + 0.05 * np.random.default_rng(3).normal(size=(LANDMARKS, 3)))
    objective = made.objective
    xy = objective.observations.xy.copy()
    xy[::11] += 0.1
    observations, prior = replace(objective.observations, xy=xy), replace(objective.prior, b=np.full(15, 50.0))
    return replace(objective, observations=observations, prior=prior), made.estimate


def test_of_a_window_before_elimination() -> None:
    """All landmarks are variables, and so are the keyframes; one landmark is behind the cameras."""
    objective, x = window_objective()
    x.points[3, 2] = -5.0
    points = dict(zip(objective.landmark_ids.tolist(), x.points, strict=True))
    objective = replace(objective, prior=objective.prior.with_points(points))
    equations = objective.linearize(x)
    assert len(equations.b) == 15 * KEYFRAMES + 3 * LANDMARKS
    kept = np.diag(equations.H) > 1e-3  # the landmark behind the cameras has no weight
    assert (~kept).sum() == 3 and not equations.b[~kept].any()
    sigma = np.where(kept, 1.0 / np.sqrt(np.where(kept, np.diag(equations.H), 1.0)), 1e-6)
    found = -gradient(objective, equations, 1e-3 * sigma)
    np.testing.assert_allclose(sigma * found, sigma * equations.b, rtol=1e-4, atol=1e-3)


def test_of_a_window_with_eliminated_landmarks() -> None:
    objective, x = window_objective()
    equations = settled(objective, x)
    assert len(equations.b) == 15 * KEYFRAMES
    assert_gradient(objective, equations, equations.b)


def test_of_the_adjustment_of_a_calibration(make_flight: MakeFlight) -> None:
    flight = make_flight(0, rest_s=-5.0, duration_s=3.0)
    given = [
        WindowKeyframe(
            k.state,
            k.rate_rad_s,
            0.0,
            GRAVITY_M_S2,
            k.preintegrated,
            k.observations.ids,
            np.zeros(len(k.observations), np.int64),
            k.observations.xy,
        )
        for k in keyframes(flight, Errors())
    ]
    estimated = np.ones(13, np.bool_)
    objective = CalibrationObjective.of(
        given,
        Calibration(flight.rig),
        AdjustmentConfig(),
        np.full(13, 1e-3),
        np.diag(np.repeat([1e4, 2.5e3], [3, 10])),
        estimated,
        GRAVITY_M_S2,
        initial=np.zeros(13),
    )
    xy = objective.observations.xy.copy()
    xy[::9] += 0.05
    xy[1::4] += 0.004 * np.random.default_rng(0).normal(size=xy[1::4].shape)
    objective = replace(
        objective,
        observations=replace(objective.observations, xy=xy),
        first_information=1e4 * objective.first_information,
    )
    state = objective.initial.state
    R, p, v = state.R_world_imu.copy(), state.p_world_imu.copy(), state.v_world_imu.copy()
    p[2, 0] += 0.3
    R[0] = R[0] @ exp_so3(np.full(3, 1e-3))
    v[0] += 0.1
    x = replace(
        objective.initial,
        state=replace(state, R_world_imu=R, p_world_imu=p, v_world_imu=v),
        bias=objective.initial.bias + 1e-3,
    )
    equations = settled(objective, x)
    assert len(x.points) > 20
    assert_gradient(objective, equations, equations.b, rtol=1e-3)


def test_of_the_refinement_of_a_start(make_flight: MakeFlight) -> None:
    flight = make_flight(0, rest_s=-5.0, duration_s=2.0, pixel_noise=0.5)
    views = measured(corrupted(window_of(flight), 0.2, random_errors), flight)
    truth = flight.truth_at(flight.frame_times_ns[:1])
    assert truth.velocity_m_s is not None
    R = truth.rotations[0]
    velocity = R.T @ truth.velocity_m_s[0] + np.array([0.3, 0.0, 0.0])
    state = WindowState(velocity, R.T @ np.array([0.0, 0.0, -GRAVITY_M_S2]), np.full(3, 0.05), np.full(3, 0.002))
    noise = NoiseModel(0.5 / 458.0, CONFIG.outlier_sigmas, BiasPrior(np.zeros(3), 0.1), GRAVITY_M_S2)
    objective = RefinementObjective(views, BiasPrior(np.zeros(3), 0.01), noise, 0.003)
    equations = settled(objective, objective.initial(state))
    assert equations.scales > noise.outlier_sigmas**2  # of the median, because the velocity is wrong
    assert_gradient(objective, equations, equations.b)


def seen(rng: np.random.Generator, T_camera_frame: Array, count: int) -> tuple[Array, Array]:
    """Return points (N, 3) in a frame and their noisy coordinates (N, 2) in a camera, an eighth of them outliers."""
    in_camera = rng.uniform([-2.0, -2.0, 3.0], [2.0, 2.0, 7.0], (count, 3))
    xy = in_camera[:, :2] / in_camera[:, 2:] + 1e-3 * rng.uniform(0.1, 3.0, (count, 1)) * rng.normal(size=(count, 2))
    xy[::8] += 0.1
    inverse = inverse_pose(T_camera_frame)
    return in_camera @ inverse[:3, :3].T + inverse[:3, 3], xy


def test_of_a_relative_pose() -> None:
    rng, rig = np.random.default_rng(0), euroc_rig()
    Ts_imu_cam = np.stack([camera.T_imu_cam for camera in rig.cameras])[:1]
    T = pose_matrix(exp_so3(np.array([0.1, -0.2, 0.3])), np.array([0.4, 0.1, -0.2]))
    T_cam_imu, zeros = inverse_pose(Ts_imu_cam[0]), np.zeros(40, np.int64)
    old = Correspondences(np.arange(40), *both(seen(rng, T_cam_imu @ inverse_pose(T), 40), zeros), zeros)
    new = Correspondences(np.arange(40), *both(seen(rng, T_cam_imu @ T, 40), zeros), zeros)
    level = exp_so3(np.array([0.3, 0.1, 0.0]))
    views = Views(Ts_imu_cam, np.array([450.0]), level, level @ T[:3, :3] @ exp_so3(np.array([0.01, 0.02, 0.0])))
    objective = RelativePoseObjective(old, new, views, RelativePoseConfig())
    off = T.copy()
    off[:3, 3] += [0.3, 0.0, 0.0]
    x = objective.linearize(objective.initial(off)).retract(np.zeros(6))  # with depths that are not zero
    assert np.abs(x.depth).max() > 0.05
    equations = objective.linearize(x)
    assert_gradient(objective, equations, equations.b)


def both(points_xy: tuple[Array, Array], camera: npt.NDArray[np.int64]) -> tuple[Array, npt.NDArray[np.int64], Array]:
    """Return points, the cameras that observe them, and their coordinates in the other keyframe."""
    return points_xy[0], camera, points_xy[1]


def test_of_a_resection() -> None:
    T = pose_matrix(exp_so3(np.array([0.1, -0.2, 0.3])), np.array([0.4, 0.1, -0.2]))
    points, xy = seen(np.random.default_rng(0), inverse_pose(T), 40)
    rays = np.column_stack([xy, np.ones(40)])
    points[1] = T[:3, 3] - 3.0 * T[:3, 2]  # behind the camera
    objective = ResectionObjective(points, rays / np.linalg.norm(rays, axis=1, keepdims=True), 2e-3)
    off = T.copy()
    off[:3, 3] += [0.3, 0.0, 0.0]
    equations = objective.linearize(off)
    assert equations.scales.sum() == 39
    assert_gradient(objective, equations, equations.b, atol=1e-6, step=1e-5)  # angles are not divided by their scale
