"""``dronevio estimate``: from a recording to a trajectory."""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, TypeAlias

import tyro

from dronevio.cli.terminal import parse, print_json, print_table, progress_bars
from dronevio.estimator.config import VioConfig
from dronevio.models.errors import ConfigError
from dronevio.models.recordings.bag.options import BagTopics

if TYPE_CHECKING:
    from dronevio.models.recordings.open import StoredRecording

CameraCount: TypeAlias = int | Literal["all"]
"""How many cameras to use."""


@dataclass(frozen=True)
class EstimateCommand:
    """Estimate the motion of a recording from its IMU and its cameras, all of them or the first.

    The recording is any EuRoC (ASL) folder with pinhole or fisheye cameras, or such a flight as a ROS 2 bag (.mcap,
    .db3, or a folder). A bag that does not say how noisy its IMU is, or where its cameras are, needs Kalibr's files.
    The result is a TUM file: one pose of the IMU for each frame since the start, in a world whose z axis points up,
    each computed from what was measured up to its frame.

    Examples:
      dronevio estimate recordings/room-0
      dronevio estimate V1_01_easy --out v101.tum
      dronevio estimate V1_01_easy --cameras 1 --imu-rate v101_imu.tum
      dronevio estimate flight.mcap --calibration camchain.yaml imu.yaml --topics.images /left/image_raw
      dronevio estimate V1_01_easy --estimator.tracker.corners.cell-px 36
      dronevio evaluate V1_01_easy v101.tum
    """

    recording: Annotated[Path, tyro.conf.Positional]
    """EuRoC folder, or ROS 2 bag."""
    out: Path = Path("estimate.tum")
    """File to write."""
    cameras: CameraCount = "all"
    """How many of the recording's cameras to use: the first, the first two, or all. With 1 it is monocular."""
    imu_rate: Path | None = None
    """Another file to write: a pose for each IMU sample, dead-reckoned from the newest frame before it."""
    json: bool = False
    """Print one JSON document instead of a table."""
    calibration: tuple[Path, ...] = ()
    """Kalibr's camchain.yaml, imu.yaml or both, in place of what a bag says."""
    topics: BagTopics = field(default_factory=BagTopics)
    """Topics of a bag, where they cannot be found by type."""
    estimator: VioConfig = field(default_factory=VioConfig)
    """Settings of the estimator."""


def opened(
    path: Path, cameras: CameraCount, calibration: Sequence[Path] = (), topics: BagTopics | None = None
) -> "StoredRecording":
    """Return a recording with so many of its cameras.

    Raises:
        InputError: It cannot be read.
        ConfigError: It has not so many.
    """
    from dronevio.models.recordings.open import open_recording

    wanted = None if cameras == "all" else cameras
    if wanted is not None and wanted < 1:
        raise ConfigError(f"--cameras {cameras}; expected one at least, or all")
    recording = open_recording(path, wanted, calibration, topics)
    found = len(recording.rig.cameras)
    if wanted is not None and found < wanted:
        raise ConfigError(f"--cameras {cameras}: {path} has {found}; expected no more, or all")
    return recording


def main(arguments: Sequence[str]) -> int:
    """Run the command."""
    command = parse(EstimateCommand, arguments, "estimate")

    from dronevio.driver import ImuRateListener, estimate_recording, require_poses
    from dronevio.estimator.vio import VisualInertialOdometry
    from dronevio.models.recordings.files import check_place
    from dronevio.models.recordings.tum import write_tum

    for place in filter(None, (command.out, command.imu_rate)):
        check_place(place)  # rather now than when the work is done
    recording = opened(command.recording, command.cameras, command.calibration, command.topics)
    between = ImuRateListener(recording.rig.imu, command.estimator.inertial)
    listeners = () if command.imu_rate is None else (between,)
    with progress_bars(quiet=command.json) as bars:
        estimator = VisualInertialOdometry(recording.rig, command.estimator)
        run = estimate_recording(recording, estimator, bars.bar("estimating"), listeners)
    trajectory = require_poses(run, recording)
    write_tum(command.out, trajectory)
    if command.imu_rate is not None:
        write_tum(command.imu_rate, between.trajectory)
    summary: dict[str, Any] = {
        "recording": str(command.recording),
        "estimate": str(command.out),
        "complete": recording.complete,
        "cameras": len(recording.rig.cameras),
        "frames": len(run.estimates),
        "poses": len(trajectory),
        "health": {str(health): count for health, count in Counter(e.health for e in run.estimates).items()},
        "first_pose_s": float((trajectory.t_ns[0] - run.t_ns[0]) * 1e-9),
        "path_m": trajectory.length_m,
        "cpu_ms_per_frame": float(run.cpu_ms.mean()),
        "real_time_factor": run.real_time_factor,
    }
    if command.imu_rate is not None:
        summary |= {"imu_rate": str(command.imu_rate), "imu_rate_poses": len(between.trajectory)}
    if command.json:
        print_json(summary)
        return 0
    print_table(
        f"Estimate of {recording.name}",
        ("", "value", "unit"),
        (
            ("cameras", f"{len(recording.rig.cameras)}", ""),
            ("frames", f"{len(run.estimates)}", ""),
            ("poses", f"{len(trajectory)}", ""),
            *((f"frames {health}", f"{count}", "") for health, count in summary["health"].items()),
            ("first pose after", f"{summary['first_pose_s']:.2f}", "s"),
            ("path", f"{trajectory.length_m:.2f}", "m"),
            ("processor time a frame", f"{run.cpu_ms.mean():.1f}", "ms"),
            ("faster than real time", f"{run.real_time_factor:.1f}", "×"),
        ),
    )
    if not recording.complete:
        print("the recording is incomplete: it was cut off")
    print(f"wrote {' and '.join(str(path) for path in (command.out, command.imu_rate) if path is not None)}")
    if recording.ground_truth is not None:
        print(f"score it:  dronevio evaluate {command.recording} {command.out}")
    return 0
