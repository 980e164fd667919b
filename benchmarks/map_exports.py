"""What leaves the map for other programs, read by them and compared with the truth, as Markdown tables.

The g2o file is optimized by GTSAM: half of χ² at the written poses and after it. The relative poses of loops and of the
odometry are compared with the true ones: the mean of their normalized error squared (NEES), for which 6 is expected
where the covariance is right, and the RMS of their positions. Loops are those that were measured during the flight, and
those of the file. The model of COLMAP is read and projected by pycolmap::

    .venv/bin/dronevio fly --scenario room-square --seed 0 --rig euroc-stereo --out recordings/square
    .venv/bin/python benchmarks/map_exports.py recordings/square --cameras 1 2
"""

import tempfile
from collections.abc import Sequence
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import gtsam
import numpy as np
import tyro
from measuring import opened, print_as_made, text

from dronevio.api import estimate
from dronevio.estimator.slam.map.odometry_factors import RelativePose
from dronevio.estimator.slam.visual_slam import VisualSlam
from dronevio.eval.metrics.association import interpolate
from dronevio.eval.metrics.errors import ate
from dronevio.models.arrays import Array
from dronevio.models.protocols import Recording
from dronevio.models.rotation import inverse_pose, matrix_from_quat_wxyz, pose_matrix
from dronevio.models.state import Trajectory


@dataclass(frozen=True)
class MapExportsCommand:
    """Measure the files that a map gives to other programs."""

    recordings: Annotated[tuple[Path, ...], tyro.conf.Positional]
    """Recordings with ground truth."""
    cameras: tuple[int, ...] = (1, 2)
    """Numbers of cameras that the estimator uses."""


@dataclass(frozen=True)
class Consistency:
    """How relative poses agree with the truth."""

    count: int
    """Number of relative poses."""
    nees: float
    """Mean NEES, 6 expected."""
    rotation_nees: float
    """Mean NEES of the rotation alone, 3 expected."""
    position_nees: float
    """Mean NEES of the position alone, 3 expected."""
    position_mm: float
    """RMS error of the position [mm]."""


def consistency(relative: Sequence[RelativePose], Ts_true: dict[int, Array]) -> Consistency | None:
    """Return how relative poses agree with the true poses (4, 4) of the keyframes; None without relative poses."""
    rows: list[list[float]] = []
    for each in relative:
        true = inverse_pose(Ts_true[each.first]) @ Ts_true[each.second]
        r, P = gtsam.Pose3.Logmap(gtsam.Pose3(inverse_pose(each.T_first_second) @ true)), each.covariance
        parts = slice(6), slice(3), slice(3, 6)
        nees = (float(r[part] @ np.linalg.solve(P[part, part], r[part])) for part in parts)
        rows.append([*nees, float(r[3:] @ r[3:])])
    if not rows:
        return None
    whole, rotation, position, square = np.mean(rows, axis=0).tolist()
    return Consistency(len(rows), whole, rotation, position, 1e3 * float(np.sqrt(square)))


def optimized_by_gtsam(path: Path) -> tuple[int, float, float]:
    """Return the number of edges of a g2o file, and half of χ² at the written poses and at those that GTSAM finds."""
    factors, values = gtsam.readG2o(str(path), True)
    edges = factors.size()
    fixed = next(int(line.split()[1]) for line in path.read_text(encoding="utf-8").splitlines() if line[:3] == "FIX")
    noise = gtsam.noiseModel.Isotropic.Sigma(6, 1e-6)
    factors.add(gtsam.PriorFactorPose3(fixed, values.atPose3(fixed), noise))
    return edges, factors.error(values), factors.error(gtsam.LevenbergMarquardtOptimizer(factors, values).optimize())


def errors_by_colmap(folder: Path) -> Array:
    """Return the reprojection errors (M,) of a model of COLMAP by its own projection [px]."""
    import pycolmap

    model = pycolmap.Reconstruction(str(folder))
    return np.array(
        [
            np.linalg.norm(image.project_point(model.point3D(point.point3D_id).xyz) - point.xy)
            for image in model.images.values()
            for point in image.points2D
        ]
    )


def true_poses(slam: VisualSlam, recording: Recording, truth: Trajectory) -> dict[int, Array]:
    """Return the true poses (4, 4) of the keyframes by their numbers, at the stamps of their images."""
    keyframes, cameras = slam.mapper.keyframes, len(recording.rig.cameras)
    stamps_ns = slam.reconstruction().stamps_ns[::cameras]
    true, rows = interpolate(truth, stamps_ns + round(1e9 * recording.rig.time_offset_s))
    Ts = pose_matrix(matrix_from_quat_wxyz(true.quat_wxyz), true.p_world_imu)
    return {keyframes[row].number: T for row, T in zip(np.arange(len(keyframes))[rows].tolist(), Ts, strict=True)}


def row_of(path: Path, cameras: int) -> dict[str, str]:
    """Estimate a recording with a number of cameras, and return its row.

    Raises:
        InputError: The recording cannot be read.
    """
    recording, truth = opened(path, cameras)
    with closing(VisualSlam(recording.rig)) as slam, tempfile.TemporaryDirectory() as scratch:
        estimate(recording, slam)
        folder, Ts_true = Path(scratch), true_poses(slam, recording, truth)
        graph, solution, before = slam.final_graph(), slam.final_map(), slam.mapper.final_solution()
        assert before is not None and solution is not None  # final_graph refuses a map without keyframes
        slam.save_graph(folder / "map.g2o")
        slam.save_colmap(folder / "colmap", recording)
        structure = slam.reconstruction().reconstruction
        edges, written, found = optimized_by_gtsam(folder / "map.g2o")
        errors_px = errors_by_colmap(folder / "colmap" / "sparse" / "0")
    measured, loops = (consistency(g.loops, Ts_true) for g in (before.without_rejected, graph))
    odometry = consistency(graph.odometry, Ts_true)
    assert odometry is not None
    numbers = sorted(graph.poses)
    p_true = np.stack([Ts_true[number][:3, 3] for number in numbers])
    in_file = np.stack([graph.poses[number][:3, 3] for number in numbers])
    errors_mm = [1e3 * ate(p_true, p).rmse for p in (solution.Ts_map_imu[:, :3, 3], in_file)]
    return {
        "flight": f"`{recording.name}`",
        "cameras": str(cameras),
        "edges": str(edges),
        "½χ² written": f"{written:.1f}",
        "½χ² by GTSAM": f"{found:.1f}",
        "½χ² an edge": f"{written / edges:.2f}",
        "poses: final, file [mm]": f"{errors_mm[0]:.2f}, {errors_mm[1]:.2f}",
        "loops": str(len(graph.loops)),
        "NEES measured": text(measured.nees if measured else None, ".1f"),
        "NEES in the file": text(loops.nees if loops else None, ".1f"),
        "rotation, position": f"{loops.rotation_nees:.1f}, {loops.position_nees:.1f}" if loops else "–",
        "error [mm]: measured, in the file": (
            f"{measured.position_mm:.1f}, {loops.position_mm:.1f}" if loops and measured else "–"
        ),
        "odometry: NEES": f"{odometry.nees:.1f}",
        "points": str(len(structure.points)),
        "reprojection, median [px]": f"{np.median(errors_px):.3f}",
    }


def main(command: MapExportsCommand) -> None:
    """Print a row for each recording and number of cameras.

    Raises:
        InputError: A recording cannot be read.
    """
    print_as_made(row_of(path, cameras) for path in command.recordings for cameras in command.cameras)


if __name__ == "__main__":
    main(tyro.cli(MapExportsCommand, description=__doc__))
