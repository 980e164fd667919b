"""The steps of the command line as functions: simulate a flight, estimate its motion, reconstruct a scene from images.

`dronevio.evaluation` evaluates the estimate.
"""

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

from dronevio.estimator.array_store import ArrayStore
from dronevio.estimator.config import VioConfig
from dronevio.estimator.dense.config import DenseConfig
from dronevio.estimator.dense.finished import FinishedDepth
from dronevio.estimator.dense.pipeline import DenseResult, densify
from dronevio.estimator.odometry import VisualInertialOdometry
from dronevio.estimator.sfm.config import SfmConfig
from dronevio.estimator.sfm.model import KnownPoses
from dronevio.estimator.sfm.pipeline import SfmResult, reconstruct
from dronevio.estimator.sfm.workspace import Workspace
from dronevio.estimator.slam.visual_slam import VisualSlam
from dronevio.estimators.driver import TimedEstimator, estimate_recording
from dronevio.eval.run import EstimatorRun
from dronevio.models.errors import ConfigError, InputError
from dronevio.models.image_sets import ImageSet, open_images, with_earlier
from dronevio.models.progress import Progress, notebook_line
from dronevio.models.protocols import Estimator, Recording
from dronevio.models.reconstruction import Reconstruction
from dronevio.models.recordings.open import open_recording
from dronevio.models.recordings.segments import segments_of
from dronevio.models.rig import Rig
from dronevio.recording.recorder import record_closed_loop, record_flight
from dronevio.sfm_inputs import EarlierResult, read_earlier, read_poses, with_cameras_of
from dronevio.sim.closed_loop.settings import LoopSettings
from dronevio.sim.scenario import Scenario
from dronevio.sim.scenarios import scenario_named


def fly(
    scenario: str | Scenario, folder: str | Path, *, seed: int | None = None, workers: int | None = None
) -> Recording:
    """Simulate a flight, render its images and write the recording into a folder.

    Args:
        scenario: A scenario, or the name of one, such as ``"room"``.
        folder: Folder of the recording in the EuRoC layout; it is made if it does not exist.
        seed: Seed of a named scenario; its own by default.
        workers: Number of rendering processes; the number of cores by default.

    Returns:
        The recording.

    Raises:
        ConfigError: There is no such scenario, or its settings contradict each other.
        GraphicsError: There is no off-screen OpenGL.
        IncompleteError: An image cannot be written.
    """
    flown = scenario_named(scenario, seed) if isinstance(scenario, str) else scenario
    record_flight(flown, Path(folder), notebook_line("simulating"), notebook_line("rendering"), workers)
    return open_recording(Path(folder))


def fly_on_estimate(
    scenario: str | Scenario,
    folder: str | Path,
    estimator: Estimator | VioConfig | None = None,
    *,
    seed: int | None = None,
    latency: LoopSettings | None = None,
    slam: bool = False,
    progress: Progress | None = None,
) -> tuple[Recording, EstimatorRun]:
    """Simulate a flight whose controller receives the output of an estimator, and write the recording into a folder.

    Args:
        scenario: A scenario, or the name of one, such as ``"room"``.
        folder: Folder of the recording in the EuRoC layout; it is made if it does not exist.
        estimator: An estimator before its first measurement, or the settings of the visual-inertial odometry; by
            default the odometry with default settings.
        seed: Seed of a named scenario; its own by default.
        latency: Latencies of images and commands.
        slam: Whether the odometry builds a map; see `estimate`.
        progress: Called with the progress of the flight; by default, a notebook shows it.

    Returns:
        The recording, and the estimates of its frames with their cost.

    Raises:
        ConfigError: There is no such scenario, or its settings contradict each other; or `slam` with an estimator.
        GraphicsError: There is no off-screen OpenGL.
        IncompleteError: An image cannot be written.
    """
    flown = scenario_named(scenario, seed) if isinstance(scenario, str) else scenario
    chosen = _estimator(flown.rig, estimator, slam)
    timed = TimedEstimator(chosen)
    record_closed_loop(flown, Path(folder), timed, latency, progress or notebook_line("flying"))
    return open_recording(Path(folder)), _with_map(timed.run, chosen)


def estimate(
    recording: Recording | str | Path,
    estimator: Estimator | VioConfig | None = None,
    *,
    slam: bool = False,
    progress: Progress | None = None,
) -> EstimatorRun:
    """Estimate the motion of a recording, frame by frame.

    Args:
        recording: A recording, or the path of one, whose defects are listed in the result.
        estimator: An estimator before its first measurement, or the settings of the visual-inertial odometry; by
            default the odometry with default settings.
        slam: Whether the odometry builds a map and closes loops (`VisualSlam`). The result then has, beside the
            trajectory of the odometry, which stays as it is, `map_trajectory`, `final_trajectory` and `map`.
        progress: Called with the number of processed frames; by default, a notebook shows it.

    Returns:
        The estimates of all frames and their cost. Where the clock of the recording steps, they are those of the first
        segment, and `later` has the runs on the other ones.

    Raises:
        InputError: The recording cannot be read.
        ConfigError: An argument is of another type, the recording has no camera, `slam` with an estimator, or an
            estimator with a recording of several segments, of which each needs its own.
    """
    source = open_recording(Path(recording), repair=True) if isinstance(recording, str | Path) else recording
    if not hasattr(source, "rig"):
        raise ConfigError(f"estimate() of {type(source).__name__}; expected a recording or its path")
    if estimator is not None and not isinstance(estimator, VioConfig) and not hasattr(estimator, "add_frame"):
        raise ConfigError(f"estimate() with {estimator!r}; expected an estimator or a VioConfig")
    segments = segments_of(source)
    if len(segments) > 1 and estimator is not None and not isinstance(estimator, VioConfig):
        raise ConfigError(
            f"one estimator for the {len(segments)} segments of {source.name}; expected a VioConfig or None, or one of"
            " the segments, `recording` or one of `recording.later`"
        )
    runs = []
    for segment in segments:
        chosen = _estimator(segment.rig, estimator, slam)
        run = estimate_recording(segment, chosen, progress or notebook_line("estimating"))
        runs.append(_with_map(run, chosen))
    return replace(runs[0], later=tuple(runs[1:]))


