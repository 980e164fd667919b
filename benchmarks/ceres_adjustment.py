"""The bundle adjustments of a reconstruction, solved again by Ceres from the same initial values.

Each adjustment of all observations that structure from motion makes is recorded. It is solved by GTSAM, as the mapper
calls it and until it has converged, and by Ceres (the residuals are COLMAP's, the solver is called by pyceres). The
table lists the costs, half the sum of the robust squared reprojection errors [px²], and how far ours is above Ceres'::

    .venv/bin/python benchmarks/ceres_adjustment.py PHOTOGRAPHS
    .venv/bin/python benchmarks/ceres_adjustment.py RECORDING --every 20
"""

import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np
import numpy.typing as npt
import tyro

from dronevio.cli.terminal import print_table
from dronevio.estimator.sfm import mapper
from dronevio.estimator.sfm.adjustment import BundleAdjustmentConfig, adjust
from dronevio.estimator.sfm.model import Scene, SfmState
from dronevio.estimator.sfm.pipeline import reconstruct
from dronevio.models.image_sets import image_folder, image_recording
from dronevio.models.reconstruction import Reconstruction
from dronevio.models.reconstructions.colmap import write_colmap
from dronevio.models.recordings.open import open_recording

CONVERGED = 1e-12
"""Relative decrease of the cost at which both solvers stop."""
NORM_WEIGHT = 1e4
"""Weight of the deviation of a squared quaternion length from 1 in the problems for Ceres [px]."""
MAX_ITERATIONS = 500
"""Largest number of iterations of both solvers."""


@dataclass(frozen=True)
class CeresAdjustmentCommand:
    """Solve the bundle adjustments of a reconstruction again by Ceres."""

    images: tyro.conf.Positional[Path]
    """Folder of photographs, or a recording."""
    every: int = 1
    """Distance between the images of a recording that are used."""


@dataclass(frozen=True, eq=False)
class Problem:
    """One bundle adjustment."""

    scene: Scene
    """Tracks and their pixels."""
    start: SfmState
    """Initial values of all quantities."""
    selected: npt.NDArray[np.bool_]
    """(M,) Observations that are used."""
    config: BundleAdjustmentConfig
    """Settings of our optimizer."""

    def cost(self, state: SfmState) -> float:
        """Return half the sum of the robust squared reprojection errors, relative to their sigmas [px²]."""
        squared = (state.errors_px(self.scene, self.selected) / self.scene.sigmas[self.selected]) ** 2
        scale = self.config.cauchy_px
        return float(0.5 * np.sum(squared if scale is None else scale**2 * np.log1p(squared / scale**2)))


@dataclass(frozen=True)
class Costs:
    """Costs of one problem [px²]."""

    start: float
    """Of the initial values."""
    mapper: float
    """After our adjustment with the mapper's tolerance."""
    converged: float
    """After our adjustment until it has converged."""
    ceres_start: float
    """Of the initial values, evaluated by Ceres."""
    ceres: float
    """After Ceres has converged."""


@contextmanager
def recorded_problems() -> Iterator[list[Problem]]:
    """Record the adjustments that the mapper makes within the context."""
    problems: list[Problem] = []

    def recording_adjust(
        scene: Scene, state: SfmState, selected: npt.NDArray[np.bool_], config: BundleAdjustmentConfig
    ) -> SfmState:
        problems.append(Problem(scene, state, selected, config))
        return adjust(scene, state, selected, config)

    with patch.object(mapper, "adjust", recording_adjust):
        yield problems


def solve(problem: Problem) -> Costs:
    """Solve one problem by both solvers."""
    converged = replace(problem.config, max_iterations=MAX_ITERATIONS, relative_tolerance=CONVERGED)
    ceres_start, ceres = solve_by_ceres(problem)
    return Costs(
        problem.cost(problem.start),
        problem.cost(adjust(problem.scene, problem.start, problem.selected, problem.config)),
        problem.cost(adjust(problem.scene, problem.start, problem.selected, converged)),
        ceres_start,
        ceres,
    )


