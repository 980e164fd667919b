"""``dronevio estimate``: from a recording to an estimated trajectory."""

from collections import Counter
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import tyro

from dronevio.cli.imported_settings import ImportedSettings
from dronevio.cli.options import Output, OutputOptions, RecordingInput, RecordingOptions
from dronevio.cli.settings.changes import SettingsInput, SettingsOptions
from dronevio.cli.settings.option_tables import ESTIMATOR, MAP, options_from
from dronevio.cli.terminal import (
    command_line,
    innovation_rows,
    parse,
    print_defects,
    print_json,
    print_run_warnings,
    print_values,
    print_warning,
    progress_bars,
)

if TYPE_CHECKING:
    from dronevio.estimator.config import VioConfig
    from dronevio.estimator.slam.config import SlamConfig
    from dronevio.estimator.slam.visual_slam import VisualSlam
    from dronevio.eval.run import EstimatorRun
    from dronevio.models.recordings.open import StoredRecording
    from dronevio.models.rig import Rig
    from dronevio.models.state import Trajectory


@dataclass(frozen=True)
class EstimateCommand:
    """Estimate the trajectory of a recording from its IMU and its cameras.

    The recording is a folder of EuRoC (ASL), TUM-VI, DSO or KITTI, a bag of ROS 1 (.bag) or ROS 2 (.mcap, .db3, or a
    folder), or a GoPro video with telemetry. Without IMU noise parameters or camera poses, it needs calibration files.
    The result is a TUM file with one pose of the IMU per frame since initialization, in a world frame whose z axis
    points up. Each pose depends only on measurements up to its frame.

    Defects of the recording, such as missing or damaged images and gaps of the IMU, are counted and printed as
    warnings, and the estimation goes on without what is defective. With --strict, they are an error.

    A wrong calibration, or images and IMU that do not belong together, are printed as warnings with their probable
    cause, and no pose is written from then on until the estimator has initialized again. The innovation is the distance
    of landmarks in the images from their prediction; its NIS, relative to the estimated covariance, is about 1 if
    calibration, noise parameters and estimate agree.

    With --slam, the odometry builds a map, and closes loops where it sees a place again. The result is then three
    TUM files: the odometry, the poses as the map has corrected them when they were estimated (OUT_map), and the poses
    by the final map, which use the whole recording (OUT_map_final). A worker process builds the map; its processor time
    is printed apart from that of the odometry.

    With --save-map, the final map is saved in a file. A later flight continues it with --map: until a place of the map
    is recognized, it has no pose in the map frame. With --localize-only, the saved map stays as it is.

    For other programs, the keyframes of the final map and their landmarks are written as a folder with images and a
    model of COLMAP (--save-colmap), the landmarks as a point cloud (--save-ply), and the pose graph for GTSAM or Ceres
    (--save-g2o).

    Examples:
      dronevio estimate recordings/room-v0-0
      dronevio estimate V1_01_easy --out v101.tum
      dronevio estimate V1_01_easy --cameras 0 --imu-rate v101_imu.tum
      dronevio estimate flight.mcap --calibration camchain.yaml imu.yaml --topics.images /left/image_raw
      dronevio estimate V1_01_easy --estimator.tracker.corners.cell-px 36
      dronevio estimate MH_01_easy.bag --calibration camchain.yaml imu.yaml
      dronevio estimate GOPR0001.MP4 --calibration camera.yaml --imu MPU-6050
      dronevio estimate flight.mcap --strict --estimator.gravity-m-s2 9.80
      dronevio estimate V1_01_easy --slam --out v101.tum --overwrite
      dronevio estimate V1_01_easy --slam --save-map v1.map
      dronevio estimate V1_01_easy --slam --save-g2o v1.g2o
      dronevio estimate V1_01_easy --slam --save-colmap v1-colmap --save-ply v1.ply
      dronevio estimate V1_02_medium --slam --map v1.map --save-map v1.map
      dronevio estimate V1_03_difficult --slam --map v1.map --localize-only
      dronevio evaluate V1_01_easy v101_map.tum
    """

    recording: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="RECORDING")]
    """Folder of EuRoC, TUM-VI, DSO or KITTI, bag of ROS 1 or ROS 2, or GoPro video."""
    out: Path = Path("estimate.tum")
    """TUM file to write."""
    strict: bool = False
    """Refuse a recording with defects: missing, damaged or unpaired images, time stamps that do not increase, gaps of
    the IMU, IMU samples that are not finite, and frames without IMU."""
    slam: bool = False
    """Build a map, recognize places and correct the odometry; write the corrected trajectories, too."""
    save_map: Path | None = None
    """File in which the final map is saved, with --slam. It may be that of --map, which is replaced at the end."""
    saved_map: Annotated[Path | None, tyro.conf.arg(name="map")] = None
    """File of a map that the flight continues, with --slam. The recording needs the same calibration."""
    localize_only: bool = False
    """Keep the map of --map as it is: its keyframes do not move, and it is not saved again."""
    save_g2o: Path | None = None
    """File in the format of g2o in which the final pose graph is written for other programs, with --slam."""
    save_colmap: Path | None = None
    """Folder to make, with --slam: the images of the keyframes in images, and a model of COLMAP with their poses and
    the landmarks of the map in sparse/0, from which COLMAP, nerfstudio and gaussian splatting start."""
    save_ply: Path | None = None
    """PLY file in which the landmarks of the final map are written with their gray values, with --slam."""
    imu_rate: Path | None = None
    """Second TUM file to write: one pose per IMU sample, propagated from the estimate of the newest frame before it."""
    reading: RecordingInput = field(default_factory=RecordingOptions)
    """How the recording is read."""
    output: Output = field(default_factory=OutputOptions)
    """How results are written and printed."""
    estimator: "VioConfig" = field(
        default_factory=ImportedSettings("dronevio.estimator.config", "VioConfig"), metadata=options_from(ESTIMATOR)
    )
    """Settings of the estimator."""
    map: "SlamConfig" = field(
        default_factory=ImportedSettings("dronevio.estimator.slam.config", "SlamConfig"), metadata=options_from(MAP)
    )
    """Settings of the map, with --slam."""
    changes: SettingsInput = field(default_factory=SettingsOptions)
    """Changes of settings."""


