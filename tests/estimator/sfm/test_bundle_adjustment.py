"""Bundle adjustment: derivatives, normal equations, and the minimum that GTSAM finds."""

from dataclasses import replace

import gtsam
import numpy as np
import pytest
from gtsam.symbol_shorthand import K, P, X

from dronevio.estimator.optimization.linalg import SingularError
from dronevio.estimator.sfm.adjustment import (
    BundleAdjustmentConfig,
    RelativePose,
    adjust,
    intrinsics_covariances,
    schur,
)
from dronevio.estimator.sfm.adjustment.bundle_adjustment import _problem
from dronevio.estimator.sfm.adjustment.reprojection import Observations, Variables, derivatives, residuals
from dronevio.estimator.sfm.adjustment.schur import Blocks, Groups, NormalEquations
from dronevio.estimator.sfm.intrinsics import IntrinsicsPrior
from dronevio.estimator.sfm.model import PositionPriors, Scene, SfmState
from dronevio.estimator.sfm.tracks import Tracks
from dronevio.models.arrays import Array
from dronevio.models.camera import CameraModel
from dronevio.models.rotation import exp_so3, pose_matrix

PINHOLE = CameraModel(640, 480, 420.0, 420.0, 319.5, 239.5, (-0.1, 0.02, 0.0, 0.0))
FISHEYE = CameraModel(640, 640, 200.0, 200.0, 319.5, 319.5, (0.01, -0.02, 0.003, 0.0), "equidistant")
DS = CameraModel(640, 640, 190.0, 191.0, 319.5, 318.0, (-0.172, 0.593), "ds")
EUCM = CameraModel(640, 640, 230.0, 231.0, 319.5, 318.0, (0.63, 1.04), "eucm")
FOV = CameraModel(640, 480, 300.0, 302.0, 319.5, 238.0, (0.93,), "fov")
EXACT = BundleAdjustmentConfig(max_iterations=200, relative_tolerance=1e-14)


def made_scene(
    camera: CameraModel = PINHOLE, images: int = 6, points: int = 60, noise_px: float = 0.5, seed: int = 0
) -> tuple[Scene, SfmState]:
    """Return points that all images see from a row of positions, and a state that is near the truth."""
    rng = np.random.default_rng(seed)
    P_world = rng.uniform([-2.0, -1.5, 4.0], [2.0, 1.5, 7.0], (points, 3))
    Ts = np.stack(
        [
            pose_matrix(exp_so3(rng.normal(scale=0.05, size=3)), np.array([0.5 * n - 1.25, 0.1 * n, 0.05 * n]))
            for n in range(images)
        ]
    )
    image, track = np.tile(np.arange(images), points), np.repeat(np.arange(points), images)
    in_camera = np.einsum("nji,nj->ni", Ts[image, :3, :3], P_world[track] - Ts[image, :3, 3])
    pixels = camera.project(in_camera) + rng.normal(scale=noise_px, size=(len(image), 2))
    scene = Scene(
        Tracks(image, track, track),
        pixels,
        rng.choice([1.0, 1.5], len(image)),
        np.zeros(images, np.int64),
        np.array([True]),
    )
    moved = Ts.copy()
    moved[1:, :3, 3] += rng.normal(scale=0.02, size=(images - 1, 3))
    moved[1:, :3, :3] = Ts[1:, :3, :3] @ exp_so3(rng.normal(scale=0.01, size=(images - 1, 3)))
    near = P_world + rng.normal(scale=0.05, size=P_world.shape)
    return scene, SfmState((camera,), moved, near, np.ones(len(image), np.bool_))


def observations_of(scene: Scene) -> Observations:
    tracks = scene.tracks
    return Observations(tracks.image, tracks.track, scene.image_camera[tracks.image], scene.pixels, scene.sigmas)


