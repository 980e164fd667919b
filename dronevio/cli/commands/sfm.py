"""``dronevio sfm``: structure from motion, a reconstruction of a scene from images alone."""

import math
import shlex
import shutil
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import tyro

from dronevio.cli.options import Output, OutputOptions
from dronevio.cli.settings.changes import SettingsInput, SettingsOptions
from dronevio.cli.settings.option_tables import SFM, options_from
from dronevio.cli.terminal import command_line, parse, print_json, print_values, print_warning, progress_bars
from dronevio.estimator.sfm.config import SfmConfig
from dronevio.models.errors import ConfigError, InputError
from dronevio.models.ranges import Range, Settings

if TYPE_CHECKING:
    from dronevio.estimator.sfm.pipeline import SfmResult
    from dronevio.estimator.sfm.placement.world import WorldFrame
    from dronevio.models.camera import CameraModel
    from dronevio.models.geodesy import GeodeticPoint
    from dronevio.models.image_sets import ImageSet
    from dronevio.models.progress import Progress
    from dronevio.models.reconstruction import SelfCalibration

Format = Literal["colmap-binary", "colmap-text", "bundler", "ply", "nerfstudio", "openmvs"]

PAIR = 2
"""Number of images of a pair."""
MOST_WARNINGS = 5
"""Number of images that cannot be used of which each has a warning."""


@dataclass(frozen=True)
class SfmCommand(Settings):
    """Reconstruct cameras and points from images alone (structure from motion).

    IMAGES is a folder of photographs, a video or a recording, or a folder with the images of a rig: cam0, cam1 and
    so on, and their calibration rig.yaml, a camchain.yaml of Kalibr. Without a calibration, focal length and
    distortion are estimated, from EXIF data or a guess; the cameras of a recording are calibrated. The IMU of a
    recording, if the motion suffices, two or more cameras, or the GPS tags of photographs give a reconstruction in
    metres; otherwise its scale is arbitrary. With an IMU, z points up. With GPS tags, or ground control points in
    gcp.csv or gcp_list.txt beside the photographs, x points east, y north and z up (--set gps.use=off ignores both).
    The result is a folder with the reconstruction in each format, a report with pictures and a rerun file.

    An interrupted reconstruction continues where it stopped when the same command is repeated. Images are added to an
    earlier result with --add-to.

    Examples:
      dronevio sfm photographs
      dronevio sfm photographs --add-to runs/sfm-photographs --out house-2
      dronevio sfm photographs --camera per-image --masks masks --out house
      dronevio sfm flight.mp4 --every 10
      dronevio sfm recordings/room-v0-0 --frames 100
      dronevio sfm recordings/room-v0-0 --frames 100 --poses recordings/room-v0-0
      dronevio sfm V1_01_easy --cameras 0 1 --frames 100 --pairs.overlap 20 --format colmap-text
    """

    images: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="IMAGES")]
    """Folder of images, video, or recording (folder of a data set, or bag)."""
    out: Path | None = None
    """Folder to make; runs/sfm-NAME by default."""
    format: tuple[Format, ...] = ("colmap-binary", "ply")
    """Formats of the reconstruction: COLMAP's binary or text model, Bundler's file, the points as PLY, a folder of
    nerfstudio (transforms.json), a scene of OpenMVS with undistorted images."""
    camera: Literal["shared", "per-image"] | None = None
    """For folders: whether images of one size and lens share a camera, as by default, or each has its own."""
    calibration: Path | None = None
    """For folders and videos: calibration of the camera, a Kalibr camchain.yaml or a recording; it stays fixed."""
    lens: Literal["pinhole", "fisheye"] | None = None
    """For folders and videos without a calibration: kind of the lens, a pinhole by default. Focal length and distortion
    are estimated: two coefficients of a pinhole with radial distortion, four of an equidistant fisheye."""
    masks: Path | None = None
    """Folder of masks with the names of the images, or one mask for all; no features are detected where it is black."""
    every: Annotated[int | None, Range(low=1)] = None
    """For videos: distance between the frames to use."""
    cameras: tuple[str, ...] | None = None
    """Cameras to use, by index or name: 0 or cam0, 1 or cam1, and so on. Of a recording the first is used by default,
    of a folder of a rig all are."""
    frames: Annotated[int | None, Range(low=1)] = None
    """For recordings: number of frames to use, spread evenly; all by default."""
    add_to: Path | None = None
    """Result of an earlier ``dronevio sfm``, or model of COLMAP, to which the images that it lacks are added. Its world
    frame and its scale stay; its cameras are adjusted again. IMAGES contains its images, too, or --earlier-images."""
    earlier_images: Path | None = None
    """With --add-to: folder, video or recording of the images of the earlier result; IMAGES by default."""
    poses: Path | None = None
    """Known poses of images: a trajectory (TUM or EuRoC), a recording with ground truth, or a model of COLMAP. They
    determine the world frame and the scale; images without one are registered as usual."""
    poses_of: Literal["imu", "camera"] | None = None
    """Whether a trajectory of --poses is that of the IMU, the default for recordings, or of the camera."""
    pose_sigma_m: Annotated[float, Range(low=0.0)] = 0.0
    """Standard deviation of the positions of --poses [m]; 0 for exact poses, which stay fixed."""
    pose_sigma_deg: Annotated[float, Range(low=0.0)] = 0.0
    """Standard deviation of the rotations of --poses [deg]; 0 for exact poses, which stay fixed."""
    strict: bool = False
    """Whether files that look like images but cannot be used are an error, and not only left out."""
    output: Output = field(default_factory=OutputOptions)
    """How the result is written and printed."""
    sfm: Annotated[SfmConfig, tyro.conf.arg(name="")] = field(default_factory=SfmConfig, metadata=options_from(SFM))
    """Settings of the reconstruction."""
    changes: SettingsInput = field(default_factory=SettingsOptions)
    """Changes of settings."""


