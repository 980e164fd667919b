"""``dronevio book eqvio``: a real flight, by our smoother and by GTSAM's equivariant filter."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from dronevio.cli.terminal import parse, print_json, print_table, progress_bars

if TYPE_CHECKING:
    import numpy as np
    import numpy.typing as npt

    from dronevio.estimator.book.eqvio import FeatureRecording
    from dronevio.models.state import Trajectory

    Array = npt.NDArray[np.float64]


@dataclass(frozen=True)
class BookEqvio:
    """Half a minute of a real flight, by our smoother and by GTSAM's equivariant filter EqVIO.

    Both get the same: the real IMU of EuRoC's V1_01 and the image features that come with the gtsam package, about one
    in five of them wrong. Writes paths.png, and both paths as smoother.tum and eqvio.tum; the filter gives no
    orientation, so its quaternions are the identity.

    The truth is not in the data. Both are therefore compared with full smoothing, which knows the whole flight when it
    answers, and by how well each path, its orientations and landmarks left free, explains the image features.

    Examples:
      dronevio book eqvio
      dronevio book eqvio --out v101 --json
    """

    out: Path = Path("runs/book-eqvio")
    """Folder for the picture and the paths."""
    json: bool = False
    """Print one JSON document instead of the table."""


def main(arguments: list[str]) -> int:
    """Run both estimators, draw their paths and print how far they are apart."""
    command = parse(BookEqvio, arguments, "book eqvio")

    import numpy as np

    from dronevio.book.plots import draw_two_paths
    from dronevio.driver import estimate_recording, require_poses
    from dronevio.estimator.book.eqvio import ReplayFrontEnd, read_feature_recording, run_eqvio
    from dronevio.estimator.vio import VisualInertialOdometry
    from dronevio.models.recordings.tum import write_tum
    from dronevio.models.state import Trajectory

    flight = read_feature_recording()
    with progress_bars(quiet=command.json) as bars:
        smoother = VisualInertialOdometry(flight.rig, front_end=ReplayFrontEnd(flight))
        run = estimate_recording(flight, smoother, bars.bar("smoother"))
        filtered = run_eqvio(flight, bars.bar("EqVIO"))
    ours = require_poses(run, flight)

    theirs_m = _laid_on(ours.p_world_imu, filtered.p_world_imu[np.searchsorted(filtered.t_ns, ours.t_ns)])
    distance_m = np.linalg.norm(ours.p_world_imu - theirs_m, axis=1)

    command.out.mkdir(parents=True, exist_ok=True)
    draw_two_paths(ours.t_ns, ours.p_world_imu, theirs_m, command.out / "paths.png")
    write_tum(command.out / "smoother.tum", ours)
    unturned = np.tile([1.0, 0.0, 0.0, 0.0], (len(filtered.t_ns), 1))
    write_tum(command.out / "eqvio.tum", Trajectory(filtered.t_ns, filtered.p_world_imu, unturned))

    summary: dict[str, Any] = {
        "poses": len(ours),
        "frames": len(run.estimates),
        "ate_between_m": _rms(ours.p_world_imu - theirs_m),
        "largest_distance_m": float(distance_m.max()),
        "path_m": ours.length_m,
        "eqvio_path_m": float(np.linalg.norm(np.diff(theirs_m, axis=0), axis=1).sum()),
        "cpu_ms_per_frame": float(run.cpu_ms.mean()),
        "eqvio_cpu_ms_per_frame": float(filtered.cpu_ms.mean()),
        **_judged(flight, ours, theirs_m),
        "out": str(command.out),
    }
    if command.json:
        print_json(summary)
        return 0
    _print_summary(summary)
    print(f"picture: {command.out}/paths.png")
    return 0


def _judged(flight: "FeatureRecording", ours: "Trajectory", theirs_m: "Array") -> dict[str, float]:
    """Return how far both paths are from full smoothing, and what each leaves of the reprojection errors.

    Args:
        flight: What was sensed.
        ours: Our path.
        theirs_m: (N, 3) The other at the same times, laid on ours [m].
    """
    import numpy as np

    from dronevio.estimator.book.batch import BatchAdjustment

    batch = BatchAdjustment(flight, ours)
    at = np.searchsorted(ours.t_ns, batch.t_ns)
    paths = {"": ours.p_world_imu[at], "eqvio_": theirs_m[at]}
    reference_m = _laid_on(paths[""], batch.full_smoothing())
    figures = {
        f"{name}ate_to_reference_m": _rms(reference_m - _laid_on(reference_m, p_m)) for name, p_m in paths.items()
    }
    for name, p_m in {**paths, "reference_": reference_m}.items():
        left = batch.reprojection_errors(p_m)
        figures[f"{name}reprojection_median_px"] = left.median_px
        figures[f"{name}reprojection_rms_px"] = left.rms_px
    return figures


def _laid_on(known_m: "Array", found_m: "Array") -> "Array":
    """Return positions (N, 3) laid on others by yaw and position [m]."""
    from dronevio.eval.metrics.alignment import align

    return align(known_m, found_m, "yaw").positions(found_m)


def _rms(difference_m: "Array") -> float:
    """Return the root mean square length of differences (N, 3) [m]."""
    return float((difference_m**2).sum(axis=1).mean() ** 0.5)


def _print_summary(s: Mapping[str, Any]) -> None:
    print_table(
        "EuRoC V1_01, 30 s: real IMU, real image features",
        ("", "smoother (ours)", "EqVIO (gtsam)", "full smoothing", "unit"),
        (
            ("poses", f"{s['poses']}", f"{s['frames']}", "", ""),
            ("path", f"{s['path_m']:.2f}", f"{s['eqvio_path_m']:.2f}", "", "m"),
            ("time a frame", f"{s['cpu_ms_per_frame']:.2f}", f"{s['eqvio_cpu_ms_per_frame']:.2f}", "", "ms"),
            (
                "from full smoothing, r.m.s.",
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
    )
    print_table(
        "Between the two, after alignment of yaw and position",
        ("", "value", "unit"),
        (
            ("ATE (root mean square)", f"{s['ate_between_m']:.3f}", "m"),
            ("largest distance", f"{s['largest_distance_m']:.3f}", "m"),
        ),
    )