def map_rows(slam: "VisualSlam | None") -> tuple[tuple[str, str, str], ...]:
    """Return rows of names, values and units that describe the map; none without a map."""
    if slam is None:
        return ()
    summary, cost, final = slam.summary, slam.map_cost, slam.final_map()
    return (
        ("keyframes of the map", f"{summary.keyframes}", ""),
        ("loops", f"{summary.loops}", ""),
        ("rejected loops", f"{summary.rejected_loops}", ""),
        ("bundle adjustment of the map", (final.adjustment if final else "") or "–", ""),
        ("processor time of the map per frame", f"{cost.worker_cpu_ms_per_frame:.1f}", "ms"),
        ("frames that waited for the map", f"{cost.waits} of {cost.results} corrections", ""),
    )


def check_map_options(command: EstimateCommand) -> None:
    """Check that the options of saved maps agree.

    Raises:
        ConfigError: An option lacks the one that it needs, or contradicts another one.
    """
    from dronevio.models.errors import ConfigError

    if not command.slam:
        options = {
            "--save-map": command.save_map,
            "--save-g2o": command.save_g2o,
            "--save-colmap": command.save_colmap,
            "--save-ply": command.save_ply,
            "--map": command.saved_map,
        }
        for name, value in options.items():
            if value is not None:
                raise ConfigError(f"{name} without --slam; expected both")
    if command.localize_only and command.saved_map is None:
        raise ConfigError("--localize-only without --map; expected the file of a map")
    if command.localize_only and command.save_map is not None:
        raise ConfigError("--localize-only with --save-map; expected one of them, since the map stays as it is")