def main(arguments: Sequence[str]) -> int:
    """Run the command and return its exit code."""
    command = parse(SfmCommand, arguments, "sfm")
    of_poses = ("poses_of", "pose_sigma_m", "pose_sigma_deg")
    unused = [f"--{name.replace('_', '-')}" for name in of_poses if getattr(command, name)]
    if unused and command.poses is None:
        raise ConfigError(f"{' and '.join(unused)} without --poses; expected --poses, too")

    from dronevio.cli.output_files import atomic_folder, require_free, resumable
    from dronevio.estimator.sfm.earlier import earlier_cameras
    from dronevio.estimator.sfm.pipeline import reconstruct
    from dronevio.estimator.sfm.workspace import Workspace
    from dronevio.models.reconstructions.formats import check_format
    from dronevio.sfm_inputs import read_earlier, read_poses, with_cameras_of

    target = command.out or Path("runs") / f"sfm-{command.images.resolve().stem}"
    require_free(target, command.output.overwrite)  # before the images are read
    earlier = None if command.add_to is None else read_earlier(command.add_to)
    images = _open(command, () if earlier is None else earlier.reconstruction.image_names)
    if command.poses is not None:
        images = with_cameras_of(command.poses, images)
    cameras = images.cameras if earlier is None else earlier_cameras(images, earlier.reconstruction)
    for kind in command.format:  # before the reconstruction, which may take hours
        check_format(kind, cameras, images.names)
    sigmas = command.pose_sigma_m, math.radians(command.pose_sigma_deg)
    poses = None if command.poses is None else read_poses(command.poses, images, command.poses_of, *sigmas)
    work = target.absolute().with_name(f".{target.name}.work")
    with resumable(work, "steps"), atomic_folder(target, command.output.overwrite, mark="report.json") as folder:
        with progress_bars(quiet=command.output.json) as bars:
            result = reconstruct(
                images,
                command.sfm,
                Workspace(work),
                bars.bar,
                earlier=None if earlier is None else earlier.reconstruction,
                earlier_world=None if earlier is None else earlier.world,
                poses=poses,
                strict=command.strict,
            )
        left_out = _left_out(images, result)
        _print_left_out(left_out)
        if not result.reconstructions:
            shutil.rmtree(work, ignore_errors=True)
            count = len(images.names)
            raise InputError(
                command.images,
                "one image" if count == 1 else f"{count} images, no two of which determine the motion of a camera",
                "images of one scene that overlap, from different positions",
            )
        with progress_bars(quiet=command.output.json) as bars:
            _write(folder, target, command, arguments, images, result, left_out, bars.bar("writing"))
    shutil.rmtree(work, ignore_errors=True)
    if command.output.json:
        print_json(_summary(target, images, result) | {"left_out": left_out})
        return 0
    _print(target, images, result, left_out)
    _print_doubts(images, result)
    return 0


