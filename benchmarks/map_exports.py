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
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import gtsam
import numpy as np
import numpy.typing as npt
import tyro
from markdown_tables import table, text

from dronevio.api import estimate
from dronevio.estimator.slam.map.odometry_factors import RelativePose
from dronevio.estimator.slam.visual_slam import VisualSlam
from dronevio.eval.metrics.association import interpolate
from dronevio.eval.metrics.errors import ate
from dronevio.models.errors import ConfigError
from dronevio.models.protocols import Recording
from dronevio.models.recordings.open import open_recording
from dronevio.models.rotation import inverse_pose, matrix_from_quat_wxyz, pose_matrix
from dronevio.models.state import Trajectory

Array = npt.NDArray[np.float64]


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


HEADINGS = (
    "flight",
    "cameras",
    "edges",
    "½χ² written",
    "½χ² by GTSAM",
    "½χ² an edge",
    "poses: final, file [mm]",
    "loops",
    "NEES measured",
    "NEES in the file",
    "rotation, position",
    "error [mm]: measured, in the file",
    "odometry: NEES",
    "points",
    "reprojection, median [px]",
)


def cells(recording: Recording, cameras: int, folder: Path) -> Sequence[str]:
    """Estimate a recording and return its row.

    Args:
        recording: The recording.
        cameras: Number of its cameras.
        folder: Folder for the files.

    Raises:
        ConfigError: The recording has no ground truth.
    """
    if recording.ground_truth is None:
        raise ConfigError(f"{recording.name} has no ground truth; expected a recording with it")
    slam = VisualSlam(recording.rig)
    estimate(recording, slam)
    Ts_true, graph, solution = true_poses(slam, recording, recording.ground_truth), slam.final_graph(), slam.final_map()
    before = slam.mapper.final_solution()
    assert before is not None and solution is not None  # final_graph refuses a map without keyframes
    slam.save_graph(folder / "map.g2o")
    slam.save_colmap(folder / "colmap", recording)
    structure = slam.reconstruction().reconstruction
    slam.close()
    edges, written, found = optimized_by_gtsam(folder / "map.g2o")
    measured, loops = (consistency(g.loops, Ts_true) for g in (before.without_rejected, graph))
    odometry = consistency(graph.odometry, Ts_true)
    assert odometry is not None
    numbers = sorted(graph.poses)
    p_true = np.stack([Ts_true[number][:3, 3] for number in numbers])
    errors_mm = [
        1e3 * ate(p_true, p).rmse
        for p in (solution.Ts_map_imu[:, :3, 3], np.stack([graph.poses[number][:3, 3] for number in numbers]))
    ]
    return (
        f"`{recording.name}`",
        str(cameras),
        str(edges),
        f"{written:.1f}",
        f"{found:.1f}",
        f"{written / edges:.2f}",
        f"{errors_mm[0]:.2f}, {errors_mm[1]:.2f}",
        str(len(graph.loops)),
        text(None if measured is None else measured.nees, ".1f"),
        text(None if loops is None else loops.nees, ".1f"),
        "–" if loops is None else f"{loops.rotation_nees:.1f}, {loops.position_nees:.1f}",
        "–" if loops is None or measured is None else f"{measured.position_mm:.1f}, {loops.position_mm:.1f}",
        f"{odometry.nees:.1f}",
        str(len(structure.points)),
        f"{np.median(errors_by_colmap(folder / 'colmap' / 'sparse' / '0')):.3f}",
    )


def main(command: MapExportsCommand) -> None:
    """Print a row for each recording and number of cameras.

    Raises:
        ConfigError: A recording has no ground truth.
        InputError: A recording cannot be read.
    """
    print(table(HEADINGS, []), flush=True)
    for path in command.recordings:
        for cameras in command.cameras:
            with tempfile.TemporaryDirectory() as folder:
                row = cells(open_recording(path, cameras), cameras, Path(folder))
            print(f"| {' | '.join(row)} |", flush=True)


if __name__ == "__main__":
    main(tyro.cli(MapExportsCommand, description=__doc__))