def slam_of(command: EstimateCommand, rig: "Rig") -> "VisualSlam":
    """Return visual SLAM before the first measurement, with the map of a command.

    Raises:
        ConfigError: The map cannot be used with the rig.
        InputError: The file of the map cannot be read.
    """
    from dronevio.estimator.slam.visual_slam import VisualSlam

    c = command
    return VisualSlam(rig, c.estimator, c.map, map=c.saved_map, localize_only=c.localize_only)


def _first_map_pose_s(run: "EstimatorRun") -> float | None:
    """Return the time from the first frame to the first pose in the map frame [s]; None without one."""
    first = next((e.t_ns for e in run.estimates if e.state is not None and e.T_map_odom is not None), None)
    return None if first is None else (first - int(run.t_ns[0])) * 1e-9


def _joined_rows(command: EstimateCommand, summary: dict[str, Any]) -> tuple[tuple[str, str, str], ...]:
    """Return a row that tells when a flight has a pose in a loaded map; none without one."""
    if command.saved_map is None:
        return ()
    first_s = summary["first_map_pose_s"]
    return (("first pose in the loaded map after", "never" if first_s is None else f"{first_s:.2f}", "s"),)


@dataclass(frozen=True, eq=False)
class Estimation:
    """What the command has estimated."""

    recording: "StoredRecording"
    """The recording that was read."""
    run: "EstimatorRun"
    """The run of the estimator, with the final map if there is one."""
    trajectory: "Trajectory"
    """The poses of the odometry."""
    slam: "VisualSlam | None"
    """The estimator with its map; None without a map."""
    imu_rate: "Trajectory | None"
    """The poses at the rate of the IMU; None if they are not asked for."""

    @property
    def trajectories(self) -> dict[str, "Trajectory"]:
        """The trajectories to write, by the keys of their files in the summary."""
        trajectories = {"estimate": self.trajectory}
        if self.slam is not None:
            trajectories["map_estimate"] = self.run.map_trajectory
            trajectories["final_map_estimate"] = self.trajectory if self.run.map is None else self.run.final_trajectory
        if self.imu_rate is not None:
            trajectories["imu_rate"] = self.imu_rate
        return trajectories


def main(arguments: Sequence[str]) -> int:
    """Run the command and return its exit code."""
    command = parse(EstimateCommand, arguments, "estimate")

    from dronevio.models.errors import ConfigError, EvaluationError
    from dronevio.models.reconstructions.formats import check_format

    check_map_options(command)
    check_places(command)  # before the estimator runs
    segments = opened(command)
    commands = [numbered(command, number) for number in range(1, len(segments) + 1)]
    for each in commands[1:]:
        check_places(each)
    if command.save_colmap is not None:
        check_format("colmap-binary", [camera.model for camera in segments[0].rig.cameras])
    summaries: list[dict[str, Any]] = []
    for of_segment, segment in zip(commands, segments, strict=True):
        try:
            estimation = estimated(of_segment, segment)
        except EvaluationError as error:
            if segment is segments[-1] and not any(each["poses"] for each in summaries):
                raise
            print_warning(str(error))
            summaries.append({"recording": str(command.recording), "poses": 0, "reason": str(error)})
            continue
        summaries.append(summary_of(of_segment, estimation))
        try:
            write_results(of_segment, estimation)
        except ConfigError as error:  # such as a map of too few keyframes
            if len(segments) == 1:
                raise
            print_warning(f"{segment.name}: {error}")
        if not command.output.json:
            print_estimation(of_segment, estimation, summaries[-1])
    if command.output.json:
        document = {"recording": str(command.recording), "segments": summaries}
        print_json(summaries[0] if len(segments) == 1 else document)
    return 0