def _open(command: SfmCommand, earlier: tuple[str, ...]) -> "ImageSet":
    """Return the images of the command, together with those of an earlier result by their names."""
    from dronevio.models.errors import ConfigError
    from dronevio.models.image_sets import open_images, with_earlier

    if command.earlier_images is not None and command.add_to is None:
        raise ConfigError("--earlier-images without --add-to; expected both")
    options: dict[str, Any] = {
        "camera": command.camera,
        "model": None if command.calibration is None else _calibrated(command.calibration),
        "masks": command.masks,
        "cameras": command.cameras,
        "lens": {None: None, "pinhole": "radtan", "fisheye": "equidistant"}[command.lens],
    }
    images = open_images(command.images, **options, every=command.every, frames=command.frames)
    if command.add_to is None:
        return images
    is_one_source = command.earlier_images is None
    available = open_images(command.earlier_images or command.images, **options)
    return with_earlier(images, earlier, available, is_one_source)


def _calibrated(path: Path) -> "CameraModel":
    """Return the model of the first camera of a calibration, a file or a recording."""
    from dronevio.models.recordings.calibration.reading import read_cameras
    from dronevio.models.recordings.open import is_bag, read_rig

    return (read_rig(path).cameras if path.is_dir() or is_bag(path) else read_cameras(path))[0].model


def _write(
    folder: Path,
    target: Path,
    command: SfmCommand,
    arguments: Sequence[str],
    images: "ImageSet",
    result: "SfmResult",
    left_out: dict[str, str],
    progress: "Progress",
) -> None:
    """Write the reconstruction, its report and its rerun file."""
    from dronevio import __version__
    from dronevio.eval.provenance import RunInfo
    from dronevio.eval.report.reconstruction import ReconstructionResults, write_reconstruction_report
    from dronevio.eval.rerun.reconstruction import write_reconstruction_rerun
    from dronevio.exports import write_component
    from dronevio.models.image_sets.source import ImageSource, write_image_source
    from dronevio.models.serialization import to_jsonable

    sources = [path for path in (command.images, command.earlier_images) if path is not None and path.is_dir()]
    total = len(command.format) + 2
    for done, kind in enumerate(command.format):
        progress(done, total)
        for number, (each, world) in enumerate(zip(result.reconstructions, result.worlds, strict=True)):
            has_mounting = world.scale == "rig"
            write_component(folder, kind, number, each, images, sources=sources, has_mounting=has_mounting)
    source = ImageSource(command.images, command.earlier_images, command.masks, command.cameras)
    write_image_source(folder / "images.json", source)
    read = _reader(images)
    registered = {name for reconstruction in result.reconstructions for name in reconstruction.image_names}
    info = RunInfo(
        title=f"Structure from motion: {command.images.name}",
        command=shlex.join(["dronevio", "sfm", *arguments]),
        open_command=command_line("view", target),
        configuration={"dronevio": __version__, "sfm": to_jsonable(command.sfm)},
    )
    results = ReconstructionResults(
        components=result.reconstructions,
        all_image_names=images.names,
        unregistered={name: _reason(result, i) for i, name in enumerate(images.names) if name not in registered}
        | left_out,
        times_s=result.times_s,
        match_counts=result.match_counts,
        read_image=read,
        unit="m" if result.is_metric else "",
        up=_up(result),
        calibrations=result.calibrations,
        origin=_origin(result),
        georeferences=tuple(world.geo for world in result.worlds),
    )
    if results.origin is not None:
        _write_places(folder, result, results.origin, target.name)
    progress(total - 2, total)
    write_reconstruction_report(folder, info, results)
    progress(total - 1, total)
    write_reconstruction_rerun(result.reconstructions, folder / "run.rrd", read, up=results.up, name=target.name)
    progress(total, total)