def solve_by_ceres(problem: Problem) -> tuple[float, float]:
    """Return the cost of the initial values and that of the solution by Ceres [px²]."""
    import pyceres
    import pycolmap
    from pycolmap.cost_functions import ReprojErrorCost

    with tempfile.TemporaryDirectory() as folder:
        write_colmap(Path(folder), selected_observations(problem))
        model: Any = pycolmap.Reconstruction(folder)
    scene, scale = problem.scene, problem.config.cauchy_px
    adjustment, squared = pyceres.Problem(), pyceres.TrivialLoss()
    loss = squared if scale is None else pyceres.CauchyLoss(scale)
    images = [model.images[i] for i in sorted(model.images)]
    poses = [image.frame.rig_from_world.params for image in images]
    points = [model.points3D[i].xyz for i in sorted(model.points3D)]
    cameras = {}
    for camera_id, index in zip(sorted(model.cameras), camera_indices(problem), strict=True):
        camera, ours = model.cameras[camera_id], problem.start.cameras[index]
        if not scene.is_calibrated[index]:
            camera.model = pycolmap.CameraModelId.RADIAL
            camera.params = [ours.fx, ours.cx + 0.5, ours.cy + 0.5, *ours.distortion[:2]]
        cameras[camera_id] = camera.model, camera.params
    image, track = (
        np.unique(of[problem.selected], return_inverse=True)[1].tolist()
        for of in (scene.tracks.image, scene.tracks.track)
    )
    rows = zip(image, track, scene.pixels[problem.selected], scene.sigmas[problem.selected], strict=True)
    for i, t, pixel, sigma in rows:
        lens, intrinsics = cameras[images[i].camera_id]
        cost = ReprojErrorCost(lens, sigma**2 * np.eye(2), pixel + 0.5)
        adjustment.add_residual_block(cost, loss, [points[t], poses[i], intrinsics])
    adjustment.set_parameter_block_constant(poses[0])
    norms = [_unit_norm(pyceres) for _ in poses[1:]]
    for norm, pose in zip(norms, poses[1:], strict=True):
        adjustment.add_residual_block(norm, squared, [pose])
    for (_, intrinsics), index in zip(cameras.values(), camera_indices(problem), strict=True):
        if scene.is_calibrated[index]:
            adjustment.set_parameter_block_constant(intrinsics)
        else:  # the principal point is constant
            adjustment.set_manifold(intrinsics, pyceres.SubsetManifold(len(intrinsics), [1, 2]))
    return _solve(pyceres, adjustment)


def _unit_norm(pyceres: Any) -> Any:
    """Return a cost that keeps the quaternion of a pose (7,) at length 1; Ceres's binding has no manifold of poses."""

    class UnitNorm(pyceres.CostFunction):  # type: ignore[misc]
        def __init__(self) -> None:
            super().__init__()
            self.set_num_residuals(1)
            self.set_parameter_block_sizes([7])

        def Evaluate(self, parameters: Any, residuals: Any, jacobians: Any) -> bool:
            quaternion = parameters[0][:4]
            residuals[0] = NORM_WEIGHT * (quaternion @ quaternion - 1.0)
            if jacobians is not None and jacobians[0] is not None:
                jacobians[0][:4] = 2.0 * NORM_WEIGHT * quaternion
                jacobians[0][4:] = 0.0
            return True

    return UnitNorm()


def _solve(pyceres: Any, problem: Any) -> tuple[float, float]:
    options, summary = pyceres.SolverOptions(), pyceres.SolverSummary()
    options.linear_solver_type = pyceres.LinearSolverType.SPARSE_SCHUR
    options.max_num_iterations = MAX_ITERATIONS
    options.function_tolerance = CONVERGED
    options.num_threads = 2
    pyceres.solve(options, problem, summary)
    return float(summary.initial_cost), float(summary.final_cost)


def camera_indices(problem: Problem) -> list[int]:
    """Return the indices of the cameras that the selected observations use."""
    return [int(k) for k in np.unique(problem.scene.image_camera[problem.scene.tracks.image[problem.selected]])]


def selected_observations(problem: Problem) -> Reconstruction:
    """Return the initial values and the selected observations as a reconstruction."""
    scene, state = problem.scene, problem.start
    images, image = np.unique(scene.tracks.image[problem.selected], return_inverse=True)
    tracks, track = np.unique(scene.tracks.track[problem.selected], return_inverse=True)
    cameras = camera_indices(problem)
    return Reconstruction(
        cameras=tuple(state.cameras[k] for k in cameras),
        image_names=tuple(f"{i:06d}" for i in images),
        image_camera=np.searchsorted(cameras, scene.image_camera[images]).astype(np.int64),
        Ts_world_cam=state.Ts_world_cam[images],
        points=state.points[tracks],
        colours=np.zeros((len(tracks), 3), np.uint8),
        observation_image=image.astype(np.int64),
        observation_point=track.astype(np.int64),
        observation_px=scene.pixels[problem.selected],
    )


def compare(command: CeresAdjustmentCommand) -> None:
    """Reconstruct the images, solve all adjustments by both solvers and print the table."""
    if (command.images / "mav0").is_dir():
        recording = open_recording(command.images)
        images = image_recording(recording, frames=list(range(0, len(recording.frame_times_ns), command.every)))
    else:
        images = image_folder(command.images)
    with recorded_problems() as problems:
        reconstruct(images)
    rows = []
    for number, problem in enumerate(problems):
        costs = solve(problem)
        counts = [len(np.unique(problem.scene.tracks.image[problem.selected])), int(problem.selected.sum())]
        values = [f"{cost:.6g}" for cost in (costs.start, costs.mapper, costs.converged, costs.ceres)]
        excesses = [f"{ours / costs.ceres - 1.0:+.1e}" for ours in (costs.mapper, costs.converged)]
        rows.append([str(number), *map(str, counts), *values, *excesses])
        assert np.isclose(costs.start, costs.ceres_start, rtol=1e-9), "the two problems differ"
    heading = (
        "adjustment",
        "images",
        "observations",
        "start [px²]",
        "mapper [px²]",
        "converged [px²]",
        "Ceres [px²]",
        "mapper / Ceres − 1",
        "converged / Ceres − 1",
    )
    print_table("Bundle adjustments, GTSAM beside Ceres", heading, rows)


if __name__ == "__main__":
    compare(tyro.cli(CeresAdjustmentCommand, description=__doc__))