def write_results(command: EstimateCommand, estimation: Estimation) -> None:
    """Write the files of the estimation of a segment, the trajectories first.

    Raises:
        ConfigError: The map is too small for a file, or has no keyframe of this flight.
        InputError: A file cannot be written.
    """
    from dronevio.cli.output_files import atomic_folder
    from dronevio.models.recordings.tum import write_tum

    places = result_files(command)
    for name, trajectory in estimation.trajectories.items():
        write_tum(places[name], trajectory)
    if estimation.slam is not None and command.save_map is not None:
        estimation.slam.save_map(command.save_map)
    if estimation.slam is not None and command.save_g2o is not None:
        estimation.slam.save_graph(command.save_g2o)
    if estimation.slam is not None and command.save_colmap is not None:
        with atomic_folder(command.save_colmap) as folder:
            estimation.slam.save_colmap(folder, estimation.recording)
    if estimation.slam is not None and command.save_ply is not None:
        estimation.slam.save_ply(command.save_ply, estimation.recording)


def print_estimation(command: EstimateCommand, estimation: Estimation, summary: dict[str, Any]) -> None:
    """Print the figures and the files of the estimation of a segment."""
    print_values(f"Estimate of {estimation.recording.name}", summary_rows(command, estimation, summary))
    if not estimation.recording.complete:
        print("The recording is incomplete: it was interrupted.")
    print(f"wrote {' and '.join(str(place) for place in result_files(command).values())}")
    if estimation.recording.ground_truth is not None:
        print(f"evaluate it:  {command_line('evaluate', command.recording, command.out)}")


def numbered(command: EstimateCommand, number: int) -> EstimateCommand:
    """Return the command with the files of a segment, counted from 1; those of the first have no number."""

    def of_segment(path: Path) -> Path:
        return path if number == 1 else path.with_stem(f"{path.stem}_{number}")

    return replace(
        command,
        out=of_segment(command.out),
        save_map=command.save_map and of_segment(command.save_map),
        save_g2o=command.save_g2o and of_segment(command.save_g2o),
        save_colmap=command.save_colmap and of_segment(command.save_colmap),
        save_ply=command.save_ply and of_segment(command.save_ply),
        imu_rate=command.imu_rate and of_segment(command.imu_rate),
    )


def result_files(command: EstimateCommand) -> dict[str, Path]:
    """Return the files and folders to write, by their keys in the summary."""
    files = {"estimate": command.out}
    if command.slam:
        files["map_estimate"] = command.out.with_stem(f"{command.out.stem}_map")
        files["final_map_estimate"] = command.out.with_stem(f"{command.out.stem}_map_final")
    if command.save_map is not None:
        files["saved_map"] = command.save_map
    if command.save_g2o is not None:
        files["g2o"] = command.save_g2o
    if command.save_colmap is not None:
        files["colmap"] = command.save_colmap
    if command.save_ply is not None:
        files["ply"] = command.save_ply
    if command.imu_rate is not None:
        files["imu_rate"] = command.imu_rate
    return files


def check_places(command: EstimateCommand) -> None:
    """Check that the files and folders of a command can be written. The map of --map may be saved in its file again.

    Raises:
        InputError: One of them cannot or exists, or the folder of --save-colmap exists and is not empty.
    """
    from dronevio.cli.output_files import require_free
    from dronevio.models.errors import InputError
    from dronevio.models.recordings.files import check_output_path

    for place in result_files(command).values():
        if place is not command.save_colmap or not place.exists():
            check_output_path(place)
            require_free(place, command.output.overwrite or place == command.saved_map)
        elif not place.is_dir() or any(place.iterdir()):
            raise InputError(place, "it exists already", "a new name for the folder of --save-colmap")


def opened(command: EstimateCommand) -> "tuple[StoredRecording, ...]":
    """Open the recording, print its defects and return its segments.

    Raises:
        InputError: It cannot be read; or it has defects, and ``--strict`` is set.
        ConfigError: An option does not fit it.
    """
    from dronevio.models.defects import refuse_defects
    from dronevio.models.recordings.segments import segments_of

    recording = command.reading.open(command.recording, repair=True)
    segments = segments_of(recording)
    defects = [defect for segment in segments for defect in segment.defects]
    if command.strict:
        refuse_defects(command.recording, defects)
        segments = (replace(recording, repair=False),)  # refuses damaged images when they are read
    print_defects(defects)
    return segments