def _write_places(folder: Path, result: "SfmResult", origin: "GeodeticPoint", name: str) -> None:
    """Write the positions on Earth of the cameras that have one."""
    from dronevio.models.reconstructions.geographic import write_cameras_geojson, write_cameras_kml

    placed = [r for r, world in zip(result.reconstructions, result.worlds, strict=True) if world.origin is not None]
    write_cameras_geojson(folder / "cameras.geojson", placed, origin)
    write_cameras_kml(folder / "cameras.kml", placed, origin, name)


def _up(result: "SfmResult") -> Any:
    """Return the up direction (3,) of the world frames, None if it is not known in all of them."""
    import numpy as np

    return np.array([0.0, 0.0, 1.0]) if all(world.is_vertical for world in result.worlds) else None


def _origin(result: "SfmResult") -> "GeodeticPoint | None":
    """Return where the origin of the world frame of the first component is on Earth, None if it is not known."""
    return result.worlds[0].origin if result.worlds else None


def _reader(images: "ImageSet") -> Callable[[str], Any]:
    """Return a function that reads an image by its name."""
    index = {name: i for i, name in enumerate(images.names)}
    return lambda name: images.read(index[name])


def _left_out(images: "ImageSet", result: "SfmResult") -> dict[str, str]:
    """Return why images are not used: the files that were skipped, and those that could not be decoded."""
    unreadable = {images.names[i]: str(error) for i, error in result.unreadable.items()}
    return {name: str(error) for name, error in images.skipped.items()} | unreadable


def _print_left_out(left_out: dict[str, str]) -> None:
    """Print a warning for each of the first images that are not used, and their number."""
    for reason in list(left_out.values())[:MOST_WARNINGS]:
        print_warning(reason)
    if len(left_out) > MOST_WARNINGS:
        print_warning(f"{len(left_out) - MOST_WARNINGS} more images cannot be used; the report names them")


def _reason(result: "SfmResult", image: int) -> str:
    """Return why an image is not registered."""
    if result.feature_counts[image] == 0:
        return "no features"
    if not result.match_counts[image].any():
        return "no verified matches with another image"
    return "too few of its features belong to points of the reconstruction"


def _summary(target: Path, images: "ImageSet", result: "SfmResult") -> dict[str, Any]:
    from dronevio.eval.metrics.reconstruction import reconstruction_statistics
    from dronevio.models.serialization import to_jsonable

    statistics = to_jsonable(reconstruction_statistics(result.reconstructions, len(images.names)))
    assert isinstance(statistics, dict)
    worlds = to_jsonable(result.worlds)
    pairs = sum(len(reconstruction.image_names) == PAIR for reconstruction in result.reconstructions)
    cameras = [
        {"component": number, **_camera_values(camera, calibration)}
        for number, (reconstruction, calibrations) in enumerate(
            zip(result.reconstructions, result.calibrations, strict=True), start=1
        )
        for camera, calibration in zip(reconstruction.cameras, calibrations, strict=True)
    ]
    summary = {"out": str(target), **statistics, "pairs": pairs, "metric": result.is_metric, "worlds": worlds}
    return summary | {"cameras": cameras, "times_s": result.times_s}


def _camera_values(camera: "CameraModel", calibration: "SelfCalibration | None") -> dict[str, Any]:
    """Return the focal length and the distortion of a camera for JSON, and the standard deviations of estimates."""
    return {
        "f_px": math.sqrt(camera.fx * camera.fy),
        "distortion": camera.distortion,
        "sigmas": None if calibration is None else calibration.sigmas,
        "held": None if calibration is None else calibration.held,
    }


def _print_doubts(images: "ImageSet", result: "SfmResult") -> None:
    """Warn of what the images do not determine."""
    largest = result.reconstructions[0]
    if len(largest.image_names) == PAIR < len(images.names):
        print_warning(
            f"only pairs of the {len(images.names)} images were reconstructed, which determine no scene;"
            " expected three or more images that overlap"
        )
    for camera, calibration in zip(largest.cameras, result.calibrations[0], strict=True):
        if calibration is not None and "f" in calibration.held:
            print_warning(
                f"the images do not determine the focal length: {camera.fx:.0f} px is a guess, and so are angles and"
                " proportions; a calibration of the camera (--calibration), or images in other directions, determine it"
            )
            break