@pytest.mark.parametrize("camera", [PINHOLE, FISHEYE, DS, EUCM, FOV], ids=lambda camera: camera.lens)
def test_derivatives_are_those_of_the_residuals(camera: CameraModel) -> None:
    scene, state = made_scene(camera)
    o, x = observations_of(scene), Variables(state.Ts_world_cam, state.points, state.cameras)
    parameters = 3 if camera in (PINHOLE, FISHEYE) else 0
    d = derivatives(o, x, np.array([parameters]))
    rng, h = np.random.default_rng(1), 1e-6
    poses, points = rng.normal(size=(6, 6)), rng.normal(size=(60, 3))
    intrinsics = np.zeros((1, 6))
    intrinsics[0, :parameters] = rng.normal(size=parameters)
    ahead, behind = (
        residuals(o, x.moved(sign * h * poses, sign * h * points, sign * h * intrinsics)) for sign in (1.0, -1.0)
    )
    expected = np.einsum("nij,nj->ni", d.pose, poses[o.image]) + np.einsum("nij,nj->ni", d.point, points[o.point])
    expected += np.einsum("nij,nj->ni", d.intrinsics, intrinsics[o.camera])
    np.testing.assert_allclose((ahead - behind) / (2.0 * h), expected, rtol=1e-5, atol=1e-3)
    assert np.all(d.intrinsics[..., parameters:] == 0.0)


def random_equations(images: int = 5, points: int = 30) -> NormalEquations:
    """Return normal equations of observations of some points in each image."""
    rng = np.random.default_rng(3)
    image, point = np.nonzero(rng.random((images, points)) < 0.5)
    A, B = rng.normal(size=(len(image), 2, 6)), rng.normal(size=(len(image), 2, 3))
    rows = np.arange(images)
    U = Groups(image, images).sums(np.swapaxes(A, 1, 2) @ A) + np.eye(6)
    V = Groups(point, points).sums(np.swapaxes(B, 1, 2) @ B) + 0.1 * np.eye(3)
    W = Blocks(image, point, np.swapaxes(A, 1, 2) @ B).matrix(images, points)
    b = rng.normal(size=6 * images), rng.normal(size=(points, 3))
    return NormalEquations(Blocks(rows, rows, U).matrix(images, images), W, V, *b)


def dense(equations: NormalEquations) -> tuple[Array, Array]:
    """Return the whole matrix and right-hand side."""
    count, points = len(equations.b_blocks), len(equations.V)
    H = np.zeros((count + 3 * points,) * 2)
    H[:count, :count], H[:count, count:] = equations.U.toarray(), equations.W.toarray()
    H[count:, :count] = H[:count, count:].T
    for t, block in enumerate(equations.V):
        rows = slice(count + 3 * t, count + 3 * t + 3)
        H[rows, rows] = block
    return H, np.concatenate([equations.b_blocks, equations.b_points.ravel()])