def _estimator(rig: Rig, estimator: Estimator | VioConfig | None, slam: bool) -> Estimator:
    """Return an estimator as it is, or one of a rig: the odometry, or visual SLAM around it.

    Raises:
        ConfigError: Visual SLAM is asked for, and there is an estimator already.
    """
    if estimator is not None and not isinstance(estimator, VioConfig):
        if slam:
            found = type(estimator).__name__
            raise ConfigError(f"slam=True with an estimator of type {found}; expected a VioConfig or None beside it")
        return estimator
    return VisualSlam(rig, estimator) if slam else VisualInertialOdometry(rig, estimator)


def _with_map(run: EstimatorRun, estimator: Estimator) -> EstimatorRun:
    """Return a finished run with the final map, if its estimator has one."""
    return replace(run, map=estimator.final_map()) if isinstance(estimator, VisualSlam) else run


def sfm(
    images: ImageSet | str | Path,
    config: SfmConfig | None = None,
    *,
    workspace: str | Path | None = None,
    add_to: Reconstruction | str | Path | None = None,
    poses: KnownPoses | str | Path | None = None,
    strict: bool = False,
) -> SfmResult:
    """Reconstruct cameras and points from images alone (structure from motion).

    With GPS tags or ground control points, the world frame is east, north, up; `SfmResult.worlds` has its origin.

    Args:
        images: A set of images, or the path of a folder of images, a video or a recording.
        config: Settings.
        workspace: Folder in which features and matches are kept; with it, an interrupted reconstruction continues.
        add_to: An earlier reconstruction of some of the images, or the path of a result or of a model of COLMAP; the
            other images are added to it, and its world frame and scale stay.
        poses: Known poses of images, or the path of a trajectory of the IMU or of a model of COLMAP, whose poses are
            exact; they determine the world frame and the scale.
        strict: Whether a file that looks like an image but cannot be used is an error, and not only left out.

    Returns:
        The reconstructions, one for each component, and the numbers of features and matches.

    Raises:
        InputError: The path holds no images, or one of them cannot be used and `strict` is set.
        ConfigError: The earlier reconstruction contradicts the images, or has all of them.
    """
    opened = images if isinstance(images, ImageSet) else open_images(images)
    kept = Workspace(None if workspace is None else Path(workspace))
    if isinstance(poses, str | Path):
        opened = with_cameras_of(Path(poses), opened)
        poses = read_poses(Path(poses), opened)
    if add_to is None:
        return reconstruct(opened, config, kept, notebook_line, poses=poses, strict=strict)
    earlier = EarlierResult(add_to) if isinstance(add_to, Reconstruction) else read_earlier(Path(add_to))
    opened = with_earlier(opened, earlier.reconstruction.image_names, opened, is_one_source=True)
    return reconstruct(
        opened,
        config,
        kept,
        notebook_line,
        earlier=earlier.reconstruction,
        earlier_world=earlier.world,
        poses=poses,
        strict=strict,
    )


def dense(
    images: ImageSet | str | Path,
    reconstruction: SfmResult | Reconstruction,
    config: DenseConfig | None = None,
    *,
    workspace: str | Path | None = None,
    finished: Mapping[str, FinishedDepth] | None = None,
    with_texture: bool = False,
) -> DenseResult:
    """Compute the surfaces of a scene from images with known cameras (multi-view stereo).

    Args:
        images: A set of images, or the path of a folder of images, a video or a recording.
        reconstruction: The result of `sfm`, of which the component with the most images is used, or a reconstruction
            of another program; see `dronevio.models.read_reconstruction`.
        config: Settings.
        workspace: Folder in which depth maps are kept; with it, an interrupted computation continues.
        finished: Depth maps of an earlier result of some of the images, which are used again where the cameras have
            hardly moved: what `dronevio.estimator.dense.finished.read_finished` reads from an earlier workspace.
        with_texture: Whether the mesh gets a texture from the images, which GLB and OBJ files store.

    Returns:
        The points with normals and colours, a mesh, and the depth map of each image.

    Raises:
        InputError: The path holds no images, an image cannot be read, or no image is registered.
    """
    opened = images if isinstance(images, ImageSet) else open_images(images)
    if isinstance(reconstruction, SfmResult):
        if not reconstruction.reconstructions:
            raise InputError("images", "a reconstruction without components", "at least one registered image")
        reconstruction = reconstruction.reconstructions[0]
    store = ArrayStore(None if workspace is None else Path(workspace))
    return densify(
        opened,
        reconstruction,
        config,
        stages=notebook_line,
        store=store,
        finished=finished,
        with_texture=with_texture,
    )