def _calibration_values(result: "SfmResult") -> list[tuple[str, str, str]]:
    """Return the rows of the table about the first camera of the first component, if it was estimated."""
    camera, calibration = result.reconstructions[0].cameras[0], result.calibrations[0][0]
    if calibration is None or "f" not in calibration.sigmas:
        return []
    return [("focal length (first camera)", f"{camera.fx:.1f} ± {calibration.sigmas['f']:.1f}", "px")]


def _world_values(world: "WorldFrame", images: "ImageSet") -> list[tuple[str, str, str]]:
    """Return the rows of the table about the world frame of the first component."""
    import numpy as np

    sources = {
        "rig": "metric (baselines of the rig)",
        "imu": "metric (IMU)",
        "poses": "metric (known poses)",
        "gps": "metric (GPS)",
        "control points": "metric (control points)",
        "gps and control points": "metric (GPS and control points)",
    }
    scale = sources.get(world.scale, "as in the earlier result" if world.scale == "earlier" else world.scale)
    rows = [("scale", scale, "")]
    if world.imu is not None and world.scale == "imu":
        rows.append(("scale, standard deviation", f"{100.0 * world.imu.scale_sigma:.2f}", "%"))
    if world.imu is not None and world.is_vertical:
        rows.append(("gravity, standard deviation", f"{np.degrees(world.imu.tilt_sigma_rad):.3f}", "°"))
    if world.geo is not None:
        geo = world.geo
        outliers = int(geo.is_outlier.sum() + geo.point_is_outlier.sum())
        rows += [
            ("scale, standard deviation", f"{100.0 * geo.scale_sigma:.2f}", "%"),
            ("north, standard deviation", f"{np.degrees(geo.north_sigma_rad):.3f}", "°"),
            ("vertical, standard deviation", f"{np.degrees(geo.tilt_sigma_rad):.3f}", "°"),
            ("measured positions", f"{len(geo.image_names) + len(geo.point_names)}, outliers {outliers}", ""),
            *((("left out"), note, "") for note in geo.notes),
        ]
    if world.origin is not None:
        place = f"{world.origin.latitude_deg:.6f}°, {world.origin.longitude_deg:.6f}°, {world.origin.altitude_m:.1f} m"
        rows.append(("origin of east, north, up", f"{place} ({world.origin.reference})", ""))
    what = "IMU" if world.imu is not None or images.inertial is not None else "positions"
    return [*rows, (f"{what} not used", world.note, "")] if world.note else rows


def _components(result: "SfmResult") -> str:
    """Return the number of components; two images are a pair."""
    pairs = sum(len(reconstruction.image_names) == PAIR for reconstruction in result.reconstructions)
    larger = len(result.reconstructions) - pairs
    if not pairs:
        return f"{larger}"
    of_two = "1 pair" if pairs == 1 else f"{pairs} pairs"
    return f"{larger}, and {of_two} of images" if larger else f"none; {of_two} of images"


def _print(target: Path, images: "ImageSet", result: "SfmResult", left_out: dict[str, str]) -> None:
    from dronevio.eval.metrics.reconstruction import reconstruction_statistics

    statistics = reconstruction_statistics(result.reconstructions, len(images.names))
    print_values(
        "Structure from motion",
        (
            ("images registered", f"{statistics.registered_images} of {statistics.images}", ""),
            *([("files that cannot be used", f"{len(left_out)}", "")] if left_out else []),
            ("components", _components(result), ""),
            ("points", f"{statistics.points}", ""),
            ("observations", f"{statistics.observations}", ""),
            ("mean track length", f"{statistics.mean_track_length:.2f}", "images"),
            ("reprojection error, median", f"{statistics.error_median_px:.2f}", "px"),
            ("reprojection error, RMS", f"{statistics.error_rms_px:.2f}", "px"),
            *_calibration_values(result),
            *_world_values(result.worlds[0], images),
            *((stage, f"{seconds:.1f}", "s") for stage, seconds in result.times_s.items()),
        ),
    )
    print(f"report:   {target}/report.html")
    print(f"open it:  {command_line('view', target)}")
