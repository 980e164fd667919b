"""``dronevio book eqvio``: fixed-lag smoother and GTSAM's equivariant filter on a real flight."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from dronevio.cli.options import Printing, PrintOptions
from dronevio.cli.terminal import parse, print_json, print_table, print_values, progress_bars

if TYPE_CHECKING:
    import numpy as np
    import numpy.typing as npt

    from dronevio.estimator.book.eqvio import FeatureRecording
    from dronevio.models.state import Trajectory

    Array = npt.NDArray[np.float64]


@dataclass(frozen=True)
class EqvioCommand:
    """Compare the fixed-lag smoother with GTSAM's equivariant filter EqVIO on 30 s of a real flight.

    Both process the real IMU samples of EuRoC V1_01 and the image features that come with the gtsam package, about one
    fifth of which are outliers. The command writes paths.png and both trajectories, smoother.tum and eqvio.tum. The
    filter provides no orientations, so the quaternions of its trajectory are the identity.

    The data contain no ground truth. Both trajectories are therefore compared with a batch estimate, which uses all
    measurements of the flight, and by the reprojection errors that remain when orientations and landmarks are optimized
    with the positions fixed.

    Examples:
      dronevio book eqvio
      dronevio book eqvio --out v101 --json
    """

    out: Path = Path("runs/book-eqvio")
    """Folder for the plot and the trajectories."""
    printing: Printing = field(default_factory=PrintOptions)
    """How results are printed."""


def main(arguments: Sequence[str]) -> int:
    """Run the command and return its exit code."""
    command = parse(EqvioCommand, arguments, "book eqvio")

    import numpy as np

    from dronevio.book.eqvio_plots import draw_two_paths
    from dronevio.book.figures import save_figure
    from dronevio.estimator.book.eqvio import ReplayFrontEnd, read_feature_recording, run_eqvio
    from dronevio.estimator.odometry import VisualInertialOdometry
    from dronevio.estimators.driver import estimate_recording, require_poses
    from dronevio.models.recordings.tum import write_tum
    from dronevio.models.state import Trajectory

    flight = read_feature_recording()
    with progress_bars(quiet=command.printing.json) as bars:
        smoother = VisualInertialOdometry(flight.rig, front_end=ReplayFrontEnd(flight))
        run = estimate_recording(flight, smoother, bars.bar("smoother"))
        filtered = run_eqvio(flight, bars.bar("EqVIO"))
    ours = require_poses(run, flight)

    theirs_m = _aligned(ours.p_world_imu, filtered.p_world_imu[np.searchsorted(filtered.t_ns, ours.t_ns)])
    distance_m = np.linalg.norm(ours.p_world_imu - theirs_m, axis=1)

    command.out.mkdir(parents=True, exist_ok=True)
    save_figure(draw_two_paths(ours.t_ns, ours.p_world_imu, theirs_m), command.out / "paths.png")
    write_tum(command.out / "smoother.tum", ours)
    identities = np.tile([1.0, 0.0, 0.0, 0.0], (len(filtered.t_ns), 1))
    write_tum(command.out / "eqvio.tum", Trajectory(filtered.t_ns, filtered.p_world_imu, identities))

    summary: dict[str, Any] = {
        "poses": len(ours),
        "frames": len(run.estimates),
        "ate_between_m": _rms(ours.p_world_imu - theirs_m),
        "largest_distance_m": float(distance_m.max()),
        "path_m": ours.length_m,
        "eqvio_path_m": float(np.linalg.norm(np.diff(theirs_m, axis=0), axis=1).sum()),
        "cpu_ms_per_frame": float(run.cpu_ms.mean()),
        "eqvio_cpu_ms_per_frame": float(filtered.cpu_ms.mean()),
        **_batch_comparison(flight, ours, theirs_m),
        "out": str(command.out),
    }
    if command.printing.json:
        print_json(summary)
        return 0
    _print_summary(summary)
    print(f"plot: {command.out}/paths.png")
    return 0


def _batch_comparison(flight: "FeatureRecording", ours: "Trajectory", theirs_m: "Array") -> dict[str, float]:
    """Return the errors of both paths with respect to the batch estimate, and their reprojection errors.

    Args:
        flight: IMU samples and image features.
        ours: Trajectory of the smoother.
        theirs_m: (N, 3) Positions of the filter at the same times, aligned with those of the smoother [m].
    """
    import numpy as np

    from dronevio.estimator.book.batch import BatchAdjustment

    batch = BatchAdjustment(flight, ours)
    at = np.searchsorted(ours.t_ns, batch.t_ns)
    paths = {"": ours.p_world_imu[at], "eqvio_": theirs_m[at]}
    reference_m = _aligned(paths[""], batch.full_smoothing())
    figures = {
        f"{name}ate_to_reference_m": _rms(reference_m - _aligned(reference_m, p_m)) for name, p_m in paths.items()
    }
    for name, p_m in {**paths, "reference_": reference_m}.items():
        residuals = batch.reprojection_errors(p_m)
        figures[f"{name}reprojection_median_px"] = residuals.median_px
        figures[f"{name}reprojection_rms_px"] = residuals.rms_px
    return figures


def _aligned(reference_m: "Array", positions_m: "Array") -> "Array":
    """Return (N, 3) positions after alignment of yaw and position with known ones [m]."""
    from dronevio.eval.metrics.alignment import align

    return align(reference_m, positions_m, "yaw").positions(positions_m)


def _rms(difference_m: "Array") -> float:
    """Return the root mean square length of (N, 3) differences [m]."""
    return float((difference_m**2).sum(axis=1).mean() ** 0.5)


def _print_summary(s: Mapping[str, Any]) -> None:
    print_table(
        "EuRoC V1_01, 30 s, real IMU and image features",
        ("", "smoother (ours)", "EqVIO (gtsam)", "batch", "unit"),
        (
            ("poses", f"{s['poses']}", f"{s['frames']}", "", ""),
            ("length of the path", f"{s['path_m']:.2f}", f"{s['eqvio_path_m']:.2f}", "", "m"),
            (
                "processor time per frame",
                f"{s['cpu_ms_per_frame']:.2f}",
                f"{s['eqvio_cpu_ms_per_frame']:.2f}",
                "",
                "ms",
            ),
            (
                "difference from batch, RMS",
                f"{s['ate_to_reference_m']:.3f}",
                f"{s['eqvio_ate_to_reference_m']:.3f}",
                "0",
                "m",
            ),
            *(
                (
                    f"reprojection, {title}",
                    *(f"{s[f'{name}reprojection_{key}_px']:.2f}" for name in ("", "eqvio_", "reference_")),
                    "px",
                )
                for key, title in (("median", "median"), ("rms", "best 80 %"))
            ),
        ),
        left=("unit",),
    )
    print_values(
        "Smoother and EqVIO compared, after alignment of yaw and position",
        (
            ("RMS distance", f"{s['ate_between_m']:.3f}", "m"),
            ("largest distance", f"{s['largest_distance_m']:.3f}", "m"),
        ),
    )