@pytest.mark.parametrize("is_dense", [True, False])
def test_steps_solve_the_whole_equations(is_dense: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    if not is_dense:
        monkeypatch.setattr(schur, "DENSE_BLOCKS", 0)
        monkeypatch.setattr(schur, "DENSE_SHARE", 1.0)
    equations, damping = random_equations(), 0.3
    H, b = dense(equations)
    D = np.diag(np.diag(H))
    blocks, points, gain = equations.step(damping)
    expected = np.linalg.solve(H + damping * D, b)
    np.testing.assert_allclose(np.concatenate([blocks.ravel(), points.ravel()]), expected, rtol=1e-8, atol=1e-10)
    assert gain == pytest.approx(b @ expected - 0.5 * expected @ H @ expected)  # of the quadratic model
    covariance = equations.covariance(np.array([2, 4]))
    inverse = np.linalg.inv(H)
    for block, found in zip((2, 4), covariance, strict=True):
        np.testing.assert_allclose(found, inverse[6 * block : 6 * block + 6, 6 * block : 6 * block + 6], rtol=1e-7)


def test_a_point_that_nothing_determines_is_an_error() -> None:
    equations = random_equations()
    V = equations.V.copy()
    V[3] = 0.0
    with pytest.raises(SingularError):
        replace(equations, V=V).covariance(np.array([0]))


def gtsam_minimum(scene: Scene, state: SfmState, cauchy_px: float | None, prior: IntrinsicsPrior) -> gtsam.Values:
    """Return the minimum with the first pose and the distance to the last held, by GTSAM's own factors."""
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    for i, T in enumerate(state.Ts_world_cam):
        values.insert(X(i), gtsam.Pose3(T))
    for t, point in enumerate(state.points):
        values.insert(P(t), point)
    camera = prior.camera
    k1, k2 = camera.distortion[:2]
    values.insert(K(0), gtsam.Cal3Bundler(camera.fx, k1, k2, camera.cx, camera.cy))
    noise = gtsam.noiseModel.Diagonal.Sigmas(prior.sigmas)
    graph.push_back(gtsam.PriorFactorCal3Bundler(K(0), values.atCal3Bundler(K(0)), noise))
    rows = zip(scene.pixels, scene.sigmas, scene.tracks.image.tolist(), scene.tracks.track.tolist(), strict=True)
    for pixel, sigma, i, t in rows:
        model: gtsam.noiseModel.Base = gtsam.noiseModel.Isotropic.Sigma(2, sigma)
        if cauchy_px is not None:
            model = gtsam.noiseModel.Robust.Create(gtsam.noiseModel.mEstimator.Cauchy.Create(cauchy_px), model)
        graph.push_back(gtsam.GeneralSFMFactor2Cal3Bundler(pixel, model, X(i), P(t), K(0)))
    positions = state.Ts_world_cam[:, :3, 3]
    distances = np.linalg.norm(positions - positions[0], axis=1)
    scale, farthest = float(distances.max()), int(np.argmax(distances))
    held = gtsam.noiseModel.Isotropic.Sigma(6, 1e-7)
    graph.push_back(gtsam.PriorFactorPose3(X(0), gtsam.Pose3(state.Ts_world_cam[0]), held))
    of_range = gtsam.noiseModel.Isotropic.Sigma(1, 1e-5 * scale)
    graph.push_back(gtsam.RangeFactorPose3(X(0), X(farthest), scale, of_range))
    parameters = gtsam.LevenbergMarquardtParams.CeresDefaults()
    parameters.setMaxIterations(500)
    parameters.setRelativeErrorTol(1e-14)
    return gtsam.LevenbergMarquardtOptimizer(graph, values, parameters).optimize()


@pytest.mark.parametrize("cauchy_px", [None, 0.5])
def test_the_minimum_is_that_of_gtsam(cauchy_px: float | None) -> None:
    scene, state = made_scene()
    guess = replace(PINHOLE, fx=440.0, fy=440.0, distortion=(0.0, 0.0, 0.0, 0.0))
    prior = IntrinsicsPrior(guess, 0.1, estimated=3)
    state = replace(state, cameras=(guess,))
    scene = replace(scene, is_calibrated=np.array([False]), priors=(prior,))
    found = adjust(scene, state, state.used(scene), replace(EXACT, cauchy_px=cauchy_px))
    expected = gtsam_minimum(scene, state, cauchy_px, prior)
    [camera] = found.cameras
    bundler = expected.atCal3Bundler(K(0))
    assert camera.fx == camera.fy == pytest.approx(bundler.fx(), abs=2e-3)
    assert camera.distortion[:2] == pytest.approx((bundler.k1(), bundler.k2()), abs=2e-5)
    for i, T in enumerate(found.Ts_world_cam):
        np.testing.assert_allclose(T, expected.atPose3(X(i)).matrix(), atol=2e-5)
    np.testing.assert_allclose(found.points[7], expected.atPoint3(P(7)), atol=1e-4)


def test_the_covariance_of_intrinsics_is_their_scatter() -> None:
    prior = IntrinsicsPrior(PINHOLE, 0.3, estimated=3)
    focal, sigmas = [], []
    for seed in range(60):
        scene, state = made_scene(seed=0)
        noise = np.random.default_rng(seed).normal(size=scene.pixels.shape) * scene.sigmas[:, None]
        in_camera = np.einsum(
            "nji,nj->ni",
            state.Ts_world_cam[scene.tracks.image, :3, :3],
            state.points[scene.tracks.track] - state.Ts_world_cam[scene.tracks.image, :3, 3],
        )
        pixels = PINHOLE.project(in_camera) + noise
        scene = replace(scene, pixels=pixels, is_calibrated=np.array([False]), priors=(prior,))
        found = adjust(scene, state, state.used(scene), EXACT)
        covariance = intrinsics_covariances(scene, found, found.used(scene), EXACT)[0]
        assert covariance.shape == (3, 3)
        focal.append(found.cameras[0].fx)
        sigmas.append(np.sqrt(covariance[0, 0]))
    assert np.std(focal) == pytest.approx(np.mean(sigmas), rel=0.3)
    assert np.mean(focal) == pytest.approx(420.0, abs=np.mean(sigmas))


def test_parameters_that_are_held_have_no_variance() -> None:
    scene, state = made_scene()
    prior = IntrinsicsPrior(PINHOLE, 0.3, estimated=1)
    scene = replace(scene, is_calibrated=np.array([False]), priors=(prior,))
    found = adjust(scene, state, state.used(scene), EXACT)
    assert found.cameras[0].distortion == PINHOLE.distortion
    covariance = intrinsics_covariances(scene, found, found.used(scene), EXACT)[0]
    assert covariance[0, 0] > 0.0 and np.all(covariance[1:] == 0.0)


def test_a_rig_determines_the_scale() -> None:
    scene, state = made_scene(noise_px=0.0)
    T = np.linalg.inv(state.Ts_world_cam[0]) @ state.Ts_world_cam[5]
    T[:3, 3] *= 2.0 / np.linalg.norm(T[:3, 3])
    found = adjust(scene, state, state.used(scene), replace(EXACT, cauchy_px=1.0), [RelativePose(0, 5, T)])
    positions = found.Ts_world_cam[:, :3, 3]
    assert np.linalg.norm(positions[5] - positions[0]) == pytest.approx(2.0, rel=1e-3)


def test_a_wrong_measured_point_is_an_outlier() -> None:
    """The last three tracks are measured, one of them wrong by metres, and so are the positions of the cameras."""
    scene, state = made_scene(noise_px=0.1, points=60)
    rng = np.random.default_rng(0)
    points = rng.uniform([-2.0, -1.5, 4.0], [2.0, 1.5, 7.0], (60, 3))  # as in `made_scene`
    targets = points[57:].copy()
    targets[1] += [0.0, 5.0, 0.0]
    positions = PositionPriors(
        cameras=np.stack([[0.5 * n - 1.25, 0.1 * n, 0.05 * n] for n in range(6)]),
        camera_sigmas=np.full((6, 3), 0.01),
        points=targets,
        point_sigmas=np.full((3, 3), 0.01),
        cauchy_sigmas=2.0,
    )
    found = adjust(scene, state, state.used(scene), EXACT, positions=positions)
    errors = np.linalg.norm(found.points - points, axis=1)
    assert errors.max() < 0.05 and errors[58] < 0.05


def test_a_precise_measurement_moves_its_point() -> None:
    scene, state = made_scene(noise_px=0.1, points=60)
    target = state.points[-1] + [0.02, -0.03, 0.01]
    positions = PositionPriors(
        cameras=state.Ts_world_cam[:, :3, 3],
        camera_sigmas=np.full((6, 3), 0.1),
        points=target[None],
        point_sigmas=np.full((1, 3), 1e-4),
        cauchy_sigmas=1e3,
    )
    found = adjust(scene, state, state.used(scene), EXACT, positions=positions)
    np.testing.assert_allclose(found.points[-1], target, atol=1e-3)


def test_a_point_that_moves_behind_its_cameras_costs_more() -> None:
    scene, state = made_scene()
    problem, x = _problem(scene, state, state.used(scene), EXACT)
    points = x.points.copy()
    points[7, 2] = -5.0
    assert problem.cost(replace(x, points=points)) > problem.cost(x) + 6 * 420.0**2


def test_a_point_behind_a_camera_does_not_end_the_adjustment() -> None:
    scene, state = made_scene()
    points = state.points.copy()
    points[5] = [0.0, 0.0, 0.06]  # before some cameras, behind others
    state = replace(state, points=points)
    found = adjust(scene, state, state.used(scene), replace(EXACT, cauchy_px=1.0))
    rest = scene.tracks.track != 5
    assert np.median(found.errors_px(scene, np.flatnonzero(rest))) < 1.0
    assert np.isfinite(found.points).all()