def estimated(command: EstimateCommand, recording: "StoredRecording") -> Estimation:
    """Run the estimator on a recording, and print what it warns of.

    Raises:
        EvaluationError: There is no pose.
    """
    from dronevio.estimator.odometry import VisualInertialOdometry
    from dronevio.estimators.driver import ImuRateObserver, estimate_recording, require_poses

    config = command.estimator
    imu_rate = ImuRateObserver(recording.rig.imu, config.preintegration, config.gravity_m_s2)
    observers = () if command.imu_rate is None else (imu_rate,)
    with progress_bars(quiet=command.output.json) as bars:
        slam = slam_of(command, recording.rig) if command.slam else None
        estimator = slam or VisualInertialOdometry(recording.rig, config)
        run = estimate_recording(recording, estimator, bars.bar("estimating"), observers)
    run = run if slam is None else replace(run, map=slam.final_map())
    print_defects(run.defects[len(recording.defects) :])
    print_run_warnings(run)
    trajectory = require_poses(run, recording)
    return Estimation(recording, run, trajectory, slam, imu_rate.trajectory if observers else None)


def summary_of(command: EstimateCommand, estimation: Estimation) -> dict[str, Any]:
    """Return the figures of an estimation and the names of its files, for ``--json``."""
    from dronevio.models.defects import defect_values

    run, places = estimation.run, {name: str(place) for name, place in result_files(command).items()}
    summary: dict[str, Any] = {
        "recording": str(command.recording),
        "estimate": places.pop("estimate"),
        "complete": estimation.recording.complete,
        "defects": defect_values(run.defects),
        "cameras": len(estimation.recording.rig.cameras),
        "frames": len(run.estimates),
        "poses": len(estimation.trajectory),
        "health": {str(health): count for health, count in Counter(e.health for e in run.estimates).items()},
        "innovations": None if run.innovations is None else asdict(run.innovations),
        "warnings": [{"t_s": (t_ns - run.t_ns[0]) * 1e-9, "text": text} for t_ns, text in run.warnings],
        "first_pose_s": float((estimation.trajectory.t_ns[0] - run.t_ns[0]) * 1e-9),
        "path_m": estimation.trajectory.length_m,
        "cpu_ms_per_frame": float(run.cpu_ms.mean()),
        "real_time_factor": run.real_time_factor,
    }
    if estimation.slam is not None:
        cost = estimation.slam.map_cost
        summary |= {"map": asdict(estimation.slam.summary), "map_cost": asdict(cost)}
        summary["map_cpu_ms_per_frame"] = cost.worker_cpu_ms_per_frame
        summary["saved_map"] = None
        summary["first_map_pose_s"] = _first_map_pose_s(run)
    summary |= places
    if estimation.imu_rate is not None:
        summary["imu_rate_poses"] = len(estimation.imu_rate)
    return summary


def summary_rows(
    command: EstimateCommand, estimation: Estimation, summary: dict[str, Any]
) -> tuple[tuple[str, str, str], ...]:
    """Return rows of names, values and units that describe an estimation with its summary."""
    from dronevio.models.defects import count_defects

    run = estimation.run
    return (
        ("cameras", f"{summary['cameras']}", ""),
        ("frames", f"{summary['frames']}", ""),
        ("poses", f"{summary['poses']}", ""),
        *((f"frames {health}", f"{count}", "") for health, count in summary["health"].items()),
        *((f"defects: {each.kind}", f"{each.count}", "") for each in count_defects(run.defects)),
        ("first pose after", f"{summary['first_pose_s']:.2f}", "s"),
        ("length of the path", f"{summary['path_m']:.2f}", "m"),
        *map_rows(estimation.slam),
        *_joined_rows(command, summary),
        *(
            (label, "–" if value is None else format(value, form), unit)
            for label, value, form, unit in innovation_rows(run.innovations)
        ),
        ("processor time per frame", f"{summary['cpu_ms_per_frame']:.1f}", "ms"),
        (
            "duration of the flight / processor time",
            "–" if run.real_time_factor is None else f"{run.real_time_factor:.1f}",
            "",
        ),
    )
