"""``dronevio book eqvio``: a real flight, by our smoother and by GTSAM's equivariant filter."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from dronevio.cli.terminal import parse, print_json, print_table, progress_bars


@dataclass(frozen=True)
class BookEqvio:
    """Half a minute of a real flight, by our smoother and by GTSAM's equivariant filter EqVIO.

    Both get the same: the real IMU of EuRoC's V1_01 and the image features that come with the gtsam package, about one
    in five of them wrong. Writes paths.png, and both paths as smoother.tum and eqvio.tum; the filter gives no
    orientation, so its quaternions are the identity.

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

    from dronevio.estimation import estimate_recording, require_poses
    from dronevio.estimator.book.eqvio import ReplayedFeatures, read_flight, run_eqvio
    from dronevio.estimator.vio import VisualInertialOdometry
    from dronevio.eval.eqvio_plot import draw_two_paths
    from dronevio.eval.metrics.alignment import align
    from dronevio.models.recordings.tum import write_tum
    from dronevio.models.state import Trajectory

    flight = read_flight()
    with progress_bars(quiet=command.json) as bars:
        smoother = VisualInertialOdometry(flight.rig, front_end=ReplayedFeatures(flight))
        run = estimate_recording(flight, smoother, bars.bar("smoother"))
        filtered = run_eqvio(flight, bars.bar("EqVIO"))
    ours = require_poses(run, flight)
    rows = np.searchsorted(filtered.t_ns, ours.t_ns)
    fit = align(ours.p_world_imu, filtered.p_world_imu[rows], "yaw")
    theirs_m = fit.positions(filtered.p_world_imu[rows])
    distance_m = np.linalg.norm(ours.p_world_imu - theirs_m, axis=1)

    command.out.mkdir(parents=True, exist_ok=True)
    draw_two_paths(ours.t_ns, ours.p_world_imu, theirs_m, command.out / "paths.png")
    write_tum(command.out / "smoother.tum", ours)
    unturned = np.tile([1.0, 0.0, 0.0, 0.0], (len(filtered.t_ns), 1))
    write_tum(command.out / "eqvio.tum", Trajectory(filtered.t_ns, filtered.p_world_imu, unturned))

    summary: dict[str, object] = {
        "poses": len(ours),
        "frames": len(run.estimates),
        "ate_between_m": float(np.sqrt(np.mean(distance_m**2))),
        "largest_distance_m": float(distance_m.max()),
        "path_m": ours.length_m,
        "eqvio_path_m": float(np.linalg.norm(np.diff(theirs_m, axis=0), axis=1).sum()),
        "cpu_ms_per_frame": float(run.cpu_ms.mean()),
        "eqvio_cpu_ms_per_frame": float(filtered.cpu_ms.mean()),
        "out": str(command.out),
    }
    if command.json:
        print_json(summary)
        return 0
    _print_summary(summary)
    print(f"picture: {command.out}/paths.png")
    return 0


def _print_summary(s: Mapping[str, object]) -> None:
    print_table(
        "EuRoC V1_01, 30 s: real IMU, real image features",
        ("", "smoother (ours)", "EqVIO (gtsam)", "unit"),
        (
            ("poses", f"{s['poses']}", f"{s['frames']}", ""),
            ("path", f"{s['path_m']:.2f}", f"{s['eqvio_path_m']:.2f}", "m"),
            ("processor time a frame", f"{s['cpu_ms_per_frame']:.2f}", f"{s['eqvio_cpu_ms_per_frame']:.2f}", "ms"),
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
